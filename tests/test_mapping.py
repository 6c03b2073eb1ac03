"""The map: where its surfaces lie, its files and picture, and that ghosts show in its sharpness."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import datasets
from benchmarks.runs import in_memory, true_states
from datasets.lidar import raycasting
from datasets.tbm_roadway import world
from tbmfg import mapping
from tbmfg.errors import TbmfgError
from tbmfg.geometry import exp_so3, rpy_from_rotation
from tbmfg.lidar import raster
from tbmfg.lidar.air import Air
from tbmfg.mcap import read_log
from tbmfg.pipeline import run, run_result
from tbmfg.results import read_calibration, summarise, write_result
from tbmfg.rig import dump_rig, load_rig, override
from tbmfg.state import Calibrated, Health, Result, Trajectory


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Path]:
    """A log of a roadway, and a result folder that holds its truth."""
    folder = tmp_path_factory.mktemp("map")
    simulation = datasets.make("tbm-roadway", seed=3, duration=6.0, columns=200, imu_rate_hz=200.0)
    simulation.write(folder / "log.mcap")
    save(folder / "truth", truth_path(simulation), simulation.rig_text)
    return folder / "log.mcap", folder / "truth"


def truth_path(simulation) -> Trajectory:
    t_ns = simulation.start_ns + np.arange(0, 6_000_000_001, 100_000_000)
    truth, zero = true_states(simulation, t_ns), np.zeros((61, 3))
    return Trajectory(t_ns, truth.position_n, truth.quat_xyzw, truth.velocity_n, zero, zero, np.zeros((61, 15, 15)))


def save(folder: Path, path: Trajectory, rig: str) -> None:
    folder.mkdir()
    np.savez(folder / "result.npz", **{name: getattr(path, name) for name in Trajectory.__slots__})
    (folder / "rig.yaml").write_text(rig)


def test_map_along_the_truth(made, tmp_path):
    log, folder = made
    made = mapping.make(str(log), folder, tmp_path / "map.ply")
    cloud = mapping.open3d().io.read_point_cloud(str(tmp_path / "map.ply"))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    assert len(points) == len(normals) == len(made.points) > 5000
    # range noise is 30 mm along the ray; a wall seen at a slant is thinner
    assert 0.01 < made.sharpness.thickness_m < 0.04
    assert made.in_air < 1e-3 * made.returns  # nothing hangs in clean air
    picture = (tmp_path / "map.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    with pytest.raises(TbmfgError, match="--force"):
        mapping.make(str(log), folder, tmp_path / "map.ply")


def test_map_along_the_estimate_is_as_sharp(made, tmp_path):
    log, folder = made
    run(str(log), estimator="batch", output=tmp_path / "batch")
    thick = [
        mapping.make(str(log), along, tmp_path / f"{along.name}.ply").sharpness.thickness_m
        for along in (folder, tmp_path / "batch")
    ]
    assert abs(thick[1] / thick[0] - 1.0) < 0.1


TURN, PLACE = (4.0, -3.0, 20.0), (0.3, -0.2, 0.6)  # deg and m


@pytest.fixture
def misread(made, tmp_path) -> Path:
    """The truth with a rig that has the mounting wrong and a summary that has found it, beside a result that drifts."""
    path, rig = mapping.read_result_npz(made[1] / "result.npz"), load_rig(made[1] / "rig.yaml")
    right = rig.sensors["lidar"].T_bl
    rpy = np.rad2deg(rpy_from_rotation(right.R @ exp_so3(np.deg2rad(TURN)).T)).tolist()
    wrong = override(rig, [f"sensors.lidar.T_bl={{xyz_m: {list(PLACE)}, rpy_deg: {rpy}}}"])
    found = {
        "lidar_mounting_m": Calibrated(right.xyz_m, (0.1,) * 3, True),
        "lidar_mounting_turn_deg": Calibrated(TURN, (0.5,) * 3, True),
    }
    drifting = replace(path, position_n=path.position_n + np.linspace(0, 1, 61)[:, None])
    result = Result("isam2", drifting, path, calibration=found)
    write_result(tmp_path / "misread", result, summarise(result, 0), dump_rig(wrong))
    return tmp_path / "misread"


def test_the_map_is_made_of_the_smoothed_trajectory_and_the_mounting_found(made, misread, tmp_path):
    log, folder = made
    right = mapping.make(str(log), folder, tmp_path / "right.ply", keep_air=True)
    found = mapping.make(str(log), misread, tmp_path / "found.ply", keep_air=True)
    assert (right.along, found.along) == ("result", "smoothed")
    assert found.sharpness.thickness_m == pytest.approx(right.sharpness.thickness_m, rel=1e-3)
    assert found.sharpness.entropy == pytest.approx(right.sharpness.entropy, abs=1e-3)
    (misread / "summary.json").write_text("{}")
    with pytest.raises(TbmfgError, match="not the summary of a result"):
        mapping.make(str(log), misread, tmp_path / "found.ply", force=True)
    (misread / "summary.json").unlink()  # and so nothing is known to be found
    as_the_rig_says = mapping.make(str(log), misread, tmp_path / "found.ply", keep_air=True, force=True)
    assert as_the_rig_says.sharpness.thickness_m > 1.2 * right.sharpness.thickness_m


def test_the_sketch_has_the_mounting_found(made, misread):
    log, path = read_log(made[0]), mapping.read_result_npz(misread / "smoothed.npz")
    result = Result("isam2", mapping.read_result_npz(misread / "result.npz"), path)
    true, _ = mapping.sketch(log, load_rig(made[1] / "rig.yaml"), result)
    found, _ = mapping.sketch(
        log, load_rig(misread / "rig.yaml"), replace(result, calibration=read_calibration(misread))
    )
    # a point at a cube's edge may fall to either side by rounding
    assert len(found) == pytest.approx(len(true), rel=1e-3)
    assert np.mean(cKDTree(true).query(found)[0] < 1e-6) > 0.99


def test_dust_is_left_out_and_counted(tmp_path):
    simulation = datasets.make(
        "tbm-roadway", seed=3, duration=6.0, dust=0.2, dust_begin=-1.0, dust_end=2.0, columns=200, imu_rate_hz=200.0
    )
    log, rig, path = in_memory(simulation), simulation.rig, truth_path(simulation)
    scans = list(mapping.scans_in_n(log, rig, path))
    walls = raycasting(world(3))

    def off(points):
        return walls.compute_distance(points.astype(np.float32)).numpy()

    made, all_of_it = mapping.mapped(lambda: scans), mapping.mapped(lambda: scans, keep_air=True)
    far = np.concatenate([off(scan.points) for scan in scans])
    out = np.concatenate([made.air.holds(scan.points) for scan in scans])
    assert (made.returns, made.in_air) == (len(far), out.sum())
    assert (all_of_it.returns, all_of_it.in_air) == (len(far), 0)
    assert np.mean(far > 0.15) > 0.4  # beyond range noise: dust
    assert out[far < 0.15].mean() < 1e-3
    # the end of a ray tells nothing over 0.4 m and a tenth of its range: dust that near to a wall is not told from it
    reach = np.concatenate([np.linalg.norm(scan.points - scan.origins, axis=1) for scan in scans])
    assert out[(reach < 2.0) & (far > 0.5)].mean() > 0.99
    assert out[far > 0.15].mean() > 0.9
    assert np.mean(far[~out] > 0.15) < 0.1
    assert np.mean(off(made.points) > 0.15) < np.mean(off(all_of_it.points) > 0.15)
    assert made.sharpness.thickness_m < all_of_it.sharpness.thickness_m


def test_walls_that_are_grazed_are_no_air():
    simulation = datasets.make("tbm-tunnel", seed=1, duration=6.0, columns=200, imu_rate_hz=200.0)
    made = mapping.mapped(lambda: mapping.scans_in_n(in_memory(simulation), simulation.rig, truth_path(simulation)))
    assert made.in_air < 0.01 * made.returns


def test_memory_for_the_air_goes_with_space_not_with_scans():
    rng = np.random.default_rng(2)
    air, points = Air(), rng.uniform(-5.0, 5.0, (3000, 3))
    for _ in range(20):
        air.add_returns(points)
    air.add_rays(points, np.zeros((3000, 3)))
    assert air.used <= 3000
    assert len(air.keys) < 8 * 3000 + (1 << 14)
    assert air.ended.sum() == 20 * 3000


def test_a_result_carries_the_map(made, tmp_path):
    log, _ = made
    run(str(log), estimator="ins", output=tmp_path / "ins", report=True)
    [(_, fields)] = read_log(tmp_path / "ins" / "result.mcap").clouds["/tbmfg/map"]
    points = np.column_stack([fields[axis] for axis in "xyz"])
    cubes = np.unique(np.floor(points.astype(float) / mapping.SKETCH_M + 1e-6), axis=0)
    assert len(points) > 1000
    assert len(cubes) > 0.99 * len(points)  # one point in each, but for those that float32 rounds into the next
    page = (tmp_path / "ins" / "report.html").read_text("utf-8")
    assert "the map along ins, of " in page
    assert "How the scans fit" in page
    assert len(page) < 15e6


def test_a_result_says_how_every_scan_fits(made, tmp_path):
    log, _ = made
    result, _ = run_result(str(log), estimator="ins", output=tmp_path / "ins")
    with np.load(tmp_path / "ins" / "health.npz") as arrays:
        told = {name.removeprefix("lidar_"): arrays[name] for name in arrays}
    assert told.keys() == set(Health.__slots__)
    stamps = read_log(log).clouds["/points"].t_ns
    assert len(told["t_ns"]) == len(stamps) - 1  # the first begins before the IMU
    assert (np.diff(told["t_ns"]) > 0).all()
    assert told["t_ns"][0] - stamps[1] == pytest.approx(1e8, abs=1e6)  # the end of a scan
    assert told["healthy"].all()
    assert told["overlap"][5:].min() > 0.5
    assert 0.0 < np.median(told["residual_m"]) < 0.06
    assert told["dust"].max() < 0.4
    assert np.array_equal(result.health["lidar"].weak, told["weak"])


def test_ghosts_show(made, tmp_path):
    log, folder = made
    read = read_log(log)
    path, rig = mapping.read_result_npz(folder / "result.npz"), load_rig(folder / "rig.yaml")
    sharp = []
    for shift in (0.0, 0.15):
        drifting = path.position_n + shift * np.linspace(0, 1, 61)[:, None] * [0.0, 1.0, 1.0]
        blur = mapping.SurfelMap(mapping.THICK_M, full=np.inf)
        for scan in mapping.scans_in_n(read, rig, replace(path, position_n=drifting)):
            blur.add(scan.points, np.zeros(3))
        sharp.append(mapping.sharpness(blur))
    assert sharp[1].thickness_m > 1.3 * sharp[0].thickness_m
    assert sharp[1].entropy > sharp[0].entropy + 0.2


def test_what_cannot_be_mapped(made, tmp_path):
    log, folder = made
    with pytest.raises(TbmfgError, match=r"\.ply or \.pcd"):
        mapping.make(str(log), folder, tmp_path / "map.xyz")
    with pytest.raises(TbmfgError, match="no scans of lidar-2"):
        mapping.make(str(log), folder, tmp_path / "map.ply", lidar="lidar-2")
    assert not list(tmp_path.iterdir())


def test_a_thin_log_gives_a_thin_map(tmp_path):
    simulation = datasets.make("tbm-roadway", seed=3, duration=1.5, columns=2, imu_rate_hz=200.0)
    simulation.write(tmp_path / "log.mcap")
    path = truth_path(simulation)
    short = Trajectory(**{name: getattr(path, name)[:15] for name in Trajectory.__slots__})
    save(tmp_path / "truth", short, simulation.rig_text)
    made = mapping.make(str(tmp_path / "log.mcap"), tmp_path / "truth", tmp_path / "map.ply")
    assert made.sharpness == mapping.Sharpness(None, None, 0)
    assert 1 < len(made.points) < 600
    assert (tmp_path / "map.ply").is_file()
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("points", [[[1.0, 2.0, 3.0]], [[0.0, 0.0, 0.0], [0.0, 0.0, -500.0]]])
def test_pictures_of_few_points_are_bounded(points):
    image = raster.picture(np.array(points), np.zeros((2, 3)))
    assert image.shape[0] < 10 * raster.WIDTH
    assert (image < 255).any()


def test_picture_holds_the_points_and_the_path():
    points = np.array([[0.0, 0.0, 0.0], [10.0, 1.0, 0.0], [10.0, 0.0, 2.0]])
    image = raster.picture(points, np.array([[0.0, 0.5, 1.0], [10.0, 0.5, 1.0]]))
    assert image.shape[1:] == (raster.WIDTH, 3)
    assert (image == raster.PATH).all(axis=2).sum() >= 2 * raster.WIDTH - 2
    data = raster.png(image)
    assert struct.unpack(">II", data[16:24]) == (raster.WIDTH, len(image))
    start = data.index(b"IDAT") + 4
    rows = zlib.decompress(data[start : data.index(b"IEND") - 8])
    assert len(rows) == len(image) * (3 * raster.WIDTH + 1)
