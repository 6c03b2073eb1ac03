"""Stamps that cannot be right are left out and counted; all others stay."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_samples import START_NS, sample

from tbmfg.mcap import describe, info_text, read_log, write_log
from tbmfg.mcap.stamps import eras, misdated
from tbmfg.timeseries import NS

DAY = 86_400 * NS
EVERY = NS // 100
TRUE = START_NS + np.arange(3000) * EVERY  # 30 s at 100 Hz


def left_out(t_ns, log_ns=TRUE, others=()):
    return np.flatnonzero(misdated(t_ns, log_ns[: len(t_ns)], eras([t_ns, *others]))).tolist()


def changed(rows, value):
    t_ns = TRUE.copy()
    t_ns[rows] = value
    return t_ns


@pytest.mark.parametrize(
    ("t_ns", "wrong"),
    [
        (TRUE, []),
        (changed(0, 0), [0]),
        (changed([5, 6, 7], 0), [5, 6, 7]),
        (changed(slice(None), 0), list(range(3000))),
        (changed(7, TRUE[7] + 3 * DAY), [7]),
        (changed(7, TRUE[7] - 3 * DAY), [7]),
        (changed(slice(0, 100), EVERY * np.arange(100)), list(range(100))),  # before the clock was set
        (changed(7, TRUE[7] + 100 * NS), [7]),  # ahead of all that follow
        (changed(700, TRUE[0]), [700]),  # behind those before it
        (changed(700, TRUE[699] - EVERY // 2), []),  # overtaken, within a second
        (changed(slice(2000, None), TRUE[2000:] - 5 * NS), list(range(2000, 2499))),  # five seconds, twice
        (changed(slice(2000, None), TRUE[2000:] + 600 * NS), []),  # a pause
        (EVERY * np.arange(3000), []),  # simulated time begins at zero
        (np.concatenate([TRUE[1500:], TRUE[:1500]]), []),  # only the order is lost
    ],
)
def test_what_is_not_to_be_believed(t_ns, wrong):
    assert left_out(t_ns) == wrong


def test_turned_back_clock_is_seen_in_the_order_of_arrival():
    t_ns = changed(slice(2000, None), TRUE[2000:] - 5 * NS)
    shuffled = np.random.default_rng(0).permutation(len(t_ns))
    assert set(left_out(t_ns[shuffled], TRUE[shuffled])) == set(np.flatnonzero(np.isin(shuffled, range(2000, 2499))))


def test_a_rare_topic_goes_by_the_others():
    rare = START_NS + np.array([0, 3, 6]) * 3600 * NS
    steady = START_NS + np.arange(0, 7 * 3600, 600) * NS
    assert left_out(rare, others=[steady]) == []
    assert len(left_out(rare)) == 2


def test_a_topic_on_a_clock_of_its_own_stays():
    assert left_out(np.arange(3000) * EVERY, others=[TRUE, TRUE]) == []


@given(st.lists(st.integers(-(2**40), 2**62), max_size=30))
def test_any_stamps_get_an_answer(stamps):
    t_ns = np.array(stamps, dtype=np.int64)
    assert len(misdated(t_ns, np.arange(len(t_ns)), eras([t_ns]))) == len(t_ns)


def test_the_log_counts_them_and_info_says_so(tmp_path):
    imu = sample("sensor_msgs/msg/Imu", 200)
    t_ns = imu.t_ns.copy()
    t_ns[[3, 40, 41]] = 0, 0, t_ns[41] + 2 * DAY
    wrong = imu.select(slice(None))
    write_log(tmp_path / "x.mcap", [type(imu)(imu.topic, imu.type, t_ns, wrong.columns)], log_ns={imu.topic: imu.t_ns})
    series = read_log(tmp_path / "x.mcap").series[imu.topic]
    assert (series.counts.received, series.counts.misdated, len(series)) == (200, 3, 197)
    np.testing.assert_array_equal(series.t_ns, np.delete(imu.t_ns, [3, 40, 41]))
    (topic,) = describe(tmp_path / "x.mcap").topics
    assert topic.rate_hz == pytest.approx(100, rel=0.2)
    assert "3 of 200 messages bear a stamp that cannot be right" in info_text(describe(tmp_path / "x.mcap"))
