"""Columns -> MCAP as rosbag2 writes it: profile ros2, CDR, definitions and QoS on board."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as Container

from tbmfg.errors import LogError
from tbmfg.mcap import clouds as cloud_messages
from tbmfg.mcap.cdr import CdrWriter
from tbmfg.mcap.layouts import LAYOUTS, Layout, encode
from tbmfg.mcap.schemas import definition
from tbmfg.mcap.streams import TRANSFORMS
from tbmfg.timeseries import Clouds, Floats, Series, Times, Transform

Compression = Literal["zstd", "lz4", "none"]
Message = tuple[int, str, bytes]  # log time, topic, CDR payload

_COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
_BATCH = 4096  # messages encoded at a time
# Latched, so that whoever replays the log and joins late still gets it (numbers as rmw defines them).
_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_LATCHED = yaml.safe_dump(
    [
        {
            "history": 1,
            "depth": 1,
            "reliability": 1,
            "durability": 1,
            "deadline": _FOREVER,
            "lifespan": _FOREVER,
            "liveliness": 1,
            "liveliness_lease_duration": _FOREVER,
            "avoid_ros_namespace_conventions": False,
        }
    ],
    sort_keys=False,
)


def write_log(
    path: str | os.PathLike,
    series: Iterable[Series],
    *,
    clouds: Iterable[Clouds] = (),
    transforms: Iterable[Transform] = (),
    attachments: Mapping[str, bytes] | None = None,
    log_ns: Mapping[str, Times] | None = None,
    compression: Compression = "zstd",
    chunked: bool = True,
    chunk_size: int = 1 << 20,
) -> None:
    """Write a recording: one file if ``path`` ends in .mcap, otherwise a rosbag2 folder with metadata.yaml.

    Columns are those ``read_log`` gives (missing ones are written as zeros), stamps become header stamps.
    Messages are written in the order of log time, which is the stamp unless ``log_ns`` has an array (n,) for
    the topic. ``transforms`` go to /tf_static. The file appears under its name only when complete.
    Raises LogError for a type that has no layout here, or where the file cannot be written.
    """
    streams, types = [], {}
    log_ns = log_ns or {}
    for one in series:
        if one.type not in LAYOUTS:
            raise LogError(f"{one.topic}: {one.type} cannot be written; known types: {', '.join(sorted(LAYOUTS))}")
        types[one.topic] = one.type
        strings = {"frame_id": one.frame_id, "child_frame_id": one.child_frame_id}
        logged_ns = log_ns.get(one.topic, one.t_ns)
        streams.append(encoded(one.topic, LAYOUTS[one.type], one.t_ns, logged_ns, one.columns, strings))
    for scans in clouds:
        types[scans.topic] = cloud_messages.TYPE
        streams.append(_cloud_messages(scans, log_ns.get(scans.topic, scans.t_ns)))
    messages = heapq.merge(*streams, key=lambda message: message[0])
    transforms = tuple(transforms)
    if transforms:
        types["/tf_static"] = TRANSFORMS
        messages = _with_transforms(messages, transforms)
    write_messages(path, types, messages, attachments or {}, compression, chunked, chunk_size)


def write_messages(
    path: str | os.PathLike,
    types: Mapping[str, str],
    messages: Iterable[Message],
    attachments: Mapping[str, bytes],
    compression: Compression = "zstd",
    chunked: bool = True,
    chunk_size: int = 1 << 20,
) -> None:
    """Write CDR messages in the order they come; ``types`` maps topic -> ROS type. As ``write_log``."""
    path = Path(path)
    folder = path if path.suffix != ".mcap" else None
    file = path / f"{path.name}_0.mcap" if folder else path
    try:
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            container = Container(
                str(temporary),
                chunk_size,
                _COMPRESSION[compression],
                use_chunking=chunked,
                enable_data_crcs=not chunked,
            )
            spans = _write(container, types, messages, attachments)
        if folder:
            with replacing(folder / "metadata.yaml") as temporary:
                temporary.write_text(_metadata(file.name, types, spans))
    except OSError as error:
        raise LogError(f"{path}: cannot be written ({error.strerror}); check the folder and its free space") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name in the same folder, renamed to ``path`` if all goes well and removed if not."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def encoded(
    topic: str, layout: Layout, t_ns: Times, log_ns: Times, columns: Mapping[str, Floats], strings: Mapping[str, str]
) -> Iterator[Message]:
    """Messages of a fixed layout in the order of their log times, encoded some thousand at a time."""
    order = np.argsort(log_ns, kind="stable")
    for first in range(0, len(order), _BATCH):
        rows = order[first : first + _BATCH]
        payloads = encode(layout, t_ns[rows], {name: values[rows] for name, values in columns.items()}, strings)
        for logged_ns, payload in zip(log_ns[rows].tolist(), payloads, strict=True):
            yield logged_ns, topic, payload


def encode_transforms(t_ns: int, transforms: Iterable[Transform]) -> bytes:
    """A tf2_msgs/TFMessage."""
    transforms = tuple(transforms)
    cdr = CdrWriter().scalars("I", len(transforms))
    for one in transforms:
        cdr.header(t_ns, one.parent).string(one.child).scalars("d", *one.xyz, *one.quat_xyzw)
    return cdr.message()


def _cloud_messages(clouds: Clouds, log_ns: Times) -> Iterator[Message]:
    """Clouds are never all in memory, so they stay in the order of their stamps."""
    for logged_ns, (t_ns, fields) in zip(log_ns.tolist(), clouds, strict=True):
        yield logged_ns, clouds.topic, cloud_messages.encode_cloud(t_ns, clouds.frame_id, fields)


def _with_transforms(messages: Iterable[Message], transforms: tuple[Transform, ...]) -> Iterator[Message]:
    """The messages with /tf_static before the first."""
    messages = iter(messages)
    first = next(messages, None)
    t_ns = first[0] if first else 0
    yield t_ns, "/tf_static", encode_transforms(t_ns, transforms)
    if first:
        yield first
        yield from messages


def _write(
    container: Container, types: Mapping[str, str], messages: Iterable[Message], attachments: Mapping[str, bytes]
) -> dict[str, tuple[int, int, int]]:
    """Write everything; topic -> (count, first and last log time)."""
    container.start(profile="ros2", library="tbmfg")
    schemas = {
        type: container.register_schema(type, "ros2msg", definition(type).encode())
        for type in dict.fromkeys(types.values())
    }
    channels = {
        topic: container.register_channel(
            topic, "cdr", schemas[type], {"offered_qos_profiles": _LATCHED if topic == "/tf_static" else ""}
        )
        for topic, type in types.items()
    }
    spans = dict.fromkeys(types, (0, 0, 0))
    for name, data in attachments.items():
        container.add_attachment(create_time=0, log_time=0, name=name, media_type="application/octet-stream", data=data)
    for log_ns, topic, payload in messages:
        count, first, last = spans[topic]
        spans[topic] = count + 1, min(first, log_ns) if count else log_ns, max(last, log_ns)
        container.add_message(channels[topic], log_time=log_ns, data=payload, publish_time=log_ns, sequence=count)
    container.finish()
    return spans


def _metadata(file: str, types: Mapping[str, str], spans: Mapping[str, tuple[int, int, int]]) -> str:
    """rosbag2's metadata.yaml."""
    used = [span for span in spans.values() if span[0]]
    start = min((first for _, first, _ in used), default=0)
    end = max((last for _, _, last in used), default=0)
    total = sum(count for count, _, _ in used)
    extent = {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": end - start},
        "message_count": total,
    }
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": type,
                "serialization_format": "cdr",
                "offered_qos_profiles": _LATCHED if topic == "/tf_static" else "",
            },
            "message_count": spans[topic][0],
        }
        for topic, type in types.items()
    ]
    information = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": [file],
        **extent,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file, **extent}],
    }
    return yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
