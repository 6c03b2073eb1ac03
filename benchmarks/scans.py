"""LiDAR odometry by the scans alone, beside the libraries, on a recording (BALM, KITTI; recordings not part of this).

GenZ-ICP is among them where it is installed (pip install genz-icp).
Every method takes the same scans in the same order, with its own constant-velocity guess, and ends where it is lost;
the one that flags at its next flag. Medians over the repetitions:

lost       first scan whose pose is more than 0.3 m or 5 degrees from the reference, the number of scans for none
flagged    share of the good scans that were flagged, of the methods that flag
late       scans from the first lost one to the next flag, 0 where none is lost
cost       CPU time of a scan, its median over the scans
ratio      of that to bare KISS-ICP at the voxel of ours, in the same run
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.rows import Row
from benchmarks.runs import points_of
from benchmarks.workers import bar
from tbmfg.timeseries import Floats

VOXELS_M = (0.2, 0.4, 0.8)
LOST_M, LOST_DEG = 0.3, 5.0
OURS, BARE = "ours", "KISS-ICP"
Register = Callable[[Floats, float], tuple[Floats, bool]]  # points (n, 3) and time s: pose (4, 4), and whether in doubt


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="NPZ", help="the packed scans")
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="(5)")
    parser.add_argument("--scans", type=int, default=None, metavar="N", help="only the first (all)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of every method; those of poses only where the recording has a reference."""
    from datasets.recordings import read_npz
    from datasets.recordings.scans import packed

    arrays = read_npz(given.source)
    count = min(given.scans or len(arrays["scan_t"]), len(arrays["scan_t"]))
    stamps_s, reference = arrays["scan_t"][:count].astype(float), arrays.get("ref_T")
    source = packed(arrays, np.arange(count))
    scenario, runs = given.source.resolve().parent.name, {}
    jobs = [(name, make) for _ in range(given.repeats) for name, make in methods().items()]
    with bar("repetitions", len(jobs)) as step:
        for name, make in jobs:
            runs.setdefault(name, []).append(_run(make(), _points(source), stamps_s, reference, name == OURS))
            step()
    return list(_rows(scenario, runs))


def methods() -> dict[str, Callable[[], Register]]:
    """Ours at its default voxel, bare KISS-ICP at the same, and the libraries at three voxels."""
    from tbmfg.rig import Lidar

    own = Lidar(topic="/points")
    found: dict[str, Callable[[], Register]] = {OURS: lambda: ours(own), BARE: lambda: bare_kiss(own.voxel)}
    for voxel in VOXELS_M:
        found[f"KISS-ICP {voxel}"] = lambda voxel=voxel: bare_kiss(voxel)
        found[f"small_gicp {voxel}"] = lambda voxel=voxel: _gicp(voxel)
        if find_spec("genz_icp"):
            found[f"GenZ-ICP {voxel}"] = lambda voxel=voxel: _genz(voxel)
    return found


def ours(sensor) -> Register:
    """Scans by themselves, without IMU."""
    from tbmfg.lidar.clouds import Scan
    from tbmfg.lidar.motion import Blind
    from tbmfg.lidar.odometry import Odometry, matrix

    odometry = Odometry(sensor, Blind())

    def register(points: Floats, t_s: float) -> tuple[Floats, bool]:
        pose = odometry.register(Scan(0, points, None, 0, 0, 0), t_s)
        return matrix(pose.R, pose.p), not pose.healthy

    return register


def bare_kiss(voxel: float) -> Register:
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.mapping.voxel_size = voxel
    kiss = KissICP(config)

    def register(points: Floats, t_s: float) -> tuple[Floats, bool]:
        kiss.register_frame(points, np.zeros(0))  # no times: no compensation
        return kiss.last_pose.copy(), False

    return register


def _genz(voxel: float) -> Register:
    from genz_icp.config import load_config
    from genz_icp.genz_icp import GenZICP

    config = load_config(None)
    config.mapping.voxel_size = voxel
    genz = GenZICP(config)

    def register(points: Floats, t_s: float) -> tuple[Floats, bool]:
        genz.register_frame(points, None)
        return genz.last_pose.copy(), False

    return register


def _gicp(voxel: float) -> Register:
    """Generalised ICP onto a map of Gaussian voxels; points are thinned to half a voxel."""
    import small_gicp

    planes, T, step = small_gicp.GaussianVoxelMap(voxel), np.eye(4), np.eye(4)

    def register(points: Floats, t_s: float) -> tuple[Floats, bool]:
        nonlocal T, step
        source, _ = small_gicp.preprocess_points(points, voxel / 2)
        if planes.size():
            found = small_gicp.align(planes, source, T @ step).T_target_source
            T, step = found, np.linalg.inv(T) @ found
        planes.insert(source, T)
        return T, False

    return register


def _points(source) -> Iterator[Floats]:
    for _, fields in source:
        points = points_of(fields)
        yield points[np.einsum("ni,ni->n", points, points) > 0.25]


def _run(
    register: Register, scans: Iterator[Floats], stamps_s: Floats, reference: Floats | None, flags: bool
) -> dict[str, float]:
    total = lost = flagged = len(stamps_s)
    poses, doubts, cost_s = [], [], []
    for scan, (points, t_s) in enumerate(zip(scans, stamps_s, strict=True)):
        started = time.process_time()
        T, doubt = register(points, t_s)
        cost_s.append(time.process_time() - started)
        poses.append(T)
        doubts.append(doubt)
        if reference is not None and lost == total and _is_lost(poses[0], T, reference[0], reference[scan]):
            lost = scan
        if lost <= scan and (doubt or not flags):
            flagged = scan
            break
    found = {"scans": total, "cost": 1e3 * np.median(cost_s), "flagged": 100 * np.mean(doubts[:lost])}
    found |= {} if reference is None else {"lost": lost, "late": flagged - lost}
    return {name: float(value) for name, value in found.items()}


def _is_lost(first: Floats, pose: Floats, first_true: Floats, true: Floats) -> bool:
    """Whether the way from the first pose to this one ends too far from the true one."""
    off = np.linalg.inv(np.linalg.inv(first_true) @ true) @ np.linalg.inv(first) @ pose
    turn_deg = np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1.0, 1.0)))
    return bool(np.linalg.norm(off[:3, 3]) > LOST_M or turn_deg > LOST_DEG)


def _rows(scenario: str, runs: dict[str, list[dict[str, float]]]) -> Iterator[Row]:
    bare = np.median([run["cost"] for run in runs[BARE]])
    medians = {
        name: {key: float(np.median([run[key] for run in repeated])) for key in repeated[0]}
        for name, repeated in runs.items()
    }
    libraries = [found["lost"] for name, found in medians.items() if name != OURS and "lost" in found]
    bounds = {"flagged": (None, 5.0), "late": (None, 2.0), "ratio": (None, 1.5)}
    if libraries:
        bounds["lost"] = (min(max(libraries) + 1.0, medians[OURS]["scans"]), None)
    for name, found in medians.items():
        found["ratio"] = found["cost"] / bare
        for metric, unit in (("lost", "scan"), ("flagged", "%"), ("late", "scans"), ("cost", "ms"), ("ratio", "")):
            if metric not in found or (metric in ("flagged", "late") and name != OURS):
                continue
            bound = bounds.get(metric) if name == OURS else None
            yield Row(scenario, name, metric, unit, found[metric], None, len(runs[name]), bound)
