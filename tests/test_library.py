"""tbmfg as a library: names load when used, objects are what they say, others add to it, its wheel stands alone."""

import subprocess
import sys
import zipfile
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import tbmfg
from datasets.__main__ import main as make_dataset
from tbmfg.errors import TbmfgError
from tbmfg.registry import Registry
from tbmfg.rig import KINDS, PositionSensor, parse_rig

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    log = tmp_path_factory.mktemp("library") / "drive.mcap"
    assert make_dataset(["make", "tbm-drive", "-o", str(log), "--duration", "6", "--set", "imu_rate_hz=100"]) == 0
    return log


def test_names_of_the_library_are_there_and_documented():
    for name in tbmfg.__all__:
        assert getattr(tbmfg, name).__doc__, name
    assert set(tbmfg.__all__) <= set(dir(tbmfg))
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = tbmfg.nonsense


def test_a_run_gives_a_result(drive, tmp_path):
    log = tbmfg.read_log(drive)
    result = tbmfg.run(log, estimator="ins", without=["magnetometer"], output=tmp_path, report=True)
    assert isinstance(result, tbmfg.Result)
    assert result.trajectory.position_n.shape == (len(result.trajectory), 3)
    assert result.summary["estimator"] == "ins"
    assert result.summary["log"] == str(drive)
    assert result.summary["metrics"]["position_rms_m"] < 0.1
    assert "magnetometer" in result.summary["options"]["without"]
    assert (tmp_path / "report.html").exists()


def test_a_comparison_gives_results_and_reasons(drive):
    compared = tbmfg.compare(drive, estimators=["ins", "shearer-sins-od"], without=["odometer"])
    assert list(compared.results) == ["ins"]
    assert compared.not_run == {"shearer-sins-od": "needs odometer"}
    assert compared.results["ins"].summary["metrics"]["evaluated"] > 0


# ---- what others add ----


def with_entry_points(monkeypatch, group: str, **values: str):
    points = [EntryPoint(name.replace("_", "-"), value, group) for name, value in values.items()]
    monkeypatch.setattr("tbmfg.registry.entry_points", lambda group: points)
    return points


def test_a_registry_holds_its_own_and_what_packages_declare(monkeypatch):
    with_entry_points(monkeypatch, "x", sqrt="math:sqrt")
    registry = Registry("x", {"own": abs})
    assert list(registry) == ["own", "sqrt"]
    assert registry["sqrt"](4) == 2


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ({"own": "math:sqrt"}, "the name own is taken"),
        ({"gone": "no.such.module:x"}, "cannot be loaded .ModuleNotFound"),
    ],
)
def test_a_broken_addition_is_named(monkeypatch, points, said):
    with_entry_points(monkeypatch, "x", **points)
    with pytest.raises(TbmfgError, match=said):
        len(Registry("x", {"own": abs}))


class Beacon(PositionSensor):
    """A beacon system, good to a decimetre."""

    def sigma_at(self, position_n):
        return np.full(len(position_n), 0.1)


def test_a_position_sensor_of_ones_own_is_used_like_a_prism(drive, monkeypatch):
    monkeypatch.setitem(KINDS, "beacon", Beacon)
    log = tbmfg.read_log(drive)
    text = log.attachments["rig.yaml"].decode().replace("  prism:\n", "  beacon:\n")
    own_keys = ("sigma_mm", "sigma_ppm", "station_m")
    rig = parse_rig("\n".join(line for line in text.splitlines() if line.strip().split(":")[0] not in own_keys), "x")
    assert isinstance(rig.sensors["beacon"], Beacon)
    result = tbmfg.run(log, rig, estimator="ins")
    assert result.counts["beacon"].used > 20
    assert result.innovations["beacon"].nis.mean() < 1.0  # of 3: the prism's fixes are far better than 0.1 m


# ---- the wheel ----


@pytest.mark.slow
def test_the_wheel_stands_alone(tmp_path):
    """Built, unpacked, and run where there is no checkout: rigs, types and command line are in it."""
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "--no-build-isolation", "-w", str(tmp_path)]
    built = subprocess.run([*build, str(ROOT)], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("tbmfg-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    assert "tbmfg/py.typed" in names
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"tbmfg"}
    script = (
        "import tbmfg; from tbmfg.rig import shipped; print(tbmfg.__file__); print(*shipped()); "
        "print(tbmfg.load_rig('tbm').name); tbmfg.run; from tbmfg.cli import app"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env={"PYTHONPATH": str(tmp_path / "site"), "PATH": "/usr/bin"},
        capture_output=True, text=True,
    )  # fmt: skip
    where, rigs, name = ran.stdout.splitlines()
    assert where.startswith(str(tmp_path / "site"))
    assert "tbm" in rigs.split()
    assert name == "tbm"
