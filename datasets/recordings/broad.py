"""Nine-axis inertial unit turned and moved by hand, attitude truth by cameras (BROAD; one trial a file).

b is the unit. The authors turned their east-north-up frame to the unit's magnetic north, so no declination is left.
Nothing measures where it is: positions of the truth are counted from the middle of the motion, where the rig puts b.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.recordings import Recording, imu, magnetic, poses, read_npz, stamps
from tbmfg.rig import load_rig
from tbmfg.timeseries import NS

START_NS = 1_600_000_000 * NS  # the recordings have no date; this one is as good as any


def load(source: str | Path) -> Recording:
    """One trial; its truth holds what the authors evaluate: the moving part, where the cameras saw the markers."""
    arrays = read_npz(source)
    rig = load_rig("broad")
    gyro, acc, field = (arrays[name].astype(float) for name in ("gyr", "acc", "mag"))
    t_ns = stamps(np.arange(len(gyro)) / float(arrays["fs"]), START_NS)
    wxyz, position = arrays["truth_q_wxyz"].astype(float), arrays["truth_p"].astype(float)
    seen = arrays["movement"] & np.isfinite(wxyz).all(axis=1) & np.isfinite(position).all(axis=1)
    middle = np.median(position[seen], axis=0) if seen.any() else np.zeros(3)
    series = (
        imu(rig.imu.topic, t_ns, gyro, acc),
        magnetic(rig.sensors["magnetometer"].topic, t_ns, field),
        poses(rig.truth.topic, t_ns[seen], position[seen] - middle, wxyz[seen][:, [1, 2, 3, 0]]),
    )
    return Recording(series, rig)
