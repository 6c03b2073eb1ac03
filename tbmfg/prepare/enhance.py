"""The inertial enhancement that a rig may ask for, once for all estimators, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tbmfg.fields import DEG, MICRO_G
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
    (gyro, acc), (gyro_density, acc_density) = changed.rms, changed.density
    warnings.append(
        f"imu: enhanced by mode decomposition in windows of {wanted.window:g} s, so that an online estimate lags by as "
        f"much: {acc:.3g} m/s^2 and {gyro / DEG:.3g} deg/s rms taken away; what may have been motion of it counts as "
        f"noise of {acc_density / MICRO_G:.3g} ug and {gyro_density / DEG:.2g} deg/s per sqrt(Hz)"
    )
    return found


def levelled(setup: Setup) -> dict[str, Calibrated]:
    """Put the correction of the tilt by gravity into the rates of ``setup``; the density of its noise.

    After the alignment: before the heading is known the Earth's rate would be taken for an error of tilt.
    """
    rig, steps = setup.rig, setup.steps
    wanted = rig.imu.enhancement
    if wanted is None or wanted.alpha_bar == 0:
        return {}
    rates = enhancement.gravity_correction(
        steps, setup.gyro, setup.acc, setup.R_start, setup.bias_gyro, rig.origin.rate_n, rig.origin.gravity,
        wanted.alpha_bar,
    )  # fmt: skip
    density = enhancement.changed_density(rates, steps.period_s, max(1, round(wanted.window / steps.period_s)))
    setup.gyro = setup.gyro + rates
    setup.frame = gyro_frame(steps, setup.gyro, setup.bias_gyro)
    setup.steps = replace(steps, extra_gyro=steps.extra_gyro + density**2)
    turned = np.sqrt(np.mean(rates**2)) / DEG
    setup.warnings.append(
        f"imu: tilt held by gravity with alpha_bar {wanted.alpha_bar:g}: {turned:.2g} deg/s rms put into the gyro's "
        f"rates, counted as noise of {density / DEG:.2g} deg/s per sqrt(Hz); accelerating is taken for tilt"
    )
    return {"tilt_correction_density_dps_rthz": Calibrated(float(density / DEG), 0.0, False)}
