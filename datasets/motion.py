"""Truth as a function of time: smooth motions with exact derivatives, and how two motions compose.

Nothing here is shared with the package under test: rotations are written out below.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from tbmfg.timeseries import Floats

# A smooth vector signal: times (n,) s -> value, first and second derivative, each (n, k).
Signal = Callable[[Floats], tuple[Floats, Floats, Floats]]


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Motion of a child frame in its parent at n times.

    ``position``, ``velocity``, ``acceleration`` (n, 3) of the child's origin, in the parent's axes, m and s;
    ``R`` (n, 3, 3) takes child axes to parent axes; ``omega`` and ``alpha`` (n, 3), rad/s and rad/s^2, are
    the child's rate against the parent and its derivative, in the child's axes.
    """

    position: Floats
    velocity: Floats
    acceleration: Floats
    R: Floats
    omega: Floats
    alpha: Floats

    def at_point(self, arm: Floats) -> tuple[Floats, Floats]:
        """Position and velocity, (n, 3) in the parent's axes, of a point fixed at ``arm`` (3,) in the child."""
        return self.position + self.R @ arm, self.velocity + rotate(self.R, np.cross(self.omega, arm))


class Spline:
    """A quintic spline through samples (m, k) at ``t_s`` (m,): from here on the spline is the signal."""

    def __init__(self, t_s: Floats, samples: Floats) -> None:
        value: BSpline = make_interp_spline(t_s, samples, k=5)
        self._derivatives = value, value.derivative(1), value.derivative(2)

    def __call__(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        value, rate, acceleration = (spline(t_s) for spline in self._derivatives)
        return value, rate, acceleration


@dataclass(frozen=True, slots=True)
class Lines:
    """A vibration: the real part of sum_l amplitude[l] exp(2 pi i frequency_hz[l] t), under an envelope.

    ``frequency_hz`` (L,), ``amplitude`` (L, k) complex, ``envelope`` a signal with one column.
    """

    frequency_hz: Floats
    amplitude: np.ndarray
    envelope: Signal

    def __call__(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        omega = 2 * np.pi * self.frequency_hz
        phase = np.multiply.outer(t_s, omega)
        cosine, sine = np.cos(phase), np.sin(phase)
        s, ds, dds = (
            cosine @ coefficient.real - sine @ coefficient.imag
            for coefficient in (self.amplitude * (1j * omega[:, None]) ** order for order in range(3))
        )
        g, dg, ddg = self.envelope(t_s)
        return g * s, dg * s + g * ds, ddg * s + 2 * dg * ds + g * dds


def lines(
    frequency_hz: Floats, acceleration: Floats, rate: Floats, envelope: Signal, rng: np.random.Generator
) -> Lines:
    """Shaking in (x, y, z, roll, pitch, yaw) with random phases.

    Amplitudes per line: ``acceleration`` (L, 3) m/s^2 along, and ``rate`` (L, 3) rad/s about the three axes.
    """
    omega = 2 * np.pi * np.asarray(frequency_hz)[:, None]
    size = np.hstack([acceleration / omega**2, rate / omega])
    return Lines(np.asarray(frequency_hz), size * np.exp(2j * np.pi * rng.random(size.shape)), envelope)


@dataclass(frozen=True, slots=True)
class Motion:
    """A machine's body: it follows a path, and shakes about it.

    ``path`` is a signal (x, y, z, roll, pitch, yaw) of the undisturbed machine in n; the ``vibrations``, signals
    of the same six, move it against that undisturbed frame. ``mounting`` (3, 3) takes b's axes to the machine's; None:
    they are the same. Calling it gives the truth.
    """

    path: Signal
    vibrations: tuple[Signal, ...] = ()
    mounting: Floats | None = None

    def undisturbed(self, t_s: Floats) -> Kinematics:
        """The body as it would travel without vibration."""
        return self._mounted(rigid(*self.path(t_s)))

    def __call__(self, t_s: Floats) -> Kinematics:
        """The body b in n at times (n,) s."""
        if not self.vibrations:
            return self.undisturbed(t_s)
        shaking = [vibration(t_s) for vibration in self.vibrations]
        shaken = rigid(*(sum(parts) for parts in zip(*shaking, strict=True)))
        return self._mounted(compose(rigid(*self.path(t_s)), shaken))

    def _mounted(self, machine: Kinematics) -> Kinematics:
        C = self.mounting
        if C is None:
            return machine
        return replace(machine, R=machine.R @ C, omega=machine.omega @ C, alpha=machine.alpha @ C)


def smooth_step(x: Floats) -> Floats:
    """0 below 0, 1 above 1, three continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)


def integral(t_s: Floats, values: Floats) -> Floats:
    """Integral of ``values`` (n,) from the first of ``t_s`` on, by the quintic spline through them."""
    return make_interp_spline(t_s, values, k=5).antiderivative()(t_s)


def rotate(R: Floats, v: Floats) -> Floats:
    """R v row by row, (n, 3, 3) and (n, 3) -> (n, 3)."""
    return np.einsum("nij,nj->ni", R, v)


def rotate_back(R: Floats, v: Floats) -> Floats:
    """R' v row by row, (n, 3, 3) and (n, 3) -> (n, 3)."""
    return np.einsum("nji,nj->ni", R, v)


def rigid(value: Floats, rate: Floats, acceleration: Floats) -> Kinematics:
    """Kinematics from (x, y, z, roll, pitch, yaw) and its derivatives, (n, 6) each; R = Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(value[:, 3:]).T, np.cos(value[:, 3:]).T
    dr, dp, dy = rate[:, 3:].T
    ddr, ddp, ddy = acceleration[:, 3:].T
    R = np.empty((len(value), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = -sp, cp * sr, cp * cr
    omega = np.column_stack([dr - dy * sp, dp * cr + dy * cp * sr, dy * cp * cr - dp * sr])
    alpha = np.column_stack(
        [
            ddr - ddy * sp - dy * dp * cp,
            ddp * cr - dp * dr * sr + ddy * cp * sr + dy * (dr * cp * cr - dp * sp * sr),
            ddy * cp * cr - dy * (dp * sp * cr + dr * cp * sr) - ddp * sr - dp * dr * cr,
        ]
    )
    return Kinematics(value[:, :3], rate[:, :3], acceleration[:, :3], R, omega, alpha)


def compose(outer: Kinematics, inner: Kinematics) -> Kinematics:
    """Motion of ``inner``'s child in ``outer``'s parent, with Coriolis, Euler and centripetal terms."""
    p, v, w = inner.position, inner.velocity, outer.omega
    relative = inner.acceleration + 2 * np.cross(w, v) + np.cross(outer.alpha, p) + np.cross(w, np.cross(w, p))
    carried = rotate_back(inner.R, w)
    return Kinematics(
        position=outer.position + rotate(outer.R, p),
        velocity=outer.velocity + rotate(outer.R, v + np.cross(w, p)),
        acceleration=outer.acceleration + rotate(outer.R, relative),
        R=outer.R @ inner.R,
        omega=carried + inner.omega,
        alpha=rotate_back(inner.R, outer.alpha) + inner.alpha - np.cross(inner.omega, carried),
    )
