"""The sliding chain against the whole one: rows come and leave, and are put in again, and nothing is forgotten."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.smoother.chain import Block, eliminate
from tbmfg.smoother.sliding import ROOM, Sliding
from tests.problems import EPS
from tests.test_chain import blocks_of

D, M, N = 4, 2, 2 * ROOM + 5


def between(block: Block, low: int, high: int) -> Block:
    """The rows that lie on keyframes low .. high alone, counted from low."""
    own = (block.i >= low) & (block.i + (block.A_j is not None) <= high)
    A_j = None if block.A_j is None else block.A_j[own]
    return Block(block.i[own] - low, block.A_i[own], A_j, block.A_c[own], block.b[own])


def slide(blocks: list[Block], last: int, sliding: Sliding, first: int, begin: int) -> None:
    """Put the rows on keyframes from ``first`` on in again; the window begins at keyframe ``begin`` of the chain."""
    sliding.make_room(last - begin + 1)
    sliding.clear(first - begin)
    for block in blocks:
        start = max(first - 1, begin) if block.A_j is not None else first
        sliding.place(between(block, start, last), start - begin)


@pytest.fixture
def system():
    """Rows of a chain, what is known of its first keyframe and of the constants, and a window of the first."""
    rng = np.random.default_rng(5)
    first, size = np.zeros(1, dtype=int), D + M
    past = Block(first, rng.normal(size=(1, size, D)), None, rng.normal(size=(1, size, M)), rng.normal(size=(1, size)))
    blocks = blocks_of(N, D, M, rng, prior=False)
    sliding = Sliding(D, M, unary=4, binary=D + 1)
    sliding.begin(past)
    return blocks, past, sliding


def same(one, other, first: int = 0) -> None:
    """Solutions and covariances from keyframe ``first`` of ``other`` on."""
    (x, c), (x_other, c_other) = one.solve(), other.solve()
    (cov, c_cov), (cov_other, c_cov_other) = one.covariances(), other.covariances(first)
    rounding = 1e5 * EPS * np.linalg.cond(other.border[:, :M])
    for ours, theirs in ((x, x_other[first:]), (c, c_other), (cov, cov_other), (c_cov, c_cov_other)):
        assert_allclose(ours, theirs, atol=rounding * np.abs(theirs).max())


def test_growing_is_the_chain_so_far(system):
    blocks, past, sliding = system
    for last in range(N):
        slide(blocks, last, sliding, first=last, begin=0)
        chain = sliding.eliminate(max(last - 1, 0), last + 1)
        whole = eliminate([*(between(block, 0, last) for block in blocks), past], last + 1, D, M)
        same(chain, whole)
        assert_allclose(chain.scale, whole.scale)
        assert_allclose(chain.border_scale, whole.border_scale)


def test_what_leaves_is_not_forgotten(system):
    blocks, past, sliding = system
    begin = 0
    for last in range(N):
        slide(blocks, last, sliding, first=last, begin=begin)
        chain = sliding.eliminate(max(last - 1 - begin, 0), last - begin + 1)
        if last % 7 == 6:
            sliding.leave(4)
            begin += 4
    whole = eliminate([*blocks, past], N, D, M)
    same(chain, whole, begin)


def test_an_elimination_stays_as_it_was(system):
    blocks, _, sliding = system
    slide(blocks, 9, sliding, first=0, begin=0)
    chain = sliding.eliminate(0, 10)
    x, _ = chain.solve()
    sliding.leave(3)
    slide(blocks, 12, sliding, first=10, begin=3)
    sliding.eliminate(0, 10)
    assert_allclose(chain.solve()[0], x, rtol=0)


def test_rows_changed_in_the_middle_take_the_place_of_the_old_ones(system):
    blocks, past, sliding = system
    slide(blocks, N - 1, sliding, first=0, begin=0)
    sliding.eliminate(0, N)
    other = [
        replace(block, b=np.where(block.i[:, None] + (block.A_j is not None) >= 9, -1.0, block.b)) for block in blocks
    ]
    slide(other, N - 1, sliding, first=9, begin=0)
    same(sliding.eliminate(8, N), eliminate([*other, past], N, D, M))


def test_left_rows_are_those_of_the_keyframes_before(system):
    blocks, past, sliding = system
    slide(blocks, 9, sliding, first=0, begin=0)
    sliding.eliminate(0, 10)
    left = sliding.leave(6)
    gone = [between(block, 0, 6) for block in blocks if block.A_j is not None]
    gone += [between(block, 0, 5) for block in blocks if block.A_j is None]
    chain = eliminate([*gone, past], 7, D, M)
    information = left[:, :-1].T @ left[:, :-1]
    cov = np.linalg.inv(information)
    assert_allclose(cov[:D, :D], chain.covariances(6)[0][0], rtol=1e-9)
    assert_allclose(cov[D:, D:], chain.covariances(6)[1], rtol=1e-9)
    assert_allclose(np.linalg.solve(left[:, :-1], left[:, -1])[:D], chain.solve()[0][6], rtol=1e-9)


@pytest.mark.parametrize(
    ("moved", "expected"),
    [((5, 0), 5), ((), N), ((N - 1, 2), N - 2), ((8, 3), 7)],
    ids=["alone", "none", "last", "as the next"],
)
def test_first_keyframe_whose_residuals_change(system, moved, expected):
    blocks, _, sliding = system
    if expected == 5:  # nothing but the rows on it alone
        blocks = [block for block in blocks if block.A_j is None]
    slide(blocks, N - 1, sliding, first=0, begin=0)
    dx = np.zeros((N, D))
    if moved:
        dx[moved] = 10.0
    assert sliding.changed(dx, np.zeros(M), 0, 1.0) == expected
    skipped = sliding.changed(dx, np.zeros(M), D + 1, 1.0)  # all rows on neighbours
    assert skipped == (moved[0] if moved else N)


def test_constants_change_all(system):
    blocks, _, sliding = system
    slide(blocks, N - 1, sliding, first=0, begin=0)
    assert sliding.changed(np.zeros((N, D)), np.full(M, 10.0), 0, 1.0) == 0
