"""Scans on a local map by an iterated error-state update: Liu, Wang & Tao (TBM-MSE), section 4, corrected.

Numbers in brackets are the paper's equations, E its errata. A scan is carried to its last point by the filter's own
motion (27)-(29) with E18, its points are measured from the edges and planes of the map (30), (31), and the state is
iterated about its prior (36)-(42) with E20-E23. However many its points, they tell of the pose alone: (39) needs no
more of them than six rows, with the same D' R^-1 D and D' R^-1 z.

The paper takes its map for known. Here it lies in the axes of the body at its first scan, and that pose stays in the
filter as a clone: a scan tells how the body moved since, and a fix of the prism moves the map along with it.

Its "adaptive weighting" (E30) has no equation; what stands for it here is ``adaptive``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pydantic import Field
from scipy.linalg import eigh

from tbmfg.fields import DEG, Flag, Node, Positive, si
from tbmfg.filters.kalman import correct, innovation
from tbmfg.geometry import skew
from tbmfg.inertial.strapdown import correct_state, mechanise
from tbmfg.lidar import features
from tbmfg.lidar.clouds import Scan, Scans
from tbmfg.lidar.features import Features, Test
from tbmfg.lidar.motion import Inertia, compensate
from tbmfg.lidar.odometry import FORGET_EVERY, LEAST_POINTS, whitening
from tbmfg.lidar.registration import KERNEL, LEAST_NEAR, SIGMA_M, STANDS_OUT
from tbmfg.lidar.surfels import SurfelMap
from tbmfg.measure import nearest
from tbmfg.problem import Inertial
from tbmfg.state import NAV, POS
from tbmfg.timeseries import Floats

MOST = 8  # iterations
STILL = 1e-4  # rad and m: a change that ends them
SEARCH = 0.1  # voxels of correction after which features are sought anew
LOST = 20  # scans in a row that find no hold, after which the map begins anew
CLONE = 6  # states of the map's pose
TINY = 1e-9  # share of the information that keeps what noise of the normals leaves out from being infinitely sure


class OnMap(Node):
    """Switches of the filters that lay scans on a map."""

    feature_test: Test = Field(
        "shape", description="Of edges and planes; printed: the ratios of the paper, which mistake most of them."
    )
    sigma_m: Positive = Field(0.03, description="Noise of a point along what it is measured from.")
    scan_sd_m: Positive = Field(
        0.01, description="Least sd of a scan's position on the map, whose errors its points share; 1e-6: as printed."
    )
    scan_sd_deg: Positive = Field(0.1, description="Least sd of its attitude.")
    adaptive: Flag = Field(
        True,
        description="A scan's noise by how its points fit and how many do, and no weight to directions that the walls "
        "do not tell; false: sigma_m for all.",
    )

    sigma = si("sigma_m")
    scan_sd = si("scan_sd_m")
    scan_turn = si("scan_sd_deg", DEG)


class Swept(NamedTuple):
    """A scan in the LiDAR's axes, taken between two IMU edges; ``t_s`` (n,) of its points, None if that is unknown."""

    first: int
    last: int
    points: Floats
    t_s: Floats | None


@dataclass(slots=True)
class ScanMap:
    """The scans of one LiDAR in time order, and the map that they make. ``name`` is the sensor's.

    Of each scan that was laid on the map its edge and NIS, ``edges``, ``nis``; and how many were not: ``few`` points,
    ``unheld`` by the map, ``begun`` a map.
    """

    name: str
    scans: Scans
    inertial: Inertial
    switches: OnMap
    edges: list[int] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    few: int = 0
    unheld: int = 0
    begun: int = 0
    given_up: int = 0
    lost: int = 0
    map: SurfelMap | None = None
    pose: Floats = field(default_factory=lambda: np.zeros(21))
    passed: deque[tuple[int, Floats]] = field(default_factory=lambda: deque(maxlen=64))
    source: Iterator[tuple[float, Scan]] = field(init=False)
    waiting: Swept | None = field(init=False)

    def __post_init__(self) -> None:
        self.source = iter(self.scans)
        self.waiting = self._next(0)

    # ---- in time order ----

    def until(self, edge: int) -> Iterator[Swept]:
        """The scans whose last points were taken by then."""
        while self.waiting is not None and self.waiting.last <= edge:
            yield self.waiting
            self.waiting = self._next(self.waiting.last)

    def _next(self, after: int) -> Swept | None:
        """The next scan that ends after an edge and has points enough."""
        for start_s, scan in self.source:
            if len(scan.points) < LEAST_POINTS:
                self.few += 1
                continue
            t_s = None if scan.after_s is None else start_s + scan.after_s
            ends = np.array([start_s, start_s] if t_s is None else [t_s.min(), t_s.max()])
            first, last = nearest(self.inertial.steps.edges_s, ends)
            if last > after:
                return Swept(int(first), int(last), scan.points, t_s)
        return None

    def passing(self, edge: int, x: Floats) -> None:
        """The filter's state at an edge: what scans are carried from."""
        self.passed.append((edge, x))

    def _carried(self, scan: Swept) -> Floats:
        """(27)-(29): its points (n, 3) in b at its last edge, by the filter's motion from where it last was before."""
        sensor, inertial, points = self.scans.sensor, self.inertial, scan.points
        known = [one for one in self.passed if one[0] <= scan.first] or list(self.passed)[:1]
        if scan.t_s is not None and known and known[-1][0] < scan.last:
            (k, x), edges = known[-1], inertial.steps.edges_s
            path = mechanise(
                x, edges[k : scan.last + 1], inertial.gyro[k : scan.last], inertial.acc[k : scan.last],
                inertial.earth_n, inertial.gravity_n,
            )  # fmt: skip
            motion = Inertia(
                edges[k : scan.last + 1], path[:, :9].reshape(-1, 3, 3), path[:, 9:12], sensor.T_bl.R, sensor.T_bl.xyz
            )
            points = compensate(points, scan.t_s, float(edges[scan.last]), motion, np.zeros(3), np.zeros(3))
        return points @ sensor.T_bl.R.T + sensor.T_bl.xyz

    # ---- the update ----

    def update(self, scan: Swept, x: Floats, P: Floats) -> tuple[Floats, Floats]:
        """Correction of the state ``x`` and covariance after a scan; the last states of ``P`` are the map's pose."""
        points, zero = self._carried(scan), np.zeros(len(P))
        if self.map is None or self.lost >= LOST:
            return zero, self._begin(points, x, P)
        thin = features.thinned(points, self.map.voxel)
        dx, P1, found, sought = zero, P, None, zero
        for iteration in range(MOST):
            # dx and what it is held against are both counted from the prior (E21, E22)
            R, p, D = relative(x, self.pose, dx)
            if found is None or np.abs((dx - sought)[: POS.stop]).max() > SEARCH * self.map.voxel:
                found, sought = features.near(thin @ R.T + p, self.map, self.switches.feature_test), dx
            told = self._told(thin, R, p, found)
            if told is None:
                self.unheld, self.lost = self.unheld + 1, self.lost + 1
                return zero, P
            S, e = told
            if iteration == 0:
                nis = innovation(P, S @ D, S @ e)[0]
            step, P1 = correct(P, S @ D, S @ (e - D @ dx))  # (39)-(41)
            change, dx = step - dx, step
            if np.abs(change[: POS.stop]).max() < STILL:
                break
        self.lost = 0
        self.edges.append(scan.last)
        self.nis.append(float(nis))
        R, p, _ = relative(x, self.pose, dx)
        self.pose = moved(self.pose, dx[-CLONE:])
        self.map.add(points @ R.T + p, R @ self.scans.sensor.T_bl.xyz + p)
        if len(self.edges) % FORGET_EVERY == 0:
            self.map.keep_near(p, self.scans.sensor.max_range)
        return dx, P1

    def _begin(self, points: Floats, x: Floats, P: Floats) -> Floats:
        """A new map from one scan, in the body's axes; the covariance with the map's pose as a clone of the body's."""
        self.map, self.pose = SurfelMap(self.scans.sensor.voxel), x.copy()
        self.map.add(points, self.scans.sensor.T_bl.xyz)
        self.begun, self.lost = self.begun + 1, 0
        P = P.copy()
        P[-CLONE:] = P[:CLONE]
        P[:, -CLONE:] = P[:, :CLONE]
        return P

    def shifted(self, dx: Floats) -> None:
        """Take what another sensor's correction says of the map's pose."""
        self.pose = moved(self.pose, dx[-CLONE:])

    def forsake(self) -> None:
        """Give the map up; the next scan begins a new one."""
        self.map, self.given_up = None, self.given_up + 1

    def _told(self, points: Floats, R: Floats, p: Floats, found: Features) -> tuple[Floats, Floats] | None:
        """What a scan says of the body's pose on the map: the square root S (6, 6) of its information D' R^-1 D, and by
        how much [rotation, position] the pose is off; None if it says nothing."""
        if found.points < LEAST_NEAR:
            return None
        r, D, tilted = features.distances(points, R, p, found)
        sigma, weight, share, F = self.switches.sigma, np.ones(len(r)), 1.0, np.zeros((6, 6))
        if self.switches.adaptive:
            sigma = float(np.clip(1.4826 * np.median(np.abs(r)), sigma, SIGMA_M[1]))
            weight = 1.0 / (1.0 + (r / (KERNEL * sigma)) ** 2) ** 2
            share = found.points / len(points)
            doubted = (np.sqrt(weight[:, None] * found.doubt)[:, :, None] * tilted).reshape(-1, 6)
            F = doubted.T @ doubted
        H, g = D.T @ (weight[:, None] * D), D.T @ (weight * r)
        # along what noise of the normals alone would tell as much nothing is told: as in lidar.registration
        ratio, V = eigh(H, F + TINY * np.diag(np.diag(H)))
        weak = ratio < STANDS_OUT
        if weak.all():
            return None
        inverse = np.linalg.inv(V)
        strength = np.where(weak, 0.0, ratio - 1.0) * share / sigma**2
        off = V @ np.where(weak, 0.0, V.T @ g / ratio)
        information = inverse.T @ (strength[:, None] * inverse)
        return whitening(information, (self.switches.scan_turn, self.switches.scan_sd)), off


def relative(x: Floats, pose: Floats, dx: Floats) -> tuple[Floats, Floats, Floats]:
    """R, p of the body in the map's axes, from the states of both corrected by ``dx``, and how [rotation, position]
    goes with ``dx`` there, (6, n): the last states of ``dx`` are the map's."""
    body, own = moved(x, dx[:CLONE]), moved(pose, dx[-CLONE:])
    R_nb, R_nm = body[:9].reshape(3, 3), own[:9].reshape(3, 3)
    R, p = R_nm.T @ R_nb, R_nm.T @ (body[9:12] - own[9:12])
    D = np.zeros((6, len(dx)))
    D[:3, :3] = np.eye(3) - 0.5 * skew(dx[:3])  # of Exp, to the first order
    D[3:, POS] = R_nm.T
    onto = np.eye(3) - 0.5 * skew(dx[-6:-3])
    D[:3, -6:-3], D[3:, -6:-3], D[3:, -3:] = -R.T @ onto, skew(p) @ onto, -R_nm.T
    return R, p, D


def moved(x: Floats, d: Floats) -> Floats:
    """A state (21,) with its pose corrected by [rotation, position]."""
    return correct_state(x, np.concatenate([d, np.zeros(NAV - CLONE)]))
