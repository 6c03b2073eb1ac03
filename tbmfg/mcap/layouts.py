"""CDR layouts of the hot ROS 2 messages: decoded and encoded many at a time as numpy structured arrays.

A message of these types is a row of fixed-size fields whose offsets depend on nothing but the lengths of
its strings. Payloads that agree in size and string lengths are therefore one structured array.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tbmfg.timeseries import NS, Floats, Times

BYTE_ORDER = {b"\x00\x01": "<", b"\x00\x00": ">"}  # CDR encapsulation; the other kinds align differently
ENCAPSULATION = 4  # bytes before the body; alignment counts from here


@dataclass(frozen=True, slots=True)
class Field:
    """One member of a message: ``kind`` is a numpy type code without byte order, or "str"."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True, slots=True)
class Layout:
    """Members of a message type in order. A name with a leading underscore is read past, not kept.

    A row with a NaN or infinity in a ``checked`` column is of no use. With ``optional`` a checked column
    without a single finite row is a field that the publisher does not fill, and costs no rows.
    """

    fields: tuple[Field, ...]
    checked: tuple[str, ...]
    optional: bool

    @property
    def columns(self) -> tuple[Field, ...]:
        return tuple(f for f in self.fields if f.kind != "str" and not f.name.startswith("_"))

    def without(self, names: Collection[str]) -> Layout:
        """The same layout, which reads past these columns."""
        return replace(self, fields=tuple(replace(f, name=f"_{f.name}") if f.name in names else f for f in self.fields))


@dataclass(frozen=True, slots=True)
class Rows:
    """Decoded messages, in the order they came.

    ``good`` (n,) tells which of the n payloads became the m rows of ``t_ns`` (m,) and ``columns``.
    ``strings`` are those of one message.
    """

    good: NDArray[np.bool_]
    t_ns: Times
    columns: dict[str, Floats]
    strings: dict[str, str] = field(default_factory=dict)


def _layout(members: str, checked: str, *, optional: bool = False) -> Layout:
    fields = []
    for member in members.split():
        name, count, kind = _MEMBER.fullmatch(member).groups()
        fields.append(Field(name, kind, int(count or 1)))
    return Layout(tuple(fields), tuple(checked.split()), optional)


_MEMBER = re.compile(r"(\w+):(\d*)(str|[fiu]\d)")  # name:f8, or name:3f8 for three of them
_HEADER = "_sec:i4 _nsec:u4 frame_id:str "
_POSE = "position:3f8 quat_xyzw:4f8 "
_TWIST = "linear:3f8 angular:3f8 "

LAYOUTS = {
    "sensor_msgs/msg/Imu": _layout(
        _HEADER + "quat_xyzw:4f8 _orientation_cov:9f8 gyro:3f8 _gyro_cov:9f8 acc:3f8 _acc_cov:9f8", "gyro acc"
    ),
    "sensor_msgs/msg/MagneticField": _layout(_HEADER + "field:3f8 _cov:9f8", "field"),
    "sensor_msgs/msg/FluidPressure": _layout(_HEADER + "pressure:f8 variance:f8", "pressure"),
    "sensor_msgs/msg/NavSatFix": _layout(_HEADER + "status:i1 _service:u2 llh:3f8 cov:9f8 cov_type:u1", "llh"),
    "geometry_msgs/msg/PointStamped": _layout(_HEADER + "point:3f8", "point"),
    "geometry_msgs/msg/TwistStamped": _layout(_HEADER + _TWIST, "linear angular", optional=True),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _layout(
        _HEADER + _TWIST + "cov:36f8", "linear angular", optional=True
    ),
    "geometry_msgs/msg/PoseStamped": _layout(_HEADER + _POSE, "position quat_xyzw", optional=True),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _layout(
        _HEADER + _POSE + "cov:36f8", "position quat_xyzw", optional=True
    ),
    "geometry_msgs/msg/TransformStamped": _layout(
        _HEADER + "child_frame_id:str " + _POSE, "position quat_xyzw", optional=True
    ),
    "nav_msgs/msg/Odometry": _layout(
        _HEADER + "child_frame_id:str " + _POSE + "pose_cov:36f8 " + _TWIST + "twist_cov:36f8",
        "position quat_xyzw linear angular",
        optional=True,
    ),
}

# A /tf message with exactly one transform, which is how a trajectory is written.
ONE_TRANSFORM = _layout("_length:u4 " + _HEADER + "child_frame_id:str " + _POSE, "")


def decode(layout: Layout, data: NDArray[np.uint8], sizes: Times) -> Rows:
    """CDR messages of one type (encapsulation included) as columns; those that do not fit are left out.

    ``data`` holds the messages one after the other, ``sizes`` (n,) bytes each.
    """
    n, ends = len(sizes), np.cumsum(sizes)
    good = np.zeros(n, dtype=bool)
    t_ns = np.zeros(n, dtype=np.int64)
    columns = {f.name: np.empty((n, f.count) if f.count > 1 else n) for f in layout.columns}
    strings: dict[str, str] = {}
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        block = data.reshape(n, size) if len(rows) == n else data[(ends[rows] - size)[:, None] + np.arange(size)]
        while len(rows):
            dtype, fixed, names = _place(layout, block[0].tobytes())
            alike = (block[:, fixed] == block[0, fixed]).all(axis=1)
            if dtype is not None:
                messages = block if alike.all() else block[alike]
                _fill(messages.view(dtype)[:, 0], rows[alike], t_ns, columns)
                good[rows[alike]] = True
                strings = strings or names
            rows, block = rows[~alike], block[~alike]
    if not good.all():
        t_ns, columns = t_ns[good], {name: values[good] for name, values in columns.items()}
    return Rows(good, t_ns, columns, strings)


def patched(layout: Layout, payload: bytes, values: Mapping[str, Any], t_ns: int | None = None) -> bytes:
    """One CDR message with these members, and its stamp, replaced; every other byte stays. Raises ValueError for one
    that does not fit the layout."""
    dtype, _, _ = _place(layout, bytes(payload))
    if dtype is None:
        raise ValueError(f"a message of {len(payload)} bytes does not fit its layout")
    data = bytearray(payload)
    message = np.frombuffer(data, dtype=dtype)
    for name, value in values.items():
        message[name] = value
    if t_ns is not None:
        message["_sec"], message["_nsec"] = divmod(int(t_ns), NS)
    return bytes(data)


def _place(layout: Layout, payload: bytes) -> tuple[np.dtype | None, list[int], dict[str, str]]:
    """Where the members of one message lie: its dtype (None if it is too short or not plain CDR), the
    bytes that other payloads must share to be read by it, and its strings."""
    order = BYTE_ORDER.get(payload[:2])
    fixed, strings = list(range(min(2, len(payload)))), {}
    if order is None:
        return None, fixed, strings
    names, formats, offsets = [], [], []
    at = ENCAPSULATION
    for member in layout.fields:
        if member.kind == "str":
            at = _align(at, 4)
            if at + 4 > len(payload):
                return None, fixed, strings
            (length,) = struct.unpack_from(order + "I", payload, at)
            fixed += range(at, at + 4)
            at += 4 + length
            strings[member.name] = payload[at - length : at].rstrip(b"\0").decode(errors="replace")
        else:
            scalar = np.dtype(order + member.kind)
            at = _align(at, scalar.itemsize)
            names.append(member.name)
            formats.append((scalar, (member.count,)) if member.count > 1 else scalar)
            offsets.append(at)
            at += scalar.itemsize * member.count
        if at > len(payload):
            return None, fixed, strings
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": len(payload)})
    return dtype, fixed, strings


def _fill(messages: NDArray, rows: NDArray, t_ns: Times, columns: dict[str, Floats]) -> None:
    t_ns[rows] = messages["_sec"].astype(np.int64) * NS + messages["_nsec"]
    for name, values in columns.items():
        values[rows] = messages[name]
    if "_orientation_cov" in messages.dtype.names:  # -1 in its first element: there is no orientation
        columns["quat_xyzw"][rows[messages["_orientation_cov"][:, 0] == -1.0]] = np.nan


def encode(layout: Layout, t_ns: Times, columns: Mapping[str, Floats], strings: Mapping[str, str]) -> list[bytes]:
    """Little-endian CDR messages from columns; columns that are not given are zero, unknown ones ignored."""
    texts = {f.name: strings.get(f.name, "").encode() + b"\0" for f in layout.fields if f.kind == "str"}
    template = _blank(layout, texts)
    dtype, _, _ = _place(layout, template)
    data = bytearray(template) * len(t_ns)
    block = np.frombuffer(data, dtype=dtype)
    block["_sec"], block["_nsec"] = np.divmod(np.asarray(t_ns, dtype=np.int64), NS)
    for member in layout.fields:
        if member.name in columns:
            block[member.name] = columns[member.name]
    if "_length" in dtype.names:
        block["_length"] = 1
    if "_orientation_cov" in dtype.names and "quat_xyzw" not in columns:
        block["_orientation_cov"][:, 0] = -1.0
    size, messages = len(template), bytes(data)
    return [messages[i : i + size] for i in range(0, len(messages), size)]


def _blank(layout: Layout, texts: dict[str, bytes]) -> bytes:
    """A message of zeros with its strings in place."""
    out = bytearray(b"\x00\x01\x00\x00")
    for member in layout.fields:
        if member.kind == "str":
            out += bytes(_align(len(out), 4) - len(out))
            out += struct.pack("<I", len(texts[member.name])) + texts[member.name]
        else:
            itemsize = np.dtype(member.kind).itemsize
            out += bytes(_align(len(out), itemsize) - len(out) + itemsize * member.count)
    return bytes(out)


def _align(at: int, size: int) -> int:
    return at + (ENCAPSULATION - at) % size
