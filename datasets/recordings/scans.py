"""LiDAR scans as they are packed: int16 coordinates of all scans one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datasets.recordings import Arrays
from tbmfg.rig import Rig, parse_rig
from tbmfg.timeseries import StreamCounts, Times

TOPIC = "/points"


@dataclass(frozen=True, slots=True)
class PackedScans:
    """Scan k holds the points ``xyz_q[offsets[k]:offsets[k + 1]]`` times ``scale`` m; they have no own times."""

    topic: str
    t_ns: Times
    arrays: Arrays = field(repr=False)
    frame_id: str = "lidar"
    counts: StreamCounts = field(default_factory=StreamCounts)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __iter__(self) -> Iterator[tuple[int, dict[str, NDArray]]]:
        offsets, scale = self.arrays["offsets"], float(self.arrays["scale"])
        for k, t_ns in enumerate(self.t_ns):
            rows = slice(offsets[k], offsets[k + 1])
            xyz = (self.arrays["xyz_q"][rows] * scale).astype(np.float32)
            intensity = self.arrays["intensity"][rows].astype(np.float32)
            yield int(t_ns), {**{axis: xyz[:, a] for a, axis in enumerate("xyz")}, "intensity": intensity}


def packed(arrays: Arrays, t_ns: Times) -> PackedScans:
    """The scans of an npz file, stamped ``t_ns`` (n,)."""
    return PackedScans(TOPIC, t_ns, arrays, counts=StreamCounts(received=len(t_ns)))


def rig(name: str, truth_topic: str | None = None) -> Rig:
    """A rig of one LiDAR. The recordings have no IMU: an estimator refuses them, LiDAR odometry does not."""
    truth = f"truth: {{topic: {truth_topic}}}\n" if truth_topic else ""
    return parse_rig(f"name: {name}\nsensors: {{imu: {{topic: /imu}}, lidar: {{topic: {TOPIC}}}}}\n{truth}", name)
