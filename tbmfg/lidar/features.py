"""Edges and planes of a local map, and how far the points of a scan lie from them.

Liu, Wang & Tao (TBM-MSE), section 4; (n) are its equations, E its errata. The map holds one point a voxel, the mean of
those that fell into it, in the same table as the planes of :mod:`tbmfg.lidar.surfels`: its neighbours lie a voxel apart
and make a patch of a metre, where the raw points of a few beams would make a line of every wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit

from tbmfg.geometry import skew
from tbmfg.lidar.surfels import EMPTY, FEW, TILT_SD, SurfelMap, find, key_of
from tbmfg.timeseries import Floats

Test = Literal["shape", "printed"]

NEIGHBOURS = 10
LEAST = 3  # points of a voxel that counts: an echo of dust is alone
REACH = 2  # voxels on either side within which neighbours are sought
THIN = 0.1  # E19: largest ratio of a variance to the next larger one, across an edge or a plane
FLAT, SHARP = 0.37, 2.1  # (30): gamma of a plane and Gamma of an edge
NONE, PLANE, EDGE = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Features:
    """What points lie near: one row for a plane, two for an edge.

    ``of`` (k,) is the row's point, ``direction`` (k, 3) the unit vector that its distance is measured along, ``mean``
    (k, 3) m a point of the feature. ``tilts`` (k, 2, 3) are the axes that ``direction`` may err towards, and
    ``doubt`` (k, 2) by which variance [rad^2].
    """

    of: np.ndarray
    direction: Floats
    mean: Floats
    tilts: Floats
    doubt: Floats

    @property
    def points(self) -> int:
        """How many points have a feature."""
        return len(np.unique(self.of))


def thinned(points: Floats, voxel: float) -> Floats:
    """The first point (k, 3) in each voxel."""
    cells = np.floor(points / voxel).astype(np.int64)
    keys = (cells[:, 0] << 42) ^ ((cells[:, 1] & 0x1FFFFF) << 21) ^ (cells[:, 2] & 0x1FFFFF)
    return points[np.sort(np.unique(keys, return_index=True)[1])]


def near(points: Floats, around: SurfelMap, test: Test = "shape") -> Features:
    """Edges and planes that ``points`` (n, 3), in the map's frame, lie near."""
    kind, mean, axes, variance = _patches(
        np.ascontiguousarray(points), around.voxel, around.keys, around.moments, test == "printed"
    )
    planes, edges = np.flatnonzero(kind == PLANE), np.flatnonzero(kind == EDGE)
    along = np.maximum(variance, 1e-12)
    # an edge lies across its second and third axis; either may only tilt towards the edge itself
    rows = [(planes, 2, (0, 1)), (edges, 1, (0, 2)), (edges, 2, (0, 1))]
    doubt = [along[of, across, None] / (FEW * along[of][:, tilts]) + TILT_SD**2 for of, across, tilts in rows]
    for part in doubt[1:]:
        part[:, 1] = 0.0
    return Features(
        of=np.concatenate([of for of, _, _ in rows]),
        direction=np.concatenate([axes[of, across] for of, across, _ in rows]),
        mean=np.concatenate([mean[of] for of, _, _ in rows]),
        tilts=np.concatenate([axes[of][:, tilts] for of, _, tilts in rows]),
        doubt=np.concatenate(doubt),
    )


def distances(points: Floats, R: Floats, p: Floats, features: Features) -> tuple[Floats, Floats, Floats]:
    """(31) with E20, (33)-(38): distances (k,) m of R ``points`` + p from their features, signed, their Jacobian
    (k, 6) to a right perturbation [rotation, position in the map], and the same along the tilts, (k, 2, 6)."""
    own = points[features.of]
    reached = own @ R.T + p
    r = np.einsum("ki,ki->k", features.direction, reached - features.mean)
    turn = -R @ skew(own)

    def along(directions: Floats) -> Floats:
        return np.concatenate([np.einsum("k...i,kij->k...j", directions, turn), directions], axis=-1)

    return r, along(features.direction), along(features.tilts)


@njit(cache=True)
def _patches(points, voxel, keys, moments, printed):
    """(30) by point: kind, and mean (3), axes (3, 3) and variances (3), largest first, of the map around it."""
    n = len(points)
    kind, mean = np.zeros(n, np.int8), np.zeros((n, 3))
    axes, variance = np.zeros((n, 3, 3)), np.zeros((n, 3))
    nearest, place = np.empty(NEIGHBOURS), np.empty((NEIGHBOURS, 3))
    for row in range(n):
        found = _neighbours(points[row], voxel, keys, moments, nearest, place)
        if found < NEIGHBOURS:
            continue
        centre, S = np.zeros(3), np.zeros((3, 3))
        for k in range(NEIGHBOURS):
            for a in range(3):
                centre[a] += place[k, a] / NEIGHBOURS
        about = points[row] if printed else centre  # E19
        for k in range(NEIGHBOURS):
            for a in range(3):
                for b in range(3):
                    S[a, b] += (place[k, a] - about[a]) * (place[k, b] - about[b]) / NEIGHBOURS
        value, vector = np.linalg.eigh(S)
        mean[row], variance[row] = centre, value[::-1]
        axes[row] = vector.T[::-1]
        kind[row] = _kind(value[2], value[1], value[0], printed)
    return kind, mean, axes, variance


@njit(cache=True)
def _kind(l1, l2, l3, printed):
    """Edge, plane or neither, by variances from the largest to the least."""
    if printed:
        ratio = (l1 - l2) / max(l2 - l3, 1e-12)
        return PLANE if ratio <= FLAT else EDGE if ratio >= SHARP else NONE
    if l2 < THIN * l1:
        return EDGE
    return PLANE if l3 < THIN * l2 else NONE


@njit(cache=True)
def _neighbours(point, voxel, keys, moments, nearest, place):
    """Put the map's points nearest to ``point`` into ``place``, their squared distances into ``nearest``, in order;
    how many there are."""
    count = 0
    for i in range(-REACH, REACH + 1):
        for j in range(-REACH, REACH + 1):
            for k in range(-REACH, REACH + 1):
                key = key_of(point[0] + i * voxel, point[1] + j * voxel, point[2] + k * voxel, voxel)
                row = find(key, keys)
                if keys[row] == EMPTY or moments[row, 0] < LEAST:
                    continue
                share = 1.0 / moments[row, 0]
                x, y, z = share * moments[row, 1], share * moments[row, 2], share * moments[row, 3]
                d = (x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2
                if count == NEIGHBOURS and d >= nearest[count - 1]:
                    continue
                at = min(count, NEIGHBOURS - 1)
                while at > 0 and nearest[at - 1] > d:
                    nearest[at] = nearest[at - 1]
                    for a in range(3):
                        place[at, a] = place[at - 1, a]
                    at -= 1
                nearest[at] = d
                place[at, 0], place[at, 1], place[at, 2] = x, y, z
                count = min(count + 1, NEIGHBOURS)
    return count
