"""Edges and planes around the points of a scan, how far those lie from them, and what such distances tell of a pose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tbmfg.geometry import exp_so3
from tbmfg.lidar import features
from tbmfg.lidar.features import distances, near, principal, thinned
from tbmfg.lidar.surfels import SurfelMap
from tests.problems import EPS

SIGMA_M = 0.03


def wall(normal_axis, at, rng, size=4.0, count=20_000):
    """Points on a square of ``size`` m, rough by the noise of a LiDAR."""
    points = rng.uniform(-size / 2, size / 2, (count, 3))
    points[:, normal_axis] = at + SIGMA_M * rng.standard_normal(count)
    return points


def room(rng):
    """Floor and two walls that meet in a corner at (-2, -2, -2)."""
    return np.concatenate([wall(axis, -2.0, rng) for axis in range(3)])


def mapped(points, voxel=0.5):
    table = SurfelMap(voxel, full=np.inf)
    table.add(points, np.zeros(3))
    return table


@pytest.mark.parametrize("axis", range(3))
def test_points_on_a_wall_lie_near_its_plane(axis):
    rng = np.random.default_rng(axis)
    scan = thinned(wall(axis, -2.0, rng, size=3.0), 0.5)
    found = near(scan, mapped(wall(axis, -2.0, rng)))
    assert found.points == len(found.of) > 0.9 * len(scan)  # one row each: planes
    assert np.degrees(np.arccos(np.abs(found.direction[:, axis]).min())) < 3.0
    r, _, _ = distances(scan, np.eye(3), np.zeros(3), found)
    assert np.std(r) == pytest.approx(SIGMA_M, rel=0.3)


def test_points_on_a_pole_lie_near_its_edge():
    rng = np.random.default_rng(3)
    pole = SIGMA_M * rng.standard_normal((20_000, 3)) + np.column_stack(
        [np.zeros((20_000, 2)), rng.uniform(-4, 4, 20_000)]
    )
    scan = thinned(pole[np.abs(pole[:, 2]) < 1.0], 0.5)
    found = near(scan, mapped(pole, voxel=0.2))
    assert found.points == len(scan)
    assert len(found.of) == 2 * len(scan)
    assert np.abs(found.direction[:, 2]).max() < 0.1  # across the pole, both of them
    r, across, along = (
        distances(scan, np.eye(3), np.array(p), found)[0] for p in ([0, 0, 0], [0.1, 0, 0], [0, 0, 0.1])
    )
    assert_allclose(np.hypot(*(across - r).reshape(2, -1)), 0.1, rtol=0.01)
    assert np.abs(along - r).max() < 0.01  # a tenth of it: what the edge's direction errs by


def test_the_printed_ratios_mistake_a_wall():
    """E19: taken about the point itself most patches of a plane are no plane."""
    rng = np.random.default_rng(4)
    scan, around = thinned(wall(2, 0.0, rng, size=3.0), 0.5), mapped(wall(2, 0.0, rng))
    planes = [
        np.sum(np.bincount(near(scan, around, test).of, minlength=len(scan)) == 1) for test in ("shape", "printed")
    ]
    assert planes[1] < 0.6 * planes[0]


@given(st.integers(0, 2**32), st.sampled_from([(1.0, 1.0, 1.0), (1.0, 1e-3, 1e-6), (5.0, 5.0, 0.0), (3.0, 0.0, 0.0)]))
def test_principal_axes_are_those_of_the_library(seed, values):
    rng = np.random.default_rng(seed)
    Q, scale = np.linalg.qr(rng.standard_normal((3, 3)))[0], 10.0 ** rng.uniform(-8, 8)
    S = scale * (Q * values) @ Q.T
    S = 0.5 * (S + S.T)
    found, axes = np.empty(3), np.empty((3, 3))
    principal(S.copy(), found, axes)
    assert_allclose(found, np.linalg.eigvalsh(S)[::-1], atol=20 * EPS * scale * values[0])
    assert_allclose(axes @ axes.T, np.eye(3), atol=20 * EPS)
    assert_allclose((axes.T * found) @ axes, S, atol=40 * EPS * scale * values[0])


def test_the_nearest_neighbours_are_those_of_a_search_through_all():
    rng = np.random.default_rng(7)
    around, points = mapped(room(rng)), rng.uniform(-2.3, 2.0, (200, 3))
    held = around.moments[around.moments[:, 0] >= features.LEAST]
    means = held[:, 1:4] / held[:, :1]
    nearest, place = np.empty(features.NEIGHBOURS), np.empty((features.NEIGHBOURS, 3))
    cells = np.floor(means / around.voxel)
    for point in points:
        count = features._neighbours(point, around.voxel, around.keys, around.moments, nearest, place)
        near_by = np.abs(cells - np.floor(point / around.voxel)).max(axis=1) <= features.REACH
        expected = np.sort(np.sum((means[near_by] - point) ** 2, axis=1))[: features.NEIGHBOURS]
        assert count == len(expected)
        assert_allclose(nearest[:count], expected, rtol=1e-12)


def test_where_there_is_no_map_or_only_dust_there_are_no_features():
    rng = np.random.default_rng(5)
    scan = rng.uniform(-2.0, 2.0, (200, 3))
    assert near(scan, SurfelMap(0.5)).points == 0
    lone = mapped(rng.uniform(-2.0, 2.0, (400, 3)))  # less than one echo a voxel
    assert near(scan, lone).points == 0
    thick = mapped(rng.uniform(-2.0, 2.0, (20_000, 3)))
    assert near(scan, thick).points < 0.1 * len(scan)


def test_jacobian_of_the_distances():
    rng = np.random.default_rng(6)
    R, p = exp_so3(np.array([0.3, -0.2, 1.1])), np.array([0.4, -0.7, 0.2])
    scan = (thinned(room(rng), 0.5) - p) @ R
    found = near(scan @ R.T + p, mapped(room(rng)))
    _, J, tilted = distances(scan, R, p, found)
    step = 1e-5
    numeric = np.empty_like(J)
    for k in range(6):
        d = step * np.eye(6)[k]
        ends = [distances(scan, R @ exp_so3(s * d[:3]), p + s * d[3:], found)[0] for s in (1, -1)]
        numeric[:, k] = (ends[0] - ends[1]) / (2 * step)
    size = np.abs(scan).max() + 2.0
    # truncation step^2 size / 6, rounding eps size / step; twice their sum
    assert_allclose(J, numeric, atol=2 * size * (step**2 / 6 + EPS / step * 4))
    # along a tilt the same distance is felt, were it the direction
    turned = found.tilts[:, 0]
    assert_allclose(tilted[:, 0, 3:], turned)
    assert_allclose(np.einsum("ki,ki->k", found.direction, turned), 0.0, atol=1e-12)


def test_thinning_leaves_a_point_of_each_voxel():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.3, 0.4], [-0.1, 0.1, 0.1], [0.1, 0.1, 0.6]])
    assert_allclose(thinned(points, 0.5), points[[0, 2, 3]])
    assert features.thinned(np.zeros((0, 3)), 0.5).shape == (0, 3)
