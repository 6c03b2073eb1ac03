"""How long a run takes, stage by stage, beside a bare GTSAM script on the same recording.

The recording is EuRoC MH_01 as MCAP, a total station tracking a multirotor, or another with a prism. Clock offset and
noise factor are given in the rig, by ``--set`` or else found once before the clock starts: a bare script does not
search for them. Everything is run once untimed, so neither imports nor compilation count. Of the repetitions ``mean``
is the median. Seconds are those of this machine; what compares are the ratios.

read .. write          stages of ``tbmfg run``; ``build`` is the preintegration, ``solve`` all iterations
total                  the whole run with writing, and the whole script without
total / bare           their ratio
position_difference    RMS distance between the two solutions: whether they solved the same problem
position_sd_ratio      median ratio of their position sds
decode                 all messages to columns, to the stock decoder's objects, and not at all (chunks iterated)
"""

from __future__ import annotations

import argparse
import os
import pkgutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.rows import Row
from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig, load_rig, override
from tbmfg.state import POS

Clock = Callable[[], float]

RECORDING = Path("mcap") / "euroc_mh01_imu_leica.mcap"
LIMIT = 4.0  # a run should take at most this many times the script
STAGES = {  # where tbmfg looks each of them up when it runs
    "read": "tbmfg.mcap.read_log",
    "prepare": "tbmfg.prepare.prepare",
    "filter": "tbmfg.filters.ins.run",
    "smooth": "tbmfg.smoother.batch.solve",
    "build": "tbmfg.smoother.graph.imu_graph",
    "covariance": "tbmfg.smoother.chain.Elimination.covariances",
    "write": "tbmfg.pipeline.write_result",
}
SHOWN = ("read", "prepare", "filter", "build", "solve", "covariance", "write", "total")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--log", type=Path, metavar="FILE", help=f"(TBMFG_DATA/{RECORDING})")
    parser.add_argument("--rig", default="euroc-leica", metavar="NAME|FILE", help="with one prism (euroc-leica)")
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="timed repetitions (3)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments", help="of the rig"
    )


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows; none, and a line that says why, without a recording."""
    path = given.log
    if path is None:
        if "TBMFG_DATA" not in os.environ:
            print("speed: skipped: TBMFG_DATA is not set and no --log given; there is no recording to read")
            return []
        path = Path(os.environ["TBMFG_DATA"]) / RECORDING
    if not path.is_file():
        raise TbmfgError(f"{path}: no such recording; name one with --log")
    if given.repeat < 1:
        raise TbmfgError(f"--repeat {given.repeat}: should be 1 or more")
    rig = fixed(path, override(load_rig(given.rig), given.assignments))
    return [*compare(path, rig, given.repeat), *decoding(path, given.repeat)]


def fixed(path: Path, rig: Rig) -> Rig:
    """The rig with clock offset and noise factor as numbers; what it leaves open is found from the log."""
    from tbmfg.mcap import read_log
    from tbmfg.prepare import prepare

    prism = rig.sensors.get("prism")
    if list(rig.of_kind("prism")) != ["prism"] or not prism.arm_sd or rig.imu.stamp != "end":
        raise TbmfgError(f"rig {rig.name}: the script wants one prism with an arm_sd_m, and an IMU stamped at the end")
    settings = []
    if rig.imu.noise_factor == "auto" or prism.clock_offset_sd:
        problem = prepare(read_log(path), rig)
        settings.append(f"sensors.imu.noise_factor={problem.calibration['noise_factor'].value:.4g}")
        settings.append(f"sensors.prism.clock_offset_s={problem.clocks['prism'].offset_s:.6f}")
    return override(rig, [*settings, "sensors.prism.clock_offset_sd_s=0", "sensors.prism.clock_drift_sd_ppm=0"])


# ---- run against script ----


def compare(path: Path, rig: Rig, repeat: int) -> list[Row]:
    """tbmfg and the script in turn, ``repeat`` times after one that does not count."""
    from benchmarks import bare
    from tbmfg.filters import ins
    from tbmfg.mcap import read_log
    from tbmfg.pipeline import run
    from tbmfg.prepare import prepare
    from tbmfg.results import read_result_npz

    problem = prepare(read_log(path), rig)
    initial = ins.run(problem).x
    spent, script = [], []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repeat + 1):
            with clocks(STAGES) as once, clock(once, "total"):
                run(path, rig=rig, truth="none", output=folder, force=True)
            once["solve"] = once["smooth"] - once["build"] - once["covariance"]
            spent.append(once)
            with clock(once := {}, "total"):
                solution = bare.run(path, problem, initial)
            script.append(once["total"])
        ours = read_result_npz(Path(folder) / "result.npz")
    spent, script = spent[1:], script[1:]
    rows = [row(path, "tbmfg", stage, "s", [once[stage] for once in spent]) for stage in SHOWN]
    ratios = [once["total"] / seconds for once, seconds in zip(spent, script, strict=True)]
    difference = np.linalg.norm(ours.position_n - problem.origin_n - solution.position, axis=1)
    sd, bare_sd = (
        np.sqrt(np.trace(cov, axis1=1, axis2=2)) for cov in (ours.cov[:, POS, POS], solution.cov[:, POS, POS])
    )
    return [
        *rows,
        row(path, "bare script", "total", "s", script),
        row(path, "tbmfg", "total / bare", "", ratios, (None, LIMIT)),
        row(path, "tbmfg", "position_difference", "mm", [1e3 * np.sqrt(np.mean(difference**2))]),
        row(path, "tbmfg", "position_sd_ratio", "", [np.median(sd / bare_sd)]),
    ]


@contextmanager
def clocks(targets: dict[str, str], now: Clock = time.perf_counter) -> Iterator[dict[str, float]]:
    """Seconds spent in each of the named functions while inside, by the names' keys."""
    spent: dict[str, float] = dict.fromkeys(targets, 0.0)
    with ExitStack() as stack:
        for stage, target in targets.items():
            stack.enter_context(mock.patch(target, clocked(spent, stage, pkgutil.resolve_name(target), now)))
        yield spent


def clocked(spent: dict[str, float], stage: str, function: Callable, now: Clock) -> Callable:
    """``function``, its time added to ``spent``."""

    def wrapper(*args: Any, **kwargs: Any) -> Any:
        with clock(spent, stage, now):
            return function(*args, **kwargs)

    return wrapper


@contextmanager
def clock(spent: dict[str, float], stage: str, now: Clock = time.perf_counter) -> Iterator[None]:
    """Add the time inside to ``spent``."""
    started = now()
    try:
        yield
    finally:
        spent[stage] = spent.get(stage, 0.0) + now() - started


# ---- decoding ----


def decoding(path: Path, repeat: int) -> list[Row]:
    """Every message of the file: read_log, the stock decoder, and bare iteration over the chunks."""
    from tbmfg.mcap import read_log

    messages = iterate(path)
    ways = {"tbmfg": read_log, "mcap-ros2-support": decode, "no decoding": iterate}
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeat + 1):
        for name, way in ways.items():
            with clock(once := {}, name):
                way(path)
            spent[name].append(once[name] / messages * 1e6)
    ours, *others = spent
    ratios = {other: np.array(spent[ours][1:]) / spent[other][1:] for other in others}
    return [
        *(row(path, name, "decode", "us per message", values[1:]) for name, values in spent.items()),
        *(row(path, ours, f"decode / {other}", "", values) for other, values in ratios.items()),
    ]


def decode(path: Path) -> int:
    """Decode every message with the stock decoder and throw it away; how many there were."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def iterate(path: Path) -> int:
    """Pass over every message without decoding it; how many there were."""
    from mcap.reader import make_reader

    with open(path, "rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages())


def row(
    path: Path,
    estimator: str,
    metric: str,
    unit: str,
    values: Sequence[float],
    bound: tuple[float | None, float | None] | None = None,
) -> Row:
    """Median and sd of the repetitions; the scenario is the recording."""
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Row(path.stem, estimator, metric, unit, float(np.median(values)), sd, len(values), bound)
