"""Whether the two costly steps of preparing keep up with their sensors, and whether scans cost memory one by one.

emd      mode decomposition of a standing roadheader's six axes with its pump on, 475 Hz
lidar    a drive through a tunnel, 28 800 points at 10 Hz: from the log on disk to the problem, with all else in it
bare     KISS-ICP alone, its cost beside ours on the same points, neither with compensation of the motion in a scan

times_real_time  seconds of log in a second of wall time
cost, ratio      CPU time of a scan, and over that of bare KISS-ICP; medians
growth           peak memory that ``--scans`` more scans of one place cost, over what they would if they were kept
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rows import Row
from benchmarks.runs import in_memory, points_of
from benchmarks.scans import bare_kiss, ours
from benchmarks.workers import run_all
from tbmfg.errors import TbmfgError
from tbmfg.rig import Lidar
from tbmfg.timeseries import Floats

EMD_TIMES, LIDAR_TIMES, RATIO = 20.0, 1.0, 1.5
GROWTH = 0.05
COLUMNS = 1800  # of 16 points


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--emd", type=float, default=300.0, metavar="S", help="of samples to decompose (300)")
    parser.add_argument("--drive", type=float, default=20.0, metavar="S", help="through the tunnel (20)")
    parser.add_argument("--scans", type=int, default=300, metavar="N", help="of one place (300)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows of both."""
    if min(given.emd, given.drive, given.scans) < 1:
        raise TbmfgError(f"--emd {given.emd:g} --drive {given.drive:g} --scans {given.scans}: each should be 1 or more")
    return [emd(given.emd), *lidar(given.drive, given.scans)]


def emd(duration_s: float) -> Row:
    """How fast samples are decomposed; a window once before, so that compiling does not count."""
    import datasets
    from tbmfg.inertial import enhancement
    from tbmfg.prepare.samples import imu_steps
    from tbmfg.rig import Enhancement

    simulation = datasets.make("tbm-static", seed=0, duration=duration_s, pump=1.0)
    steps, _ = imu_steps(in_memory(simulation), simulation.rig, (), [])
    wanted = Enhancement()
    size = 2 * round(0.5 * wanted.window / steps.period_s)
    enhancement.enhanced(steps.gyro[:size], "noise", size, give_back=True)
    started = time.perf_counter()
    enhancement.denoise(steps, "noise", wanted.window)
    return _times("tbm-static", "emd", duration_s, started, EMD_TIMES)


def lidar(duration_s: float, more: int) -> Iterator[Row]:
    """How fast a drive is prepared, what a scan costs, and what many of one place cost in memory."""
    import datasets
    from tbmfg.mcap import read_log
    from tbmfg.prepare import prepare

    simulation = datasets.make("tbm-tunnel", seed=0, duration=duration_s, columns=COLUMNS)
    sensor = simulation.rig.sensors["lidar"]
    with TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        simulation.write(log)
        prepare(read_log(log), simulation.rig)
        started = time.perf_counter()
        prepare(read_log(log), simulation.rig)
        yield _times("tbm-tunnel", "lidar", duration_s, started, LIDAR_TIMES)
    [clouds] = simulation.clouds
    scans = [(points_of(fields), t_ns * 1e-9) for t_ns, fields in clouds]
    cost = {name: [_cpu(register, *scan) for scan in scans] for name, register in (
        ("lidar", ours(sensor)), ("bare", bare_kiss(sensor.voxel)),
    )}  # fmt: skip
    for name, each in cost.items():
        yield Row("tbm-tunnel", name, "cost", "ms", 1e3 * float(np.median(each)), None, len(each))
    ratio = float(np.median(cost["lidar"]) / np.median(cost["bare"]))
    yield Row("tbm-tunnel", "lidar", "ratio", "", ratio, None, len(scans), (None, RATIO))
    [growth] = run_all(_growth, [(*scans[-1], sensor, more)], 1, "pace")  # a process whose peak is its own
    yield Row("tbm-tunnel", "lidar", "growth", "", growth, None, more, (None, GROWTH))


def _growth(job: tuple[Floats, float, Lidar, int]) -> float:
    """What ``more`` registrations of one scan, ``points`` at ``t_s``, add to the peak memory, over the size of their
    points; as many before, until the map is full."""
    points, t_s, sensor, more = job
    register = ours(sensor)
    peak_kb = []
    for turn in range(2):
        for scan in range(more):
            register(points, t_s + 0.1 * (turn * more + scan))
        peak_kb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return 1024.0 * (peak_kb[1] - peak_kb[0]) / (more * points.nbytes)


def _cpu(register, points: Floats, t_s: float) -> float:
    started = time.process_time()
    register(points, t_s)
    return time.process_time() - started


def _times(scenario: str, name: str, duration_s: float, started: float, least: float) -> Row:
    times = duration_s / (time.perf_counter() - started)
    return Row(scenario, name, "times_real_time", "", times, None, 1, (least, None))
