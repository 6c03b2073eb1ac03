"""The chain solver against dense least squares and GTSAM: solutions, covariances, and what is not determined."""

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.smoother.chain import Block, eliminate, newest
from tests.problems import EPS


def blocks_of(n, d, m, rng, prior=True, rows=4):
    """Random rows on single keyframes, on neighbours and on the border, and a prior on the first keyframe."""
    every, links = np.arange(n), np.arange(n - 1)
    out = [
        Block(every, rng.normal(size=(n, rows, d)), None, rng.normal(size=(n, rows, m)), rng.normal(size=(n, rows))),
        Block(
            links,
            rng.normal(size=(n - 1, d + 1, d)),
            rng.normal(size=(n - 1, d + 1, d)),
            rng.normal(size=(n - 1, d + 1, m)),
            rng.normal(size=(n - 1, d + 1)),
        ),
    ]
    if prior:
        first = np.zeros(1, dtype=int)
        out += [
            Block(first, np.eye(d)[None], None, np.zeros((1, d, m)), rng.normal(size=(1, d))),
            Block(first, np.zeros((1, m, d)), None, np.eye(m)[None], rng.normal(size=(1, m))),
        ]
    return out


def dense(blocks, n, d, m):
    """The whole system: A (rows, n d + m) and b."""
    A, b = [], []
    for block in blocks:
        for r, i in enumerate(block.i):
            row = np.zeros((block.b.shape[1], n * d + m))
            row[:, i * d : (i + 1) * d] = block.A_i[r]
            if block.A_j is not None:
                row[:, (i + 1) * d : (i + 2) * d] = block.A_j[r]
            row[:, n * d :] = block.A_c[r]
            A.append(row)
            b.append(block.b[r])
    return np.vstack(A), np.concatenate(b)


@pytest.mark.parametrize(("n", "d", "m"), [(12, 5, 3), (12, 5, 0), (1, 4, 2), (1, 4, 0), (2, 17, 4), (30, 1, 1)])
def test_solution_and_covariances_are_those_of_dense_least_squares(n, d, m):
    blocks = blocks_of(n, d, m, np.random.default_rng(n))
    chain = eliminate(blocks, n, d, m)
    A, b = dense(blocks, n, d, m)
    expected, *_ = np.linalg.lstsq(A, b)
    information = A.T @ A
    cov = np.linalg.inv(information)
    rounding = 100 * EPS * np.linalg.cond(information)
    x, c = chain.solve()
    assert_allclose(np.concatenate([x.ravel(), c]), expected, atol=rounding * np.abs(expected).max())
    covs, c_cov = chain.covariances()
    for k in range(n):
        assert_allclose(covs[k], cov[k * d : (k + 1) * d, k * d : (k + 1) * d], atol=rounding * np.abs(cov).max())
    assert_allclose(c_cov, cov[n * d :, n * d :], atol=rounding * np.abs(cov).max())
    assert chain.undetermined() == []


@pytest.mark.parametrize(("n", "d", "m"), [(12, 5, 3), (12, 5, 0), (1, 4, 2), (2, 17, 4), (30, 1, 1)])
def test_covariance_of_the_newest_keyframe_is_that_of_the_rows_up_to_it(n, d, m):
    blocks = blocks_of(n, d, m, np.random.default_rng(n))
    found = newest(blocks, n, d, m)
    assert found.shape == (n, d, d)
    for k in range(n):
        past = []
        for block in blocks:
            own = block.i + (block.A_j is not None) <= k
            A_j = None if block.A_j is None else block.A_j[own]
            past.append(Block(block.i[own], block.A_i[own], A_j, block.A_c[own], block.b[own]))
        A, _ = dense(past, k + 1, d, m)
        information = A.T @ A
        cov = np.linalg.inv(information)
        rounding = 100 * EPS * np.linalg.cond(information)
        newest_rows = slice(k * d, (k + 1) * d)
        assert_allclose(found[k], cov[newest_rows, newest_rows], atol=rounding * np.abs(cov).max())


def test_against_gtsam_marginals():
    n, d, m = 8, 4, 2
    blocks = blocks_of(n, d, m, np.random.default_rng(3))
    graph = gtsam.GaussianFactorGraph()
    C = 1000
    unit = {k: gtsam.noiseModel.Unit.Create(k) for k in range(1, 10)}
    for block in blocks:
        for r, i in enumerate(block.i):
            keys = [int(i), C] if block.A_j is None else [int(i), int(i) + 1, C]
            parts = [block.A_i[r], block.A_c[r]] if block.A_j is None else [block.A_i[r], block.A_j[r], block.A_c[r]]
            terms = [x for pair in zip(keys, parts, strict=True) for x in pair]
            graph.add(gtsam.JacobianFactor(*terms, block.b[r], unit[len(block.b[r])]))
    solution = graph.optimize()
    values = gtsam.Values()
    for k in range(n):
        values.insert(k, np.zeros(d))
    values.insert(C, np.zeros(m))
    marginals = gtsam.Marginals(graph, values)
    chain = eliminate(blocks, n, d, m)
    x, c = chain.solve()
    covs, c_cov = chain.covariances()
    for k in range(n):
        assert_allclose(x[k], solution.at(k), atol=1e-11)
        assert_allclose(covs[k], marginals.marginalCovariance(k), atol=1e-11)
    assert_allclose(c, solution.at(C), atol=1e-11)
    assert_allclose(c_cov, marginals.marginalCovariance(C), atol=1e-11)


def test_order_of_rows_and_blocks_does_not_matter():
    n, d, m = 10, 4, 2
    rng = np.random.default_rng(7)
    blocks = blocks_of(n, d, m, rng)
    straight = eliminate(blocks, n, d, m)
    shuffled = []
    for block in reversed(blocks):
        order = rng.permutation(len(block.i))
        A_j = None if block.A_j is None else block.A_j[order]
        shuffled.append(Block(block.i[order], block.A_i[order], A_j, block.A_c[order], block.b[order]))
    other = eliminate(shuffled, n, d, m)
    for one, two in zip(
        [*straight.solve(), *straight.covariances()], [*other.solve(), *other.covariances()], strict=True
    ):
        assert_allclose(two, one, atol=1e-12)


def test_cost_at_the_solution_is_least():
    n, d, m = 6, 3, 2
    blocks = blocks_of(n, d, m, np.random.default_rng(8))
    A, b = dense(blocks, n, d, m)
    x, c = eliminate(blocks, n, d, m).solve()
    residual = A @ np.concatenate([x.ravel(), c]) - b
    assert_allclose(A.T @ residual, 0.0, atol=1e-12)


# ---- conditioning ----


def test_a_bias_walk_of_1e_9_beside_unit_priors():
    """A random walk seen through noise: normal equations hold 1e18 beside 1 and lose the second, QR keeps both.

    Closed form: n steps of the walk are next to constant, so the first state's variance is that of a mean.
    """
    n, walk = 200, 1e-9
    rng = np.random.default_rng(9)
    i, seen = np.arange(n), 3.0 + rng.standard_normal(n)
    one = np.ones((1, 1, 1))
    blocks = [
        Block(np.zeros(1, dtype=int), one, None, np.zeros((1, 1, 0)), np.zeros((1, 1))),
        Block(i, np.ones((n, 1, 1)), None, np.zeros((n, 1, 0)), seen[:, None]),
        Block(i[:-1], np.full((n - 1, 1, 1), -1 / walk), np.full((n - 1, 1, 1), 1 / walk), np.zeros((n - 1, 1, 0)),
              np.zeros((n - 1, 1))),
    ]  # fmt: skip
    chain = eliminate(blocks, n, 1, 0)
    x, _ = chain.solve()
    cov, _ = chain.covariances()
    mean, variance = seen.sum() / (n + 1), 1.0 / (n + 1)
    # the walk adds at most n^2 walk^2; QR rounds by the condition number, not its square
    rounding = 20 * EPS / walk
    assert_allclose(x[:, 0], mean, rtol=rounding)
    assert_allclose(cov[:, 0, 0], variance, rtol=rounding)
    A, b = dense(blocks, n, 1, 0)
    information = A.T @ A
    try:
        normal = np.linalg.solve(information, A.T @ b)
    except np.linalg.LinAlgError:
        return
    assert np.abs(normal - mean).max() > 1e3 * rounding, "normal equations fail here, so this test says something"


def test_states_of_very_different_size():
    """Columns over 12 orders of magnitude, as attitude, position and gyro bias are."""
    n, d, m = 20, 6, 2
    rng = np.random.default_rng(10)
    scale = np.array([1e-4, 1e-4, 1.0, 1.0, 1e-9, 1e-9])
    plain = blocks_of(n, d, m, rng)
    scaled = [Block(b.i, b.A_i / scale, None if b.A_j is None else b.A_j / scale, b.A_c / 1e-6, b.b) for b in plain]
    one, two = eliminate(plain, n, d, m), eliminate(scaled, n, d, m)
    x, c = one.solve()
    covs, c_cov = one.covariances()
    y, e = two.solve()
    scaled_covs, scaled_c_cov = two.covariances()
    assert_allclose(y / scale, x, atol=1e-11)
    assert_allclose(e / 1e-6, c, atol=1e-11)
    assert_allclose(scaled_covs / np.outer(scale, scale), covs, atol=1e-11)
    assert_allclose(scaled_c_cov / 1e-12, c_cov, atol=1e-11)
    assert two.undetermined() == []


# ---- what is not determined ----


def relative_chain(n, d, weight, rng):
    """Differences of neighbours, mixed over the components: the sum of all keyframes is free, d unknowns."""
    mix = weight * rng.normal(size=(n - 1, d, d))
    nothing = np.zeros((n - 1, d, 0))
    return [Block(np.arange(n - 1), -mix, mix, nothing, rng.normal(size=(n - 1, d)))]


@pytest.mark.parametrize("weight", [1e-3, 1.0, 1e6])
def test_a_chain_that_nothing_holds_is_found(weight):
    """Where rows are large, rounding leaves more than 1e-12 in the place of zero."""
    n, d = 30, 3
    chain = eliminate(relative_chain(n, d, weight, np.random.default_rng(11)), n, d, 0)
    assert len(chain.undetermined()) == d


@pytest.mark.parametrize("weight", [1e-3, 1.0, 1e6])
def test_weak_but_sufficient_knowledge_is_not_refused(weight):
    n, d = 30, 3
    hold = Block(np.zeros(1, dtype=int), 1e-2 * np.eye(d)[None], None, np.zeros((1, d, 0)), np.zeros((1, d)))
    chain = eliminate([*relative_chain(n, d, weight, np.random.default_rng(11)), hold], n, d, 0)
    assert chain.undetermined() == []
    assert_allclose(chain.covariances()[0][0], 1e4 * np.eye(d), atol=1.0)


def test_unseen_unknowns_are_named():
    n, d, m = 5, 3, 2
    blocks = blocks_of(n, d, m, np.random.default_rng(12), rows=5)
    for block in blocks:
        block.A_c[:, :, 1] = 0.0  # a constant that no row sees
        block.A_i[block.i == 4, :, 2] = 0.0
        if block.A_j is not None:
            block.A_j[block.i == 3, :, 2] = 0.0
    assert eliminate(blocks, n, d, m).undetermined() == [(4, 2), (-1, 1)]


def test_two_constants_of_which_only_the_sum_is_seen():
    n, d, m = 5, 3, 2
    blocks = blocks_of(n, d, m, np.random.default_rng(13), prior=False, rows=6)
    for block in blocks:
        block.A_c[:, :, 1] = block.A_c[:, :, 0]
    assert eliminate(blocks, n, d, m).undetermined() == [(-1, 1)]
