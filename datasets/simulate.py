"""From a motion to a log: the place on Earth, what inertia feels there, and the rig whose priors all is drawn from.

n is taken as small and flat: gravity is one vector, n turns with the Earth, and a body in it feels
f_b = R_bn (a_n + 2 w_ie x v_n - g_n) and turns at w_nb_b + R_bn w_ie. The centripetal term is in g_n.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from datasets.motion import Kinematics, Motion, rotate_back
from tbmfg.errors import RigError
from tbmfg.rig import Origin, Rig, dump_rig, kind_of
from tbmfg.timeseries import NS, Clouds, Floats, Series, Times

START_NS = 1_700_000_000 * NS
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)
PANEL_S = 2.2e-3  # four nodes integrate 220 Hz over this panel to 1e-6 of its amplitude
CHUNK = 16_384  # times evaluated at once: stays in cache, and an hour's log in memory


@dataclass(frozen=True, slots=True)
class Scene:
    """A motion at a place on Earth; its times are seconds since ``START_NS``."""

    motion: Motion
    origin: Origin
    duration_s: float

    @property
    def north_up_n(self) -> tuple[Floats, Floats]:
        """Unit vectors of true north and of up in n, (3,) each."""
        azimuth = np.radians(self.origin.x_axis_azimuth_deg)
        x_n, y_n = (np.sin(azimuth), np.cos(azimuth)), (-np.cos(azimuth), np.sin(azimuth))  # in east, north
        return np.array([x_n[1], y_n[1], 0.0]), np.array([0.0, 0.0, 1.0])

    @property
    def earth_rate_n(self) -> Floats:
        """Rate of the Earth in n, (3,) rad/s: one turn in a sidereal day of 86164.0989 s."""
        north, up = self.north_up_n
        latitude = np.radians(self.origin.latitude_deg)
        return 2 * np.pi / 86164.0989 * (np.cos(latitude) * north + np.sin(latitude) * up)

    @property
    def gravity_n(self) -> Floats:
        """Gravity with the centripetal term, (3,) m/s^2: Somigliana on the WGS 84 semi-axes, inverse square above."""
        c2, s2 = np.cos(np.radians(self.origin.latitude_deg)) ** 2, np.sin(np.radians(self.origin.latitude_deg)) ** 2
        a, b, at_equator, at_pole = 6378137.0, 6356752.314245, 9.7803253359, 9.8321849379
        surface = (a * at_equator * c2 + b * at_pole * s2) / np.sqrt(a**2 * c2 + b**2 * s2)
        return np.array([0.0, 0.0, -surface * (a / (a + self.origin.height_m)) ** 2])

    def inertial(self, t_s: Floats) -> Floats:
        """Angular rate and specific force in b, (n, 6): what an ideal unit at b's origin feels at ``t_s``."""
        truth, earth_rate = self.motion(t_s), self.earth_rate_n
        force_n = truth.acceleration + 2 * np.cross(earth_rate, truth.velocity) - self.gravity_n
        return np.hstack([truth.omega + earth_rate @ truth.R, rotate_back(truth.R, force_n)])


@dataclass(frozen=True, slots=True)
class Sensed:
    """One sensor's output: as logged, as a perfect sensor would give it, and what was drawn for it.

    ``clean`` holds the same columns without noise, bias and scale, stamped with the true time of measurement;
    lever arms in it are the true ones. ``drawn`` has the names of the rig's fields.
    """

    log: Series | Clouds
    clean: Series | Clouds
    drawn: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated log and everything that it hides.

    ``truth`` maps seconds since ``start_ns`` (n,) to the :class:`Kinematics` of b in n; ``clean`` and
    ``drawn`` are those of :class:`Sensed` by sensor name. ``clouds`` are cast when they are iterated over.
    """

    name: str
    log_series: tuple[Series, ...]
    rig: Rig
    truth: Callable[[Floats], Kinematics]
    clean: dict[str, Series | Clouds]
    drawn: dict[str, dict[str, Any]]
    clouds: tuple[Clouds, ...] = ()
    start_ns: int = START_NS

    @property
    def rig_text(self) -> str:
        """The rig as YAML, as attached to the log."""
        return dump_rig(self.rig)

    def write(self, path: str | Path) -> None:
        """Write the MCAP log, with its rig attached as ``rig.yaml``."""
        from tbmfg.mcap import write_log

        write_log(path, self.log_series, clouds=self.clouds, attachments={"rig.yaml": self.rig_text.encode()})


def stream(seed: int, name: str) -> np.random.Generator:
    """The random stream of one sensor: it depends on nothing but the seed and its name."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),)))


def simulate(
    name: str,
    motion: Motion,
    rig: Rig,
    sensors: Mapping[str, Callable[[Scene, Any, np.random.Generator], Sensed]],
    *,
    seed: int,
    duration_s: float,
    truth_rate_hz: float,
) -> Simulation:
    """A log of every sensor of ``rig`` whose kind is in ``sensors``; the others leave the rig."""
    if rig.origin.latitude_deg is None:
        raise RigError(f"{name}: origin.latitude_deg is not given; it says what gravity and Earth rate are felt")
    scene = Scene(motion, rig.origin, duration_s)
    kept = {key: sensor for key, sensor in rig.sensors.items() if kind_of(key) in sensors}
    sensed = {key: sensors[kind_of(key)](scene, sensor, stream(seed, key)) for key, sensor in kept.items()}
    initial = rig.initial.model_copy(update=draw_prior(rig, motion(np.zeros(1)), stream(seed, "initial")))
    truth = [] if rig.truth is None else [odometry(scene, rig.truth.topic, truth_rate_hz)]
    logs = [part.log for part in sensed.values()]
    return Simulation(
        name=name,
        log_series=(*(log for log in logs if isinstance(log, Series)), *truth),
        rig=rig.model_copy(update={"sensors": kept, "initial": initial}),
        truth=motion,
        clean={key: part.clean for key, part in sensed.items()},
        drawn={key: part.drawn for key, part in sensed.items()},
        clouds=tuple(log for log in logs if not isinstance(log, Series)),
    )


def draw_prior(rig: Rig, start: Kinematics, rng: np.random.Generator) -> dict[str, Any]:
    """Values for the rig's ``initial``: the true start plus errors drawn from its standard deviations.

    The attitude error is a rotation vector e about n's axes, R_rig = Exp(e) R_true: x and y have
    ``tilt_sd_deg``, z has ``yaw_sd_deg``. A heading that the rig does not know (180 degrees) stays unknown.
    """
    prior = rig.initial
    turn, shift, speed = rng.standard_normal((3, 3))
    error_n = np.radians([prior.tilt_sd_deg, prior.tilt_sd_deg, prior.yaw_sd_deg]) * turn
    R = Rotation.from_rotvec(error_n).as_matrix() @ start.R[0]
    yaw_deg = float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))
    return {
        "yaw_deg": yaw_deg if prior.yaw_sd_deg < 180.0 else None,
        "pitch_deg": float(np.degrees(-np.arcsin(R[2, 0]))),
        "roll_deg": float(np.degrees(np.arctan2(R[2, 1], R[2, 2]))),
        "position_m": tuple((start.position[0] + prior.position_sd_m * shift).tolist()),
        "velocity_mps": tuple((start.velocity[0] + prior.velocity_sd_mps * speed).tolist()),
    }


def ticks(duration_s: float, rate_hz: float) -> Times:
    """Instants 0, 1/rate, ... up to the duration, (n + 1,) int64 ns since the start."""
    return np.round(np.arange(int(duration_s * rate_hz + 1e-6) + 1) * (NS / rate_hz)).astype(np.int64)


def period_means(signal: Callable[[Floats], Floats], edges_ns: Times, panel_s: float = PANEL_S) -> Floats:
    """Mean of ``signal`` (t -> (n, k)) over each of the periods between ``edges_ns`` (n + 1,); (n, k).

    Each period is cut into panels no longer than ``panel_s`` with four Gauss-Legendre nodes each.
    """
    edges = edges_ns * 1e-9
    panels = int(np.ceil(np.diff(edges).max() / panel_s))
    offsets = ((np.arange(panels)[:, None] + (NODES + 1) / 2) / panels).ravel()
    weights = np.tile(WEIGHTS / (2 * panels), panels)
    means = []
    step = max(1, CHUNK // len(offsets))
    for first in range(0, len(edges) - 1, step):
        part = edges[first : first + step + 1]
        t = part[:-1, None] + np.diff(part)[:, None] * offsets
        means.append(np.einsum("nmk,m->nk", signal(t.ravel()).reshape(*t.shape, -1), weights))
    return np.concatenate(means)


def odometry(scene: Scene, topic: str, rate_hz: float) -> Series:
    """The truth as nav_msgs/Odometry: pose of b in n, twist in b."""
    t_ns = ticks(scene.duration_s, rate_hz)
    truth = scene.motion(t_ns * 1e-9)
    columns = {
        "position": truth.position,
        "quat_xyzw": Rotation.from_matrix(truth.R).as_quat(canonical=True),
        "linear": rotate_back(truth.R, truth.velocity),
        "angular": truth.omega,
    }
    return Series(topic, "nav_msgs/msg/Odometry", START_NS + t_ns, columns, "n", "b")
