"""A car rolling to a stop in a town: 78 scans of 64 beams, 10 Hz, nothing else (KITTI raw 2011_09_26).

The scans are as the unit gave them, distorted by the motion; their stamps are nominal. There is no truth.
"""

from __future__ import annotations

from pathlib import Path

from datasets.recordings import Recording, read_npz, stamps
from datasets.recordings.scans import packed, rig
from tbmfg.timeseries import NS

START_NS = 1_317_000_000 * NS  # of that day; the hour is not known


def load(source: str | Path) -> Recording:
    """All scans; the last one is cut off in the source."""
    arrays = read_npz(source)
    return Recording((), rig("kitti-lidar"), clouds=(packed(arrays, stamps(arrays["scan_t"], START_NS)),))
