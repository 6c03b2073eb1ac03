"""What a recording's truth is worth, and what is reached against it with a prism made of it (EuRoC).

``NPZ`` is packaged as for the dataset ``euroc``; recordings are not part of this. First, no estimator asked, the truth
is held against its own inertial unit over windows: a window's start position, velocity and accelerometer bias are free,
its attitude is the gyro's course laid on the truth's attitude, and one lateness and one turn hold for all windows.
Standard deviations are those of a jackknife over the windows. A truth is some estimator's product, and over a short
window may follow its inertial unit by its own attitude, which hides its faults: so the windows have three lengths L.

truth_steps       count of samples after which the truth's position steps by more than 1 mm
largest_step      the largest of them, mm; all are taken out for what follows
attitude_late     by which the truth's attitude comes after the gyro, whose stamps are the ends of its samples, ms
truth_late@L      by which the truth's positions come after the accelerometer, ms
truth_turned@L    by which the truth's attitude must be turned about n's vertical to fit the truth's own positions, deg
truth_tilted_x@L  the same about n's x, and likewise about y; a window's free bias leaves little of it to be seen

Then a prism is made of the truth as ``datasets import euroc`` does, 0.08 s late with 3 mm of noise, and the estimators
are compared with the truth, the rig as it is imported: it knows neither arm nor heading nor that lateness.

position             RMS of the 3-D error, mm; asked are 3 or 1.05 of the Cramer-Rao bound, whichever is more
tracked_point        the same of the prism, which an error of the arm leaves where it is, mm
attitude             RMS of the angle of the error, deg; 0.5 or 1.05 of the bound
.._over_bound        either over its bound
attitude_about_mean  the same after the one turn of n that takes the mean error out, deg
arm                  error of the arm in its standard deviations, the largest of three
clock_offset         error of the prism's clock offset in its standard deviations

``NAME, mended`` is all of this with a better truth: steps taken out, positions and attitude earlier by what they are
late, attitude turned, each by the figure of the longest windows where that is beyond three of its standard deviations,
about each axis of n, and else not at all. What the first has over the second is the truth's. The drift that the steps
corrected remains.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.rows import Row
from datasets.recordings import Arrays, G, read_npz
from tbmfg.errors import TbmfgError
from tbmfg.geometry import exp_so3, skew
from tbmfg.timeseries import Floats

WINDOWS_S = (0.5, 1.0, 2.0)
STEP_M = 1e-3
REACH_S = 0.05  # of a lateness, and of the truth beyond the windows
SPAN_S = 0.005  # either side, of a difference that gives the truth's rate
ROUNDS = 3  # of linearising a lateness
SIGNIFICANT = 3.0
LATENCY_S, NOISE_M, ARM_M = 0.08, 0.003, (0.075, -0.018, -0.12)
POSITION_MM, ATTITUDE_DEG, SDS = 3.0, 0.5, 3.0
REACHED = 1.05  # of the Cramer-Rao bound: where that is more than is asked, no more can be asked


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sources", nargs="+", type=Path, metavar="NPZ", help="recordings")
    parser.add_argument("--estimators", default="batch,ins", metavar="A,B", help="(batch,ins)")


def measure(given: argparse.Namespace) -> list[Row]:
    """Rows by recording, as it is and mended."""
    rows = []
    for source in given.sources:
        arrays = read_npz(source)
        name = arrays.path.stem
        better = mended(arrays, worth(arrays, max(WINDOWS_S)))
        for scenario, kept in ((name, arrays), (f"{name}, mended", better)):
            rows += _truth_rows(scenario, kept) + _estimator_rows(scenario, kept, given.estimators.split(","))
    return rows


# ---- what the truth is worth ----


@dataclass(frozen=True, slots=True)
class Worth:
    """What ``count`` windows of ``length_s`` say of a truth, value and standard deviation: lateness of its attitude and
    of its positions, s, and the turn (3,) rad in n that its attitude lacks."""

    length_s: float
    count: int
    attitude_late: tuple[float, float]
    late: tuple[float, float]
    turn: tuple[Floats, Floats]


def worth(arrays: Arrays, length_s: float) -> Worth:
    """By windows of that length; :class:`TbmfgError` where they are fewer than three, or nothing in them moves."""
    windows = cut(arrays, length_s)
    attitude = Slerp(arrays["truth_t"], Rotation.from_quat(arrays["truth_q_xyzw"]))
    path = CubicSpline(arrays["truth_t"], without_steps(arrays["truth_p"]))
    try:
        attitude_late = late_attitude(windows, attitude)
        values, sds = late_and_turned(windows, path, anchored(windows, attitude, attitude_late[0]))
    except np.linalg.LinAlgError:
        raise TbmfgError(f"{arrays.path}: the truth stands still; what it is late shows in motion only") from None
    return Worth(length_s, len(windows.t_s), attitude_late, (float(values[0]), float(sds[0])), (values[1:], sds[1:]))


def steps(position: Floats) -> tuple[np.ndarray, Floats]:
    """Rows (k,) after which ``position`` (n, 3) steps, and the steps (k, 3) m: what a chord has over the mean of its
    neighbours, which acceleration does not show in and its rate of change hardly, 0.06 mm at 200 Hz and 1000 m/s^3."""
    chord = np.diff(position, axis=0)
    jump = np.zeros_like(chord)
    jump[1:-1] = chord[1:-1] - 0.5 * (chord[:-2] + chord[2:])
    rows, _ = find_peaks(np.linalg.norm(jump, axis=1), height=STEP_M, distance=3)  # neighbours show half of a step
    return rows, jump[rows]


def without_steps(position: Floats) -> Floats:
    """The same path, its steps taken out: what follows each is shifted."""
    rows, jump = steps(position)
    gone = np.zeros_like(position)
    gone[rows + 1] = jump
    return position - np.cumsum(gone, axis=0)


@dataclass(frozen=True, slots=True)
class Windows:
    """m windows of n samples. ``t_s`` (m, n) stamps, ends of samples of ``dt`` (m, n) s; ``force`` (m, n, 3); attitudes
    (m, n, 3, 3) against the window's start by the gyro, ``midway`` in samples and at their ``end``."""

    t_s: Floats
    dt: Floats
    force: Floats
    midway: Floats
    end: Floats

    def twice(self, acc: Floats) -> Floats:
        """Integrals to the ends of samples of integrals of ``acc`` (m, n, ...), constant within a sample."""
        dt = self.dt.reshape(*self.dt.shape, *(1,) * (acc.ndim - 2))
        return np.cumsum((np.cumsum(acc * dt, axis=1) - 0.5 * acc * dt) * dt, axis=1)


def cut(arrays: Arrays, length_s: float) -> Windows:
    """The windows within the truth's span; the gyro's bias is what their turns have over the truth's, in the median."""
    t_s, at_s = arrays["imu_t"], arrays["truth_t"]
    inside = np.flatnonzero((t_s > at_s[0] + REACH_S) & (t_s < at_s[-1] - REACH_S))[1:]
    n = round(length_s / float(np.median(np.diff(t_s))))
    if len(inside) < 3 * n:
        raise TbmfgError(f"{arrays.path}: truth and IMU share {len(inside)} samples, three windows take {3 * n}")
    rows = inside[: len(inside) // n * n].reshape(-1, n)
    dt, gyro = t_s[rows] - t_s[rows - 1], arrays["imu_gyr"][rows]
    truth = Slerp(at_s, Rotation.from_quat(arrays["truth_q_xyzw"]))
    true = truth(t_s[rows[:, 0] - 1]).inv() * truth(t_s[rows[:, -1]])
    bias = np.zeros(3)
    for _ in range(2):  # the first is of the first order in the turn within a window
        _, end = turned((gyro - bias) * dt[..., None])
        over = (true.inv() * Rotation.from_matrix(end[:, -1])).as_rotvec()
        bias = bias + np.median(over / dt.sum(axis=1, keepdims=True), axis=0)
    return Windows(t_s[rows], dt, arrays["imu_acc"][rows], *turned((gyro - bias) * dt[..., None]))


def turned(angle: Floats) -> tuple[Floats, Floats]:
    """Attitudes (m, n, 3, 3) midway through samples that turn by ``angle`` (m, n, 3) rad each, and at their ends."""
    turns = exp_so3(angle)
    start = np.empty((*angle.shape, 3))
    start[:, 0] = np.eye(3)
    for k in range(1, angle.shape[1]):
        start[:, k] = start[:, k - 1] @ turns[:, k - 1]
    return start @ exp_so3(0.5 * angle), start @ turns


def anchored(windows: Windows, attitude: Slerp, late: float) -> Floats:
    """Attitudes (m, 1, 3, 3) at the windows' starts for which their courses lie nearest to the truth's."""
    true = attitude((windows.t_s + late).ravel()).as_matrix().reshape(windows.end.shape)
    U, _, Vt = np.linalg.svd(np.einsum("mnij,mnkj->mik", true, windows.end))
    Vt[:, 2] *= np.linalg.det(U @ Vt)[:, None]
    return (U @ Vt)[:, None]


def late_attitude(windows: Windows, attitude: Slerp) -> tuple[float, float]:
    """Lateness [s] and its sd, each window's start attitude and gyro bias being free."""
    late, sd = 0.0, np.inf
    start = np.broadcast_to(np.eye(3), windows.end.shape)
    for _ in range(ROUNDS):
        R = anchored(windows, attitude, late) @ windows.end
        at_s = (windows.t_s + late).ravel()
        error = (attitude(at_s) * Rotation.from_matrix(R.reshape(-1, 3, 3)).inv()).as_rotvec()
        # The truth's own rate: the gyro's noise is in the error already, and would make a late one later.
        rate_n = (attitude(at_s + SPAN_S) * attitude(at_s - SPAN_S).inv()).as_rotvec() / (2.0 * SPAN_S)
        bias = np.cumsum(R * windows.dt[..., None, None], axis=1)
        found, sds = common(
            error.reshape(windows.force.shape),
            -rate_n.reshape(*windows.force.shape, 1),
            np.concatenate([start, bias], axis=3),
        )
        late, sd = late + float(found[0]), float(sds[0])
    return late, sd


def late_and_turned(windows: Windows, path: CubicSpline, start: Floats) -> tuple[Floats, Floats]:
    """Lateness [s] of the positions ``path`` and turn [rad] in n, (4,), and their sds (4,), with ``start`` (m, 1, 3, 3)
    the windows' attitudes at their starts; start position, velocity and accelerometer bias of each are free."""
    R = start @ windows.midway
    force_n = (R @ windows.force[..., None])[..., 0]
    moved = windows.twice(force_n - [0.0, 0.0, G])
    turn, bias = windows.twice(-skew(force_n)), windows.twice(-R)
    position = np.broadcast_to(np.eye(3), R.shape)
    velocity = (windows.t_s - windows.t_s[:, :1])[..., None, None] * position
    free = np.concatenate([position, velocity, bias], axis=3)
    late = 0.0
    for _ in range(ROUNDS):
        shared = np.concatenate([-path(windows.t_s + late, 1)[..., None], turn], axis=3)
        found, sds = common(path(windows.t_s + late) - moved, shared, free)
        late += float(found[0])
    return np.array([late, *found[1:]]), sds


def common(y: Floats, shared: Floats, free: Floats) -> tuple[Floats, Floats]:
    """x (c,) of the least squares y = shared x + free z, x one for all windows and z of each, and its sds by a
    jackknife over the windows; ``y`` (m, n, 3), ``shared`` (m, n, 3, c), ``free`` (m, n, 3, l)."""
    m = len(y)
    Q, _ = np.linalg.qr(free.reshape(m, -1, free.shape[3]))
    J = np.concatenate([shared, y[..., None]], axis=3).reshape(m, Q.shape[1], -1)
    J = J - Q @ (np.swapaxes(Q, 1, 2) @ J)  # what no z makes
    squares = np.swapaxes(J, 1, 2) @ J
    N, b = squares[:, :-1, :-1], squares[:, :-1, -1:]
    x = np.linalg.solve(N.sum(axis=0), b.sum(axis=0))[:, 0]
    without = np.linalg.solve(N.sum(axis=0) - N, b.sum(axis=0) - b)[..., 0]
    return x, np.sqrt((m - 1) * np.var(without, axis=0))


def mended(arrays: Arrays, found: Worth) -> Arrays:
    """The recording with a truth that has none of what was found significant."""
    late, attitude_late = (
        value if abs(value) > SIGNIFICANT * sd else 0.0 for value, sd in (found.late, found.attitude_late)
    )
    turn = np.where(np.abs(found.turn[0]) > SIGNIFICANT * found.turn[1], found.turn[0], 0.0)
    t_s = arrays["truth_t"]
    kept = t_s[(t_s + min(late, attitude_late) >= t_s[0]) & (t_s + max(late, attitude_late) <= t_s[-1])]
    attitude = Slerp(t_s, Rotation.from_quat(arrays["truth_q_xyzw"]))(kept + attitude_late)
    changed = {
        "truth_t": kept,
        "truth_p": CubicSpline(t_s, without_steps(arrays["truth_p"]))(kept + late),
        "truth_q_xyzw": (Rotation.from_rotvec(turn) * attitude).as_quat(),
    }
    if "truth_v" in arrays:
        changed["truth_v"] = CubicSpline(t_s, arrays["truth_v"])(kept + late)
    return Arrays(arrays.path, arrays | changed)


def _truth_rows(scenario: str, arrays: Arrays) -> list[Row]:
    found = [worth(arrays, length_s) for length_s in WINDOWS_S]
    _, jump = steps(arrays["truth_p"])
    largest, longest = np.linalg.norm(jump, axis=1).max(initial=0.0), found[-1]
    values = [("truth_steps", "", float(len(jump)), None, 1), ("largest_step", "mm", 1e3 * float(largest), None, 1)]
    values.append(("attitude_late", "ms", *(1e3 * part for part in longest.attitude_late), longest.count))
    values += [(f"truth_late@{one.length_s:g}s", "ms", *(1e3 * part for part in one.late), one.count) for one in found]
    for axis, metric in ((2, "truth_turned@{:g}s"), (0, "truth_tilted_x@{:g}s"), (1, "truth_tilted_y@{:g}s")):
        for one in found:
            turn = (float(np.rad2deg(part[axis])) for part in one.turn)
            values.append((metric.format(one.length_s), "deg", *turn, one.count))
    return [Row(scenario, "truth", *value) for value in values]


# ---- what is reached against it ----


def _estimator_rows(scenario: str, arrays: Arrays, estimators: list[str]) -> list[Row]:
    from datasets.recordings import euroc
    from tbmfg.evaluation.metrics import trajectory_errors
    from tbmfg.pipeline import open_session

    rows = []
    with TemporaryDirectory() as folder:
        source, log = Path(folder) / "recording.npz", Path(folder) / "recording.mcap"
        np.savez(source, **arrays)
        euroc.load(source, prism="synthetic", arm=ARM_M, latency=LATENCY_S, noise=NOISE_M).write(log)
        session = open_session(log)
        for name in estimators:
            result, summary = session.estimate(name)
            errors = trajectory_errors(result.trajectory, session.truth(result))
            arm, offset = (result.calibration[f"prism_{what}"] for what in ("lever_arm_m", "clock_offset_s"))
            R = Rotation.from_quat(result.trajectory.quat_xyzw[errors.rows])
            R_true = R * Rotation.from_rotvec(-errors.rotation_b)
            tracked = errors.position_n + R.apply(arm.value) - R_true.apply(ARM_M)
            turn = R * R_true.inv()
            about_mean = (turn.mean().inv() * turn).magnitude()
            session.hold_to_bound(result, summary)
            reached = summary["metrics"]
            position_mm, attitude_deg = (
                max(asked, REACHED * unit * reached[f"bound_{metric}"])
                for asked, unit, metric in (
                    (POSITION_MM, 1e3, "position_rms_m"),
                    (ATTITUDE_DEG, 1.0, "attitude_rms_deg"),
                )
            )
            values = {
                ("position", "mm", position_mm): 1e3 * reached["position_rms_m"],
                ("position_over_bound", "", None): reached["position_over_bound"],
                ("tracked_point", "mm", None): 1e3 * np.sqrt(np.mean(np.sum(tracked**2, axis=1))),
                ("attitude", "deg", attitude_deg): reached["attitude_rms_deg"],
                ("attitude_over_bound", "", None): reached["attitude_over_bound"],
                ("attitude_about_mean", "deg", None): np.rad2deg(np.sqrt(np.mean(about_mean**2))),
                ("arm", "sds", SDS): np.max(np.abs(np.subtract(arm.value, ARM_M)) / arm.sd),
                ("clock_offset", "sds", SDS): abs(offset.value - LATENCY_S) / offset.sd,
            }
            for (metric, unit, most), value in values.items():
                rows.append(Row(scenario, name, metric, unit, float(value), None, 1, most and (None, most)))
    return rows
