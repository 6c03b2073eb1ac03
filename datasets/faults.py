"""Faults for recorded logs: what goes wrong underground, done on purpose to any MCAP log, and written down.

``corrupt(LOG, OUT, [parse("gross:share=0.3")], seed=1)`` or ``python -m datasets corrupt LOG -o OUT --fault KIND``. A
fault is ``KIND`` or ``KIND:key=value,key=value``: of any kind ``topic`` (the first with positions unless given),
``start`` and ``end`` in s from that topic's first stamp, and its own parameters. Sizes are in the units of the message.

Messages that no fault touches are copied byte for byte; of one that is, only the values and the stamp change. Point
clouds take the kinds that change no values, and stay in the file until they are copied. The
attachment ``faults.json`` holds what was done: of each fault the kind, topic, parameters, stretch, and the stamps (as
they were) of the messages that it hit.
"""

from __future__ import annotations

import contextlib
import heapq
import inspect
import itertools
import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from mcap.reader import McapReader, make_reader
from mcap.records import Channel, Schema
from mcap.records import Message as Record
from numpy.random import Generator
from numpy.typing import NDArray

from tbmfg.errors import LogError, TbmfgError
from tbmfg.mcap.clouds import TYPE as CLOUD
from tbmfg.mcap.into import copying, records
from tbmfg.mcap.layouts import ENCAPSULATION, LAYOUTS, Field, Layout, Rows, decode, patched
from tbmfg.mcap.reader import recording_files
from tbmfg.timeseries import NS

TOLD = "faults.json"
STAMPS = ("gap", "clock", "duplicate", "shuffle")  # kinds that need no more of a message than its stamp
HEAD = ENCAPSULATION + 8  # bytes up to the end of a header's stamp
STAMPED = Layout((Field("_sec", "i4", 1), Field("_nsec", "u4", 1)), (), False)
POSITIONS = ("geometry_msgs/msg/PointStamped", "sensor_msgs/msg/NavSatFix")


@dataclass(frozen=True, slots=True)
class Fault:
    """What to do to one topic from ``start_s`` to ``end_s``, None being the kind's own choice."""

    kind: str
    topic: str | None = None
    start_s: float | None = None
    end_s: float | None = None
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stored:
    """A cloud that stays in the file ``number``, ``nth`` of its topic at ``log_time``; ``head``, its first bytes, as
    they are to be."""

    head: bytes
    number: int
    log_time: int
    nth: int


@dataclass(slots=True)
class Messages:
    """Those of one topic, in the order of their log times; the data of clouds are :class:`Stored`."""

    number: int
    schema: Schema
    channel: Channel
    records: list[Record]

    @property
    def layout(self) -> Layout:
        return STAMPED if self.schema.name == CLOUD else LAYOUTS[self.schema.name]

    def decoded(self) -> Rows:
        stored = self.schema.name == CLOUD
        payloads = [record.data.head if stored else bytes(record.data) for record in self.records]
        sizes = np.fromiter(map(len, payloads), dtype=np.int64, count=len(payloads))
        return decode(self.layout, np.frombuffer(b"".join(payloads), dtype=np.uint8), sizes)

    def patch(self, row: int, values: dict[str, Any], t_ns: int | None = None) -> None:
        """Replace members of one message."""
        record = self.records[row]
        if isinstance(record.data, Stored):
            data = replace(record.data, head=patched(self.layout, record.data.head, values, t_ns))
        else:
            data = patched(self.layout, record.data, values, t_ns)
        self.records[row] = replace(record, data=data)


# ---- kinds: each changes ``messages`` at some of ``rows`` (k,) and returns which, (m,) ----


def gross(messages: Messages, rows: NDArray, rng: Generator, share: float = 0.1, size: float = 2.0) -> NDArray:
    """Fixes on a wrong reflector: ``share`` of them are of another point, ``size`` away."""
    name, values = _measured(messages)
    hit = rows[rng.random(len(rows)) < share]
    elsewhere = np.median(values[rows], axis=0) + size * _direction(rng, values)
    for row in hit:
        messages.patch(row, {name: elsewhere + 1e-3 * size * rng.standard_normal(np.shape(elsewhere))})
    return hit


def bias(messages: Messages, rows: NDArray, rng: Generator, size: float = 0.1) -> NDArray:
    """A constant error of ``size``."""
    name, values = _measured(messages)
    offset = size * _direction(rng, values)
    for row in rows:
        messages.patch(row, {name: values[row] + offset})
    return rows


def frozen(messages: Messages, rows: NDArray, rng: Generator) -> NDArray:
    """The value stays what it was, with new stamps."""
    columns = messages.decoded().columns
    held = {name: columns[name][rows[0]] for name in messages.layout.checked}
    for row in rows[1:]:
        messages.patch(row, held)
    return rows[1:]


def gap(messages: Messages, rows: NDArray, rng: Generator) -> NDArray:
    """Messages are missing."""
    lost = set(rows.tolist())
    messages.records = [record for row, record in enumerate(messages.records) if row not in lost]
    return rows


def clock(messages: Messages, rows: NDArray, rng: Generator, step: float = 0.5) -> NDArray:
    """The clock of the stamps is set forward by ``step`` s, and at the end back."""
    stamps = messages.decoded().t_ns
    for row in rows:
        messages.patch(row, {}, int(stamps[row]) + round(step * NS))
    return rows


def nan(messages: Messages, rows: NDArray, rng: Generator, bursts: float = 3, length: float = 5) -> NDArray:
    """``bursts`` of ``length`` messages without a value."""
    starts = rng.integers(0, max(len(rows) - int(length), 1), int(bursts))
    hit = rows[np.unique(np.clip(starts[:, None] + np.arange(int(length)), 0, len(rows) - 1))]
    for row in hit:
        messages.patch(row, dict.fromkeys(messages.layout.checked, np.nan))
    return hit


def duplicate(messages: Messages, rows: NDArray, rng: Generator, share: float = 0.1) -> NDArray:
    """``share`` of the messages come twice."""
    hit = rows[rng.random(len(rows)) < share]
    twice = np.repeat(np.arange(len(messages.records)), 1 + np.isin(np.arange(len(messages.records)), hit))
    messages.records = [messages.records[row] for row in twice]
    return hit


def shuffle(messages: Messages, rows: NDArray, rng: Generator, reach: float = 5) -> NDArray:
    """Messages overtake each other: in every ``reach`` of them the order is lost."""
    order = np.argsort(np.arange(len(rows)) // int(reach) + rng.random(len(rows)), kind="stable")
    before = [messages.records[row] for row in rows]
    for row, old, new in zip(rows, before, order, strict=True):
        messages.records[row] = replace(old, data=before[new].data)
    return rows[order != np.arange(len(rows))]


KINDS: dict[str, Callable[..., NDArray]] = {
    kind.__name__: kind for kind in (gross, bias, frozen, gap, clock, nan, duplicate, shuffle)
}
STRETCH = (
    "bias",
    "frozen",
    "gap",
    "clock",
)  # these last for a tenth of the log, somewhere, unless told; others for all


def _measured(messages: Messages) -> tuple[str, NDArray]:
    """The column that a sensor of this type measures first of all."""
    name = messages.layout.checked[0]
    return name, messages.decoded().columns[name]


def _direction(rng: Generator, values: NDArray) -> NDArray:
    """A random unit vector as wide as a row of ``values``, along the axes that are measured: an odometer's others are
    always zero. 1 or -1 for single ones."""
    drawn = rng.standard_normal(values.shape[1:]) * (values != 0).any(axis=0)
    return drawn / np.linalg.norm(drawn)


# ---- a log ----


def parse(text: str) -> Fault:
    """A fault as on the command line."""
    kind, _, rest = text.partition(":")
    if kind not in KINDS:
        raise TbmfgError(f"--fault {text}: no such kind; there are {', '.join(KINDS)}")
    known = parameters(kind)
    given: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, _, value = part.partition("=")
        if key not in ("topic", "start", "end", *known):
            raise TbmfgError(f"--fault {text}: no key {key}; there are {', '.join(['topic', 'start', 'end', *known])}")
        try:
            given[key] = value if key == "topic" else float(value)
        except ValueError:
            raise TbmfgError(f"--fault {text}: {key} should be a number") from None
    stretch = (given.pop(key, None) for key in ("topic", "start", "end"))
    return Fault(kind, *stretch, given)


def parameters(kind: str) -> dict[str, float]:
    """A kind's own parameters and their defaults."""
    found = inspect.signature(KINDS[kind]).parameters.values()
    return {one.name: one.default for one in found if one.default is not inspect.Parameter.empty}


def corrupt(
    source: str | os.PathLike, target: str | os.PathLike, faults: Sequence[Fault], *, seed: int = 0
) -> list[dict[str, Any]]:
    """Copy the recording ``source`` to the file ``target`` with ``faults``, one after the other: what was done, as in
    ``faults.json``. Raises LogError for a topic that is not there or cannot be decoded, and where no copy can be made.
    """
    rng = np.random.default_rng(seed)
    streams = _streams(recording_files(source))
    touched: dict[str, Messages] = {}
    told = []
    for fault in faults:
        topic = fault.topic or next((name for name, one in streams.items() if one.schema.name in POSITIONS), None)
        if topic not in streams:
            raise LogError(
                f"{source}: no topic {topic or 'with positions'} to make wrong; there are {', '.join(streams)}"
            )
        if streams[topic].schema.name == CLOUD and fault.kind not in STAMPS:
            raise LogError(f"{topic}: clouds have no values that {fault.kind} could change; give {', '.join(STAMPS)}")
        touched[topic] = streams[topic]
        told.append({"topic": topic, **_apply(fault, streams[topic], rng)})
    with copying(source, target) as copy:
        changed = (
            (record.log_time, one.number, (one.schema, one.channel, record))
            for one in touched.values()
            for record in one.records
        )
        others = (one for one in records(copy.files) if one[2][1].topic not in touched)
        in_order = sorted(changed, key=lambda one: one[0])
        with contextlib.ExitStack() as opened:
            readers = [make_reader(opened.enter_context(open(path, "rb"))) for path in copy.files]
            for _, number, (schema, channel, record) in heapq.merge(others, in_order, key=lambda one: one[0]):
                copy.keep(number, schema, channel, _whole(record, channel.topic, readers))
        copy.attach(TOLD, json.dumps({"seed": seed, "faults": told}).encode())
    return told


def _whole(record: Record, topic: str, readers: list[McapReader]) -> Record:
    """A message with its data, which those of clouds are read for."""
    stored = record.data
    if not isinstance(stored, Stored):
        return record
    at_once = readers[stored.number].iter_messages([topic], starting_at=stored.log_time, ending_at=stored.log_time)
    _, _, found = next(itertools.islice(at_once, stored.nth, None))
    return replace(record, data=stored.head + bytes(found.data[HEAD:]))


def _streams(files: list) -> dict[str, Messages]:
    """The topics that can be made wrong, by name."""
    found: dict[str, Messages] = {}
    at_once: Counter[tuple[str, int, int]] = Counter()
    for log_time, number, (schema, channel, record) in records(files):
        if schema is None or schema.name not in (*LAYOUTS, CLOUD):
            continue
        if schema.name == CLOUD:
            place = channel.topic, number, log_time
            record = replace(record, data=Stored(bytes(record.data[:HEAD]), number, log_time, at_once[place]))
            at_once[place] += 1
        found.setdefault(channel.topic, Messages(number, schema, channel, [])).records.append(record)
    return found


def _apply(fault: Fault, messages: Messages, rng: Generator) -> dict[str, Any]:
    rows = messages.decoded()
    if not rows.good.all() or not len(rows.t_ns):
        raise LogError(f"{messages.channel.topic}: {int((~rows.good).sum())} messages of it cannot be decoded")
    t_s = (rows.t_ns - rows.t_ns.min()) * 1e-9
    start_s, end_s = fault.start_s, fault.end_s
    if fault.kind in STRETCH and start_s is None:
        start_s = float(rng.uniform(0.2, 0.8)) * t_s.max() if end_s is None else 0.0
        end_s = start_s + 0.1 * t_s.max() if end_s is None else end_s
    start_s, end_s = start_s or 0.0, t_s.max() if end_s is None else end_s
    inside = np.flatnonzero((t_s >= start_s) & (t_s <= end_s))
    values = parameters(fault.kind) | fault.parameters
    hit = KINDS[fault.kind](messages, inside, rng, **values) if len(inside) else inside
    return {
        "kind": fault.kind,
        **values,
        "start_s": float(start_s),
        "end_s": float(end_s),
        "messages": len(rows.t_ns),
        "stamps_ns": rows.t_ns[hit].tolist(),
    }
