"""Magnetometer, barometer and laser against their units and their health: recognised, said, counted."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import datasets
from tbmfg.errors import LogError
from tbmfg.estimators import estimate
from tbmfg.prepare import health, prepare
from tbmfg.prepare.units import in_si
from tbmfg.rig import Barometer, Laser, Magnetometer, override
from tbmfg.timeseries import Series
from tests.problems import log_of
from tests.test_outcome import assert_counted

SENSORS = {
    "magnetometer": (Magnetometer, "field", np.array([20e-6, -5e-6, 40e-6])),
    "barometer": (Barometer, "pressure", 98_000.0),
    "laser": (Laser, "point", np.array([8e-3, -4e-3, 0.0])),
}
SIZES = {"T": 1.0, "G": 1e4, "uT": 1e6, "nT": 1e9, "Pa": 1.0, "hPa": 1e-2, "kPa": 1e-3, "m": 1.0, "mm": 1e3}


def series(column, values, rate_hz=50.0):
    t_ns = np.round(np.arange(len(values)) * 1e9 / rate_hz).astype(np.int64)
    return Series("/topic", "type", t_ns, {column: np.asarray(values, dtype=float)})


def readings_of(kind, unit, n=100):
    """Readings of a live sensor in a unit."""
    _, column, typical = SENSORS[kind]
    noise = 1 + 1e-3 * np.random.default_rng(0).standard_normal((n, *np.shape(typical)))
    return series(column, SIZES[unit] * typical * noise)


@pytest.mark.parametrize(
    ("kind", "unit"),
    [("magnetometer", unit) for unit in ("T", "G", "uT", "nT")]
    + [("barometer", unit) for unit in ("Pa", "hPa", "kPa")]
    + [("laser", unit) for unit in ("m", "mm")],
)
def test_a_unit_is_recognised_refused_and_taken_once_the_rig_confirms_it(kind, unit):
    model, column, typical = SENSORS[kind]
    given = readings_of(kind, unit)
    confirmed = in_si("log", kind, model(topic="/topic", unit=unit), given)
    assert np.median(confirmed[column], axis=0) == pytest.approx(typical, rel=1e-3)
    if unit in ("T", "Pa", "m"):
        assert np.array_equal(confirmed[column], given[column])
        return
    with pytest.raises(LogError, match=rf"set sensors\.{kind}-top\.unit={unit}$"):
        in_si("log", f"{kind}-top", model(topic="/topic"), given)


def test_a_unit_that_the_rig_states_wrongly_is_refused_as_well():
    with pytest.raises(LogError, match=r"seems to be in Pa; if so, set sensors\.barometer\.unit=Pa"):
        in_si("log", "barometer", Barometer(topic="/topic", unit="kPa"), readings_of("barometer", "Pa"))


def test_what_no_unit_explains_is_said():
    with pytest.raises(
        LogError, match=r"typically 5 Pa, where 30000 to 160000 can be: none of Pa, hPa, kPa explains it"
    ):
        in_si("log", "barometer", Barometer(topic="/topic"), series("pressure", np.full(20, 5.0)))


def test_other_sensors_pass():
    given = series("linear", np.ones((30, 3)))
    assert in_si("log", "odometer", Magnetometer(topic="/x"), given) is given


def test_a_barometer_that_repeats_one_value_is_left_out():
    t_s = np.arange(50) / 20
    sound, [said] = health.barometer(t_s, np.full(50, 320.0))
    assert not sound.any()
    assert "all 50 samples are the same, 320.00 m" in said
    assert health.barometer(t_s, np.repeat([320.0, 320.1], 25))[0].all()


def test_spots_at_the_edge_of_the_detector_and_spots_that_hang():
    t_s, spot = np.arange(500) / 50, readings_of("laser", "m", 500)["point"][:, :2].copy()
    spot[100:110, 1] = -30e-3
    spot[200:400] = spot[200]
    spot[450:500] = spot[450]  # a second: too short to tell
    sound, said = health.laser(t_s, spot, 30e-3)
    assert np.array_equal(np.flatnonzero(~sound), [*range(100, 110), *range(201, 400)])
    assert len(said) == 2
    assert "10 of 500 samples, the first at 2.0 s" in said[0]
    assert "199 of 500 samples" in said[1]
    assert health.laser(t_s, spot, None)[0][100:110].all(), "how large the detector is, only the rig can tell"


# ---- in a log ----


@cache
def shaft():
    return datasets.make("shaft-descend", seed=1, duration=15.0, settings=("sensors.imu.noise_factor=1",))


def log_with(**changed):
    """The shaft's log with the values of some topics' columns replaced by a function of them."""
    topics = {"laser": "/laser/spot", "barometer": "/barometer", "magnetometer": "/imu/mag"}
    by_topic = {topics[name]: change for name, change in changed.items()}
    spoilt = []
    for given in shaft().log_series:
        change = by_topic.get(given.topic, lambda values: values)
        spoilt.append(replace(given, columns={name: change(values.copy()) for name, values in given.columns.items()}))
    return log_of(spoilt)


def test_what_is_left_out_is_counted_and_said():
    def spoil(point):
        point[100:200] = [30e-3, 0.0, 0.0]
        point[300:500] = point[300]
        return point

    rig = shaft().rig
    log = log_with(laser=spoil, barometer=lambda p: np.full_like(p, 98_000.0))
    problem = prepare(log, rig)
    result = estimate("sbm-ekf", problem)
    assert_counted(result, log, rig)
    plain = estimate("sbm-ekf", prepare(log_with(), rig))
    assert result.counts["laser"].unused == plain.counts["laser"].unused + 100 + 199
    assert result.counts["barometer"].used == 0
    assert sum(line.startswith("barometer:") for line in problem.warnings) == 1


def test_a_log_in_other_units_gives_the_same_once_confirmed():
    rig = shaft().rig
    log = log_with(barometer=lambda p: p / 1e3, magnetometer=lambda b: b * 1e4)
    with pytest.raises(LogError, match=r"sensors\.magnetometer\.unit=G"):
        prepare(log, rig)
    confirmed = override(rig, ["sensors.barometer.unit=kPa", "sensors.magnetometer.unit=G"])
    found, plain = (
        estimate("sbm-cf", prepare(*given)).trajectory.position_n for given in ((log, confirmed), (log_with(), rig))
    )
    assert np.abs(found - plain).max() < 1e-6
