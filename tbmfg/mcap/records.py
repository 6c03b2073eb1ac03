"""The records in a block of an MCAP file, found by compiled code: a log of an hour holds millions of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numba import njit
from numpy.typing import NDArray

from tbmfg.timeseries import Times

MESSAGE = int(Opcode.MESSAGE)
HEAD_SIZE = 9  # opcode, length of what follows
MESSAGE_HEAD_SIZE = 22  # channel, sequence, log time, publish time


class Entries(NamedTuple):
    """Messages in a block: log times and where their payloads lie, (m,) each."""

    log_ns: Times
    start: Times
    stop: Times

    def select(self, rows: NDArray) -> Entries:
        return Entries(self.log_ns[rows], self.start[rows], self.stop[rows])

    def payloads(self, data: bytes) -> list[bytes]:
        return [data[start:stop] for start, stop in zip(self.start.tolist(), self.stop.tolist(), strict=True)]


def walk(data: bytes) -> tuple[NDArray[np.int64], Entries, list[tuple[int, int, int]], int]:
    """Channel of each message (m,), the messages, the other records as (opcode, first, past the last byte of the body),
    and the byte up to which there are whole records."""
    rows, at = _walk(np.frombuffer(data, np.uint8))
    message = rows[:, 0] == MESSAGE
    _, channel, log_ns, start, stop = rows[message].T
    others = [(int(row[0]), int(row[3]), int(row[4])) for row in rows[~message]]
    return channel, Entries(log_ns, start, stop), others, at


def gather(data: bytes, entries: Entries) -> NDArray[np.uint8]:
    """The payloads of ``entries``, one after the other."""
    return _gather(np.frombuffer(data, np.uint8), entries.start, entries.stop)


@njit(cache=True)
def _number(data, at, size):
    """Little-endian integer; of eight bytes the highest bit is the sign."""
    value = np.int64(0)
    for k in range(size):
        value |= np.int64(data[at + k]) << (8 * k)
    return value


@njit(cache=True)
def _walk(data):
    """Opcode, channel, log time, first and past-the-last byte of the payload of every record (n, 5), and the end."""
    count, capacity, end, at = 0, len(data) // 100 + 16, len(data), 0
    rows = np.empty((capacity, 5), np.int64)
    while at + HEAD_SIZE <= end:
        opcode, length, start = data[at], _number(data, at + 1, 8), at + HEAD_SIZE
        if length < 0 or length > end - start or (opcode == MESSAGE and length < MESSAGE_HEAD_SIZE):
            break
        at = start + length
        if count == capacity:
            capacity *= 2
            longer = np.empty((capacity, 5), np.int64)
            longer[:count] = rows
            rows = longer
        rows[count, 0], rows[count, 3], rows[count, 4] = opcode, start, at
        if opcode == MESSAGE:
            rows[count, 1], rows[count, 2] = _number(data, start, 2), _number(data, start + 6, 8)
            rows[count, 3] = start + MESSAGE_HEAD_SIZE
        count += 1
    return rows[:count], at


@njit(cache=True)
def _gather(data, start, stop):
    out = np.empty(np.sum(stop - start), np.uint8)
    at = 0
    for k in range(len(start)):
        size = stop[k] - start[k]
        out[at : at + size] = data[start[k] : stop[k]]
        at += size
    return out
