"""What a report is made of: the trajectories of a comparison beside their errors, as light as the plots need them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tbmfg.evaluation.metrics import Errors, at_point, trajectory_errors
from tbmfg.geometry import matrix_from_quat
from tbmfg.rig import Rig
from tbmfg.state import POS, ROT, Health, Innovations, Result, Trajectory, Truth
from tbmfg.timeseries import Floats, Log, Times

POSE = slice(0, 6)  # of the covariance, what is drawn: rotation in b and position in n


@dataclass(frozen=True, slots=True)
class Track:
    """One trajectory of an estimator, its covariance cut to the pose (n, 6, 6).

    ``errors`` are those of :func:`tbmfg.evaluation.metrics.trajectory_errors`, ``error_cov`` (m, 6, 6) the covariance
    at the same keyframes and of the same point; both None without truth.
    """

    label: str
    estimator: str
    smoothed: bool
    path: Trajectory
    errors: Errors | None = None
    error_cov: Floats | None = None

    def position_sd(self) -> Floats:
        """(n, 3) m, along n."""
        return deviations(self.path.cov[:, POS, POS])

    def rotation_sd(self) -> Floats:
        """(n, 3) rad, about the axes of n: two tilts and the heading."""
        return rotation_sd_n(self.path.rotations(), self.path.cov[:, ROT, ROT])


@dataclass(slots=True)
class Report:
    """Everything that a report shows. Times are seconds from ``t0_ns``, the first IMU sample.

    ``found`` and ``assumed`` are the warnings that the log and the rig, not an estimator, gave rise to; ``stamps_s``
    the recorded stamps by sensor; ``map_n`` (k, 3) m points of a map in n, and what they are. ``summaries`` are as
    compare.json has them.
    """

    title: str
    rig_yaml: str
    t0_ns: int
    stamps_s: Mapping[str, Floats] = field(default_factory=dict)
    found: Sequence[str] = ()
    assumed: Sequence[str] = ()
    map_n: Floats | None = None
    map_label: str = "the map"
    summaries: dict[str, dict[str, Any]] = field(default_factory=dict)
    tracks: list[Track] = field(default_factory=list)
    innovations: dict[str, dict[str, Innovations]] = field(default_factory=dict)
    health: Mapping[str, Health] = field(default_factory=dict)
    truth: Truth | None = None

    def add(self, result: Result, summary: dict[str, Any], truth: Truth | None) -> None:
        """Take up what one estimator gave: its trajectories, causal before last, and how the sensors agreed with it."""
        name = result.estimator
        self.summaries[name] = summary
        if result.smoothed is None:
            self.tracks.append(_track(name, name, False, result.trajectory, truth))
        else:
            self.tracks.append(_track(f"{name} (causal)", name, False, result.trajectory, truth))
            self.tracks.append(_track(f"{name} (last)", name, True, result.smoothed, truth))
        self.innovations[name] = result.innovations
        self.health = result.health
        self.truth = self.truth or truth

    def span_s(self) -> tuple[float, float]:
        """Between which times there are estimates."""
        ends = np.array([track.path.t_ns[[0, -1]] for track in self.tracks])
        return float(ends[:, 0].min() - self.t0_ns) * 1e-9, float(ends[:, 1].max() - self.t0_ns) * 1e-9

    def html(self) -> str:
        """The page."""
        from tbmfg.report.page import page

        return page(self)


def _track(label: str, estimator: str, smoothed: bool, path: Trajectory, truth: Truth | None) -> Track:
    path = replace(path, cov=np.ascontiguousarray(path.cov[:, POSE, POSE]))
    if truth is None:
        return Track(label, estimator, smoothed, path)
    errors = trajectory_errors(path, truth)
    return Track(label, estimator, smoothed, path, errors, at_point(path, truth.arm_b).cov[errors.rows])


def stamps_of(log: Log, rig: Rig, t0_ns: int) -> dict[str, Floats]:
    """When each sensor's messages were stamped, s from ``t0_ns``; sensors whose topic the log lacks are empty."""
    nothing: Times = np.zeros(0, dtype=np.int64)
    found = {}
    for name, sensor in rig.sensors.items():
        source = log.series.get(sensor.topic) or log.clouds.get(sensor.topic)
        found[name] = ((nothing if source is None else source.t_ns) - np.int64(t0_ns)) * 1e-9
    return found


def deviations(cov: Floats) -> Floats:
    """Standard deviations (n, k) of covariances (n, k, k)."""
    return np.sqrt(np.clip(np.diagonal(cov, axis1=1, axis2=2), 0.0, None))


def rotation_sd_n(R_nb: Floats, cov_b: Floats) -> Floats:
    """Standard deviations (n, 3) rad about the axes of n, from covariances of rotations in b (n, 3, 3)."""
    return deviations(R_nb @ cov_b @ R_nb.transpose(0, 2, 1))


def error_rotation_sd(track: Track) -> Floats:
    """:func:`rotation_sd_n` at the evaluated keyframes, (m, 3) rad."""
    R_nb = matrix_from_quat(track.path.quat_xyzw[track.errors.rows])
    return rotation_sd_n(R_nb, track.error_cov[:, ROT, ROT])
