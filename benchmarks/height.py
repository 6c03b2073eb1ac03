"""Height by air pressure, against satellite heights of metres that the estimators do not get (recordings not part of
this).

barometer     the standard atmosphere's height of each reading
difference    sd of the difference from the satellite heights; its mean is the weather, which no barometer knows
correlation   of the two
said          what the covariance says of the height's change since the start, RMS
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rows import Row
from tbmfg.timeseries import Floats, Times


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="NPZ", help="the recording, as datasets import phone")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments", help="of the rig"
    )


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of the barometer alone and of the estimators."""
    from datasets.recordings import phone
    from tbmfg.pipeline import open_session
    from tbmfg.prepare.samples import pressure_height

    recording = phone.load(given.source)
    series = {part.topic: part for part in recording.log_series}
    topic = {name: sensor.topic for name, sensor in recording.rig.sensors.items()}
    fixes, readings = series[topic["gnss"]], series[topic["barometer"]]
    reference = fixes.t_ns, fixes["llh"][:, 2]
    rows = _rows(given.source.stem, "barometer", readings.t_ns, pressure_height(readings["pressure"]), *reference)
    with TemporaryDirectory() as folder:
        log = Path(folder) / "phone.mcap"
        recording.write(log)
        session = open_session(log, without=("gnss",), overrides=given.assignments)
        for name in given.estimators.split(","):
            path = session.estimate(name)[0].trajectory
            rows += _rows(given.source.stem, name, path.t_ns, path.position_n[:, 2], *reference)
            said = float(np.sqrt(np.mean(path.cov[:, 5, 5])))
            rows.append(Row(given.source.stem, name, "said", "m", said, None, 1))
    return rows


def _rows(scenario: str, name: str, t_ns: Times, height: Floats, at_ns: Times, reference: Floats) -> list[Row]:
    inside = (at_ns >= t_ns[0]) & (at_ns <= t_ns[-1])
    found = np.interp(at_ns[inside], t_ns, height)
    difference, alike = float(np.std(found - reference[inside])), float(np.corrcoef(found, reference[inside])[0, 1])
    return [
        Row(scenario, name, "difference", "m", difference, None, int(inside.sum())),
        Row(scenario, name, "correlation", "", alike, None, int(inside.sum())),
    ]
