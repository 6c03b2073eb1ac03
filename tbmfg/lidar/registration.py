"""A scan on a map of planes: the pose, and which directions of it the planes tell.

Errors of a pose are right perturbations [rotation, position] in the LiDAR's axes. The Hessian of the distances to the
planes shows where a pose may slide; but normals that are noisy by a few degrees pretend to hold it everywhere. What
that noise alone would contribute is computed beside it, and a direction counts only where it stands out against that.
All planes help to find the pose; only firm ones, whose normals are known and checked by enough places, bear witness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import eigh

from tbmfg.geometry import exp_so3, log_so3
from tbmfg.lidar.surfels import SurfelMap, nearest_plane
from tbmfg.timeseries import Floats

STANDS_OUT = 3.0  # least ratio of a direction's information to what noise of the normals would give
NEVER_TOLD = 1e-9  # noise that a direction has without any plane
ROUNDED = 1e-12  # and as a share of all noise: matches with a single plane leave less of some than rounding does
SIGMA_M = (0.005, 0.3)  # limits of the distances' noise
KERNEL = 2.0  # sds at which a distance has a quarter of its weight
ON = 0.2  # largest distance of a point on a plane, in voxels
LEAST_NEAR = 30  # points near planes that can be registered
ITERATIONS = 12
STILL = 3e-4  # m and rad: a step that ends the iteration


@dataclass(frozen=True, slots=True)
class Aligned:
    """Pose R (3, 3), p (3,) of a scan in the map, ``information`` (6, 6), ``weak`` directions (6, k) that have none.

    ``overlap`` is the share of the points near a plane that lie on it, by the planes' weights, ``support`` that of all
    points, ``sigma`` the noise of their distances [m], ``dust`` the share without a plane among the points nearer than
    most that have one.
    """

    R: Floats
    p: Floats
    information: Floats
    weak: Floats
    overlap: float
    support: float
    sigma: float
    dust: float


def align(
    points: Floats, start: tuple[Floats, Floats], prior: tuple[Floats, Floats], planes: SurfelMap, slide_m: float
) -> Aligned:
    """Gauss-Newton on the distances of ``points`` (n, 3) to ``planes``, from ``start``.

    In directions that the planes do not tell the pose is that of ``prior``: Zhang et al. (2016), with the test above.
    ``slide_m`` is how far off it may be there. The direction itself is known only as well as the normals: an error e
    of it turns a slide s into e s of what is told. e' H e has the mean w' F w / m along w with m planes; where these
    have unequal shares of the points, the sum of the shares' squares stands for 1 / m.
    """
    (R, p), sigma = start, SIGMA_M[1]
    table = planes.voxel, planes.keys, planes.surfels
    for iteration in range(ITERATIONS):
        H, g, told, F, distance, plane = linearise(points, R, p, *table, KERNEL * sigma)
        found = distance[plane >= 0]
        if len(found) < LEAST_NEAR:
            return Aligned(R, p, np.zeros((6, 6)), np.eye(6), 0.0, 0.0, SIGMA_M[1], 1.0)
        sigma = float(np.clip(1.4826 * np.median(np.abs(found)), *SIGMA_M))
        F += ROUNDED * np.trace(F) * np.eye(6)
        ratio, V = eigh(told, F)
        weak = ratio < STANDS_OUT
        inverse = V.T @ F
        if iteration == 0 and weak.any():
            off = np.concatenate([log_so3(prior[0].T @ R), prior[0].T @ (p - prior[1])])
            step = V @ np.where(weak, 0.0, inverse @ off)
            R, p = prior[0] @ exp_so3(step[:3]), prior[1] + prior[0] @ step[3:]
            continue
        B = V[:, ~weak]
        step = -B @ np.linalg.solve(B.T @ H @ B, B.T @ g)
        R, p = R @ exp_so3(step[:3]), p + R @ step[3:]
        if np.abs(step).max() < STILL:
            break
    slid = np.sum((slide_m / np.maximum(np.linalg.norm(V[3:, weak], axis=0), 1e-9)) ** 2)  # V' F V = 1
    firm = plane[(plane >= 0) & (planes.surfels[plane, 14] > 0.0)]
    share = np.unique(firm, return_counts=True)[1] / max(len(firm), 1)
    strength = np.where(weak, 0.0, ratio - 1.0) / (sigma**2 + slid * np.sum(share**2))
    information = inverse.T @ (strength[:, None] * inverse)
    trust = planes.surfels[plane[plane >= 0], 13]
    on = float(trust @ (np.abs(found) < ON * planes.voxel))
    ranges, alone = np.linalg.norm(points, axis=1), np.isnan(distance)
    dust = float(np.mean(alone[ranges <= np.median(ranges[~alone])]))
    return Aligned(R, p, information, V[:, weak], on / trust.sum(), on / len(points), sigma, dust)


@njit(cache=True)
def linearise(points, R, p, voxel, keys, surfels, kernel):
    """Hessian H and gradient g of half the weighted squared distances, the share of firm planes in H, what noise of
    their normals adds to that on average (F), and the distances (n,) and rows of the planes (n,), NaN and -1 where
    there is none."""
    H, told, F, g = np.zeros((6, 6)), np.zeros((6, 6)), NEVER_TOLD * np.eye(6), np.zeros(6)
    distance = np.full(len(points), np.nan)
    plane = np.full(len(points), -1)
    J = np.empty((3, 6))
    for n in range(len(points)):
        q = points[n]
        x = R[0, 0] * q[0] + R[0, 1] * q[1] + R[0, 2] * q[2] + p[0]
        y = R[1, 0] * q[0] + R[1, 1] * q[1] + R[1, 2] * q[2] + p[1]
        z = R[2, 0] * q[0] + R[2, 1] * q[1] + R[2, 2] * q[2] + p[2]
        row = nearest_plane(x, y, z, voxel, keys, surfels)
        if row < 0:
            continue
        s = surfels[row]
        r = s[3] * (x - s[0]) + s[4] * (y - s[1]) + s[5] * (z - s[2])
        distance[n], plane[n] = r, row
        w = s[13] / (1.0 + (r / kernel) ** 2) ** 2
        # the normal and the two vectors of its covariance, each as a direction of measurement
        for d in range(3):
            u = s[3 + 3 * d : 6 + 3 * d]
            for a in range(3):
                J[d, 3 + a] = R[0, a] * u[0] + R[1, a] * u[1] + R[2, a] * u[2]
            J[d, 0] = q[1] * J[d, 5] - q[2] * J[d, 4]
            J[d, 1] = q[2] * J[d, 3] - q[0] * J[d, 5]
            J[d, 2] = q[0] * J[d, 4] - q[1] * J[d, 3]
        for a in range(6):
            g[a] += w * r * J[0, a]
            for b in range(a + 1):
                H[a, b] += w * J[0, a] * J[0, b]
                if s[14] == 0.0:
                    continue
                told[a, b] += w * J[0, a] * J[0, b]
                F[a, b] += w * (J[1, a] * J[1, b] + J[2, a] * J[2, b])
    for a in range(6):
        for b in range(a):
            H[b, a], told[b, a], F[b, a] = H[a, b], told[a, b], F[a, b]
    return H, g, told, F, distance, plane
