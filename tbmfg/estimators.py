"""The estimators by name. Each takes the prepared problem and returns a Result; nothing else knows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tbmfg.errors import TbmfgError

if TYPE_CHECKING:
    from tbmfg.problem import Problem
    from tbmfg.state import Result


Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Estimator:
    """``run`` loads what it needs when called; ``needs`` lists the sensor kinds it cannot do without."""

    run: Callable[[Problem, Progress], Result]
    summary: str
    needs: tuple[str, ...]
    source: str


def ins(problem: Problem, progress: Progress) -> Result:
    """Error-state Kalman filter with all sensors."""
    from tbmfg.filters import ins as filter_
    from tbmfg.outcome import result

    f = filter_.run(problem, fixed=("clock_offset",), progress=progress)
    out = result(problem, "ins", f.x, f.cov, f.c, f.c_cov, f.nis, f.gated)
    out.warnings += [
        f"{sensor}: the gate was opened {times} times after {filter_.REOPEN} rejections in a row"
        for sensor, times in f.reopened.items()
        if times
    ]
    return out


def batch(problem: Problem, progress: Progress) -> Result:
    """Smoother over the whole log, started from ``ins``."""
    from tbmfg.filters import ins as filter_
    from tbmfg.outcome import result
    from tbmfg.smoother import batch as smoother

    f = filter_.run(problem, progress=lambda share: progress(0.3 * share))
    s = smoother.solve(problem, f.x, f.c, progress=lambda share: progress(0.3 + 0.7 * share))
    out = result(problem, "batch", s.x, s.cov, s.c, s.c_cov, s.nis, s.gated)
    if not s.converged:
        out.warnings.append(f"batch did not converge in {s.iterations} iterations; check the prior and the lever arms")
    return out


ESTIMATORS: dict[str, Estimator] = {
    "batch": Estimator(
        batch,
        "smooths the whole log: Gauss-Newton over GTSAM's IMU factors and all sensors",
        ("imu",),
        "Dellaert & Kaess (2017); Forster et al. (2017)",
    ),
    "ins": Estimator(
        ins,
        "error-state Kalman filter with all sensors, gated",
        ("imu",),
        "Groves (2013) ch. 14",
    ),
}


def estimate(name: str, problem: Problem, *, progress: Callable[[str, float], None] | None = None) -> Result:
    """Run the estimator called ``name``. Raises TbmfgError for a name that does not exist."""
    if name not in ESTIMATORS:
        raise TbmfgError(f"no estimator {name!r}; there are {', '.join(ESTIMATORS)}")
    return ESTIMATORS[name].run(problem, lambda share: progress(name, share) if progress else None)
