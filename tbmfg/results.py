"""The files of a result, and reading them back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

from tbmfg import storage
from tbmfg.errors import TbmfgError
from tbmfg.geometry import matrix_from_quat
from tbmfg.state import Calibrated, Innovations, Result, Trajectory, Truth
from tbmfg.timeseries import NS, Floats, Log, Series, Times

if TYPE_CHECKING:
    from tbmfg.rig import Rig
    from tbmfg.storage import Place

NIS_BINS = 60  # stretches of time that a summary gives the innovations in
SUMMARY = "summary.json"
REPORT = "report.html"
# The summary is first to go and last to come: a folder that holds one holds a complete result.
FILES = (
    "trajectory.tum",
    "result.npz",
    "smoothed.tum",
    "smoothed.npz",
    "health.npz",
    "result.mcap",
    "rig.yaml",
    REPORT,
    SUMMARY,
)


# ---- a result folder ----


def refuse_existing(output: str | Place, force: bool) -> None:
    """Raise unless a result may be written to the folder ``output``."""
    output = storage.place(output)
    if output.exists() and not output.is_dir():
        raise TbmfgError(f"{output}: is a file; -o wants a folder")
    existing = [name for name in FILES if (output / name).exists()]
    if existing and not force:
        raise TbmfgError(f"{output}: already holds {', '.join(existing)}; give another folder, or --force to replace")


def write_text(path: str | Place, text: str, *, force: bool = False) -> None:
    """Write one text file, which appears under its name when complete; raises where it exists without ``force``."""
    refuse_existing_file(path, force)
    storage.write_text(storage.place(path), text)


def refuse_existing_file(path: str | Place, force: bool) -> None:
    """Raise unless the file ``path`` may be written."""
    path = storage.place(path)
    if path.is_dir():
        raise TbmfgError(f"{path}: is a folder; -o wants a file here")
    if path.exists() and not force:
        raise TbmfgError(f"{path}: exists already; give another name, or --force to replace it")


def write_result(
    output: str | Place,
    result: Result,
    summary: dict[str, Any],
    rig_yaml: str,
    *,
    report: str | None = None,
    map_n: Floats | None = None,
    force: bool = False,
) -> None:
    """Write every file of ``result`` to the folder ``output``, a path or a URL, which is made where it is missing;
    ``report`` is a page, ``map_n`` (k, 3) m a map for result.mcap.

    The files are written elsewhere and come to their names when all are complete.
    """
    from tbmfg.mcap import write_trajectory

    def write(folder: Path) -> None:
        _write_trajectory_files(folder, "trajectory.tum", "result.npz", result.trajectory)
        if result.smoothed is not None:
            _write_trajectory_files(folder, "smoothed.tum", "smoothed.npz", result.smoothed)
        if result.health:
            told = {
                f"{lidar}_{part}": values
                for lidar, one in result.health.items()
                for part, values in asdict(one).items()
            }
            np.savez(folder / "health.npz", **told)
        write_trajectory(
            folder / "result.mcap",
            result.trajectory,
            diagnostics=_diagnostics(result),
            intervals=result.intervals,
            map_n=map_n,
        )
        (folder / "rig.yaml").write_text(rig_yaml, "utf-8")
        if report is not None:
            (folder / REPORT).write_text(report, "utf-8")
        (folder / SUMMARY).write_text(to_json(summary), "utf-8")

    refuse_existing(output, force)
    write_atomically(storage.place(output), FILES, write)


def write_atomically(output: Place, names: Iterable[str], write: Callable[[Path], None]) -> None:
    """Run ``write`` on a scratch folder, then move what it wrote to ``output``, in the order of ``names``.

    Files of ``names`` that were there before and are not written again are removed, the last name first.
    """
    with storage.scratch_for(output) as scratch:
        write(scratch)
        names = tuple(names)
        for name in reversed(names):
            (output / name).unlink(missing_ok=True)
        for name in names:
            if (scratch / name).exists():
                storage.publish(scratch / name, output / name)


def _write_trajectory_files(folder: Path, tum: str, npz: str, trajectory: Trajectory) -> None:
    write_tum(folder / tum, trajectory.t_ns, trajectory.position_n, trajectory.quat_xyzw)
    np.savez(folder / npz, **{name: getattr(trajectory, name) for name in Trajectory.__slots__})


# ---- what a summary says of a result ----


def summarise(result: Result, t0_ns: int) -> dict[str, Any]:
    """Calibration, counts, warnings, intervals and innovations of ``result``.

    Intervals are in seconds from ``t0_ns``, the first IMU sample, as ``--outage`` takes them.
    ``nis_per_dof`` is the mean squared normalised residual of the accepted updates over its degrees of
    freedom: 1 where noise and model agree.
    """
    return {
        "calibration": {name: asdict(value) for name, value in result.calibration.items()},
        "sensors": {name: asdict(counts) for name, counts in result.counts.items()},
        "warnings": list(result.warnings),
        "intervals": [
            {
                "sensor": interval.sensor,
                "kind": interval.kind,
                "start_s": (interval.start_ns - t0_ns) * 1e-9,
                "end_s": (interval.end_ns - t0_ns) * 1e-9,
            }
            for interval in result.intervals
        ],
        "innovations": {name: _innovation_summary(values, t0_ns) for name, values in result.innovations.items()},
    }


def _diagnostics(result: Result) -> dict[str, str]:
    """The same for whoever opens result.mcap in a viewer: one line of text each."""
    lines = {"estimator": result.estimator}
    for name, value in result.calibration.items():
        found, sd = np.asarray(value.value).tolist(), np.asarray(value.sd).tolist()
        lines[name] = f"{found}, sd {sd}" if value.estimated else f"{found}, not estimated"
    for name, counts in result.counts.items():
        lines[name] = ", ".join(f"{part} {count}" for part, count in asdict(counts).items() if count)
    return lines | {f"warning {number}": text for number, text in enumerate(result.warnings, 1)}


def _innovation_summary(innovations: Innovations, t0_ns: int) -> dict[str, Any]:
    gated = np.asarray(innovations.gated, dtype=bool)
    accepted = np.asarray(innovations.nis, dtype=float)[~gated]
    return {
        "updates": len(gated),
        "gated": int(gated.sum()),
        "dof": innovations.dof,
        "nis_per_dof": float(accepted.mean()) / innovations.dof if len(accepted) else None,
        "correlation": innovations.correlation,
        "correlation_sd": innovations.correlation_sd,
        "over_time": _over_time(innovations, t0_ns),
    }


def _over_time(innovations: Innovations, t0_ns: int) -> dict[str, list[float | None]]:
    """Mean NIS per degree of freedom and share gated in equal stretches of time; ``end_s`` of each from ``t0_ns``."""
    t_s = (innovations.t_ns - t0_ns) * 1e-9
    if len(t_s) == 0:
        return {"end_s": [], "nis_per_dof": [], "gated": []}
    edges = np.linspace(t_s[0], t_s[-1], min(NIS_BINS, len(t_s)) + 1)
    which = np.clip(np.searchsorted(edges, t_s, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(which, minlength=len(edges) - 1)
    sums = [np.bincount(which, v, minlength=len(count)) for v in (innovations.nis / innovations.dof, innovations.gated)]
    nis, gated = (np.where(count > 0, total / np.maximum(count, 1), np.nan) for total in sums)
    return {"end_s": edges[1:].tolist(), "nis_per_dof": nis.tolist(), "gated": gated.tolist()}


def to_json(value: Any) -> str:
    """Strict JSON in the given key order; NaN and infinities become null."""
    return json.dumps(_plain(value), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


# ---- trajectories as text and arrays ----


def write_tum(path: str | Path, t_ns: Times, position: Floats, quat_xyzw: Floats) -> None:
    """Poses as ``t x y z qx qy qz qw`` with 9 decimals; stamps are formatted from integers, so they are exact."""
    with open(path, "w", encoding="ascii", newline="\n") as file:
        for t, row in zip(t_ns.tolist(), np.hstack([position, quat_xyzw]).tolist(), strict=True):
            whole, fraction = divmod(abs(t), NS)
            file.write(f"{'-' if t < 0 else ''}{whole}.{fraction:09d} " + " ".join(f"{x:.9f}" for x in row) + "\n")


def read_tum(path: str | Path) -> Truth:
    """Poses of a TUM file, sorted by stamp, of equal stamps the first; ``#`` starts a comment.

    Rows that are not finite are left out. All-zero quaternions mean that there is no attitude.
    """
    stamps, rows = [], []
    with open(path, encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            fields = line.partition("#")[0].split()
            if not fields:
                continue
            try:
                stamp, row = int((Decimal(fields[0]) * NS).to_integral_value()), [float(x) for x in fields[1:]]
            except (ValueError, InvalidOperation, OverflowError):
                row = []
            if len(row) != 7:
                raise TbmfgError(f"{path}:{number}: not a TUM pose 't x y z qx qy qz qw': {line.strip()[:60]!r}")
            stamps.append(stamp)
            rows.append(row)
    if not rows:
        raise TbmfgError(f"{path}: holds no poses")
    table = np.array(rows)
    return clean_truth(np.array(stamps, dtype=np.int64), table[:, :3], table[:, 3:])


def read_result_npz(path: str | Path) -> Trajectory:
    """The trajectory of ``result.npz`` or ``smoothed.npz``."""
    with _arrays(path, Trajectory.__slots__) as arrays:
        return Trajectory(**{name: arrays[name] for name in Trajectory.__slots__})


def read_calibration(folder: str | Path) -> dict[str, Calibrated]:
    """What the result in ``folder`` says of calibrations in its summary; nothing of a folder without one."""
    path = Path(folder) / SUMMARY
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text("utf-8"))["calibration"]
        return {name: Calibrated(**value) for name, value in found.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise TbmfgError(f"{path}: is not the summary of a result: {error!r}; make the result again") from error


@contextmanager
def _arrays(path: str | Path, names: Iterable[str]) -> Iterator[Any]:
    """The arrays of an npz file that must hold ``names``."""
    try:
        arrays = np.load(path)
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise TbmfgError(f"{path}: is not a readable npz file: {error}") from error
    with arrays:
        missing = [name for name in names if name not in arrays]
        if missing:
            raise TbmfgError(f"{path}: lacks the array {', '.join(missing)}")
        yield arrays


# ---- truth ----


def find_truth(spec: str, log: Log, rig: Rig) -> str | None:
    """The topic or file that ``spec`` names: "auto", "none", a topic, a TUM file or an npz.

    auto is the rig's topic where the log has it, else a topic whose name contains "truth": of several the
    one with the most columns (a velocity, an attitude), then the first by name.
    """
    if spec == "none":
        return None
    if spec == "auto":
        if rig.truth is not None and rig.truth.topic in log.series:
            return rig.truth.topic
        named = sorted(topic for topic in log.series if "truth" in topic.lower() and _position(log.series[topic]))
        return max(named, key=lambda topic: len(log.series[topic].columns), default=None)
    if spec in log.series or Path(spec).is_file():
        return spec
    posed = ", ".join(topic for topic, series in log.series.items() if _position(series)) or "none"
    raise TbmfgError(f"--truth {spec}: neither a topic of the log nor a file; topics with positions: {posed}")


def load_truth(source: str, log: Log) -> Truth:
    """Reference poses of b in n from what :func:`find_truth` found.

    Odometry holds its velocity in the child frame (nav_msgs), which is taken to be b, and is turned to n.
    """
    if source in log.series:
        return _truth_of(log.series[source])
    if Path(source).suffix == ".npz":
        with _arrays(source, ("t_ns", "position_n")) as arrays:
            optional = [arrays.get(name) for name in ("quat_xyzw", "velocity_n")]
            return clean_truth(arrays["t_ns"], arrays["position_n"], *optional)
    return read_tum(source)


def _position(series: Series) -> str | None:
    return next((name for name in ("position", "point") if name in series.columns), None)


def _truth_of(series: Series) -> Truth:
    position = _position(series)
    if position is None:
        raise TbmfgError(f"{series.topic}: {series.type} holds no positions, so it cannot be the truth")
    truth = clean_truth(series.t_ns, series[position], series.columns.get("quat_xyzw"), series.columns.get("linear"))
    if not len(truth.t_ns):
        raise TbmfgError(f"{series.topic}: none of its {len(series)} poses is finite, so it cannot be the truth")
    if truth.velocity_n is None:
        return truth
    if truth.quat_xyzw is None:
        return replace(truth, velocity_n=None)
    R_nb = matrix_from_quat(truth.quat_xyzw)
    return replace(truth, velocity_n=np.einsum("nij,nj->ni", R_nb, truth.velocity_n))


def clean_truth(
    t_ns: Times, position_n: Floats, quat_xyzw: Floats | None = None, velocity_n: Floats | None = None
) -> Truth:
    """Truth in time order without repeated stamps and non-finite rows.

    A column that is never filled in becomes None: nowhere finite, quaternions all zero, or velocities all
    zero of a body that moves.
    """
    if quat_xyzw is not None:
        quat_xyzw = np.where(np.linalg.norm(quat_xyzw, axis=1, keepdims=True) > 0, quat_xyzw, np.nan)
    if velocity_n is not None and not velocity_n.any() and np.ptp(position_n, axis=0).any():
        velocity_n = None
    finite = np.isfinite(position_n).all(axis=1)
    optional = []
    for column in (quat_xyzw, velocity_n):
        filled = None if column is None else np.isfinite(column).all(axis=1)
        if filled is None or not filled.any():
            optional.append(None)
        else:
            optional.append(column)
            finite &= filled
    stamps, first = np.unique(t_ns[finite], return_index=True)
    rows = np.flatnonzero(finite)[first]
    return Truth(stamps, position_n[rows], *(None if column is None else column[rows] for column in optional))
