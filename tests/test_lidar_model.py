"""The LiDAR's model: zero at the truth, Jacobians against differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tbmfg.geometry import exp_so3
from tbmfg.inertial.strapdown import correct_state
from tbmfg.sensors import lidar

RNG = np.random.default_rng(11)
STEP = 1e-6


def state(turn, position, velocity):
    x = np.zeros(21)
    x[:9], x[9:12], x[12:15] = exp_so3(np.array(turn)).ravel(), position, velocity
    return x


X_I = state([0.3, -0.2, 1.1], [4.0, -7.0, 1.2], [0.5, 0.2, -0.1])
X_J = state([0.35, -0.1, 1.3], [4.2, -6.8, 1.1], [0.6, 0.1, -0.2])
C = np.array([0.5, -0.3, 0.8, 0.01, -0.02, 0.03])
S = np.triu(RNG.standard_normal((6, 6))) + 3 * np.eye(6)


def row(error):
    """Measurement and data of a scan pair; the measured pose is off by ``error``, a right perturbation."""
    carried = [(0.02, [1e-3, -2e-3, 5e-4], [0.01, -0.03, 0.02]), (-0.01, [3e-4, 1e-4, -2e-4], [0.02, 0.01, -0.01])]
    R_bl = exp_so3(np.array([0.1, 0.2, -0.4]))
    ends, parts = [], []
    for x, (dt, s, turn) in zip((X_I, X_J), carried, strict=True):
        R, own = x[:9].reshape(3, 3), exp_so3(np.array(turn))
        ends.append((R @ own @ R_bl @ exp_so3(C[3:]), x[9:12] + x[12:15] * dt + R @ (np.array(s) + own @ C[:3])))
        parts += [[dt], s, own.ravel()]
    (R_i, p_i), (R_j, p_j) = ends
    R_z = R_i.T @ R_j @ exp_so3(-np.array(error[:3]))
    p_z = R_i.T @ (p_j - p_i) - R_z @ np.array(error[3:])
    data = np.concatenate([*parts, R_bl.ravel(), S.ravel()])
    return np.concatenate([R_z.ravel(), p_z])[None], data[None]


def test_residual_is_the_whitened_error():
    error = np.array([0.01, -0.02, 0.015, 0.05, -0.03, 0.02])
    r, *_ = lidar(*row(error), X_I[None], X_J[None], C)
    assert_allclose(r[0], S @ error, atol=1e-13)


@pytest.mark.parametrize("which", ["i", "j", "c"])
def test_jacobians(which):
    error = [0.01, -0.02, 0.015, 0.05, -0.03, 0.02]
    z, data = row(error)
    (*_,) = parts = lidar(z, data, X_I[None], X_J[None], C)
    size = 6 if which == "c" else 15
    numeric = np.empty((6, size))
    for k in range(size):
        r = []
        for step in (STEP, -STEP):
            d = step * np.eye(size)[k]
            x_i = correct_state(X_I, d) if which == "i" else X_I
            x_j = correct_state(X_J, d) if which == "j" else X_J
            r.append(lidar(z, data, x_i[None], x_j[None], C + d if which == "c" else C)[0][0])
        numeric[:, k] = (r[0] - r[1]) / (2 * STEP)
    # |S| < 6: rounding 6 eps |p| / step = 1e-8; Log to the second order leaves |error|^4 / 720, Exp(d) of the mounting
    # to the first |d|^2 / 6 = 2.3e-4
    atol = 6 * 2.4e-4 if which == "c" else 1e-7
    assert_allclose(parts["_ijc".index(which)][0], numeric, atol=atol)
