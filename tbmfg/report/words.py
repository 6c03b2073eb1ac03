"""The diagnosis in words, the most important first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tbmfg.comparison import not_run, ran, rows, together
from tbmfg.evaluation.metrics import chi_square_bounds
from tbmfg.report.content import Report, Track


@dataclass(frozen=True, slots=True)
class Finding:
    """Lines under one heading; ``grave`` ones are marked on the page."""

    heading: str
    lines: list[str]
    grave: bool = False


def findings(report: Report) -> list[Finding]:
    """What a reader must know before the figures; groups without lines are left out."""
    summaries = report.summaries
    shared = {*report.found, *report.assumed}
    own = [
        (name, line) for name, summary in ran(summaries).items() for line in summary["warnings"] if line not in shared
    ]
    told = [f"{', '.join(names)}: {line}" for line, names in together(own).items()]
    groups = [
        Finding("Result", [*_results(report)]),
        Finding("Not run", [f"{name}: {why}" for name, why in not_run(summaries).items()]),
        Finding("Surer than it should be", list(_overconfident(report)), grave=True),
        Finding("What the estimators warn of", told, grave=True),
        Finding("What the log and the rig gave rise to", list(report.found)),
        Finding("Assumed, because nobody said", list(report.assumed)),
    ]
    return [group for group in groups if group.lines]


def _results(report: Report) -> Iterable[str]:
    metrics = {row.label: row.metrics for row in rows(report.summaries)}
    for track in report.tracks:
        yield f"{track.label}: {_claim(track)}{_against(metrics.get(track.label) or {})}."
    if report.truth is None:
        yield "There was no truth to compare with: how sure is what the estimators say of themselves."


def _claim(track: Track) -> str:
    position = np.linalg.norm(track.position_sd(), axis=1)
    heading = np.rad2deg(track.rotation_sd()[:, 2])
    if not position.any():
        return "does not say how sure it is"
    worst = int(position.argmax())
    at_s = (track.path.t_ns[worst] - track.path.t_ns[0]) * 1e-9
    return (
        f"says that it knows the position to {length(float(np.median(position)))} (1 sigma, median; at worst "
        f"{length(float(position[worst]))}, {at_s:.0f} s in) and the heading to {np.median(heading):.2g}°"
    )


def _against(metrics: dict[str, Any]) -> str:
    if metrics.get("position_rms_m") is None:
        return ""
    text = f"; against the truth it is off by {length(metrics['position_rms_m'])} rms"
    if metrics.get("outage_position_rms_m") is not None:
        text += f", {length(metrics['outage_position_rms_m'])} in the outages"
    if metrics.get("yaw_rms_deg") is not None:
        text += f", and by {metrics['yaw_rms_deg']:.2g}° in heading"
    return text


def _overconfident(report: Report) -> Iterable[str]:
    for row in rows(report.summaries):
        bounds = nees_bounds(row.metrics)
        if bounds is not None and row.metrics["nees_mean"] > bounds[1]:
            factor = np.sqrt(row.metrics["nees_mean"] / row.metrics["nees_dof"])
            yield (
                f"{row.label}: its errors are {factor:.1f} times what its covariance says (NEES "
                f"{row.metrics['nees_mean']:.3g}, at most {bounds[1]:.3g} by chance): take its bands that much wider"
            )


def nees_bounds(metrics: dict[str, Any]) -> tuple[float, float] | None:
    """Between what the mean NEES of a consistent estimator lies with 99 %, by the effective number of samples."""
    if metrics.get("nees_mean") is None or not metrics.get("nees_n_eff"):
        return None
    return chi_square_bounds(metrics["nees_n_eff"], metrics["nees_dof"])


def length(metres: float) -> str:
    """A length in the unit that suits it."""
    if metres < 1.0:
        return f"{1e3 * metres:.3g} mm"
    return f"{metres:.3g} m" if metres < 1e3 else f"{metres / 1e3:.3g} km"
