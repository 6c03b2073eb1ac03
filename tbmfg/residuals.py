"""What is left of a sensor's readings, component by component: where they lie to one side and by how much, and whether
one tells of the next, as no noise does that the rig knows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np
from scipy.ndimage import binary_closing, median_filter
from scipy.special import ndtr, ndtri

from tbmfg.fields import DEG
from tbmfg.problem import Problem
from tbmfg.sensors import Rows
from tbmfg.state import Interval
from tbmfg.timeseries import Floats

BIASED = 3.0  # sds to one side from which a sensor of one number is called biased
MEDIAN_ROWS = 9  # of the running median that judges it
FEWEST_PAIRS = 30  # of neighbours that a correlation is taken of
CHANCE = 1e-3  # with which white residuals of one of the sensors would be named
WORTH = 1.2  # factor on sds from which a correlation is worth naming
UNTOLD = 1e3  # m and rad: sd of what the walls tell a LiDAR nothing of

# By model: what a positive residual means for the reading, the words for each component, and the unit with its size in
# SI. Of what spans two keyframes the rate is said.
_N, _B = ("along x of n", "along y of n", "upwards"), ("ahead", "to the left", "upwards")
_TURNS = tuple(f"about its {axis} axis" for axis in "xyz")
AXES: dict[str, tuple[float, tuple[tuple[str, str, float], ...]]] = {
    "prism": (-1.0, tuple((axis, "m", 1.0) for axis in _N)),
    "odometer": (-1.0, tuple((axis, "m/s", 1.0) for axis in _B)),
    "magnetometer": (1.0, (("", "deg", DEG),)),
    "magnetic_field": (1.0, (("", "deg", DEG),)),
    "barometer": (-1.0, (("upwards", "m", 1.0),)),
    "laser": (-1.0, tuple((f"along {axis} of the detector", "m", 1.0) for axis in "xy")),
    "lidar": (
        -1.0,
        (*((axis, "deg/s", DEG) for axis in _TURNS), *((f"along its {axis} axis", "m/s", 1.0) for axis in "xyz")),
    ),
}


@dataclass(frozen=True, slots=True)
class Bias:
    """A stretch in which one component of a sensor read too much by ``size`` in ``unit``; ``where``: along what."""

    stretch: Interval
    where: str
    size: float
    unit: str


def parted(problem: Problem, rows: Rows, x: Floats, c: Floats) -> tuple[Floats, Floats]:
    """By how much rows read too much, component by component of ``AXES``, at the keyframe states ``x`` (n, 21 + e) and
    calibrations ``c``: in sds, and in the component's unit."""
    sign, axes = AXES[rows.model]
    r, sd = sign * rows.evaluate(x, c)[0], rows.sigma
    if rows.model == "lidar":  # whitened by the root S of its information: back to turn and way
        S = rows.data[:, 35:].reshape(-1, 6, 6) / rows.sigma[:, :, None]
        cov = np.linalg.inv(S.swapaxes(1, 2) @ S + UNTOLD**-2.0 * np.eye(6))
        e, sd = (cov @ S.swapaxes(1, 2) @ r[:, :, None])[:, :, 0], np.sqrt(np.einsum("nkk->nk", cov))
        r = e / sd
    sizes = r * sd / np.array([unit for _, _, unit in axes])
    spans = problem.keyframes_s[rows.j] - problem.keyframes_s[rows.i]
    return r, np.where(spans[:, None] > 0, sizes / np.maximum(spans, 1e-9)[:, None], sizes)


def biased(problem: Problem, x: Floats, c: Floats, causal: bool = False) -> list[Bias]:
    """Where a component of a sensor lay ``BIASED`` sds or more to one side of the estimate, in order of time: the
    running median says so, which neither noise (0.4 sd) nor single spikes move. Beside ``causal`` states, which knew
    neither the calibrations ``c`` of the end nor each other, only sensors of one number are judged.

    A median of ``MEDIAN_ROWS`` is beyond a limit where most of them are, with a probability that goes by the power of
    how many that is. The limit of k components is as much farther out as makes all of them as rare as one.
    """
    found: list[Bias] = []
    most = MEDIAN_ROWS // 2 + 1
    for rows in problem.rows:
        if rows.model not in AXES or len(rows) < MEDIAN_ROWS or (causal and rows.dof > 1):
            continue
        axes = AXES[rows.model][1]
        limit = -ndtri(ndtr(-BIASED) * len(axes) ** (-1.0 / most))
        t_ns = problem.t_ns[rows.j]
        for residual, size, (where, unit, _) in zip(
            *(part.T for part in parted(problem, rows, x, c)), axes, strict=True
        ):
            median = median_filter(residual, MEDIAN_ROWS, mode="nearest")
            for sign in (1.0, -1.0):
                far = binary_closing(np.pad(sign * median > limit, MEDIAN_ROWS), np.ones(MEDIAN_ROWS))
                edges = np.flatnonzero(np.diff(far[MEDIAN_ROWS - 1 : 1 - MEDIAN_ROWS].astype(int)))
                for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
                    if last - first < MEDIAN_ROWS // 2:
                        continue  # a bias long enough to move the median keeps it there longer
                    stretch = Interval(rows.sensor, "biased", int(t_ns[first]), int(t_ns[last]))
                    found.append(Bias(stretch, where, float(np.median(size[first : last + 1])), unit))
    return sorted(found, key=lambda one: one.stretch.start_ns)


@dataclass(frozen=True, slots=True)
class Correlation:
    """How much of a residual the next one repeats: lag-1 correlation ``value`` over all components, rows that are
    gated left out; ``sd``, by how much it is off zero if they are white, 1 / sqrt(n), Bartlett (1946); ``square``: the
    mean square of the residuals in sds of the rig."""

    value: float
    sd: float
    square: float

    @property
    def factor(self) -> float:
        """By how much the sd of a mean of many is larger than if they were white and as large as the rig says: of a
        Markov process sqrt(square (1 + value) / (1 - value)). Readings that share a sample, as an odometer's do, repeat
        a part too, but are so much smaller than their share that it comes out as 1."""
        return float(np.sqrt(self.square * (1.0 + self.value) / max(1.0 - self.value, 1e-3)))


def correlation(problem: Problem, x: Floats, c: Floats, gated: dict[str, np.ndarray]) -> dict[str, Correlation]:
    """By sensor, at smoothed states ``x`` and calibrations ``c``. What a fit takes from white noise makes neighbours
    differ, never agree: a correlation above zero is the sensor's."""
    found = {}
    for rows in problem.rows:
        if rows.model not in AXES:
            continue
        r, own = parted(problem, rows, x, c)[0], ~gated[rows.sensor]
        if rows.model == "odometer":
            r = r[:, :1]  # that it does not slide is no reading of it
        pairs = own[:-1] & own[1:]
        before, after = r[:-1][pairs], r[1:][pairs]
        size = float(np.sqrt(np.sum(before**2) * np.sum(after**2)))
        if before.size >= FEWEST_PAIRS and size > 0:
            found[rows.sensor] = Correlation(
                float(np.sum(before * after)) / size, before.size**-0.5, float(np.mean(r[own] ** 2))
            )
    return found


def correlated_in_words(problem: Problem, found: dict[str, Correlation]) -> list[str]:
    """Sensors whose residuals tell of the next more than chance explains, and enough to matter."""
    lines = []
    for sensor, one in found.items():
        limit = -float(ndtri(CHANCE / len(found))) * one.sd
        if one.value > limit and one.factor > WORTH:
            times = problem.rig.sensors[sensor].times * one.factor
            lines.append(
                f"{sensor}: its residuals are no white noise, {one.value:.0%} of one is in the next (by chance "
                f"{limit:.0%} at most): sds that rest on it are too small, by a factor of about {one.factor:.1f}; look "
                "for what drifts (clock, mounting, smoothing in the device), or set "
                f"sensors.{sensor}.noise_factor={times:.2g}"
            )
    return lines


def biased_in_words(found: list[Bias], origin_ns: int) -> list[str]:
    """One line per component of a sensor: the longest of its stretches."""

    def component(one: Bias) -> tuple[str, str]:
        return one.stretch.sensor, one.where

    lines = []
    for (sensor, where), several in groupby(sorted(found, key=component), component):
        own = list(several)
        longest = max(own, key=lambda one: one.stretch.end_ns - one.stretch.start_ns)
        start, end = ((t - origin_ns) * 1e-9 for t in (longest.stretch.start_ns, longest.stretch.end_ns))
        by = f"{longest.size:+.1f} deg" if longest.unit == "deg" else f"{longest.size:+.2g} {longest.unit}"
        by += f" {where}" if where else ""
        times = f" ({len(own)} times, this the longest)" if len(own) > 1 else ""
        lines.append(f"{sensor}: biased by {by} from {start:.1f} to {end:.1f} s against all else{times}")
    return lines
