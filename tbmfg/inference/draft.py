"""A rig while it is put together: what is known of the log, what was taken, and what was said of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tbmfg.geometry import matrix_from_quat, rpy_from_rotation
from tbmfg.rig import Rig
from tbmfg.timeseries import Floats, Log, Series, Transform

BASE = "base_link"  # REP-105: the body of the machine; REP-103: forward, left, up
UPRIGHT = np.cos(np.deg2rad(45.0))


@dataclass(frozen=True, slots=True)
class Assumption:
    """A guess: the ``key`` of the rig that it fills or leaves open, and why."""

    key: str
    reason: str

    def __str__(self) -> str:
        return f"assumed {self.key}: {self.reason}"


@dataclass(slots=True)
class Inferred:
    """A rig, what was assumed for it, and why which topics (topic -> reason) have no place in it."""

    rig: Rig
    assumptions: list[Assumption]
    unused: dict[str, str]

    def lines(self) -> list[str]:
        """All of it as text for the user."""
        return [*map(str, self.assumptions), *(f"not used: {topic}: {reason}" for topic, reason in self.unused.items())]


@dataclass(slots=True)
class Draft:
    """The rig while it is put together."""

    log: Log
    imu: Series
    R_bi: Floats
    linked: bool
    frames: Frames
    sensors: dict[str, dict] = field(default_factory=dict)
    said: list[Assumption] = field(default_factory=list)
    unused: dict[str, str] = field(default_factory=dict)

    def say(self, key: str, reason: str) -> None:
        self.said.append(Assumption(key, reason))

    def leave(self, topic: str, reason: str) -> None:
        self.unused[topic] = reason

    @property
    def up(self) -> Floats:
        """Direction of the typical specific force in b, (3,)."""
        force = self.R_bi @ np.median(self.imu["acc"], axis=0)
        return force / max(float(np.linalg.norm(force)), 1e-9)

    def arm(self, frame: str) -> list[float] | None:
        """Origin of ``frame`` in b [m]; None where nothing links it to the IMU."""
        T = self.frames.between(self.imu.frame_id, frame)
        return None if T is None else rounded(self.R_bi @ T[:3, 3])

    def rpy(self, frame: str) -> list[float] | None:
        """Rotation from the axes of ``frame`` to b [deg]; None where nothing links it to the IMU."""
        T = self.frames.between(self.imu.frame_id, frame)
        return None if T is None else rpy_deg(self.R_bi @ T[:3, :3])


class Frames:
    """Static transforms as a graph."""

    def __init__(self, transforms: Iterable[Transform]) -> None:
        self._neighbours: dict[str, dict[str, Floats]] = {}
        for one in transforms:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = matrix_from_quat(np.array(one.quat_xyzw)), one.xyz
            parent, child = bare(one.parent), bare(one.child)
            self._neighbours.setdefault(parent, {})[child] = T
            self._neighbours.setdefault(child, {})[parent] = np.linalg.inv(T)

    def between(self, a: str, b: str) -> Floats | None:
        """T_ab, (4, 4): takes coordinates in ``b`` to those in ``a``; None where the two are not linked."""
        a, b = bare(a), bare(b)
        found, queue = {a: np.eye(4)}, [a]
        for here in queue:
            for name, T in self._neighbours.get(here, {}).items():
                if name not in found:
                    found[name] = found[here] @ T
                    queue.append(name)
        return found.get(b)

    def linked(self, frame: str) -> list[str]:
        """All frames that are linked to ``frame``, itself among them."""
        return [bare(frame), *(name for name in self._neighbours if self.between(frame, name) is not None)]


def axis_of(direction: Floats) -> str:
    best = int(np.argmax(np.abs(direction)))
    return ("-" if direction[best] < 0 else "") + "xyz"[best]


def bare(frame: str) -> str:
    return frame.lstrip("/")


def short(type: str) -> str:
    return type.replace("/msg/", "/")


def rate(series: Series) -> str:
    span = (series.t_ns[-1] - series.t_ns[0]) * 1e-9
    return f"{len(series)} messages" + (f", {(len(series) - 1) / span:.3g} Hz" if span > 0 else "")


def rpy_deg(R: Floats) -> list[float]:
    return rounded(np.rad2deg(rpy_from_rotation(R)))


def rounded(values: Floats) -> list[float]:
    return [round(float(x), 6) + 0.0 for x in values]


def numbers(values: Floats) -> str:
    return ", ".join(f"{x:.2g}" for x in values)


def listed(words: list[str], most: int = 6) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more topics" if len(words) > most else "") or "nothing"


def one_line(text: str) -> str:
    """Text that stays on one line."""
    return " ".join(text.split())


def losses(series: Series) -> str:
    """How many messages there were, and why so few are left."""
    c = series.counts
    lost = {"hold NaN": c.nonfinite, "bear a wrong stamp": c.misdated, "cannot be decoded": c.undecodable}
    reasons = [f"{count} {what}" for what, count in lost.items() if count]
    return ", ".join([f"{len(series)} usable of {c.received + c.undecodable} messages", *reasons])
