"""LiDAR odometry: KISS-ICP finds the scan, planes refine it and say what it tells.

KISS-ICP (Vizzo et al. 2023) gives a pose and no doubt, and in a tunnel it slides along the axis. So its pose is where a
registration on planes starts, which holds the directions that the walls do not tell at the prediction, and gives the
information of the others. The map of both is made of the refined poses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tbmfg.geometry import exp_so3, log_so3, rotation_z
from tbmfg.lidar import registration
from tbmfg.lidar.clouds import Scan
from tbmfg.lidar.motion import Blind, Inertia, compensate
from tbmfg.lidar.registration import Aligned
from tbmfg.lidar.surfels import SurfelMap
from tbmfg.rig import Lidar
from tbmfg.timeseries import Floats

LEAST_POINTS = 100  # of a scan that can be registered
FITS = 0.5  # least share of the points near planes that lie on them; below, the scan is not taken
USUAL, FEW = 20, 3  # scans over which what is usual is taken, and from how many on
SPREAD = 0.02  # least sd of the overlap from scan to scan
DOUBT = 3.0  # sds by which it falls short of the usual where a pose is in doubt
TURNS = np.deg2rad(
    [-15.0, 15.0, -30.0, 30.0, -45.0, 45.0, -60.0, 60.0]
)  # by which a doubtful scan may have turned beside its prediction
LOST = 20  # such scans in a row after which the map begins anew
FAR_M = 20.0  # a turn about an axis at least this far away is a slide, as far as noisy normals can tell
ASKEW = np.deg2rad(3.0)  # by which a slide may seem to differ from the usual: noise of the normals, or a slow curve
NEAREST_SD = (2e-4, 1e-3)  # rad and m: no scan is known better than this, whatever its many points say
ROUGHLY = 2e-3, 50  # KISS-ICP need not settle to the micrometre where planes take over: step and iterations
FORGET_EVERY = 50  # scans after which what is out of range is forgotten


@dataclass(frozen=True, slots=True)
class Pose:
    """Where one scan was taken: R (3, 3), p (3,) m of the LiDAR in the map, at ``t_s`` s, the time of its last point.

    ``root`` (6, 6): square root S of the information S' S of the step from the last placed scan, as a right
    perturbation [rotation, position] of this pose; zero rows where there is none. ``overlap``: share of the points near
    planes of the map that lie on them; ``sigma``: noise of their distances [m]; ``weak``: directions that the walls do
    not tell; ``dust``: share of the near points that hang in the air. ``healthy``: the scan fits the map as scans
    usually do; ``placed``: it lies on the map or begins a new one, else its pose is a mere prediction.
    """

    t_s: float
    R: Floats
    p: Floats
    root: Floats
    overlap: float
    sigma: float
    weak: int
    dust: float
    healthy: bool
    placed: bool


class Usual:
    """Mean and spread of a figure over the last scans: what it usually is, where the place changes slowly."""

    def __init__(self) -> None:
        self.values: deque[float] = deque(maxlen=USUAL)

    def learn(self, value: float) -> None:
        self.values.append(value)

    def falls_short(self, value: float) -> bool:
        """Clearly below what it usually is; never before that is known."""
        if len(self.values) < FEW:
            return False
        return value < np.mean(self.values) - DOUBT * max(np.std(self.values), SPREAD)


class Slides:
    """In which directions the walls let the LiDAR slide, in the map's axes, as the last scans have it.

    Walls that leave a slide open are blind to it as a mere translation. Noisy normals find it with some turn in it and
    a little askew, in every scan otherwise; and of a hundred scans, each open in a direction of its own, who knows the
    turns, as an IMU does, concludes that none was open: errors in variables. What the scans share is where the walls
    lead.
    """

    def __init__(self) -> None:
        self.projectors: deque[Floats] = deque(maxlen=USUAL)

    def leave_open(self, R: Floats, information: Floats, weak: Floats) -> Floats:
        """``information`` (6, 6) of a pose with attitude R without any along the slides among its ``weak`` directions
        (6, k): the usual ones, unless the scan's own are clearly others."""
        own = R @ slides(weak)
        if own.shape[1] == 0:
            return information
        usual = np.linalg.eigh(np.sum([*self.projectors, own @ own.T], axis=0))[1][:, 3 - own.shape[1] :]
        if np.linalg.svd(usual.T @ own, compute_uv=False).min() < np.cos(ASKEW):
            self.projectors.clear()
            usual = own
        self.projectors.append(own @ own.T)
        told = np.eye(6)
        told[3:, 3:] -= R.T @ usual @ usual.T @ R
        return told @ information @ told


class Odometry:
    """Scan after scan onto a map that grows by them; memory goes with the map within the LiDAR's range."""

    def __init__(self, sensor: Lidar, motion: Inertia | Blind) -> None:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.mapping.voxel_size = sensor.voxel
        config.data.max_range, config.data.min_range = sensor.max_range, sensor.min_range
        config.registration.convergence_criterion, config.registration.max_num_iterations = ROUGHLY
        self.sensor, self.motion = sensor, motion
        self.kiss = KissICP(config)
        self.planes = SurfelMap(sensor.voxel)
        self.velocity_0, self.rate_l = np.zeros(3), np.zeros(3)
        self.usual, self.slides = Usual(), Slides()
        self.last: Pose | None = None
        self.unfit = self.restarts = self.scans = 0

    def register(self, scan: Scan, start_s: float) -> Pose | None:
        """The pose of a scan whose stamp is ``start_s`` s; None for one of too few points."""
        if len(scan.points) < LEAST_POINTS:
            return None
        points, t_s = scan.points, start_s
        if scan.after_s is not None:
            t_s = start_s + float(scan.after_s.max())
            points = compensate(points, start_s + scan.after_s, t_s, self.motion, self.velocity_0, self.rate_l)
        if self.last is not None and t_s <= self.last.t_s:
            return None
        self.scans += 1
        source, dense = self.kiss.voxelize(points)
        if self.last is None:
            R, p = (part[0] for part in self.motion.poses(np.array([t_s]), self.velocity_0, self.rate_l))
            return self._begin(t_s, R, p, points, dense, None)
        prior = self._predicted(t_s)
        slide_m = self.motion.slide(self.last.t_s, t_s)
        found = self._align(source, prior, prior, slide_m)
        if self.usual.falls_short(found.overlap):
            found = max([found, *self._sought_anew(source, prior, slide_m)], key=lambda one: one.support)
        deviation = np.linalg.inv(matrix(*prior)) @ matrix(found.R, found.p)
        self.kiss.adaptive_threshold.update_model_deviation(deviation)
        if found.overlap < FITS and self.unfit + 1 < LOST:
            self.unfit += 1
            nothing = np.zeros((6, 6))
            self.last = Pose(t_s, *prior, nothing, found.overlap, found.sigma, 6, found.dust, False, False)
            return self.last
        if found.overlap < FITS:
            self.restarts += 1
            return self._begin(t_s, *prior, points, dense, found)
        doubtful = self.usual.falls_short(found.overlap)
        self.usual.learn(found.overlap)
        if doubtful:  # the place has changed, or the track is lost: what comes is tied to this scan, and not to the map
            self.restarts += 1
            return self._begin(t_s, found.R, found.p, points, dense, found)
        self.unfit = 0
        if self.last.placed:
            self._learn_velocity(t_s, found)
        root = whitening(self.slides.leave_open(found.R, found.information, found.weak))
        weak = found.weak.shape[1]
        self._extend(found.R, found.p, points, dense)
        self.last = Pose(t_s, found.R, found.p, root, found.overlap, found.sigma, weak, found.dust, True, True)
        return self.last

    def _predicted(self, t_s: float) -> tuple[Floats, Floats]:
        """The last pose, moved on."""
        R, p = self.motion.poses(np.array([self.last.t_s, t_s]), self.velocity_0, self.rate_l)
        # by the angle: products would keep the rounding of long sums, and KISS-ICP ends the process at 1e-10 of it
        turn, shift = exp_so3(log_so3(R[0].T @ R[1])), R[0].T @ (p[1] - p[0])
        return self.last.R @ turn, self.last.p + self.last.R @ shift

    def _align(
        self, source: Floats, guess: tuple[Floats, Floats], prior: tuple[Floats, Floats], slide_m: float
    ) -> Aligned:
        """Onto the planes from KISS-ICP's pose, which is sought from ``guess``."""
        sigma = self.kiss.adaptive_threshold.get_threshold()
        T = self.kiss.registration.align_points_to_map(
            points=source,
            voxel_map=self.kiss.local_map,
            initial_guess=matrix(*guess),
            max_correspondance_distance=3 * sigma,
            kernel=sigma,
        )
        return registration.align(source, (T[:3, :3], T[:3, 3]), prior, self.planes, slide_m)

    def _sought_anew(self, source: Floats, prior: tuple[Floats, Floats], slide_m: float) -> Iterator[Aligned]:
        """From where it was, and from the prediction turned either way about the LiDAR's axis."""
        R, p = prior
        for guess in ((self.last.R, self.last.p), *((R @ rotation_z(turn), p) for turn in TURNS)):
            yield self._align(source, guess, prior, slide_m)

    def _begin(self, t_s: float, R: Floats, p: Floats, points: Floats, dense: Floats, found: Aligned | None) -> Pose:
        """A new map from one scan; ``found`` is how it lay on the old one."""
        self.unfit, self.planes = 0, SurfelMap(self.sensor.voxel)
        self.kiss.local_map.clear()
        self._extend(R, p, points, dense)
        overlap, sigma, dust = (1.0, 0.0, 0.0) if found is None else (found.overlap, found.sigma, found.dust)
        self.last = Pose(t_s, R, p, np.zeros((6, 6)), overlap, sigma, 6, dust, found is None, True)
        return self.last

    def _extend(self, R: Floats, p: Floats, points: Floats, dense: Floats) -> None:
        self.kiss.local_map.update(dense, matrix(R, p))
        self.planes.add(points @ R.T + p, p)
        if self.scans % FORGET_EVERY == 0:
            self.planes.keep_near(p, self.sensor.max_range)

    def _learn_velocity(self, t_s: float, found: Aligned) -> None:
        """What a LiDAR without an odometer is taken to go on with, in the axes that ``motion`` has.

        Where the walls tell nothing, standing is the guess that cannot run away.
        """
        velocity_l = self.last.R.T @ (found.p - self.last.p) / (t_s - self.last.t_s)
        if found.weak.shape[1]:
            slides, size, _ = np.linalg.svd(found.weak[3:])
            slides = slides[:, : len(size)][:, size > 0.1 * np.linalg.norm(found.weak, axis=0).max()]
            velocity_l -= slides @ (slides.T @ velocity_l)
        self.rate_l = log_so3(self.last.R.T @ found.R) / (t_s - self.last.t_s)
        R_0, _ = self.motion.poses(np.array([self.last.t_s]), self.velocity_0, self.rate_l)
        self.velocity_0 = R_0[0] @ velocity_l


def slides(weak: Floats) -> Floats:
    """Orthonormal directions (3, j) in which the LiDAR can slide without a turn, of ``weak`` ones (6, k)."""
    span = np.linalg.qr(np.repeat([FAR_M, 1.0], 3)[:, None] * weak)[0]
    _, turn, combination = np.linalg.svd(span[:3])
    turn = np.concatenate([turn, np.zeros(len(combination) - len(turn))])
    return np.linalg.qr(span[3:] @ combination[turn < np.sqrt(0.5)].T)[0]


def whitening(information: Floats, least_sd: tuple[float, float] = NEAREST_SD) -> Floats:
    """Square root S of an information matrix, S' S, with sds no smaller than the least ones, rad and m; (6, 6)."""
    scale = np.repeat(least_sd, 3)
    value, vector = np.linalg.eigh(information * np.outer(scale, scale))
    value = np.where(value > 1e-12 * max(value[-1], 1.0), value, 0.0)  # what rounding leaves of a weak direction
    return np.sqrt(value / (1.0 + value))[:, None] * vector.T / scale


def matrix(R: Floats, p: Floats) -> Floats:
    """Pose as (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T
