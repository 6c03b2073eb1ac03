"""``python -m datasets``: the list, and a log that reads back as it was simulated."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import datasets
from datasets.__main__ import main
from tbmfg.mcap import read_log
from tbmfg.rig import parse_rig


def test_list_names_every_dataset_and_its_options(capsys):
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    for name in datasets.MACHINES:
        assert name in printed
    assert "vibration=1.0" in printed


def test_made_log_reads_back(tmp_path, capsys):
    path = tmp_path / "drive.mcap"
    options = ["--set", "prism_rate_hz=2", "--set", "truth_rate_hz=50", "--set", "sensors.prism.sigma_mm=2"]
    assert main(["make", "tbm-drive", "-o", str(path), "--seed", "7", "--duration", "4", *options]) == 0
    assert "/prism/position 8" in capsys.readouterr().out
    simulation = datasets.make(
        "tbm-drive", seed=7, duration=4.0, prism_rate_hz=2.0, truth_rate_hz=50.0, settings=("sensors.prism.sigma_mm=2",)
    )
    log = read_log(path)
    assert set(log.series) == {series.topic for series in simulation.log_series}
    for written in simulation.log_series:
        read = log.series[written.topic]
        assert_array_equal(read.t_ns, written.t_ns)
        for name, column in written.columns.items():
            assert_array_equal(read[name], column)
    assert parse_rig(log.attachments["rig.yaml"].decode(), "rig.yaml") == simulation.rig
    assert simulation.rig.sensors["prism"].sigma_mm == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tbm"], "no such dataset; there are tbm-drive"),
        (["tbm-drive", "--set", "vibration=much"], "should be a number"),
        (["tbm-drive", "--set", "wobble=1"], "no option wobble"),
        (["tbm-drive", "--set", "sensors.prism.sgima_mm=1"], "unknown key"),
    ],
)
def test_faults_are_one_line_and_exit_1(arguments, message, tmp_path, capsys):
    assert main(["make", *arguments, "-o", str(tmp_path / "x.mcap"), "--duration", "2"]) == 1
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_options_that_datasets_share_are_options_of_each():
    shared = ("mti30", "speed_mps", "vibration", "field_ut")
    for name in ("shearer-cut", "shearer-panel", "shearer-magfault"):
        assert set(shared) <= set(datasets.defaults(name))
    slow = datasets.make("shearer-panel", duration=20.0, speed_mps=0.5, face_m=60.0)
    fast = datasets.make("shearer-panel", duration=20.0, face_m=60.0)
    ways = [np.linalg.norm(np.ptp(one.truth(np.array([0.0, 20.0])).position, axis=0)) for one in (slow, fast)]
    assert ways[0] == pytest.approx(0.5 * 19, rel=0.02)  # less half of the 2 s that it takes to speed up
    assert ways[1] == pytest.approx(19, rel=0.02)


def test_usage_exits_2():
    done = subprocess.run([sys.executable, "-m", "datasets", "make"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "usage" in done.stderr


def test_without_a_duration_a_log_has_its_own_length(tmp_path, capsys):
    path = tmp_path / "static.mcap"
    assert main(["make", "shaft-static", "-o", str(path)]) == 0
    assert "/imu/data 2000, /imu/mag 2001" in capsys.readouterr().out  # 40 s at 50 Hz
