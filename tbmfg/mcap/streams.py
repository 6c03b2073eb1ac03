"""What becomes of the messages of one topic: columns, places of clouds, transforms, or just a count."""

from __future__ import annotations

import struct

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from tbmfg.mcap.clouds import McapClouds, Place, decode_cloud
from tbmfg.mcap.container import Block
from tbmfg.mcap.layouts import Layout, Rows, decode
from tbmfg.mcap.records import Entries, gather
from tbmfg.mcap.schemas import definition
from tbmfg.mcap.stamps import misdated
from tbmfg.timeseries import Floats, Series, StreamCounts, Times, Transform

TRANSFORMS = "tf2_msgs/msg/TFMessage"

_BATCH_BYTES = 2 << 20  # raw messages held back until they are decoded together
_UNIT_NORM = 0.01  # a quaternion further than this from norm 1 was never filled in


class Stream:
    """Takes the messages of one topic in file order; this base class only counts them."""

    def __init__(self, topic: str, type: str) -> None:
        self.topic = topic
        self.type = type
        self._log_ns: list[Times] = []

    def take(self, block: Block, path: str, entries: Entries) -> None:
        """Messages ``entries`` of a block of the file ``path``."""
        self._log_ns.append(entries.log_ns)

    def log_ns(self) -> Times:
        """Log times of all messages, in file order."""
        return np.concatenate([np.empty(0, np.int64), *self._log_ns])

    def stamps(self) -> tuple[Times, Times]:
        """Header stamps and log times of the decoded messages, in file order."""
        return np.empty(0, np.int64), np.empty(0, np.int64)


class SeriesStream(Stream):
    """Columns of a type with a fixed layout."""

    def __init__(self, topic: str, type: str, layout: Layout) -> None:
        super().__init__(topic, type)
        self._layout = layout
        self._payloads: list[NDArray[np.uint8]] = []
        self._sizes: list[Times] = []
        self._waiting = 0
        self._batches: list[Rows] = []

    def take(self, block: Block, path: str, entries: Entries) -> None:
        super().take(block, path, entries)
        self._payloads.append(gather(block.data, entries))
        self._sizes.append(entries.stop - entries.start)
        self._waiting += len(self._payloads[-1])
        if self._waiting > _BATCH_BYTES:
            self._decode()

    def _decode(self) -> None:
        data, sizes = [np.empty(0, np.uint8), *self._payloads], [np.empty(0, np.int64), *self._sizes]
        self._batches.append(decode(self._layout, np.concatenate(data), np.concatenate(sizes)))
        self._payloads, self._sizes, self._waiting = [], [], 0

    def _rows(self) -> Rows:
        """All messages so far, as one batch."""
        if self._payloads or not self._batches:
            self._decode()
        if len(self._batches) > 1:
            good = np.concatenate([rows.good for rows in self._batches])
            t_ns = np.concatenate([rows.t_ns for rows in self._batches])
            columns = {}
            for name in list(self._batches[0].columns):  # one column at a time: only one is in memory twice
                columns[name] = np.concatenate([rows.columns.pop(name) for rows in self._batches])
            strings = next((rows.strings for rows in self._batches if rows.strings), {})
            self._batches = [Rows(good, t_ns, columns, strings)]
        return self._batches[0]

    def stamps(self) -> tuple[Times, Times]:
        rows = self._rows()
        return rows.t_ns, self.log_ns()[rows.good]

    def series(self, eras: Times) -> Series:
        """Sorted by stamp, without duplicates, rows that are not finite and stamps of other ``eras``."""
        rows = self._rows()
        columns = _filled(self._layout, rows.columns)
        finite = np.ones(len(rows.t_ns), dtype=bool)
        for name in self._layout.checked:
            if name in columns:
                finite &= _finite_rows(columns[name])
        wrong = misdated(*self.stamps(), eras)
        kept, counts = _in_time_order(rows.t_ns, finite, wrong, int((~rows.good).sum()))
        if not np.array_equal(kept, np.arange(len(rows.t_ns))):  # else nothing needs to be copied
            columns = {name: values[kept] for name, values in columns.items()}
        return Series(
            self.topic,
            self.type,
            rows.t_ns[kept],
            columns,
            rows.strings.get("frame_id", ""),
            rows.strings.get("child_frame_id", ""),
            counts,
        )


class CloudStream(Stream):
    """Stamps and places of point clouds; the points stay in the file."""

    def __init__(self, topic: str, type: str) -> None:
        super().__init__(topic, type)
        self._places: list[Place] = []
        self._t_ns: list[int] = []
        self._good: list[bool] = []
        self._frame_id = ""

    def take(self, block: Block, path: str, entries: Entries) -> None:
        super().take(block, path, entries)
        for start, stop in zip(entries.start.tolist(), entries.stop.tolist(), strict=True):
            try:
                t_ns, frame_id, _ = decode_cloud(memoryview(block.data)[start:stop])
            except ValueError:
                self._good.append(False)
                continue
            self._good.append(True)
            self._t_ns.append(t_ns)
            self._places.append(Place(path, block.chunk, block.start + start, block.start + stop))
            self._frame_id = self._frame_id or frame_id

    def stamps(self) -> tuple[Times, Times]:
        return np.array(self._t_ns, dtype=np.int64), self.log_ns()[np.array(self._good, dtype=bool)]

    def clouds(self, eras: Times) -> McapClouds:
        t_ns, log_ns = self.stamps()
        wrong = misdated(t_ns, log_ns, eras)
        kept, counts = _in_time_order(t_ns, np.ones(len(t_ns), dtype=bool), wrong, self._good.count(False))
        return McapClouds(self.topic, t_ns[kept], tuple(self._places[i] for i in kept), self._frame_id, counts)


class TransformStream(Stream):
    """Static transforms; of one parent and child the last counts."""

    def __init__(self, topic: str, type: str) -> None:
        super().__init__(topic, type)
        schema = Schema(id=1, name=TRANSFORMS, encoding="ros2msg", data=definition(TRANSFORMS).encode())
        self._decoder = DecoderFactory().decoder_for("cdr", schema)
        self._transforms: dict[tuple[str, str], Transform] = {}
        self.undecodable = 0

    def take(self, block: Block, path: str, entries: Entries) -> None:
        super().take(block, path, entries)
        for payload in entries.payloads(block.data):
            try:
                message = self._decoder(payload)
            except (struct.error, ValueError, IndexError, McapError):
                self.undecodable += 1
                continue
            for one in message.transforms:
                move, turn = one.transform.translation, one.transform.rotation
                key = one.header.frame_id, one.child_frame_id
                self._transforms[key] = Transform(*key, (move.x, move.y, move.z), (turn.x, turn.y, turn.z, turn.w))

    def transforms(self) -> tuple[Transform, ...]:
        return tuple(self._transforms.values())


def _in_time_order(
    t_ns: Times, finite: NDArray[np.bool_], wrong: NDArray[np.bool_], undecodable: int
) -> tuple[NDArray[np.intp], StreamCounts]:
    """Rows to keep, by stamp, the first of each stamp; and what happened to the others."""
    index = np.flatnonzero(finite & ~wrong)
    index = index[np.argsort(t_ns[index], kind="stable")]
    first = np.ones(len(index), dtype=bool)
    first[1:] = np.diff(t_ns[index]) > 0
    duplicate, disordered = np.zeros(len(t_ns), dtype=bool), np.zeros(len(t_ns), dtype=bool)
    duplicate[index[~first]] = True
    dated = np.flatnonzero(~wrong)
    disordered[dated[1:]] = np.diff(t_ns[dated]) < 0
    found = {
        "duplicate": duplicate,
        "disordered": disordered,
        "nonfinite": ~finite,
        "misdated": finite & wrong,
    }
    counts = StreamCounts(
        received=len(t_ns),
        **{what: int(rows.sum()) for what, rows in found.items()},
        undecodable=undecodable,
        first_ns={
            what: int(t_ns[np.argmax(rows)]) for what, rows in found.items() if rows.any() and what != "misdated"
        },
    )
    return index[first], counts


def _finite_rows(values: Floats) -> NDArray[np.bool_]:
    finite = np.isfinite(values)
    return finite if finite.ndim == 1 else finite.all(axis=1)


def _filled(layout: Layout, columns: dict[str, Floats]) -> dict[str, Floats]:
    """The columns that the publisher fills in.

    An attitude that no estimation needs (Imu) stays only if it is one in every row. A checked column of an
    optional kind stays if any row is finite, or, for a quaternion, has unit norm.
    """
    empty = set()
    for name, values in columns.items():
        if name == "quat_xyzw":
            with np.errstate(over="ignore", invalid="ignore"):
                unit = np.abs(np.linalg.norm(values, axis=1) - 1.0) < _UNIT_NORM
            if not (unit.any() if name in layout.checked else unit.all()):
                empty.add(name)
        elif layout.optional and name in layout.checked and not _finite_rows(values).any():
            empty.add(name)
    if empty.issuperset(layout.checked):  # nothing of use at all: the rows say so
        empty -= set(layout.checked)
    return {name: values for name, values in columns.items() if name not in empty}
