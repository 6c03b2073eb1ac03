"""MCAP file or rosbag2 folder -> Log."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import numpy as np
import yaml
from mcap.records import Channel, ChunkIndex
from numpy.typing import NDArray

from tbmfg.errors import LogError
from tbmfg.mcap import clouds
from tbmfg.mcap.container import Block, McapFile
from tbmfg.mcap.layouts import LAYOUTS
from tbmfg.mcap.records import walk
from tbmfg.mcap.schemas import full_name
from tbmfg.mcap.stamps import eras
from tbmfg.mcap.streams import TRANSFORMS, CloudStream, SeriesStream, Stream, TransformStream
from tbmfg.storage import Place, is_folder, place
from tbmfg.timeseries import NS, Log, Times

_SCHEMA_ENCODINGS = ("ros2msg", "ros2idl")


Topics = Collection[str] | Callable[[str], bool] | None


@dataclass(slots=True)
class Wanted:
    """The part of a recording that is read; see :func:`read_log`. ``origin_ns`` is the first log time, once known."""

    topics: Topics = None
    start_s: float | None = None
    end_s: float | None = None
    leave: Collection[str] = ()
    origin_ns: int | None = None

    def topic(self, name: str) -> bool:
        if self.topics is None:
            return True
        return self.topics(name) if callable(self.topics) else name in self.topics

    def begins(self, log_ns: Collection[int]) -> None:
        """Log times among which is the first of the recording; of later files and blocks they count no more."""
        if self.origin_ns is None and len(log_ns):
            self.origin_ns = int(min(log_ns))

    @property
    def window(self) -> tuple[float, float] | None:
        """Log times in ns that the window begins and ends at; None where there is none."""
        if self.origin_ns is None or (self.start_s is None and self.end_s is None):
            return None
        first, last = self.start_s or 0.0, np.inf if self.end_s is None else self.end_s
        return self.origin_ns + round(first * NS), self.origin_ns + (last * NS if last == np.inf else round(last * NS))

    def inside(self, log_ns: Times) -> NDArray[np.bool_]:
        first, last = self.window
        return (log_ns >= first) & (log_ns < last)

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        if self.window is None:
            return True
        first, last = self.window
        return last_ns >= first and first_ns < last


@dataclass(slots=True)
class Recording:
    """All messages of a recording by topic, before they are sorted and cleaned."""

    path: str
    streams: dict[str, Stream] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    messages: int = 0

    def log(self) -> Log:
        streams = self.streams.values()
        undecoded = [s for s in streams if isinstance(s, TransformStream) and s.undecodable]
        starts = eras(s.stamps()[0] for s in streams)
        return Log(
            self.path,
            {s.topic: s.series(starts) for s in streams if isinstance(s, SeriesStream)},
            {s.topic: s.clouds(starts) for s in streams if isinstance(s, CloudStream)},
            tuple(t for s in streams if isinstance(s, TransformStream) for t in s.transforms()),
            self.attachments,
            self.unknown,
            (*self.damage, *(f"{s.topic}: messages that cannot be decoded: {s.undecodable}" for s in undecoded)),
            self.unread,
        )


def read_log(
    path: str | os.PathLike,
    topics: Topics = None,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    leave: Collection[str] = (),
    progress: Callable[[float], None] | None = None,
) -> Log:
    """A recording in columns: ``path`` is an .mcap file or a rosbag2 folder with metadata.yaml, here or at a URL.

    With ``topics``, names or what tells them, only these become series and clouds, and ``Log.unread`` lists the others;
    static transforms and attachments are always read. ``start_s`` and ``end_s`` keep the messages logged between, in
    seconds from the first message of the recording. Chunks that hold nothing of this are not even unpacked. Columns
    named in ``leave`` are not kept.

    ``progress`` is called with the fraction done, 0 to 1. Damaged parts are skipped and described in
    ``Log.damage``. Raises LogError where nothing can be read.
    """
    return scan(path, Wanted(topics, start_s, end_s, leave), progress).log()


def scan(
    path: str | os.PathLike,
    wanted: Wanted | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """One pass over all files of a recording; errors as ``read_log``."""
    wanted = wanted or Wanted()
    recording = Recording(str(path))
    files = recording_files(path)
    sizes = [file.stat().st_size if file.is_file() else 0 for file in files]
    for number, file in enumerate(files):
        try:
            mcap = McapFile(file)
        except LogError as error:
            if len(files) == 1:
                raise
            recording.damage.append(str(error))
            continue
        with mcap:
            distributor = _Distributor(recording, mcap, wanted)
            for block in mcap.blocks(distributor.holds_any):
                distributor.take(block)
                if progress:
                    progress((sum(sizes[:number]) + mcap.position) / sum(sizes))
            distributor.finish()
    if not recording.messages and wanted.window and wanted.origin_ns is not None:
        first, last = wanted.start_s or 0.0, np.inf if wanted.end_s is None else wanted.end_s
        raise LogError(
            f"{path}: no message between {first:g} and {last:g} s of the log; tbmfg info says how long it is"
        )
    if not recording.messages:
        reasons = recording.damage[:4] + ["..."] * (len(recording.damage) > 4)
        raise LogError("; ".join([f"{path}: no message could be read from {sum(sizes)} bytes", *reasons]))
    if progress:
        progress(1.0)
    return recording


def read_attachments(path: str | os.PathLike | Place) -> dict[str, bytes]:
    """The attachments that the summaries of a recording list, without reading anything else; errors as ``read_log``."""
    found: dict[str, bytes] = {}
    for file in recording_files(path):
        with McapFile(file) as mcap:
            found |= mcap.listed_attachments()
    return found


def recording_files(path: str | os.PathLike | Place) -> list[Place]:
    """The MCAP files of a recording in order. Raises LogError for a folder that is not a rosbag2 recording."""
    path = place(path)
    if not is_folder(path):
        return [path]
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        count = len(list(path.glob("*.mcap")))
        raise LogError(f"{path}: a folder without metadata.yaml ({count} .mcap files in it); name one of the files")
    try:
        info = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
        names = [str(name) for name in info["relative_file_paths"]]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
        raise LogError(
            f"{metadata}: not a rosbag2 description ({type(error).__name__}: {str(error).splitlines()[0]}); "
            "rebuild it with: ros2 bag reindex"
        ) from None
    storage = info.get("storage_identifier", "mcap")
    if storage != "mcap" or info.get("compression_mode"):
        packed = f", compressed by {info['compression_mode']}" if info.get("compression_mode") else ""
        raise LogError(f"{path}: storage {storage}{packed}; convert it to plain mcap with: ros2 bag convert")
    if not names:
        raise LogError(f"{metadata}: names no files; rebuild it with: ros2 bag reindex")
    # Early rosbag2 wrote the folder's own name into the paths.
    return [path / name if (path / name).exists() else path / PurePosixPath(name).name for name in names]


class _Distributor:
    """Hands the messages of one file to the streams of their topics."""

    def __init__(self, recording: Recording, mcap: McapFile, wanted: Wanted) -> None:
        self._recording = recording
        self._mcap = mcap
        self._wanted = wanted
        wanted.begins([chunk.message_start_time for chunk in mcap.index.values() if chunk.message_end_time])
        self._streams: dict[int, Stream | None] = {}  # by channel; None: its messages are passed over
        self._undeclared: Counter[int] = Counter()

    def holds_any(self, chunk: ChunkIndex) -> bool:
        """Whether an indexed chunk may hold anything that is wanted."""
        channels = {number: self._mcap.channels.get(number) for number in chunk.message_index_offsets}
        if not channels or None in channels.values() or any(map(self._static, channels)):
            return True
        inside = self._wanted.overlaps(chunk.message_start_time, chunk.message_end_time)
        for number, channel in channels.items():
            if number not in self._streams:  # so that a topic is known, or listed as unread, wherever it is
                self._streams[number] = self._open(channel)
        return inside and any(self._streams[number] is not None for number in channels)

    def take(self, block: Block) -> None:
        """All messages of a block; declarations among them go to the file."""
        channels, entries, others, at = walk(block.data)
        self._wanted.begins(entries.log_ns)
        for opcode, start, stop in others:
            self._mcap.declare(opcode, block.data[start:stop])
        if at < len(block.data) and block.whole:
            self._note(f"{len(block.data) - at} bytes in the chunk at byte {block.chunk} are no records; skipped")
        for channel in np.unique(channels).tolist():
            messages = entries.select(channels == channel)
            if self._wanted.window is not None and not self._static(channel):
                messages = messages.select(self._wanted.inside(messages.log_ns))
            if channel not in self._mcap.channels:
                self._undeclared[channel] += len(messages.log_ns)
                continue
            if self._wanted.window is None or not self._static(channel):
                self._recording.messages += len(messages.log_ns)
            if channel not in self._streams:
                self._streams[channel] = self._open(self._mcap.channels[channel])
            stream = self._streams[channel]
            if stream:
                stream.take(block, self._mcap.path, messages)

    def finish(self) -> None:
        """Hand on what concerns the file as a whole."""
        for channel, count in self._undeclared.items():
            self._note(f"{count} messages of channel {channel}, which is declared nowhere, skipped")
        self._recording.attachments |= self._mcap.attachments
        self._recording.damage += self._mcap.damage

    def _note(self, damage: str) -> None:
        self._mcap.damage.append(f"{self._mcap.name}: {damage}")

    def _type(self, channel: Channel) -> str:
        schema = self._mcap.schemas.get(channel.schema_id)
        return full_name(schema.name) if schema else ""

    def _static(self, number: int) -> bool:
        """Whether a channel holds static transforms, which are always read: they come once, at the beginning."""
        channel = self._mcap.channels[number]
        return self._type(channel) == TRANSFORMS and channel.topic.endswith("tf_static")

    def _open(self, channel: Channel) -> Stream | None:
        """The stream for a channel."""
        schema = self._mcap.schemas.get(channel.schema_id)
        topic, type = channel.topic, self._type(channel)
        static = self._static(channel.id)
        if not static and not self._wanted.topic(topic):
            self._recording.unread[topic] = type
            return None
        known = self._recording.streams.get(topic)
        if known:
            if known.type == type:
                return known
            self._note(f"{topic} is {known.type} and also {type or 'of no type'}; the latter skipped")
            return None
        stream: Stream = Stream(topic, type)
        unknown = self._recording.unknown
        if channel.message_encoding != "cdr":
            unknown[topic] = f"{type} (message encoding {channel.message_encoding!r})"
        elif schema and schema.encoding not in _SCHEMA_ENCODINGS:
            unknown[topic] = f"{type} (schema encoding {schema.encoding!r})"
        elif type in LAYOUTS:
            stream = SeriesStream(topic, type, LAYOUTS[type].without(self._wanted.leave))
        elif type == clouds.TYPE:
            stream = CloudStream(topic, type)
        elif static:
            stream = TransformStream(topic, type)
        elif type != TRANSFORMS:  # /tf is understood but not kept: poses over time come as Odometry
            unknown[topic] = type
        self._recording.streams[topic] = stream
        return stream
