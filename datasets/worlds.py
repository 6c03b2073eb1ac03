"""Places underground as triangle meshes, to be seen by a LiDAR.

A mesh is vertices (n, 3) m in n and triangles (m, 3) int; what stands inside sees it from either side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tbmfg.timeseries import Floats


class Mesh(NamedTuple):
    """Vertices (n, 3) m and triangles (m, 3)."""

    vertices: Floats
    triangles: np.ndarray


RIB_SPACING_M, RIB_WIDTH_M, RIB_DEPTH_M = 1.5, 0.2, 0.15  # steel arches


def horseshoe(width: float = 5.0, wall: float = 1.5, arch: int = 24) -> Floats:
    """Cross-section of a driven tunnel, (k, 2) as y, z about the middle of its floor: straight walls under an arch."""
    angle = np.linspace(0.0, np.pi, arch + 1)
    roof = np.column_stack([np.cos(angle), np.sin(angle)]) * width / 2 + [0.0, wall]
    return np.vstack([[width / 2, 0.0], roof, [-width / 2, 0.0]])


def tunnel(first_x: float, last_x: float, ribbed: bool, floor_z: float) -> Mesh:
    """A straight tunnel along n's x axis, open at both ends. Smooth, nothing in it tells where along it one is."""
    section = horseshoe()
    if not ribbed:
        x, inset = np.array([first_x, last_x]), np.zeros(2)
    else:
        start = np.arange(first_x, last_x, RIB_SPACING_M)
        x = (start[:, None] + [0.0, 0.02, RIB_WIDTH_M, RIB_WIDTH_M + 0.02]).ravel()
        inset = np.tile([0.0, RIB_DEPTH_M, RIB_DEPTH_M, 0.0], len(start))
    centre = np.array([0.0, 2.0])
    outward = section - centre
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    outward[[0, -1]] = np.sign(outward[[0, -1]]) * [1.0, 0.0]  # the arches stand on the floor
    rings = section - inset[:, None, None] * outward
    vertices = np.concatenate([np.broadcast_to(x[:, None, None], (*rings.shape[:2], 1)), rings], axis=2)
    vertices[:, :, 2] += floor_z
    return Mesh(vertices.reshape(-1, 3), _strip(len(x), len(section)))


def _strip(rings: int, around: int) -> np.ndarray:
    """Triangles between neighbouring rings of ``around`` vertices each."""
    r, k = (part.ravel() for part in np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij"))
    a, b = r * around + k, r * around + (k + 1) % around
    return np.vstack([np.column_stack([a, b, a + around]), np.column_stack([b, b + around, a + around])])


def roadway(
    low: Floats, high: Floats, rough_m: float, rng: np.random.Generator, step_m: float = 0.2, waves: int = 60
) -> Mesh:
    """The closed box between the corners ``low`` and ``high`` (3,), its walls displaced by ``rough_m`` rms per axis.

    The displacement is a sum of waves of 0.6 to 3 m, a function of the place alone: faces stay joined at the edges.
    """
    vertices, triangles, used = [], [], 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        grid_u, grid_v = (np.linspace(low[k], high[k], max(2, round((high[k] - low[k]) / step_m) + 1)) for k in (u, v))
        for side in (low[axis], high[axis]):
            face = np.empty((len(grid_u), len(grid_v), 3))
            face[..., axis], face[..., u], face[..., v] = side, grid_u[:, None], grid_v
            vertices.append(face.reshape(-1, 3))
            a = (np.arange(len(grid_u) - 1)[:, None] * len(grid_v) + np.arange(len(grid_v) - 1)).ravel() + used
            down = a + len(grid_v)
            triangles += [np.column_stack([a, a + 1, down]), np.column_stack([a + 1, down + 1, down])]
            used += face[..., 0].size
    points = np.concatenate(vertices)
    direction = rng.standard_normal((waves, 3))
    wave = direction / np.linalg.norm(direction, axis=1, keepdims=True) * 2 * np.pi / rng.uniform(0.6, 3.0, (waves, 1))
    amplitude = rough_m * np.sqrt(2 / waves) * rng.standard_normal((waves, 3))
    shift = np.cos(points @ wave.T + 2 * np.pi * rng.random(waves)) @ amplitude
    return Mesh(points + shift, np.concatenate(triangles))
