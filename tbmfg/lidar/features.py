"""Edges and planes of a local map, and how far the points of a scan lie from them.

Liu, Wang & Tao (TBM-MSE), section 4; (n) are its equations, E its errata. The map holds one point a voxel, the mean of
those that fell into it, in the same table as the planes of :mod:`tbmfg.lidar.surfels`: its neighbours lie a voxel apart
and make a patch of a metre, where the raw points of a few beams would make a line of every wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numba import njit

from tbmfg.geometry import skew
from tbmfg.lidar.surfels import EMPTY, FEW, TILT_SD, SurfelMap, find, key_at, key_of
from tbmfg.timeseries import Floats

Test = Literal["shape", "printed"]

NEIGHBOURS = 10
LEAST = 3  # points of a voxel that counts: an echo of dust is alone
REACH = 2  # voxels on either side within which neighbours are sought
THIN = 0.1  # E19: largest ratio of a variance to the next larger one, across an edge or a plane
FLAT, SHARP = 0.37, 2.1  # (30): gamma of a plane and Gamma of an edge
NONE, PLANE, EDGE = 0, 1, 2
SWEEPS, ROUNDING = 30, 1e-32  # Jacobi's, and the square of off-diagonal elements that ends them

_STEPS = np.array(list(product(range(-REACH, REACH + 1), repeat=3)))
AROUND = _STEPS[np.argsort(np.sum(_STEPS**2, axis=1), kind="stable")]  # voxels around one, the near ones first


@dataclass(frozen=True, slots=True)
class Features:
    """What points lie near: one row for a plane, two for an edge.

    ``of`` (k,) is the row's point, ``direction`` (k, 3) the unit vector that its distance is measured along, ``mean``
    (k, 3) m a point of the feature. ``tilts`` (k, 2, 3) are the axes that ``direction`` may err towards, and
    ``doubt`` (k, 2) by which variance [rad^2]. ``points`` have a feature.
    """

    of: np.ndarray
    direction: Floats
    mean: Floats
    tilts: Floats
    doubt: Floats
    points: int


def thinned(points: Floats, voxel: float) -> Floats:
    """The first point (k, 3) in each voxel."""
    return points[_firsts(points, voxel)]


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
        points=len(planes) + len(edges),
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
def _firsts(points, voxel):
    """Rows of the first point in each voxel, in order."""
    size = 1
    while size < 2 * len(points):
        size *= 2
    keys, rows, count = np.full(size, EMPTY), np.empty(len(points), np.int64), 0
    for n in range(len(points)):
        key = key_of(points[n, 0], points[n, 1], points[n, 2], voxel)
        place = find(key, keys)
        if keys[place] == EMPTY:
            keys[place] = key
            rows[count] = n
            count += 1
    return rows[:count]


@njit(cache=True)
def _patches(points, voxel, keys, moments, printed):
    """(30) by point: kind, and mean (3), axes (3, 3) and variances (3), largest first, of the map around it."""
    n = len(points)
    kind, mean = np.zeros(n, np.int8), np.zeros((n, 3))
    axes, variance = np.zeros((n, 3, 3)), np.zeros((n, 3))
    nearest, place, S = np.empty(NEIGHBOURS), np.empty((NEIGHBOURS, 3)), np.empty((3, 3))
    for row in range(n):
        found = _neighbours(points[row], voxel, keys, moments, nearest, place)
        if found < NEIGHBOURS:
            continue
        for a in range(3):
            for k in range(NEIGHBOURS):
                mean[row, a] += place[k, a] / NEIGHBOURS
        about = points[row] if printed else mean[row]  # E19
        for a in range(3):
            for b in range(a + 1):
                S[a, b] = 0.0
                for k in range(NEIGHBOURS):
                    S[a, b] += (place[k, a] - about[a]) * (place[k, b] - about[b]) / NEIGHBOURS
                S[b, a] = S[a, b]
        principal(S, variance[row], axes[row])
        kind[row] = _kind(variance[row, 0], variance[row, 1], variance[row, 2], printed)
    return kind, mean, axes, variance


@njit(cache=True)
def principal(S, values, vectors):
    """Eigenvalues of a symmetric ``S`` (3, 3), largest first, into ``values`` (3,), their unit vectors into the rows of
    ``vectors`` (3, 3); ``S`` is overwritten. Jacobi's rotations, as a library's call is slow."""
    for a in range(3):
        for b in range(3):
            vectors[a, b] = 1.0 if a == b else 0.0
    for _ in range(SWEEPS):
        if S[0, 1] ** 2 + S[0, 2] ** 2 + S[1, 2] ** 2 <= ROUNDING * (S[0, 0] ** 2 + S[1, 1] ** 2 + S[2, 2] ** 2):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if S[p, q] == 0.0:
                    continue
                theta = 0.5 * (S[q, q] - S[p, p]) / S[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    S[k, p], S[k, q] = c * S[k, p] - s * S[k, q], s * S[k, p] + c * S[k, q]
                for k in range(3):
                    S[p, k], S[q, k] = c * S[p, k] - s * S[q, k], s * S[p, k] + c * S[q, k]
                    vectors[p, k], vectors[q, k] = (
                        c * vectors[p, k] - s * vectors[q, k],
                        s * vectors[p, k] + c * vectors[q, k],
                    )
    for a in range(3):
        values[a] = S[a, a]
    for a, b in ((0, 1), (1, 2), (0, 1)):
        if values[a] < values[b]:
            values[a], values[b] = values[b], values[a]
            for k in range(3):
                vectors[a, k], vectors[b, k] = vectors[b, k], vectors[a, k]


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
    i, j, k = int(np.floor(point[0] / voxel)), int(np.floor(point[1] / voxel)), int(np.floor(point[2] / voxel))
    x0, y0, z0 = point[0] - i * voxel, point[1] - j * voxel, point[2] - k * voxel
    for at in range(len(AROUND)):
        di, dj, dk = AROUND[at, 0], AROUND[at, 1], AROUND[at, 2]
        if count == NEIGHBOURS:
            # the whole voxel may lie farther away than all that were found
            least = _gap(x0, di, voxel) ** 2 + _gap(y0, dj, voxel) ** 2 + _gap(z0, dk, voxel) ** 2
            if least >= nearest[count - 1]:
                continue
        row = find(key_at(i + di, j + dj, k + dk), keys)
        if keys[row] == EMPTY or moments[row, 0] < LEAST:
            continue
        share = 1.0 / moments[row, 0]
        x, y, z = share * moments[row, 1], share * moments[row, 2], share * moments[row, 3]
        d = (x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2
        if count == NEIGHBOURS and d >= nearest[count - 1]:
            continue
        to = min(count, NEIGHBOURS - 1)
        while to > 0 and nearest[to - 1] > d:
            nearest[to] = nearest[to - 1]
            for a in range(3):
                place[to, a] = place[to - 1, a]
            to -= 1
        nearest[to] = d
        place[to, 0], place[to, 1], place[to, 2] = x, y, z
        count = min(count + 1, NEIGHBOURS)
    return count


@njit(cache=True)
def _gap(inside, steps, voxel):
    """Distance along an axis from a point that lies ``inside`` its voxel by so much to a voxel some ``steps`` on."""
    if steps > 0:
        return steps * voxel - inside
    return inside - (steps + 1) * voxel if steps < 0 else 0.0
