"""Rotations in arrays: thin over scipy, vectorised where GTSAM takes one at a time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tbmfg.timeseries import Floats

FLIP = np.diag([1.0, -1.0, -1.0])  # forward-left-up from forward-right-down, z up from z down, and back


def skew(v: Floats) -> Floats:
    """[v]x with [v]x w = v x w; shape (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp_so3(rotvec: Floats) -> Floats:
    """Exp of rotation vectors; (..., 3) rad -> (..., 3, 3)."""
    rotvec = np.asarray(rotvec, dtype=float)
    return Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix().reshape(*rotvec.shape, 3)


def log_so3(R: Floats) -> Floats:
    """Log of rotation matrices; (..., 3, 3) -> (..., 3) rad, norm at most pi."""
    R = np.asarray(R, dtype=float)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)


def matrix_from_quat(quat_xyzw: Floats) -> Floats:
    """(..., 4) -> (..., 3, 3)."""
    quat = np.asarray(quat_xyzw, dtype=float)
    return Rotation.from_quat(quat.reshape(-1, 4)).as_matrix().reshape(*quat.shape[:-1], 3, 3)


def quat_from_matrix(R: Floats) -> Floats:
    """(..., 3, 3) -> (..., 4) as x, y, z, w with w >= 0."""
    R = np.asarray(R, dtype=float)
    quat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)
    return quat.reshape(*R.shape[:-2], 4)


def rotation_z(angle: float) -> Floats:
    """Rotation by ``angle`` rad about z, counter-clockwise seen from above; (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_rpy(rpy: Floats) -> Floats:
    """R = Rz(yaw) Ry(pitch) Rx(roll), rad; (3,) -> (3, 3)."""
    return Rotation.from_euler("ZYX", np.asarray(rpy, dtype=float)[::-1]).as_matrix()


def rpy_from_rotation(R: Floats) -> Floats:
    """Roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll); (3, 3) -> (3,). Roll is 0 at 90 deg pitch."""
    R = np.asarray(R, dtype=float)
    if abs(R[2, 0]) > 1 - 1e-12:
        return np.array([0.0, -np.sign(R[2, 0]) * np.pi / 2, np.arctan2(-R[0, 1], R[1, 1])])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])


def yaw_of(R_nb: Floats) -> Floats:
    """Heading of the body's x axis, counter-clockwise from n's x axis, rad; (..., 3, 3) -> (...)."""
    return np.arctan2(R_nb[..., 1, 0], R_nb[..., 0, 0])


def wrap(angle: Floats) -> Floats:
    """Angle to (-pi, pi]."""
    return -((-np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


def level(specific_force: Floats) -> Floats:
    """R_nb with zero turn about the vertical that takes ``specific_force`` (3,) in b to n's z axis; (3, 3)."""
    up_b = specific_force / np.linalg.norm(specific_force)
    up_n = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up_b, up_n)
    sine, cosine = np.linalg.norm(axis), up_b @ up_n
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return exp_so3(axis / sine * np.arctan2(sine, cosine))


def split_yaw_tilt(rotvec_n: Floats) -> tuple[Floats, Floats]:
    """Attitude error as a rotation vector in n (..., 3) -> its turn about the vertical (heading), and the size of the
    tilt that is left (inclination); rad. Exact for large errors: BROAD (Laidig et al., Data 6(7), 2021), sec. 4."""
    half = 0.5 * np.linalg.norm(rotvec_n, axis=-1)
    vector = 0.5 * rotvec_n * np.sinc(half / np.pi)[..., None]
    return 2.0 * np.arctan2(vector[..., 2], np.cos(half)), 2.0 * np.arcsin(np.linalg.norm(vector[..., :2], axis=-1))
