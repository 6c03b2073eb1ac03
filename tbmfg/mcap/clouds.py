"""sensor_msgs/PointCloud2: decoded as views, streamed from the file one cloud at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tbmfg.mcap.cdr import CdrReader, CdrWriter
from tbmfg.mcap.container import McapFile
from tbmfg.timeseries import StreamCounts, Times

TYPE = "sensor_msgs/msg/PointCloud2"
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_CODES = {code: number for number, code in _DTYPES.items()}


class Place(NamedTuple):
    """Where one message lies: bytes ``start`` to ``stop`` of the chunk at byte ``chunk``, or of the file (-1)."""

    path: str
    chunk: int
    start: int
    stop: int


class PlaceReader:
    """Reads single messages again; keeps the last chunk, since neighbours come from the same one."""

    def __init__(self) -> None:
        self._file: McapFile | None = None
        self._key: tuple[str, int] = ("", -1)
        self._data = b""

    def __enter__(self) -> PlaceReader:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._file:
            self._file.__exit__(kind, error, trace)

    def __call__(self, place: Place) -> memoryview:
        if self._file is None or self._file.path != place.path:
            self.__exit__(None, None, None)
            self._file, self._key = McapFile(place.path), ("", -1)
        if place.chunk < 0:
            return memoryview(self._file.load(place.start, place.stop))
        if self._key != (place.path, place.chunk):
            self._key, self._data = (place.path, place.chunk), self._file.load_chunk(place.chunk)
        return memoryview(self._data)[place.start : place.stop]


@dataclass(frozen=True, slots=True)
class McapClouds:
    """Clouds of one topic, sorted by stamp, stamps unique; each iteration reads the file again.

    Yields (stamp in ns, field name -> (n,) or (n, count) array of the field's own type); raises LogError
    where the file has changed since.
    """

    topic: str
    t_ns: Times
    places: tuple[Place, ...] = field(repr=False)
    frame_id: str = ""
    counts: StreamCounts = field(default_factory=StreamCounts)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __iter__(self) -> Iterator[tuple[int, dict[str, NDArray]]]:
        with PlaceReader() as read:
            for place in self.places:
                t_ns, _, fields = decode_cloud(read(place))
                yield t_ns, fields


def decode_cloud(payload: bytes | memoryview) -> tuple[int, str, dict[str, NDArray]]:
    """(stamp in ns, frame_id, fields); the arrays are views of the payload, in native byte order.

    Raises ValueError where sizes contradict each other.
    """
    cdr = CdrReader(payload)
    t_ns, frame_id = cdr.header()
    height, width = cdr.scalar("I"), cdr.scalar("I")
    members = []
    for _ in range(cdr.scalar("I")):
        members.append((cdr.string(), cdr.scalar("I"), cdr.scalar("B"), max(cdr.scalar("I"), 1)))
    order = ">" if cdr.scalar("B") else "<"
    point_step, row_step = cdr.scalar("I"), cdr.scalar("I")
    data = cdr.octets(cdr.scalar("I"))
    if height == 1:
        row_step = width * point_step  # some drivers leave it zero
    if row_step < width * point_step or height * row_step > len(data):
        raise ValueError(f"{height} x {width} points of {point_step} bytes do not fit in {len(data)} bytes")
    fields = {}
    for name, offset, datatype, count in members:
        if datatype not in _DTYPES:
            raise ValueError(f"field {name} has unknown type {datatype}")
        dtype = np.dtype(order + _DTYPES[datatype])
        if offset + dtype.itemsize * count > point_step:
            raise ValueError(f"field {name} ends after the point step of {point_step} bytes")
        shape, strides = (height, width, count), (row_step, point_step, dtype.itemsize)
        view = np.ndarray(shape, dtype, data, offset, strides) if height * width else np.empty(shape, dtype)
        values = view.reshape(height * width, count)
        fields[name] = (values[:, 0] if count == 1 else values).astype(dtype.newbyteorder("="), copy=False)
    return t_ns, frame_id, fields


def encode_cloud(t_ns: int, frame_id: str, fields: dict[str, NDArray]) -> bytes:
    """An unorganised PointCloud2 with these fields, (n,) or (n, count) each, packed in the order given."""
    arrays = {name: np.asarray(values) for name, values in fields.items()}
    packed = np.dtype([(name, a.dtype.newbyteorder("<"), a.shape[1:]) for name, a in arrays.items()])
    n = len(next(iter(arrays.values()), ()))
    points = np.empty(n, dtype=packed)
    cdr = CdrWriter().header(t_ns, frame_id).scalars("I", 1, n, len(arrays))
    for name, values in arrays.items():
        points[name] = values
        base, offset = packed.fields[name][0].base, packed.fields[name][1]
        cdr.string(name).scalars("I", offset).scalars("B", _CODES[base.str[1:]])
        cdr.scalars("I", int(np.prod(values.shape[1:], dtype=int)))
    cdr.scalars("B", 0).scalars("I", packed.itemsize, n * packed.itemsize)
    data = points.tobytes()
    dense = all(np.isfinite(values).all() for values in arrays.values())
    return cdr.scalars("I", len(data)).octets(data).scalars("B", dense).message()
