"""What the README says can be typed: its commands exist, its demo runs what it says, its rig loads."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from datasets.__main__ import main as make_dataset
from tbmfg.cli import app
from tbmfg.estimators import ESTIMATORS
from tbmfg.pipeline import compare
from tbmfg.rig import load_rig, parse_rig, shipped

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def test_commands_exist():
    listed = README.split("## Command line")[1].split("```")[1]
    named = set(re.findall(r"^tbmfg (\w+) ", listed, re.MULTILINE))
    registered = {command.name or command.callback.__name__ for command in app.registered_commands}
    assert named == registered


def test_estimators_are_the_ones_listed():
    section = README.split("## Estimators")[1].split("##")[0]
    assert set(re.findall(r"^\| `([\w-]+)` \|", section, re.MULTILINE)) == set(ESTIMATORS)


def test_rig_loads_and_shipped_rigs_are_named():
    [text] = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    assert parse_rig(text, "README").name == "my-machine"
    named = re.findall(r"`([\w-]+)`", README.split("Rigs that come with tbmfg:")[1].split(".")[0])
    assert set(named) == set(shipped())
    assert all(load_rig(name).name for name in named)


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in re.findall(r"^make (\w+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_demo_in_small(tmp_path: Path):
    lines = re.findall(r"^\t\$\(BIN\)/(.*)$", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    assert any("datasets make tbm-drive" in line for line in lines)
    [line] = [line for line in lines if line.startswith("tbmfg compare")]
    log = tmp_path / "drive.mcap"
    assert make_dataset(["make", "tbm-drive", "-o", str(log), "--duration", "8", "--set", "imu_rate_hz=100"]) == 0
    names = re.search(r"--estimators (\S+)", line)[1].split(",")
    summaries = compare(log, estimators=names, output=tmp_path / "result")
    for name in names:
        assert (tmp_path / "result" / name / "trajectory.tum").exists()
        # the tracked point is known to 3 mm and the arm to 5 mm per axis: far below a tenth of a metre
        assert summaries[name]["metrics"]["position_rms_m"] == pytest.approx(0.0, abs=0.1)
