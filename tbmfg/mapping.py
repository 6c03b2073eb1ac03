"""The map that a log's LiDAR scans make along an estimated trajectory, without what hangs in the air; its sharpness."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from tbmfg.errors import TbmfgError
from tbmfg.inertial.steps import compensate
from tbmfg.lidar import clouds, raster
from tbmfg.lidar.air import Air
from tbmfg.lidar.surfels import SurfelMap
from tbmfg.mcap import read_log
from tbmfg.measure import gyro_frame
from tbmfg.outcome import as_found
from tbmfg.prepare.samples import imu_steps
from tbmfg.results import read_calibration, read_result_npz, refuse_existing_file
from tbmfg.rig import Lidar, Rig, load_rig
from tbmfg.state import Result, Trajectory
from tbmfg.timeseries import Floats, Log, seconds

FORMATS = (".ply", ".pcd")
MANY = 20  # scans that are thinned at once
VOXEL_M = 0.05
THICK_M = 0.25  # voxels that the sharpness is judged in
LEAST = 20  # points of such a voxel
NORMAL_M = 0.3  # neighbourhood of a normal
SKETCH_M, SKETCH_SCANS, SKETCH_POINTS = 0.2, 600, 5000  # of a sketch: a point a voxel; most scans, most points of each


@dataclass(frozen=True, slots=True)
class Sharpness:
    """How sharp a map is: ``thickness_m``, the median sd of the points across the surface in a voxel of 0.25 m, and
    ``entropy``, the mean of ln det(2 pi e C) / 2 over the same voxels (Droeschel, Behnke 2014). Ghosts raise both. None
    of a map without such ``voxels``: it is too thin to judge."""

    thickness_m: float | None
    entropy: float | None
    voxels: int


@dataclass(frozen=True, slots=True)
class Map:
    """Points (k, 3) m in n of a map with their normals, as Open3D's ``cloud``; of ``returns`` within the trajectory
    ``in_air`` hang in the ``air`` and are not in it. ``along``: result or smoothed, the trajectory of a result's folder
    that it was made along."""

    cloud: Any
    sharpness: Sharpness
    returns: int
    in_air: int
    air: Air | None
    along: str = ""

    @property
    def points(self) -> Floats:
        return np.asarray(self.cloud.points)


def make(
    log_path: str,
    trajectory: str | Path,
    output: str | Path,
    *,
    lidar: str | None = None,
    keep_air: bool = False,
    force: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Map:
    """Write the map of ``log_path`` along the result in the folder ``trajectory`` to ``output`` (.ply or .pcd), and its
    picture beside it (.png): along the smoothed trajectory where the folder holds one, with the LiDAR mounted as the
    result found it. Scans are read one by one, three times; once with ``keep_air``, which leaves nothing out.
    """
    output, folder = Path(output), Path(trajectory)
    if output.suffix not in FORMATS:
        raise TbmfgError(f"{output}: a map ends in {' or '.join(FORMATS)}")
    for file in (output, output.with_suffix(".png")):
        refuse_existing_file(file, force)
    if not (folder / "result.npz").is_file():
        raise TbmfgError(f"{folder}: holds no result; make one: tbmfg run {log_path} -o {folder}")
    log = read_log(log_path)
    rig = as_found(load_rig(folder / "rig.yaml"), read_calibration(folder))
    along = "smoothed" if (folder / "smoothed.npz").is_file() else "result"
    path = read_result_npz(folder / f"{along}.npz")
    made = mapped(partial(scans_in_n, log, rig, path, lidar), keep_air, progress)
    if made is None:
        raise TbmfgError(f"{log_path}: no scan lies within the trajectory of {folder}")
    scratch = output.with_name(f".{output.stem}.part{output.suffix}")
    open3d().io.write_point_cloud(str(scratch), made.cloud)
    scratch.replace(output)
    output.with_suffix(".png").write_bytes(raster.png(raster.picture(made.points, path.position_n)))
    return replace(made, along=along)


def mapped(
    scans: Callable[[], Iterable[Placed]], keep_air: bool = False, progress: Callable[[str, float], None] | None = None
) -> Map | None:
    """The map of scans that can be read again and again; None of none."""

    def told(step: str) -> Iterator[Placed]:
        for number, scan in enumerate(scans()):
            if progress and number % 10 == 0:
                progress(step, scan.share)
            yield scan

    air = None if keep_air else between(told)
    o3d = open3d()
    blur, cloud, waiting = SurfelMap(THICK_M, full=np.inf), o3d.geometry.PointCloud(), []
    returns = in_air = 0
    for scan in told("mapping"):
        kept = scan.points if air is None else scan.points[~air.holds(scan.points)]
        returns, in_air = returns + len(scan.points), in_air + len(scan.points) - len(kept)
        blur.add(kept, np.zeros(3))
        waiting.append(kept)
        if len(waiting) == MANY:
            cloud, waiting = _thinned(o3d, cloud, waiting), []
    if not returns:
        return None
    sharp, cloud = sharpness(blur), _thinned(o3d, cloud, waiting)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_M, max_nn=30))
    return Map(cloud, sharp, returns, in_air, air)


def between(scans: Callable[[str], Iterable[Placed]]) -> Air:
    """The air between a LiDAR and its walls, from scans that are read twice, each time for a purpose in words."""
    air = Air()
    for scan in scans("returns"):
        air.add_returns(scan.points)
    for scan in scans("rays"):
        air.add_rays(scan.points, scan.origins)
    return air


def sketch(log: Log, rig: Rig, result: Result) -> tuple[Floats | None, str]:
    """The first LiDAR's map along the best trajectory of ``result``, (k, 3) m in n, one point in every cube of 0.2 m of
    scans spread evenly over the log, and in words what it is; None where no scan lies within it."""
    rig = as_found(rig, result.calibration)
    lidar = next((sensor for sensor in rig.of_kind("lidar").values() if sensor.topic in log.clouds), None)
    if lidar is None:
        return None, ""
    every = -(-len(log.clouds[lidar.topic]) // SKETCH_SCANS)
    points_n, scans = np.zeros((0, 3)), 0
    for scan in scans_in_n(log, rig, result.smoothed or result.trajectory, every=every):
        points_n = np.vstack([points_n, scan.points[:: -(-len(scan.points) // SKETCH_POINTS)]])
        points_n = points_n[np.unique(np.floor(points_n / SKETCH_M).astype(np.int64), axis=0, return_index=True)[1]]
        scans += 1
    if not scans:
        return None, ""
    label = f"the map along {result.estimator}, of {scans} scans a point in every cube of {SKETCH_M:g} m"
    return points_n, label


class Placed(NamedTuple):
    """A scan in n: ``points`` (k, 3) m, the LiDAR at the time of each, ``origins`` (k, 3) m; ``share`` of the log."""

    share: float
    points: Floats
    origins: Floats


def scans_in_n(log: Log, rig: Rig, path: Trajectory, name: str | None = None, every: int = 1) -> Iterator[Placed]:
    """One LiDAR's scans, of ``every`` so many one, each point from its own pose.

    Attitude between keyframes by gyro, position by the cubic through positions and velocities.
    """
    lidars = {n: s for n, s in rig.of_kind("lidar").items() if s.topic in log.clouds}
    if not lidars or (name is not None and name not in lidars):
        raise TbmfgError(f"{log.path}: no scans of {name or 'a lidar'}; the rig has {', '.join(lidars) or 'none'} here")
    sensor: Lidar = lidars[name or next(iter(lidars))]
    source = log.clouds[sensor.topic]
    steps, _ = imu_steps(log, rig, (), [])
    bias = path.bias_gyro.mean(axis=0)
    frame = gyro_frame(steps, compensate(steps, bias, np.zeros(3))[0], bias)
    key_s = seconds(path.t_ns, steps.t0_ns)
    track = CubicHermiteSpline(key_s, path.position_n, path.velocity_n)
    R_n0 = path.rotations() @ frame.at(key_s).swapaxes(1, 2)
    stamps_s = seconds(source.t_ns, steps.t0_ns) - sensor.clock_offset
    period_s = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 0.1
    for k, (t_ns, fields) in enumerate(source):
        if k % every:
            continue
        scan = clouds.read(t_ns, fields, sensor, period_s)
        t_s = stamps_s[k] + (np.zeros(len(scan.points)) if scan.after_s is None else scan.after_s)
        inside = (t_s >= key_s[0]) & (t_s <= key_s[-1])
        if not inside.any():
            continue
        own_s, which = np.unique(t_s[inside], return_inverse=True)
        key = np.clip(np.searchsorted(key_s, own_s, side="right") - 1, 0, len(key_s) - 1)
        R = R_n0[key] @ frame.at(own_s)
        origins = (R @ sensor.T_bl.xyz + track(own_s))[which]
        way = (R @ sensor.T_bl.R)[which] @ scan.points[inside][:, :, None]
        yield Placed(k / len(source), origins + way[:, :, 0], origins)


def _thinned(o3d, cloud, scans: list[Floats]):
    """``cloud`` with more scans in it, one point a voxel."""
    if not scans:
        return cloud
    cloud.points.extend(o3d.utility.Vector3dVector(np.concatenate(scans)))
    return cloud.voxel_down_sample(VOXEL_M)


def sharpness(blur: SurfelMap) -> Sharpness:
    """Of the points in a map that took them all; voxels that hold a surface, thick or thin, count alike. Of a map
    without such a voxel there is nothing to tell."""
    cov = blur.covariances(LEAST)
    value = np.linalg.eigvalsh(cov)
    value = np.maximum(value[value[:, 1] > (0.15 * blur.voxel) ** 2], 1e-12)
    if not len(value):
        return Sharpness(None, None, 0)
    entropy = 0.5 * np.sum(np.log(2 * np.pi * np.e * value), axis=1)
    return Sharpness(float(np.median(np.sqrt(value[:, 0]))), float(entropy.mean()), len(value))


def open3d():
    """Open3D. It wants libusb, which a bare machine lacks: the wheel's own is loaded first."""
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
