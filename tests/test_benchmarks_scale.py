"""The benchmark of scale: what it makes of its measurements, and one small run."""

from argparse import Namespace

import pytest

import datasets
from benchmarks import scale
from tbmfg.errors import TbmfgError


def spent(length: float) -> dict[str, float]:
    """A run that grows with the square of the length, its memory with the length."""
    return {stage: 1e-6 * length**2 for stage in (*scale.SHOWN, "total")} | {"length": length, "peak_rss": 0.1 * length}


def test_growth_is_the_exponent_that_the_times_have():
    rows = {row.metric: row for row in scale.growth_rows("batch", [spent(450.0 * 2**k) for k in range(4)])}
    assert rows["growth of total"].mean == pytest.approx(2.0)
    assert not rows["growth of total"].inside
    assert rows["growth of peak_rss"].mean == pytest.approx(1.0)
    assert rows["growth of peak_rss"].inside
    assert rows["growth of total"].scenario == "7.5-60 min"
    assert scale.growth_rows("batch", [spent(450.0)]) == []


def test_an_hour_is_held_to_what_is_asked_of_it():
    hour, quarter = ({row.metric: row for row in scale.stage_rows("batch", spent(s))} for s in (3600.0, 900.0))
    assert hour["x real time"].mean == pytest.approx(3600.0 / 12.96)
    assert hour["x real time"].inside
    assert hour["peak_rss"].inside
    assert quarter["x real time"].bound is None


def test_updates_that_slow_down_are_seen():
    mean, *_, last = scale.update_rows("fixed-lag", {"ms": [2.0] * 60 + [3.0] * 60, "length": 600.0})
    assert (mean.metric, mean.mean, mean.inside) == ("update, mean", 2.5, True)
    assert (last.metric, last.mean, last.inside) == ("update, late / early", 1.5, False)


def test_lengths_that_are_none_are_refused():
    with pytest.raises(TbmfgError, match="--minutes 5,x"):
        scale.measure(Namespace(minutes="5,x"))


@pytest.mark.slow
def test_a_small_run(tmp_path):
    log = tmp_path / "drive.mcap"
    datasets.make("tbm-drive", duration=24.0, imu_rate_hz=50.0).write(log)
    given = Namespace(log=log, minutes="0.2,0.4", estimators="ins", online="", copies=0, copy_minutes=0.2)
    rows = {(row.scenario, row.metric): row.mean for row in scale.measure(given)}
    whole = [metric for scenario, metric in rows if scenario == "0.4 min"]
    assert {"read", "prepare", "filter", "write", "total", "x real time", "peak_rss"} <= set(whole)
    # prepare filters too, so that stages overlap
    assert rows["0.4 min", "total"] >= max(rows["0.4 min", stage] for stage in ("read", "prepare", "filter", "write"))
