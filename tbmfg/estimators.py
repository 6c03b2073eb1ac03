"""The estimators by name. Each takes the prepared problem and returns a Result; nothing else knows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from tbmfg.errors import EstimationError, RigError, TbmfgError
from tbmfg.fields import Node, near
from tbmfg.registry import Registry
from tbmfg.rig import Rig, kind_of, switches

if TYPE_CHECKING:
    from tbmfg.filters import tbm
    from tbmfg.problem import Problem
    from tbmfg.smoother.online import Online
    from tbmfg.state import Result


Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Estimator:
    """``run`` loads what it needs when called; ``needs`` lists the sensor kinds it cannot do without; ``switches``
    loads the model of what the rig may set under ``estimators``; ``whole``: its trajectory knows the whole log, and is
    held to the bound of smoothing."""

    run: Callable[[Problem, Progress], Result]
    summary: str
    needs: tuple[str, ...]
    source: str
    switches: Callable[[], type[Node]] = lambda: Node
    whole: bool = False


def ins(problem: Problem, progress: Progress) -> Result:
    """Error-state Kalman filter with all sensors."""
    from tbmfg.filters import ins as filter_
    from tbmfg.outcome import result
    from tbmfg.problem import CLOCK

    f = filter_.run(problem, fixed=CLOCK, progress=progress)
    out = result(problem, "ins", f.x, f.cov, f.c, f.c_cov, f.nis, f.gated)
    _opened(out, f.reopened, filter_.REOPEN)
    return out


def _opened(out: Result, reopened: dict[str, int], after: int) -> None:
    """Say how often a filter believed a sensor again that contradicted it, and mark it: from the first of the rejected
    rows to the one that was taken, beyond the gate as it is."""
    import numpy as np

    from tbmfg.chance import chi_square_point
    from tbmfg.problem import GATE
    from tbmfg.state import Interval

    for sensor, times in reopened.items():
        if not times:
            continue
        out.warnings.append(f"{sensor}: after {after} rejections in a row the gate was opened, {times} in all")
        series = out.innovations[sensor]
        for row in np.flatnonzero((series.nis > chi_square_point(GATE, series.dof)) & ~series.gated):
            first = row - np.argmin(series.gated[:row][::-1])  # after the last that was not rejected
            out.intervals.append(Interval(sensor, "reopened", int(series.t_ns[first]), int(series.t_ns[row])))


def batch(problem: Problem, progress: Progress) -> Result:
    """Smoother over the whole log, started from ``ins``."""
    from tbmfg.filters import ins as filter_
    from tbmfg.outcome import beyond_gate, result
    from tbmfg.smoother import batch as smoother

    f = filter_.run(problem, progress=lambda share: progress(0.3 * share))
    s = smoother.solve(problem, f.x, f.c, progress=lambda share: progress(0.3 + 0.7 * share))
    out = result(problem, "batch", s.x, s.cov, s.c, s.c_cov, s.nis, beyond_gate(problem, s.nis), last_x=s.x)
    last = len(problem.keyframe_edges) - 1
    if not s.converged:
        _mark(problem, out, "batch", "unconverged", 0, last)
        out.warnings.append(f"batch did not converge in {s.iterations} iterations; check the prior and the lever arms")
    if s.held:
        # the keyframes hang together: what is held at the end of the chain is not known before it either
        _mark(problem, out, "batch", "undetermined", 0, max((k for k, _ in s.held if k >= 0), default=last))
        out.warnings.append(
            f"no row determines {smoother.in_words(problem, s.held)}: held where ins had it, with next to no "
            "certainty, as its sd says; add a sensor that sees it, or a prior in the rig (initial.*_sd, sensors.*.*_sd)"
        )
    return out


def isam2(problem: Problem, progress: Progress) -> Result:
    """iSAM2 over the whole past: causal estimates, and the last one of every keyframe."""
    from tbmfg.smoother import incremental

    return _online(problem, "isam2", incremental.run(problem, progress))


def fixed_lag(problem: Problem, progress: Progress) -> Result:
    """Smoother over the rig's lag: causal estimates, and the last one of every keyframe before it left."""
    from tbmfg.smoother import window

    return _online(problem, "fixed-lag", window.run(problem, problem.rig.lag_s, progress))


def _online(problem: Problem, name: str, online: Online) -> Result:
    """Result of an online solver: counts at the last estimates, and where it had to start again."""
    from tbmfg.outcome import beyond_gate, result, trajectory

    gated = beyond_gate(problem, online.nis)
    states, constants = (online.causal_x, online.causal_cov), (online.c, online.c_cov)
    out = result(problem, name, *states, *constants, online.nis, gated, last_x=online.last_x)
    out.smoothed = trajectory(problem, online.last_x, online.last_cov)
    t_s, end = problem.keyframes_s, len(problem.keyframe_edges) - 1
    for restart in online.restarts:
        again = end if restart.again is None else restart.again
        _mark(problem, out, name, "restarted", restart.before, again)
        line = f"{name} failed behind {t_s[restart.before]:.1f} s ({restart.reason})"
        if again > restart.before + 1:
            line += f", went on by the IMU alone until {t_s[again]:.1f} s"
        if restart.again is not None:
            line += f", and was started again at {t_s[again]:.1f} s from there with a wider covariance"
        out.warnings.append(f"{line}; look at what the sensors say there")
    if online.unclosed is not None:
        _mark(problem, out, name, "restarted", online.unclosed.before, end)
        out.warnings.append(
            f"{name}: the last estimates from {t_s[online.unclosed.before]:.1f} s on are the causal ones: its closing "
            f"iterations failed ({online.unclosed.reason})"
        )
    return out


def _mark(problem: Problem, out: Result, name: str, kind: str, first: int, last: int) -> None:
    """Mark what happened to an estimator from keyframe to keyframe."""
    from tbmfg.state import Interval

    out.intervals.append(Interval(name, kind, int(problem.t_ns[first]), int(problem.t_ns[last])))


def shearer(problem: Problem, progress: Progress, name: str) -> Result:
    """One of the Kalman filters of Yan & Wang (2021)."""
    import numpy as np

    from tbmfg.filters import shearer as filter_
    from tbmfg.inertial.steps import to_ns
    from tbmfg.outcome import beyond_gate, result, ungated

    design = filter_.DESIGNS[name]
    seen = filter_.view(problem, design)
    f = filter_.run(seen, design, switches(problem.rig, name, design.switches), progress)
    gated = {sensor: np.zeros(len(nis), dtype=bool) for sensor, nis in f.nis.items()}
    edges_ns = to_ns(problem.inertial.steps, problem.inertial.steps.edges_s)
    out = result(seen, name, f.x, f.cov, f.c, f.c_cov, f.nis, gated, edges_ns)
    out.warnings += ungated(beyond_gate(seen, f.nis))
    return out


def _shearer(name: str, summary: str, *needs: str) -> Estimator:
    """The entry of one of them; its switches stand beside its design."""

    def load() -> type[Node]:
        from tbmfg.filters.shearer import DESIGNS

        return DESIGNS[name].switches

    return Estimator(partial(shearer, name=name), summary, ("imu", *needs), "Yan & Wang (2021)", load)


def sbm(problem: Problem, progress: Progress, name: str) -> Result:
    """One of the three filters of Wang et al. (2019)."""
    from tbmfg.filters import sbm as filters
    from tbmfg.outcome import of_samples

    filter_, model = filters.FILTERS[name]
    run = filter_(problem, switches(problem.rig, name, model))
    out = of_samples(problem, name, run.x, run.cov, run.used)
    out.warnings += run.warnings
    return out


def _sbm(name: str, summary: str) -> Estimator:
    def model() -> type[Node]:
        from tbmfg.filters.sbm import FILTERS

        return FILTERS[name][1]

    return Estimator(partial(sbm, name=name), summary, ("imu", "magnetometer"), "Wang et al. (2019)", model)


def tbm_ins_ts(problem: Problem, progress: Progress) -> Result:
    """The coupled filter of inertial unit and total station of Liu, Wang & Tao."""
    return _ins_ts(problem, progress)[0]


def _ins_ts(problem: Problem, progress: Progress) -> tuple[Result, tbm.Filtered]:
    from tbmfg.filters import tbm
    from tbmfg.inertial.steps import to_ns
    from tbmfg.outcome import result

    name = "tbm-ins-ts"
    options = switches(problem.rig, name, tbm.InsTs)
    seen = tbm.view(problem, options)
    f = tbm.run(seen, options, progress)
    edges_ns = to_ns(problem.inertial.steps, problem.inertial.steps.edges_s)
    out = result(seen, name, f.x, f.cov, f.c, f.c_cov, f.nis, f.gated, edges_ns)
    _opened(out, f.reopened, tbm.REOPEN)
    return out, f


def tbm_rrr_mf(problem: Problem, progress: Progress) -> Result:
    """The states of ``tbm-ins-ts`` and LiDAR odometry in a factor graph."""
    from dataclasses import replace

    import numpy as np

    from tbmfg.filters import tbm
    from tbmfg.outcome import beyond_gate, result, ungated
    from tbmfg.smoother import rrr

    name = "tbm-rrr-mf"
    options = switches(problem.rig, name, rrr.RrrMf)
    ins_ts, f = _ins_ts(problem, progress)
    steps = [rrr.trusted(rows, options) for rows in problem.rows if rows.model == "lidar"]
    c = problem.parameters.start
    fused = rrr.solve(f.x, f.cov, steps, c)
    seen = replace(problem, rows=steps, drift_names=(), drift_walk=np.zeros(0))
    gated = {sensor: np.zeros(len(nis), dtype=bool) for sensor, nis in fused.nis.items()}
    out = result(seen, name, fused.x, fused.cov, c, np.zeros((len(c), len(c))), fused.nis, gated)
    for prism in ins_ts.innovations:
        out.innovations[prism], out.counts[prism] = ins_ts.innovations[prism], ins_ts.counts[prism]
    out.calibration = ins_ts.calibration
    _opened(out, f.reopened, tbm.REOPEN)
    if not fused.converged:
        _mark(problem, out, name, "unconverged", 0, len(f.x) - 1)
        out.warnings.append(f"{name} did not converge in {rrr.MOST} iterations; the steps and the filter contradict")
    out.warnings += [
        *ungated(beyond_gate(seen, fused.nis)),
        f"{name} takes every state of tbm-ins-ts for an independent prior, though they share their fixes: its "
        "covariance is too small",
    ]
    return out


def tbm_mse(problem: Problem, progress: Progress, name: str) -> Result:
    """TBM-MSE of Liu, Wang & Tao, its ablation, or LINS as they compare with."""
    from dataclasses import replace

    import numpy as np

    from tbmfg.filters import mse
    from tbmfg.inertial.steps import to_ns
    from tbmfg.outcome import result
    from tbmfg.state import Innovations

    design = mse.DESIGNS[name]
    run = mse.run(problem, design, switches(problem.rig, name, design.switches), progress)
    f, scans = run.filtered, run.scans
    edges_ns = to_ns(problem.inertial.steps, problem.inertial.steps.edges_s)
    out = result(run.seen, name, f.x, f.cov, f.c, f.c_cov, f.nis, f.gated, edges_ns)
    held = np.array(scans.edges, dtype=int)
    out.innovations[scans.name] = Innovations(edges_ns[held], np.array(scans.nis), 6, np.zeros(len(held), dtype=bool))
    count = replace(out.counts[scans.name], used=scans.begun + len(held), gated=scans.unheld, unused=0)
    out.counts[scans.name] = replace(count, unused=count.received - count.parts())
    out.warnings += run.warnings
    return out


def _tbm_mse(name: str, summary: str, *needs: str) -> Estimator:
    def load() -> type[Node]:
        from tbmfg.filters.mse import DESIGNS

        return DESIGNS[name].switches

    return Estimator(partial(tbm_mse, name=name), summary, ("imu", *needs), "Liu, Wang & Tao (TBM-MSE)", load)


def _tbm_switches() -> type[Node]:
    from tbmfg.filters.tbm import InsTs

    return InsTs


def _rrr_switches() -> type[Node]:
    from tbmfg.smoother.rrr import RrrMf

    return RrrMf


OWN: dict[str, Estimator] = {
    "batch": Estimator(
        batch,
        "smooths the whole log: Gauss-Newton over GTSAM's IMU factors and all sensors",
        ("imu",),
        "Dellaert & Kaess (2017); Forster et al. (2017)",
        whole=True,
    ),
    "fixed-lag": Estimator(
        fixed_lag,
        "smooths online over the rig's lag_s seconds: the rows of batch in a moving window",
        ("imu",),
        "Dong-Si & Mourikis (2011)",
    ),
    "isam2": Estimator(
        isam2,
        "smooths online over the whole past: GTSAM's iSAM2 with QR",
        ("imu",),
        "Kaess et al. (2012)",
    ),
    "ins": Estimator(
        ins,
        "error-state Kalman filter with all sensors, gated",
        ("imu",),
        "Groves (2013) ch. 14",
    ),
    "shearer-sins": _shearer("shearer-sins", "inertial navigation alone, with the covariance of its drift"),
    "shearer-sins-od": _shearer(
        "shearer-sins-od", "inertial navigation corrected by every speed of the odometer", "odometer"
    ),
    "shearer-ckf": _shearer(
        "shearer-ckf", "shearer-sins-od and magnetic yaw in one Kalman filter without gates", "odometer", "magnetometer"
    ),
    "shearer-ckf-ar": _shearer(
        "shearer-ckf-ar", "shearer-ckf with noise found from the innovations", "odometer", "magnetometer"
    ),
    "shearer-afkf": _shearer(
        "shearer-afkf", "shearer-ckf-ar as a federation of two local filters", "odometer", "magnetometer"
    ),
    "tbm-ins-ts": Estimator(
        tbm_ins_ts,
        "inertial navigation corrected by every prism fix of a total station, lever arm in the filter, gated",
        ("imu", "prism"),
        "Liu, Wang & Tao (TBM-MSE)",
        _tbm_switches,
    ),
    "tbm-mse": _tbm_mse(
        "tbm-mse",
        "tbm-ins-ts with inertial enhancement, and scans laid on a local map of edges and planes",
        "prism",
        "lidar",
    ),
    "tbm-mse-star": _tbm_mse(
        "tbm-mse-star", "tbm-mse without inertial enhancement, coning and sculling", "prism", "lidar"
    ),
    "tbm-lins": _tbm_mse("tbm-lins", "tbm-mse-star without the total station", "lidar"),
    "tbm-rrr-mf": Estimator(
        tbm_rrr_mf,
        "the states of tbm-ins-ts and LiDAR odometry of a fixed covariance in a factor graph",
        ("imu", "prism", "lidar"),
        "Liu, Wang & Tao (TBM-MSE), as a comparison",
        _rrr_switches,
    ),
    "sbm-cf": _sbm("sbm-cf", "complementary filter: gyro with accelerometer and magnetometer, observers for the rest"),
    "sbm-ekf": _sbm("sbm-ekf", "extended Kalman filter in Euler angles, with laser spot and barometer"),
    "sbm-cfekf": _sbm("sbm-cfekf", "the same, its rates corrected by the complementary filter"),
}
ESTIMATORS: Registry[Estimator] = Registry("tbmfg.estimators", OWN)


def estimate(name: str, problem: Problem, *, progress: Callable[[str, float], None] | None = None) -> Result:
    """Run the estimator called ``name``. Raises TbmfgError for a name that does not exist, EstimationError where
    the problem is hopeless."""
    if name not in ESTIMATORS:
        raise TbmfgError(f"no estimator {name!r}; there are {', '.join(ESTIMATORS)}")
    from tbmfg.problem import breakdown_explained

    if (reason := unmet(name, problem)) is not None:
        raise EstimationError(
            f"{name} {reason}, of which this log and rig have nothing to use; tbmfg info LOG lists its topics"
        )
    with breakdown_explained(name):
        result = ESTIMATORS[name].run(problem, lambda share: progress(name, share) if progress else None)
    _refuse_nonsense(problem, result)
    for sensor, count in result.counts.items():
        if count.gated > count.used:
            result.warnings.append(
                f"{sensor}: {count.gated} of {count.gated + count.used} samples contradict the estimate and were "
                "gated; do not trust it before the rig's entry for this sensor is checked"
            )
    return result


def unmet(name: str, problem: Problem) -> str | None:
    """What an estimator needs and this problem does not have, or None."""
    have = {"imu", *map(kind_of, problem.samples), *map(kind_of, problem.scans)}
    missing = [kind for kind in ESTIMATORS[name].needs if kind not in have]
    return f"needs {', '.join(missing)}" if missing else None


def check_switches(rig: Rig) -> None:
    """Raise RigError for an entry under the rig's ``estimators`` that no estimator knows."""
    for name in rig.estimators:
        if name not in ESTIMATORS:
            raise RigError(f"{rig.name}: estimators.{name}: no such estimator{near(name, ESTIMATORS)}")
        switches(rig, name, ESTIMATORS[name].switches())


def _refuse_nonsense(problem: Problem, result: Result) -> None:
    """Raise EstimationError where a result holds numbers that are none."""
    import numpy as np

    for path in (result.trajectory, result.smoothed or result.trajectory):
        columns = (path.position_n, path.quat_xyzw, path.velocity_n, path.bias_acc, path.bias_gyro, path.cov)
        finite = np.all([np.isfinite(column).reshape(len(path), -1).all(axis=1) for column in columns], axis=0)
        if not finite.all():
            raise EstimationError(
                f"{result.estimator} lost the state at {problem.keyframes_s[np.argmin(finite)]:.1f} s: it is not "
                "finite there; check the rig's units and priors, and the readings at that time"
            )
