"""MCAP file or rosbag2 folder -> Log."""

from __future__ import annotations

import os
import struct
from collections import Counter, defaultdict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import yaml
from mcap.opcode import Opcode
from mcap.records import Channel

from tbmfg.errors import LogError
from tbmfg.mcap import clouds
from tbmfg.mcap.container import HEAD, Block, McapFile
from tbmfg.mcap.layouts import LAYOUTS
from tbmfg.mcap.schemas import full_name
from tbmfg.mcap.stamps import eras
from tbmfg.mcap.streams import TRANSFORMS, CloudStream, Entries, SeriesStream, Stream, TransformStream
from tbmfg.storage import Place, is_folder, place
from tbmfg.timeseries import Log

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_SCHEMA_ENCODINGS = ("ros2msg", "ros2idl")


@dataclass(slots=True)
class Recording:
    """All messages of a recording by topic, before they are sorted and cleaned."""

    path: str
    streams: dict[str, Stream] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
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
        )


def read_log(
    path: str | os.PathLike,
    topics: Collection[str] | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> Log:
    """A recording in columns: ``path`` is an .mcap file or a rosbag2 folder with metadata.yaml, here or at a URL.

    With ``topics`` only these become series and clouds; static transforms and attachments are always read.
    ``progress`` is called with the fraction done, 0 to 1. Damaged parts are skipped and described in
    ``Log.damage``. Raises LogError where nothing can be read.
    """
    return scan(path, topics, progress).log()


def scan(
    path: str | os.PathLike,
    topics: Collection[str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """One pass over all files of a recording; arguments and errors as ``read_log``."""
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
            distributor = _Distributor(recording, mcap, topics)
            for block in mcap.blocks():
                distributor.take(block)
                if progress:
                    progress((sum(sizes[:number]) + mcap.position) / sum(sizes))
            distributor.finish()
    if not recording.messages:
        reasons = recording.damage[:4] + ["..."] * (len(recording.damage) > 4)
        raise LogError("; ".join([f"{path}: no message could be read from {sum(sizes)} bytes", *reasons]))
    if progress:
        progress(1.0)
    return recording


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

    def __init__(self, recording: Recording, mcap: McapFile, topics: Collection[str] | None) -> None:
        self._recording = recording
        self._mcap = mcap
        self._topics = topics
        self._streams: dict[int, Stream | None] = {}  # by channel; None: its messages are passed over
        self._undeclared: Counter[int] = Counter()

    def take(self, block: Block) -> None:
        """All messages of a block; declarations among them go to the file."""
        entries: defaultdict[int, Entries] = defaultdict(list)
        data, end, at = block.data, len(block.data), 0
        while at + HEAD.size <= end:
            opcode, length = HEAD.unpack_from(data, at)
            start = at + HEAD.size
            if start + length > end or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
                break
            at = start + length
            if opcode == Opcode.MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(data, start)
                entries[channel].append((log_ns, start + _MESSAGE.size, at))
            else:
                self._mcap.declare(opcode, data[start:at])
        if at < end and block.whole:
            self._note(f"{end - at} bytes in the chunk at byte {block.chunk} are no records; skipped")
        for channel, messages in entries.items():
            if channel not in self._mcap.channels:
                self._undeclared[channel] += len(messages)
                continue
            self._recording.messages += len(messages)
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

    def _open(self, channel: Channel) -> Stream | None:
        """The stream for a channel."""
        schema = self._mcap.schemas.get(channel.schema_id)
        topic, type = channel.topic, full_name(schema.name) if schema else ""
        static = type == TRANSFORMS and topic.endswith("tf_static")
        if self._topics is not None and topic not in self._topics and not static:
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
            stream = SeriesStream(topic, type, LAYOUTS[type])
        elif type == clouds.TYPE:
            stream = CloudStream(topic, type)
        elif static:
            stream = TransformStream(topic, type)
        elif type != TRANSFORMS:  # /tf is understood but not kept: poses over time come as Odometry
            unknown[topic] = type
        self._recording.streams[topic] = stream
        return stream
