"""The chain of a window that moves: rows come at its end and leave at its beginning, and only what they change is
eliminated again.

Rows are kept by the keyframe that they begin at, as they were linearised. What the past says of a keyframe, its carry,
stays as long as no row before it changes; where the oldest keyframes leave, the carry is what they leave behind: linear
rows on the one that is then the oldest, and on the constants.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tbmfg.smoother.chain import Block, Elimination, end, pass_on, put
from tbmfg.timeseries import Floats

ROOM = 16  # keyframes, at first


class Sliding:
    """Rows on [x_k, c, b] in ``unary`` (room, ., d + m + 1) and on [x_k, x_k+1, c, b] in ``binary``, of which keyframe
    k has ``count[k]``; ``carry`` (room, d + m, d + m + 1) of each."""

    def __init__(self, d: int, m: int, unary: int, binary: int) -> None:
        """An empty window of states (d,) and constants (m,), for so many rows on one keyframe and on neighbours."""
        self.d, self.m = d, m
        self.unary, self.binary = np.zeros((ROOM, unary, d + m + 1)), np.zeros((ROOM, binary, 2 * d + m + 1))
        self.count = np.zeros((ROOM, 2), dtype=np.int64)
        self.carry, self.conditionals = np.zeros((ROOM, d + m, d + m + 1)), np.zeros((ROOM, d, 2 * d + m + 1))
        self.squares = np.zeros((ROOM, 2 * d + m))  # of the columns, by the keyframe that the rows begin at

    def make_room(self, n: int) -> None:
        """Room for ``n`` keyframes."""
        while n > len(self.count):
            for name in ("unary", "binary", "count", "carry", "conditionals", "squares"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))

    def begin(self, left: Block) -> None:
        """What the past says of the oldest keyframe and the constants, d + m rows."""
        self.carry[0] = np.hstack([left.A_i[0], left.A_c[0], left.b[0][:, None]])

    def clear(self, first: int) -> None:
        """Forget the rows on keyframes from ``first`` on."""
        self.count[first:] = 0
        self.count[max(first - 1, 0), 1] = 0

    def place(self, block: Block, start: int) -> None:
        """Add rows whose keyframes are counted from ``start``."""
        binary = block.A_j is not None
        rows, A_j = (self.binary, block.A_j) if binary else (self.unary, block.A_i)
        first = np.arange(len(rows)) * rows.shape[1]
        place = first + self.count[:, int(binary)]
        put(rows.reshape(-1, rows.shape[2]), place, block.i + start, binary, block.A_i, A_j, block.A_c, block.b)
        self.count[:, int(binary)] = place - first

    def eliminate(self, first: int, n: int) -> Elimination:
        """Eliminate keyframes ``first`` .. n - 1 again."""
        d, m = self.d, self.m
        border = _eliminate(
            self.unary, self.binary, self.count, self.carry, self.conditionals, self.squares, first, n, d, m
        )
        squares = self.squares[:n]
        own = squares[:, :d].copy()
        own[1:] += squares[:-1, d : 2 * d]
        past = np.sum(self.carry[0] ** 2, axis=0)
        own[0] += past[:d]
        border_columns = np.sqrt(squares[:, 2 * d :].sum(axis=0) + past[d:-1])
        return Elimination(self.conditionals[:n].copy(), border, np.sqrt(own), border_columns, n, d, m)

    def changed(self, dx: Floats, dc: Floats, skip: int, by: float) -> int:
        """First keyframe with a row whose residual ``dx`` (n, d) and ``dc`` (m,) change by more than ``by``: 0 where
        the constants alone do, n for none. The first ``skip`` rows on neighbours are passed over."""
        return _changed(self.unary, self.binary, self.count, dx, dc, skip, by)

    def leave(self, count: int) -> Floats:
        """Drop the oldest ``count`` keyframes: what they leave, rows [A, A_c, b] (d + m, d + m + 1)."""
        for rows in (self.unary, self.binary, self.count, self.carry, self.conditionals, self.squares):
            rows[:-count] = rows[count:]
        return self.carry[0].copy()


@njit(cache=True)
def _eliminate(unary, binary, count, carry, conditionals, squares, first, n, d, m):
    """Carries and conditionals of keyframes ``first`` .. n - 1, in place, and the triangle [R_c, rhs] of c."""
    W = np.empty((d + m + unary.shape[1] + binary.shape[1], 2 * d + m + 1))
    for k in range(first, n):
        own, next_too = unary[k, : count[k, 0]], binary[k, : count[k, 1]]
        _square(squares[k], own, next_too, d, m)
        if k < n - 1:
            pass_on(W, carry[k], own, next_too, d, m)
            conditionals[k], carry[k + 1] = W[:d], W[d : 2 * d + m, d:]
    return end(conditionals[n - 1], carry[n - 1], unary[n - 1, : count[n - 1, 0]], d, m)


@njit(cache=True)
def _square(out, unary, binary, d, m):
    """Squared lengths of the columns [x_k, x_k+1, c] of a keyframe's rows."""
    out[:] = 0.0
    for row in unary:
        for q in range(d):
            out[q] += row[q] ** 2
        for q in range(m):
            out[2 * d + q] += row[d + q] ** 2
    for row in binary:
        for q in range(2 * d + m):
            out[q] += row[q] ** 2


@njit(cache=True)
def _changed(unary, binary, count, dx, dc, skip, by):
    n, d, m = len(dx), dx.shape[1], len(dc)
    first = n
    for k in range(n):
        for r in range(count[k, 0]):
            row = unary[k, r]
            constant = np.dot(row[d : d + m], dc)
            if abs(constant) > by:
                return 0
            if abs(constant + np.dot(row[:d], dx[k])) > by:
                first = min(first, k)
        if k == n - 1:
            break
        for r in range(skip, count[k, 1]):
            row = binary[k, r]
            constant = np.dot(row[2 * d : 2 * d + m], dc)
            if abs(constant) > by:
                return 0
            if abs(constant + np.dot(row[:d], dx[k]) + np.dot(row[d : 2 * d], dx[k + 1])) > by:
                first = min(first, k)
    return first
