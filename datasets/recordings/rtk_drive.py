"""Car with a MEMS inertial unit and the fixes of an RTK antenna on its roof: streets on a hill, then a car park.

``clock`` chooses the inertial stamps: ``unit`` counts by the unit's own clock from the first sample on; ``logger``
takes the packaged ones, which the authors stretched by 275 ppm to fit the logger's first and last time, so that their
offset to the receiver drifts by 0.1 s in the drive. Either way they are late by 0.125 s, say the authors.
The truth is the track of the antenna, on the receiver's clock: hide fixes with ``--outage``, and it still has them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.recordings import G, Recording, fixes, imu, poses, read_npz, stamps
from tbmfg import earth
from tbmfg.errors import TbmfgError
from tbmfg.rig import load_rig

STATUS = {1: 2, 2: 2, 3: 1, 4: 2, 5: 0, 6: 1}  # RTKLIB's quality -> NavSatStatus: ground-based, satellite-based, none
FIXED = 1  # quality of a solution with its ambiguities resolved: good enough for a truth


def load(source: str | Path, clock: str = "unit") -> Recording:
    """The drive; the navigation frame of its truth touches the Earth at the first fix, as the rig's does."""
    if clock not in ("unit", "logger"):
        raise TbmfgError(f"rtk-drive: clock should be unit or logger, not {clock!r}")
    arrays = read_npz(source)
    rig = load_rig("rtk-drive")
    t0_ns = int(stamps(np.asarray(arrays["t0_gpst_unix"])))
    imu_s, unit_s = arrays["imu_t"], arrays["imu_clock_s"]
    imu_ns = stamps(imu_s if clock == "logger" else imu_s[0] + (unit_s - unit_s[0]), t0_ns)
    gnss_ns = stamps(arrays["gnss_t"], t0_ns)
    llh, quality = arrays["gnss_llh_deg_m"], arrays["gnss_Q"]
    status = np.array([STATUS.get(int(q), -1) for q in quality])
    radians = llh * [np.pi / 180, np.pi / 180, 1.0]
    track = earth.n_from_llh(radians, radians[status >= 0][0], rig.origin.x_axis_azimuth)
    sd_enu = arrays["gnss_sd_neu"][:, [1, 0, 2]]
    topics = rig.sensors
    return Recording(
        (
            imu(topics["imu"].topic, imu_ns, np.radians(arrays["imu_gyr_degps"]), G * arrays["imu_acc_g"]),
            fixes(topics["gnss"].topic, gnss_ns, llh, sd_enu, status),
            poses(rig.truth.topic, gnss_ns[quality == FIXED], track[quality == FIXED]),
        ),
        rig,
    )
