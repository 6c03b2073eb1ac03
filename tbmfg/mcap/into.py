"""A trajectory into a copy of the recording that it was estimated from."""

from __future__ import annotations

import heapq
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.records import Message as Record
from mcap.writer import CompressionType, Writer

from tbmfg.errors import LogError
from tbmfg.mcap.layouts import BYTE_ORDER, ENCAPSULATION
from tbmfg.mcap.reader import recording_files
from tbmfg.mcap.schemas import definition
from tbmfg.mcap.trajectory import trajectory_messages
from tbmfg.mcap.writer import replacing
from tbmfg.state import Trajectory
from tbmfg.timeseries import NS

OURS = -1  # in place of the number of a source file
DELAYS = 1000  # messages that the delay between stamps and log times is judged on


def write_into(
    source: str | os.PathLike, target: str | os.PathLike, trajectory: Trajectory, stamped_topic: str
) -> None:
    """Copy the recording ``source`` to the file ``target`` and add odometry and path, on topics of their own.

    Every message of the source is kept byte for byte with its times, sequence number, schema and channel; so are
    attachments and metadata. The added ones are logged as much later than their stamps as the messages of
    ``stamped_topic`` are. Raises LogError where a file is damaged (nothing is left out of a copy), where the topics
    exist already, and where the target cannot be written.
    """
    with copying(source, target) as copy:
        types, streams = trajectory_messages(trajectory, delay_ns=_delay_ns(copy.files, stamped_topic))
        ours = heapq.merge(*streams, key=lambda message: message[0])
        added = ((log_ns, OURS, (topic, payload)) for log_ns, topic, payload in ours)
        for log_ns, number, what in heapq.merge(records(copy.files), added, key=lambda one: one[0]):
            if number == OURS:
                copy.add(types[what[0]], log_ns, *what)
            elif what[1].topic in types:
                raise LogError(f"{source}: holds {what[1].topic} already; give the recording without it")
            else:
                copy.keep(number, *what)


@contextmanager
def copying(source: str | os.PathLike, target: str | os.PathLike) -> Iterator[Copy]:
    """A copy of the recording ``source``, to be given its messages; its attachments and metadata come last, and the
    file ``target`` appears when it is complete. Errors as in :func:`write_into`."""
    files, target = recording_files(source), Path(target)
    if target.suffix != ".mcap":
        raise LogError(f"{target}: the copy is one file; give it a name that ends in .mcap")
    if any(target.exists() and target.samefile(file) for file in files):
        raise LogError(f"{target}: is the recording itself; give the copy another name")
    try:
        with replacing(target) as temporary, open(temporary, "wb") as file:
            copy = Copy(file, files)
            yield copy
            copy.close()
    except OSError as error:
        raise LogError(f"{target}: cannot be written ({error.strerror}); check the folder and its free space") from None
    except (McapError, zstandard.ZstdError, RuntimeError, struct.error, ValueError) as error:
        raise LogError(f"{source}: damaged ({error}); a copy would not be whole, so none is made") from error


class Copy:
    """The new file of the recording ``files``: channels of the sources as they were, one per file and id, and ours."""

    def __init__(self, file: Any, files: list[Path]) -> None:
        self.files = files
        self.writer = Writer(file, compression=CompressionType.ZSTD)
        self.writer.start(profile="ros2", library="tbmfg")
        self._channels: dict[tuple[int, int], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._ours: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def keep(self, number: int, schema: Schema | None, channel: Channel, record: Record) -> None:
        """A message of the source file ``number``."""
        key = number, channel.id
        if key not in self._channels:
            schema_id = self._schema(schema.name, schema.encoding, schema.data) if schema else 0
            self._channels[key] = self.writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
            )
        self.writer.add_message(self._channels[key], record.log_time, record.data, record.publish_time, record.sequence)

    def add(self, type: str, log_ns: int, topic: str, payload: bytes) -> None:
        """A message of ours."""
        if topic not in self._ours:
            schema_id = self._schema(type, "ros2msg", definition(type).encode())
            self._ours[topic] = self.writer.register_channel(topic, "cdr", schema_id, {"offered_qos_profiles": ""})
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self.writer.add_message(self._ours[topic], log_ns, payload, log_ns, sequence)

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        if (name, encoding, data) not in self._schemas:
            self._schemas[name, encoding, data] = self.writer.register_schema(name, encoding, data)
        return self._schemas[name, encoding, data]

    def attach(self, name: str, data: bytes) -> None:
        """An attachment of ours."""
        self.writer.add_attachment(0, 0, name, "application/octet-stream", data)

    def close(self) -> None:
        """Attachments and metadata, then the index."""
        for path in self.files:
            with open(path, "rb") as file:
                reader = make_reader(file)
                for one in reader.iter_attachments():
                    self.writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
                for record in reader.iter_metadata():
                    self.writer.add_metadata(record.name, record.metadata)
        self.writer.finish()


def records(files: list[Path]) -> Iterator[tuple[int, int, tuple[Schema | None, Channel, Record]]]:
    """Every message of the recording by log time: (log time, number of its file, what was read)."""

    def of(number: int, path: Path) -> Iterator[tuple[int, int, tuple[Schema | None, Channel, Record]]]:
        with open(path, "rb") as file:
            for schema, channel, record in make_reader(file, validate_crcs=True).iter_messages():
                yield record.log_time, number, (schema, channel, record)

    return heapq.merge(*(of(number, path) for number, path in enumerate(files)), key=lambda one: one[0])


def _delay_ns(files: list[Path], topic: str) -> int:
    """Median of log time less header stamp over the first messages of ``topic``; 0 without any."""
    delays: list[int] = []
    for path in files:
        with open(path, "rb") as file:
            for _, _, record in make_reader(file).iter_messages([topic]):
                order = BYTE_ORDER.get(bytes(record.data[:2]))
                if order is not None and len(record.data) >= ENCAPSULATION + 8:
                    sec, nanosec = struct.unpack_from(f"{order}iI", record.data, ENCAPSULATION)
                    delays.append(record.log_time - (sec * NS + nanosec))
                if len(delays) == DELAYS:
                    return int(np.median(delays))
    return int(np.median(delays)) if delays else 0
