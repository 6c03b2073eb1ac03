"""The inertial enhancement that a rig may ask for, once for all estimators, and what is said of it."""

from __future__ import annotations

from tbmfg.fields import DEG
from tbmfg.inertial import enhancement
from tbmfg.inertial.steps import Steps
from tbmfg.measure import gyro_frame
from tbmfg.prepare.start import Setup
from tbmfg.rig import Rig
from tbmfg.state import Calibrated


def denoised(rig: Rig, steps: Steps, warnings: list[str]) -> Steps:
    """The steps without what empirical mode decomposition takes for noise, before anything is made of them."""
    wanted = rig.imu.enhancement
    if wanted is None or wanted.emd_threshold == "off":
        return steps
    found, changed = enhancement.denoise(steps, wanted.emd_threshold, wanted.window, wanted.give_back)
    warnings.append(str(changed))
    return found


def levelled(setup: Setup) -> dict[str, Calibrated]:
    """Put the correction of the tilt by gravity into the rates of ``setup``; the density of its noise.

    After the alignment: before the heading is known the Earth's rate would be taken for an error of tilt.
    """
    rig = setup.rig
    wanted = rig.imu.enhancement
    if wanted is None or wanted.alpha_bar == 0:
        return {}
    setup.steps, setup.gyro, told = enhancement.level(
        setup.steps, setup.gyro, setup.acc, setup.R_start, setup.bias_gyro, rig.origin.rate_n, rig.origin.gravity,
        wanted,
    )  # fmt: skip
    setup.frame = gyro_frame(setup.steps, setup.gyro, setup.bias_gyro)
    setup.warnings.append(str(told))
    return {"tilt_correction_density_dps_rthz": Calibrated(told.density / DEG, 0.0, False)}
