"""A map of planes: in every voxel the mean and the normal of the points that fell into it, and how well it is known.

A LiDAR errs along its rays. So a plane is a regression of the ranges on the directions, not of the least distances:
the points of a single ring spread along their rays by that noise alone, and the plane of least distances through them
is that of the rays, seen edge-on as no surface is. In the regression they tell nothing about the other direction.

The table is hashed with open addressing: memory goes with the surface seen, a point costs some tens of nanoseconds.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tbmfg.timeseries import Floats

LEAST = 6  # points of a plane
FEW = 10  # points of a plane beyond which its normal gets no better: errors within a scan are not independent
RAY_SD = 2e-3  # rad, of a ray's direction: its width, and what is left of the scan's attitude
TILT_SD = 0.01  # rad, of the normals beside what their points' scatter tells: walls are not planes
VAGUE, VAGUEST = 0.1, 0.3  # rad: sd of a normal from which it counts less, and beyond which it is none
PLACES = 5.0  # least number of them that a normal rests on: a few points off a line make no plane
GROWN = 1.2  # times its points after which a plane is fitted anew
FULL = 100  # points after which a voxel takes no more: the map stands still
EMPTY = np.int64(-(2**62))


class SurfelMap:
    """Planes of ``voxel`` m in the frame of the points added.

    Columns of ``surfels``: mean (3), normal (3), two vectors (6) whose outer products sum to the normal's covariance,
    points (1); weight (1), less than 1 where the normal is vague, and 0 where a voxel holds no plane; firm (1), 1 where
    the normal is neither vague nor rests on few places. A voxel takes no more than ``full`` points.
    """

    def __init__(self, voxel: float, full: float = FULL) -> None:
        self.voxel, self.full = voxel, float(full)
        self.keys = np.full(1 << 14, EMPTY)
        self.places = np.zeros(len(self.keys), np.int64)
        self.moments = np.zeros((len(self.keys), 13))
        self.surfels = np.zeros((len(self.keys), 15))
        self.used = 0

    def add(self, points: Floats, origin: Floats) -> None:
        """Add points (n, 3) m that were seen from ``origin`` (3,)."""
        while self.used + len(points) > len(self.keys) // 2:
            self._resize(np.ones(len(self.keys), dtype=bool), 2 * len(self.keys))
        rows, used = _add(points, origin, self.voxel, self.full, self.keys, self.places, self.moments)
        self.used += used
        _fit(rows, self.voxel, self.places, self.moments, self.surfels)

    def keep_near(self, centre: Floats, radius: float) -> None:
        """Forget what is farther than ``radius`` from ``centre`` (3,)."""
        filled = self.moments[:, 0] > 0
        mean = self.moments[:, 1:4] / np.maximum(self.moments[:, :1], 1.0)
        self._resize(filled & (np.sum((mean - centre) ** 2, axis=1) < radius**2), len(self.keys))

    def covariances(self, least: int) -> Floats:
        """Of the points in every voxel that holds ``least``, (n, 3, 3) m^2."""
        return _spread(self.moments[self.moments[:, 0] >= least], self.voxel)[1]

    def _resize(self, keep: np.ndarray, size: int) -> None:
        old = self.keys, self.places, self.moments, self.surfels
        self.keys, self.places = np.full(size, EMPTY), np.zeros(size, np.int64)
        self.moments, self.surfels = np.zeros((size, 13)), np.zeros((size, 15))
        self.used = _refill(keep, *old, self.keys, self.places, self.moments, self.surfels)


@njit(cache=True)
def key_of(x, y, z, voxel):
    """Integer key of the voxel that holds a point: 21 bits an axis."""
    return key_at(int(np.floor(x / voxel)), int(np.floor(y / voxel)), int(np.floor(z / voxel)))


@njit(cache=True)
def key_at(i, j, k):
    """Key of the voxel that is the i-th, j-th and k-th along the axes."""
    return ((np.int64(i) & 0x1FFFFF) << 42) | ((np.int64(j) & 0x1FFFFF) << 21) | (np.int64(k) & 0x1FFFFF)


@njit(cache=True)
def find(key, keys):
    """Row of ``key``, or of the empty place where it belongs."""
    mask = len(keys) - 1
    h = key * np.int64(-7046029254386353131)
    row = (h ^ (h >> 29)) & mask
    while keys[row] != key and keys[row] != EMPTY:
        row = (row + 1) & mask
    return row


@njit(cache=True)
def _refill(keep, old_keys, old_places, old_moments, old_surfels, keys, places, moments, surfels):
    used = 0
    for n in range(len(old_keys)):
        if keep[n] and old_keys[n] != EMPTY:
            row = find(old_keys[n], keys)
            keys[row], places[row] = old_keys[n], old_places[n]
            moments[row], surfels[row] = old_moments[n], old_surfels[n]
            used += 1
    return used


@njit(cache=True)
def _add(points, origin, voxel, full, keys, places, moments):
    """Sums by voxel of 1, p, d d' and the ray to p, d counted from the voxel's corner, and which of its 4 x 4 x 4
    places are taken; the rows touched, and how many are new."""
    used, count, touched = 0, 0, np.empty(len(points), np.int64)
    d = np.empty(3)
    for n in range(len(points)):
        key = key_of(points[n, 0], points[n, 1], points[n, 2], voxel)
        row = find(key, keys)
        if keys[row] == EMPTY:
            keys[row] = key
            used += 1
        m = moments[row]
        if m[0] >= full:
            continue
        m[0] += 1.0
        at = 4
        for a in range(3):
            m[1 + a] += points[n, a]
            d[a] = points[n, a] - np.floor(points[n, a] / voxel) * voxel
        for a in range(3):
            for b in range(a, 3):
                m[at] += d[a] * d[b]
                at += 1
            m[10 + a] += points[n, a] - origin[a]
        place = 0
        for a in range(3):
            place = 4 * place + min(int(4 * d[a] / voxel), 3)
        places[row] |= np.int64(1) << place
        touched[count] = row
        count += 1
    return touched[:count], used


@njit(cache=True)
def _fit(rows, voxel, places, moments, surfels):
    """Planes of voxels from their sums, where these have grown.

    With C the points' covariance and u the ray, the normal is a / |a| with a = C^-1 u, the ranges scatter by 1 / u'a,
    and (u'a C^-1 - a a') / |a|^2 / n is the normal's covariance, but for its part along the normal itself.
    """
    C, E = np.empty((3, 3)), np.empty((2, 3))
    for row in rows:
        m, s = moments[row], surfels[row]
        if m[0] < LEAST or m[0] < GROWN * s[12]:
            continue
        s[:], s[12] = 0.0, m[0]
        ray = m[10:] / m[0]
        reach = np.sqrt(ray @ ray)
        u = ray / max(reach, 1e-9)
        blur = (RAY_SD * reach) ** 2
        at = 4
        for a in range(3):
            s[a] = m[1 + a] / m[0]
        for a in range(3):
            for b in range(a, 3):
                d_a, d_b = s[a] - np.floor(s[a] / voxel) * voxel, s[b] - np.floor(s[b] / voxel) * voxel
                C[a, b] = m[at] / m[0] - d_a * d_b - blur * ((a == b) - u[a] * u[b])
                C[b, a] = C[a, b]
                at += 1
            C[a, a] += 1e-10
        M = _inverse_of_positive(C)
        if M[0, 0] == 0.0:
            continue
        support = _support(places[row], u)
        alpha = M @ u
        square = alpha @ alpha
        n = alpha / np.sqrt(square)
        k = np.argmin(np.abs(n))
        for a in range(3):
            E[0, a] = (a == k) - n[k] * n[a]
        E[0] /= np.sqrt(1.0 - n[k] ** 2)
        E[1] = np.cross(n, E[0])
        T = ((u @ alpha) / (square * min(max(support, 1.0), FEW))) * (E @ M @ E.T)
        T[0, 0] += TILT_SD**2
        T[1, 1] += TILT_SD**2
        half, apart = 0.5 * (T[0, 0] + T[1, 1]), 0.5 * (T[0, 0] - T[1, 1])
        variance = half + np.sqrt(apart**2 + T[0, 1] ** 2)
        if variance > VAGUEST**2:
            continue
        s[13], s[14] = min(1.0, VAGUE**2 / variance), variance < VAGUE**2 and support >= PLACES
        s[3:6] = n
        root = np.sqrt(T[0, 0])
        s[6:9] = root * E[0] + (T[0, 1] / root) * E[1]
        s[9:12] = np.sqrt(T[1, 1] - (T[0, 1] / root) ** 2) * E[1]


@njit(cache=True)
def _support(taken, u):
    """On how many places the tilt of a plane rests in the direction across the ray ``u`` that they tell least.

    Of deviations b it is (sum b^2)^2 / sum b^4: one place beside a line of others counts one, however often it is seen.
    """
    k = np.argmin(np.abs(u))
    e = -u[k] * u
    e[k] += 1.0
    e /= np.sqrt(1.0 - u[k] ** 2)
    f = np.cross(u, e)
    across, count = np.empty((64, 2)), 0
    for place in range(64):
        if taken >> place & 1:
            x, y, z = place // 16, place // 4 % 4, place % 4
            across[count, 0] = x * e[0] + y * e[1] + z * e[2]
            across[count, 1] = x * f[0] + y * f[1] + z * f[2]
            count += 1
    a, b = across[:count, 0] - across[:count, 0].mean(), across[:count, 1] - across[:count, 1].mean()
    angle = 0.5 * np.arctan2(2 * (a @ b), a @ a - b @ b)  # of the direction that they tell most
    square = (b * np.cos(angle) - a * np.sin(angle)) ** 2
    return square.sum() ** 2 / max(square @ square, 1e-12)


@njit(cache=True)
def _inverse_of_positive(C):
    """Inverse of a symmetric (3, 3) matrix, zeros where it is not positive."""
    M = np.zeros((3, 3))
    minor = C[1, 1] * C[2, 2] - C[1, 2] ** 2
    M01, M02 = C[0, 2] * C[1, 2] - C[0, 1] * C[2, 2], C[0, 1] * C[1, 2] - C[0, 2] * C[1, 1]
    det = C[0, 0] * minor + C[0, 1] * M01 + C[0, 2] * M02
    if C[2, 2] <= 0.0 or minor <= 0.0 or det <= 0.0:
        return M
    M[0, 0], M[0, 1], M[0, 2] = minor, M01, M02
    M[1, 0], M[1, 1], M[1, 2] = M01, C[0, 0] * C[2, 2] - C[0, 2] ** 2, C[0, 1] * C[0, 2] - C[0, 0] * C[1, 2]
    M[2, 0], M[2, 1], M[2, 2] = M02, M[1, 2], C[0, 0] * C[1, 1] - C[0, 1] ** 2
    return M / det


def _spread(moments: Floats, voxel: float) -> tuple[Floats, Floats]:
    """Means (n, 3) and covariances (n, 3, 3) from the sums (n, 13) of voxels."""
    count = moments[:, :1]
    mean = moments[:, 1:4] / count
    d = mean - np.floor(mean / voxel) * voxel
    rows, columns = np.triu_indices(3)
    cov = np.empty((len(moments), 3, 3))
    cov[:, rows, columns] = cov[:, columns, rows] = moments[:, 4:10] / count - d[:, rows] * d[:, columns]
    return mean, cov


@njit(cache=True)
def nearest_plane(x, y, z, voxel, keys, surfels):
    """Row of the plane whose mean is nearest to a point: its own voxel's, else of the 26 around it; -1 for none."""
    row = find(key_of(x, y, z, voxel), keys)
    if keys[row] != EMPTY and surfels[row, 13] > 0.0:
        return row
    best, closest = -1, (1.2 * voxel) ** 2
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                row = find(key_of(x + i * voxel, y + j * voxel, z + k * voxel, voxel), keys)
                if keys[row] == EMPTY or surfels[row, 13] == 0.0:
                    continue
                d = (x - surfels[row, 0]) ** 2 + (y - surfels[row, 1]) ** 2 + (z - surfels[row, 2]) ** 2
                if d < closest:
                    best, closest = row, d
    return best
