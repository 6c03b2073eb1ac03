"""Whether everything that tbmfg needs is there and works: versions, imports, compiled code, and a run of a second."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path

import numpy as np

from tbmfg import __version__
from tbmfg.pipeline import run_result
from tbmfg.rig import parse_rig
from tbmfg.timeseries import NS, Floats, Log, Series

OK, ABSENT, BROKEN = "ok", "absent", "broken"
REQUIRED = (
    "gtsam",
    "numpy",
    "scipy",
    "numba",
    "open3d",
    "kiss_icp",
    "mcap",
    "mcap_ros2",
    "PyEMD",
    "plotly",
    "pydantic",
)
OPTIONAL = {
    "distributed": "batch --scheduler: pip install 'tbmfg[cluster]'",
    "s3fs": "logs and results in S3: pip install 'tbmfg[cluster]'",
}
DISTRIBUTIONS = {"open3d": ("open3d-cpu", "open3d"), "mcap_ros2": ("mcap-ros2-support",), "PyEMD": ("EMD-signal",)}

RADIUS_M, SPEED_MPS, SPAN_S, RATE_HZ = 5.0, 1.0, 10.0, 100.0  # of the self-test's circle
RIG = """
name: self-test
initial: {yaw_deg: 90, yaw_sd_deg: 5, velocity_mps: [0, 1, 0]}
sensors:
  imu: {topic: /imu, gyro_density_dps_rthz: 0.01, acc_density_ug_rthz: 200}
  prism: {topic: /prism, sigma_mm: 3, sigma_ppm: 0}
zero_velocity: {enabled: false}
"""


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at. ``state``: ok, absent (optional and not installed) or broken; ``remedy``: what to do."""

    name: str
    state: str
    found: str
    remedy: str = ""


def checks() -> Iterator[Check]:
    """Everything that is looked at, one after the other; the last is a run."""
    yield Check("tbmfg", OK, f"{__version__} in {Path(__file__).parent}")
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors"
    yield Check("Python", OK, f"{platform.python_version()} on {machine}")
    for name in REQUIRED:
        yield _imported(
            name, BROKEN, f"pip install {_distribution(name)[0]}, or install tbmfg anew in a fresh environment"
        )
    for name, remedy in OPTIONAL.items():
        yield _imported(name, ABSENT, f"only for {remedy}")
    yield _guarded("compiled code", _compiled, "set NUMBA_CACHE_DIR to a folder that can be written")
    yield _guarded("self-test", _self_test, "run it again with --debug, and report what it says")


def _imported(name: str, otherwise: str, remedy: str) -> Check:
    try:
        if name == "open3d":
            from tbmfg.mapping import open3d

            open3d()
        else:
            import_module(name)
    except Exception as error:  # a broken binary may raise anything
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            return Check(name, otherwise, "not installed", remedy)
        return Check(name, BROKEN, _said(error), remedy)
    return Check(name, OK, _distribution(name)[1])


def _distribution(name: str) -> tuple[str, str]:
    """What ``pip`` calls the package of a module, and its version."""
    names = DISTRIBUTIONS.get(name, (name.replace("_", "-"),))
    for one in names:
        try:
            return one, metadata.version(one)
        except metadata.PackageNotFoundError:
            continue
    return names[0], "version not known"


def _guarded(name: str, look: Callable[[], str], remedy: str) -> Check:
    try:
        return Check(name, OK, look())
    except Exception as error:
        return Check(name, BROKEN, _said(error), remedy)


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _compiled() -> str:
    """Where numba keeps what it compiled of tbmfg, and how many functions that are."""
    from tbmfg.filters.kalman import predict

    folder = Path(predict.stats.cache_path)
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written: every run compiles anew, which takes about a minute")
    root = Path(__file__).parent if folder.is_relative_to(Path(__file__).parent) else folder.parent
    count = sum(1 for _ in root.rglob("*.nbi"))
    return f"{count} functions in {root}" if count else f"none yet in {root}: the first run compiles, about a minute"


def _self_test() -> str:
    """Smooth a circle driven level at constant speed; its largest error has to lie within five of its own sds."""
    started = time.perf_counter()
    log, truth = circle(np.random.default_rng(0))
    path = run_result(log, rig=parse_rig(RIG, "self-test"), truth="none")[0].trajectory
    error = path.position_n - truth((path.t_ns - log.series["/imu"].t_ns[0]) * 1e-9)
    sds = np.abs(error) / np.sqrt(np.einsum("kii->ki", path.cov[:, 3:6, 3:6]))
    if not sds.max() < 5.0:
        raise ArithmeticError(f"the estimate of a known path is {sds.max():.1f} of its sds off; 5 are the limit")
    rms_mm = 1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return f"{SPAN_S:g} s smoothed to {rms_mm:.1f} mm in {time.perf_counter() - started:.1f} s"


def circle(rng: np.random.Generator) -> tuple[Log, Callable[[Floats], Floats]]:
    """IMU and prism of a unit on a level circle, heading along it, and where it is at times (n,) s after the start."""
    turn = SPEED_MPS / RADIUS_M

    def position(t_s: Floats) -> Floats:
        return RADIUS_M * np.column_stack([np.cos(turn * t_s), np.sin(turn * t_s), np.zeros(len(t_s))])

    n, start_ns = int(SPAN_S * RATE_HZ) + 1, 1_700_000_000 * NS
    # the acceleration of a circle points to its centre, which lies to the left
    still = np.ones((n, 1))
    gyro = still * [0, 0, turn] + np.deg2rad(0.01) * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3))
    acc = still * [0, SPEED_MPS * turn, 9.80665] + 200e-6 * 9.80665 * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3))
    t_imu = np.arange(n) / RATE_HZ
    t_prism = np.arange(0.0, SPAN_S, 0.2)
    fixes = position(t_prism) + 0.003 * rng.standard_normal((len(t_prism), 3))

    def stamps(t_s: Floats) -> np.ndarray:
        return start_ns + np.round(t_s * NS).astype(np.int64)

    imu = Series("/imu", "sensor_msgs/msg/Imu", stamps(t_imu), {"gyro": gyro, "acc": acc})
    prism = Series("/prism", "geometry_msgs/msg/PointStamped", stamps(t_prism), {"point": fixes})
    return Log("self-test", {"/imu": imu, "/prism": prism}), position
