"""The two-point mounting calibration: exact without noise, as sure as it says with it, and refused without a way."""

from dataclasses import replace

import numpy as np
import pytest

from tbmfg.errors import EstimationError
from tbmfg.filters.mounting import two_point_mounting
from tbmfg.geometry import rotation_from_rpy, rpy_from_rotation
from tbmfg.prepare import prepare
from tbmfg.rig import SurveyPoint, override
from tests.problems import clean_log, drive, log_of, true_rig

YAW_DEG, PITCH_DEG = 6.0, -3.0
# b is turned so that the tracks, along x in the simulation, point YAW left and PITCH down of its x axis
TURN = rotation_from_rpy(np.radians([0.0, PITCH_DEG, YAW_DEG]))


def turned(simulation, log, rig):
    """The problem in a body frame that is turned against the simulated one, and the truth at its ends."""
    rpy = np.degrees(rpy_from_rotation(TURN)).tolist()
    arm = (TURN @ rig.sensors["odometer"].arm).tolist()
    rig = override(rig, [f"sensors.imu.T_bi.rpy_deg={rpy}", f"sensors.odometer.arm_m={arm}"])
    problem = prepare(log, rig, without=("prism", "magnetometer"))
    x = problem.prior.x.copy()
    before = rotation_from_rpy(np.radians([rig.initial.roll_deg, rig.initial.pitch_deg, rig.initial.yaw_deg]))
    x[:9] = (before @ TURN.T).ravel()
    ends = simulation.truth(problem.inertial.steps.edges_s[[0, -1]] + (problem.t0_ns - simulation.start_ns) * 1e-9)
    return replace(problem, prior=replace(problem.prior, x=x)), ends.position


def points(position_n, sigma_m=0.005):
    return [
        SurveyPoint(at=at, position_m=tuple(p.tolist()), sigma_m=sigma_m)
        for at, p in zip(("start", "end"), position_n, strict=True)
    ]


def found(problem, position_n):
    out = two_point_mounting(problem, *points(position_n))
    angles, scale = out["odometer_mounting_yaw_pitch_deg"], out["odometer_scale"]
    return np.array([*angles.value, scale.value]), np.array([*angles.sd, scale.sd])


def test_mounting_is_found_where_nothing_is_noisy():
    simulation = drive(0, 60.0, slide=0.0)
    value, _ = found(*turned(simulation, clean_log(simulation), true_rig(simulation)))
    # what is left is the attitude inside an odometer's period: 1 deg/s over 0.05 s, seen from its middle
    np.testing.assert_allclose(value, [YAW_DEG, PITCH_DEG, 0.0], atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_sds_are_those_of_the_error(seed):
    """Heading and tilt start where the prior drew them, and are most of the error."""
    simulation = drive(seed, 60.0, slide=1.0)
    value, sd = found(*turned(simulation, log_of(simulation.log_series), simulation.rig))
    error = value - [YAW_DEG, PITCH_DEG, simulation.drawn["odometer"]["scale"]]
    assert np.abs(error / sd).max() < 3.5
    # 0.02 m/s over 60 s at 20 Hz are 35 mm, and the way is 3.7 m
    assert sd.max() < 1.0
    assert sd[2] < 0.02


def test_too_short_a_way_and_points_that_contradict_it_give_no_mounting():
    simulation = drive(0, 15.0, slide=0.0)
    problem, _ = turned(simulation, clean_log(simulation), true_rig(simulation))
    here = np.zeros((2, 3))
    for sigma_m, reason in ((0.5, r"known to 0\.71 m; drive farther"), (0.005, "no mounting explains")):
        with pytest.raises(EstimationError, match=rf"apart after a way of 1\.\d+ m by odometer, .*{reason}") as caught:
            two_point_mounting(problem, *points(here, sigma_m))
        assert "\n" not in str(caught.value)
    with pytest.raises(EstimationError, match="no samples; the log has odometer"):
        two_point_mounting(problem, *points(here), "odometer-left")
