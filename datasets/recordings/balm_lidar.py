"""100 scans of a LiDAR carried through a building, 2 Hz, turning by up to 48 degrees between them (BALM benchmark).

The reference poses come with the data; how they were made is not stated: they are consistent, and no independent truth.
"""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from datasets.recordings import Recording, poses, read_npz, stamps
from datasets.recordings.scans import packed, rig
from tbmfg.timeseries import NS

TRUTH = "/truth/pose"


def load(source: str | Path) -> Recording:
    """All scans, and the reference poses of the LiDAR, which b is here."""
    arrays = read_npz(source)
    t_ns = stamps(arrays["scan_t"], round(float(arrays["t0_unix"]) * NS))
    T = arrays["ref_T"]
    truth = poses(TRUTH, t_ns, T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat())
    return Recording((truth,), rig("balm-lidar", TRUTH), clouds=(packed(arrays, t_ns),))
