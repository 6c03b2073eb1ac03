"""Integration steps from IMU samples: where stamps lie, what stands in for lost samples, and wild stamps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from tbmfg.errors import LogError
from tbmfg.geometry import rotation_from_rpy
from tbmfg.inertial.steps import interpolation_error, make_steps, step_index, to_ns
from tests.problems import EPS, imu_series

PERIOD_NS, PERIOD = 5_000_000, 5e-3
START_NS = 1_700_000_000_000_000_000
UPRIGHT = np.eye(3)


def ramp(count):
    """Samples that grow along a straight line: interpolation restores them."""
    k = np.arange(count)[:, None]
    return 0.1 + k * np.array([1e-3, -2e-3, 3e-3]), 9.0 + k * np.array([-4e-3, 5e-3, 1e-3])


def series_without(lost, count=40, samples=None):
    """A regular series with the rows ``lost`` missing."""
    gyro, acc = ramp(count) if samples is None else samples
    keep = np.setdiff1d(np.arange(len(gyro)), lost)
    return imu_series(gyro[keep], acc[keep], t_ns=START_NS + PERIOD_NS * keep)


# ---- stamps ----


@pytest.mark.parametrize(("stamp", "first"), [("start", 0.0), ("centre", -PERIOD / 2), ("end", -PERIOD)])
def test_a_sample_covers_its_period(stamp, first):
    series = series_without([])
    steps = make_steps(series, UPRIGHT, stamp)
    assert_allclose(steps.edges_s, first + PERIOD * np.arange(41), atol=1e-15)
    assert steps.t0_ns == START_NS
    assert steps.period_s == pytest.approx(PERIOD, abs=1e-15)
    assert_array_equal(steps.gyro, series["gyro"])
    assert_array_equal(steps.acc, series["acc"])
    assert steps.gaps == ()
    assert not steps.extra_gyro.any()
    assert not steps.extra_acc.any()
    assert steps.end_s == pytest.approx(first + 40 * PERIOD, abs=1e-15)


def test_samples_are_turned_into_body_axes():
    R_bi = rotation_from_rpy(np.radians([10.0, -20.0, 70.0]))
    series = series_without([7, 8])
    steps, upright = make_steps(series, R_bi, "end"), make_steps(series, UPRIGHT, "end")
    assert_allclose(steps.gyro, upright.gyro @ R_bi.T, atol=8 * EPS)
    assert_allclose(steps.acc, upright.acc @ R_bi.T, atol=80 * EPS)


def test_jitter_of_stamps_is_no_gap():
    rng = np.random.default_rng(0)
    t_ns = START_NS + PERIOD_NS * np.arange(200) + rng.integers(-1_000_000, 1_000_001, 200)
    steps = make_steps(imu_series(*ramp(200), t_ns=t_ns), UPRIGHT, "end")
    assert len(steps) == 200
    assert_allclose(steps.edges_s[1:], (t_ns - t_ns[0]) * 1e-9, atol=1e-15)


def test_times_and_stamps_are_inverse_and_find_their_step():
    steps = make_steps(series_without([3]), UPRIGHT, "centre")
    assert_array_equal(to_ns(steps, steps.edges_s[1:] - 2.5e-3), START_NS + PERIOD_NS * np.arange(40))
    middle = (steps.edges_s[:-1] + steps.edges_s[1:]) / 2
    assert_array_equal(step_index(steps, middle), np.arange(40))
    assert_array_equal(step_index(steps, np.array([-9.0, steps.edges_s[0], steps.end_s, 99.0])), [0, 0, 39, 39])


def test_too_few_samples_are_refused_with_the_next_move():
    with pytest.raises(LogError, match=r"/imu: 2 usable IMU samples; at least 3.*topic"):
        make_steps(imu_series(*ramp(2)), UPRIGHT, "end")


# ---- lost samples ----


@pytest.mark.parametrize("stamp", ["start", "centre", "end"])
@pytest.mark.parametrize("lost", [[5], [5, 6, 7], [2, 9, 10, 30], list(range(4, 35))])
def test_lost_samples_of_a_ramp_are_restored(lost, stamp):
    whole, filled = make_steps(series_without([]), UPRIGHT, stamp), make_steps(series_without(lost), UPRIGHT, stamp)
    assert_allclose(filled.edges_s, whole.edges_s, atol=1e-12)
    assert_allclose(filled.gyro, whole.gyro, atol=1e-12)
    assert_allclose(filled.acc, whole.acc, atol=1e-12)
    assert not np.delete(filled.extra_gyro + filled.extra_acc, lost).any()


def test_gaps_say_what_was_lost():
    lost = [5, 20, 21, 22]
    steps = make_steps(series_without(lost), UPRIGHT, "end")
    assert_allclose(steps.gaps, [(4 * PERIOD, 5 * PERIOD), (19 * PERIOD, 22 * PERIOD)], atol=1e-12)


def test_extra_noise_is_the_error_that_the_same_interpolation_makes():
    """Samples alternate: a lost one is replaced by its negative, an error of exactly two amplitudes."""
    amplitude = np.array([0.3, 0.2, 0.1])
    sign = (-1.0) ** np.arange(400)[:, None]
    samples = sign * amplitude, 5 * sign * amplitude
    steps = make_steps(series_without([100], samples=samples), UPRIGHT, "end")
    error = 2 * np.sqrt(np.mean(amplitude**2))
    # the density that makes the same change over the gap: (error x length)^2 = density x length
    # near the gap itself the known samples do not alternate: 3 of 397 windows
    assert steps.extra_gyro[100] == pytest.approx(error**2 * PERIOD, rel=0.02)
    assert steps.extra_acc[100] == pytest.approx(25 * error**2 * PERIOD, rel=0.02)
    assert np.flatnonzero(steps.extra_gyro).tolist() == [100]


@pytest.mark.parametrize("count", [1, 3, 10])
def test_extra_noise_covers_what_lost_samples_cost(count):
    """White samples: the mean of ``count`` lost ones against the mean of two has variance s^2 (1 / count + 1 / 2)."""
    rng, sd, n = np.random.default_rng(1), 0.4, 20_000
    known = sd * rng.standard_normal((n, 3))
    expected = sd * np.sqrt(1 / count + 1 / 2)
    # 3 n errors, neighbours sharing samples over 2 (count + 1): that many fewer are independent
    spread = 4 * np.sqrt(2 * (count + 1) / (2 * 3 * n))
    assert interpolation_error(known, count) == pytest.approx(expected, rel=spread)
    lost = np.arange(500, 500 + count)
    steps = make_steps(series_without(lost, samples=(known, known)), UPRIGHT, "end")
    density = steps.extra_gyro[lost]
    assert_allclose(density, expected**2 * count * PERIOD, rtol=2 * spread)
    # and that is what it does to the integral over the gap
    assert np.sum(density) * PERIOD == pytest.approx((expected * count * PERIOD) ** 2, rel=2 * spread)


def test_interpolation_error_of_a_gap_longer_than_the_log():
    known = np.random.default_rng(2).standard_normal((30, 3))
    assert 0 < interpolation_error(known, 10_000) < 2
    assert interpolation_error(known[:2], 5) == pytest.approx(np.std(known[:2]))


# ---- wild stamps ----


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.one_of(st.integers(1, 3), st.integers(10**6, 10**7), st.integers(10**7, 10**9)), min_size=2, max_size=60
    ),
    st.sampled_from(["start", "centre", "end"]),
)
def test_whatever_the_stamps_the_steps_are_contiguous_and_hold_every_sample(intervals, stamp):
    t_ns = START_NS + np.concatenate([[0], np.cumsum(intervals)])
    n = len(t_ns)
    gyro, acc = ramp(n)
    try:
        steps = make_steps(imu_series(gyro, acc, t_ns=t_ns), UPRIGHT, stamp)
    except LogError:
        assert np.sum(intervals) > 50 * n * np.median(intervals), "only stamps that hold next to no samples are refused"
        return
    assert np.all(np.diff(steps.edges_s) > 0)
    assert np.isfinite(steps.gyro).all()
    assert len(steps.edges_s) == len(steps) + 1 == len(steps.extra_gyro) + 1 == len(steps.extra_acc) + 1
    shift = {"start": 1.0, "centre": 0.5, "end": 0.0}[stamp] * steps.period_s
    ends = (t_ns - t_ns[0]) * 1e-9 + shift
    at = np.searchsorted(steps.edges_s, ends - 1e-12)
    assert_allclose(steps.edges_s[at], ends, atol=1e-12)
    assert_array_equal(steps.gyro[at - 1], gyro)
    assert_array_equal(steps.acc[at - 1], acc)
    assert np.all(steps.dt < 2.5 * steps.period_s)


def test_stamps_in_bursts_are_refused_rather_than_filled():
    """Eight samples a microsecond apart every 40 ms: the median interval is no period."""
    t_ns = START_NS + np.cumsum(np.tile([1000] * 7 + [40_000_000], 30))
    with pytest.raises(LogError, match=r"/imu.*burst"):
        make_steps(imu_series(*ramp(240), t_ns=t_ns), UPRIGHT, "end")
