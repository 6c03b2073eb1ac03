"""The doctor: what it finds of an installation, and whether its self-test would see a wrong estimate."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from tbmfg import cli, doctor


def ask(*arguments: str):
    return CliRunner().invoke(cli.app, ["doctor", *arguments], prog_name="tbmfg")


def test_doctor_finds_all_well_and_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(doctor, "REQUIRED", ("gtsam", "mcap_ros2"))
    monkeypatch.setattr(doctor, "OPTIONAL", {})
    well = ask()
    assert well.exit_code == 0, well.output
    assert "ok     gtsam: " in well.stdout
    assert "smoothed to" in well.stdout
    assert "broken" not in well.stdout
    monkeypatch.setattr(doctor, "REQUIRED", ("numpy", "no_such_package"))
    monkeypatch.setattr(doctor, "OPTIONAL", {"no_such_option": "nothing"})
    monkeypatch.setattr(doctor, "_self_test", lambda: 1 / 0)
    ill = ask("--json")
    assert ill.exit_code == 1
    found = {check["name"]: check for check in json.loads(ill.stdout)}
    assert found["no_such_package"]["state"] == "broken"
    assert "pip install no-such-package" in found["no_such_package"]["remedy"]
    assert found["no_such_option"]["state"] == "absent"
    assert "ZeroDivisionError" in found["self-test"]["found"]


def test_the_self_test_sees_an_estimate_that_is_off(monkeypatch):
    def shifted(rng):
        log, truth = circle(rng)
        return log, lambda t_s: truth(t_s) + np.array([0.0, 0.1, 0.0])

    circle = doctor.circle
    monkeypatch.setattr(doctor, "circle", shifted)
    with pytest.raises(ArithmeticError, match="of its sds off"):
        doctor._self_test()
