"""From recorded samples to rows: which keyframe each measurement belongs to, carried there by the gyro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tbmfg.earth import north_direction
from tbmfg.errors import RigError
from tbmfg.fields import MICRO_TESLA
from tbmfg.geometry import exp_so3, rotation_from_rpy
from tbmfg.inertial.steps import GAP, Steps, step_index
from tbmfg.inertial.strapdown import rotations
from tbmfg.rig import Barometer, Keyframes, Laser, Magnetometer, Odometer, PositionSensor, SurveyPoint
from tbmfg.sensors import Rows
from tbmfg.timeseries import Floats

HELD_S = 0.05  # a speed may stand for this much time at least
LEVEL_S = 300.0  # over which the attitude at the start and the gyro hold the horizon
SMOOTHED_S = 4.0  # the speed that an odometer's scale is judged on is a mean over this time
RATE_WINDOW_S = 0.02  # the angular rate at a fix is a mean over this much on either side


@dataclass(frozen=True, slots=True)
class Samples:
    """Accepted samples of one sensor: stamps in s since the log's first IMU sample (clock offset not removed).

    ``sigma`` (n, 3) is the standard deviation per axis of positions [m], None for other sensors.
    """

    sensor: str
    t_s: Floats
    values: Floats
    sigma: Floats | None = None

    def select(self, rows: np.ndarray) -> Samples:
        """Only these rows (index array or mask)."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return Samples(self.sensor, self.t_s[rows], self.values[rows], sigma)


@dataclass(frozen=True, slots=True)
class Clock:
    """How late a sensor's stamps are: ``offset_s`` at the first IMU sample, and growing by ``drift`` [s/s]."""

    offset_s: float
    drift: float = 0.0

    def true(self, t_s: Floats) -> Floats:
        """IMU times of stamps ``t_s``."""
        return t_s - self.offset_s - self.drift * t_s


def keyframe_edges(rule: Keyframes, edges_s: Floats, end_s: float, fixes_s: Floats) -> np.ndarray:
    """IMU edges at which the keyframes lie, int64 (n,): the span's ends, the edge nearest to every fix (at most
    ``max_rate_hz``), and what fills gaps to ``max_gap_s``.

    On edges no IMU sample is cut, and what is left between a fix and its keyframe, half an IMU period at most, is
    bridged by the velocity. A vibrating body moves too fast inside a sample to be interpolated there.
    """
    last = int(nearest(edges_s, np.array([end_s]))[0])
    closest = (1 - 1e-6) / rule.max_rate_hz
    inside = fixes_s[(fixes_s > edges_s[0]) & (fixes_s < edges_s[last])]
    kept = [0]
    for k in np.unique(nearest(edges_s, inside)):
        if edges_s[k] - edges_s[kept[-1]] >= closest:
            kept.append(int(k))
    if kept[-1] != last:
        kept.append(last)
    parts = np.maximum(np.ceil(np.diff(edges_s[kept]) / rule.max_gap_s - 1e-9).astype(int), 1)
    number = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    between = np.repeat(kept[:-1], parts) + number * np.repeat(np.diff(kept) / parts, parts)
    return np.unique(np.append(between, last).astype(int))


def nearest(keyframes_s: Floats, t_s: Floats) -> np.ndarray:
    """Index of the keyframe nearest to each time."""
    right = np.clip(np.searchsorted(keyframes_s, t_s), 1, len(keyframes_s) - 1)
    return np.where(t_s - keyframes_s[right - 1] < keyframes_s[right] - t_s, right - 1, right)


@dataclass(frozen=True, slots=True)
class GyroFrame:
    """Attitude by gyro alone relative to the first edge: carries vectors over fractions of a second to a keyframe."""

    steps: Steps
    R_0t: Floats  # (n + 1, 3, 3)
    gyro: Floats  # (n, 3), bias removed
    bias_gyro: Floats

    def at(self, t_s: Floats) -> Floats:
        """R_0b at any time, (n, 3, 3): the attitude at the step's start, turned at the step's rate."""
        k = step_index(self.steps, t_s)
        return self.R_0t[k] @ exp_so3(self.gyro[k] * (t_s - self.steps.edges_s[k])[:, None])

    def rate(self, t_s: Floats, window_s: float = RATE_WINDOW_S) -> Floats:
        """Mean angular rate in b [rad/s] around each time, (n, 3)."""
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(self.gyro * self.steps.dt[:, None], axis=0)])
        edges = self.steps.edges_s
        middle = np.clip(t_s, edges[0] + window_s, max(edges[-1] - window_s, edges[0] + window_s))
        low, high = middle - window_s, np.minimum(middle + window_s, edges[-1])
        angle = [np.interp(high, edges, total[:, a]) - np.interp(low, edges, total[:, a]) for a in range(3)]
        return np.stack(angle, axis=1) / (high - low)[:, None]


def gyro_frame(steps: Steps, gyro: Floats, bias_gyro: Floats) -> GyroFrame:
    """The frame of compensated rates ``gyro`` (n, 3) that a bias (3,) is still to be taken from."""
    return GyroFrame(steps, rotations(steps.edges_s, gyro, bias_gyro), gyro - bias_gyro, bias_gyro)


def position_rows(
    sensor: PositionSensor,
    fixes: Samples,
    clock: Clock,
    keyframes_s: Floats,
    frame: GyroFrame,
    origin_n: Floats,
    calib: slice,
) -> Rows:
    """Fixes of a prism or antenna at their true times."""
    t = clock.true(fixes.t_s)
    k = nearest(keyframes_s, t)
    data = np.column_stack([t - keyframes_s[k], frame.rate(t), t])
    ones = np.ones(len(t), dtype=int)
    return Rows(fixes.sensor, "prism", k, k, fixes.values - origin_n, data, fixes.sigma, calib, ones, sensor.loss)


def odometer_rows(sensor: Odometer, speeds: Samples, keyframes_s: Floats, frame: GyroFrame, calib: slice) -> Rows:
    """Displacement between keyframes; ``speeds.values`` (n,) m/s, each the mean over the period that ends at its stamp.

    Intervals that the samples do not cover are left out.
    """
    starts, ends, period = periods(sensor, speeds)
    edges_s = frame.steps.edges_s
    edges_s = edges_s[: np.searchsorted(edges_s, keyframes_s[-1]) + 1]  # the keyframes may end long before the log
    middle, dt = 0.5 * (edges_s[:-1] + edges_s[1:]), np.diff(edges_s)
    k = np.clip(np.searchsorted(ends, middle), 0, len(ends) - 1)
    covered = (middle > starts[k] - 0.01 * period) & (middle <= ends[k])
    v = np.where(covered, speeds.values[k], 0.0)
    smooth = _running_mean(speeds.values, round(SMOOTHED_S / period))[k]

    E = rotation_from_rpy(np.array([0.0, sensor.pitch, sensor.yaw]))
    ahead = frame.at(middle) @ E[:, 0]
    way, smoothed = (ahead * (speed * dt)[:, None] for speed in (v, smooth))
    sums = [_cumulative(values) for values in (way, smoothed, way * middle[:, None], covered * dt)]
    way, smoothed, sweep, cover = (np.diff(_interpolate(edges_s, values, keyframes_s), axis=0) for values in sums)

    length = np.diff(keyframes_s)
    i = np.flatnonzero(cover > 0.999 * length - 1e-9)
    R_i = frame.at(keyframes_s[i])
    D, D_smooth = (np.einsum("kji,kj->ki", R_i, values[i]) @ E for values in (way, smoothed))
    B = np.einsum("kji,kj->ki", R_i, sweep[i] - way[i] * keyframes_s[i, None])
    data = np.column_stack([np.tile(sensor.arm, (len(i), 1)), B, np.tile(frame.bias_gyro, (len(i), 1)), D_smooth])
    # white noise per sample of one period: over a time T it leaves a displacement of sigma sqrt(period T)
    per_sample = np.array([sensor.sigma, sensor.lateral_sigma, sensor.lateral_sigma])
    sigma = per_sample * np.sqrt(period * length[i])[:, None]
    samples = np.searchsorted(ends, keyframes_s[i + 1] + 1e-9) - np.searchsorted(ends, keyframes_s[i] + 1e-9)
    return Rows(speeds.sensor, "odometer", i, i + 1, D, data, sigma, calib, samples, sensor.loss)


def wheel_rows(sensor: Odometer, speeds: Samples, edges_s: Floats, frame: GyroFrame, calib: slice) -> Rows:
    """Every sample by itself: a mean over a period is the speed at its middle, taken at the IMU edge nearest to that.

    Exact for a constant acceleration; the angular rate that the arm is turned with is a mean over the same period.
    """
    starts, ends, period = periods(sensor, speeds)
    middle = 0.5 * (starts + ends)
    inside = (middle >= edges_s[0]) & (middle <= edges_s[-1])
    t = middle[inside]
    k = nearest(edges_s, t)
    rate = frame.rate(t, 0.5 * period) + frame.bias_gyro
    smooth = _running_mean(speeds.values, round(SMOOTHED_S / period))[inside]
    data = np.column_stack([np.tile(sensor.arm, (len(t), 1)), rate, smooth])
    sigma = np.tile([sensor.sigma, sensor.lateral_sigma, sensor.lateral_sigma], (len(t), 1))
    z, ones = speeds.values[inside, None], np.ones(len(t), dtype=int)
    return Rows(speeds.sensor, "wheel", k, k, z, data, sigma, calib, ones, sensor.loss)


def periods(sensor: Odometer, speeds: Samples) -> tuple[Floats, Floats, float]:
    """Start and end of the time that each sample is the mean over, and the sensor's usual period [s]."""
    spacing = np.diff(speeds.t_s)
    period = float(np.median(spacing))
    ends = speeds.t_s - sensor.clock_offset
    # stamps jitter, in bursts on a bus: a sample covers the time since the one before, unless some were lost between
    alone = np.append(True, spacing > max(GAP * period, HELD_S))
    return ends - np.where(alone, period, np.append(period, spacing)), ends, period


def magnetometer_rows(
    sensor: Magnetometer,
    fields: Samples,
    keyframes_s: Floats,
    frame: GyroFrame,
    x_axis_azimuth: float,
    calib: slice,
    horizontal: float = 0.0,
) -> Rows:
    """Fields averaged to the nearest keyframe, carried there by the gyro, and where the machine's own is to be found,
    with them the sensor's axes and the length of the ``horizontal`` field [T] that the rig's sigma belongs to."""
    t = fields.t_s - sensor.clock_offset
    k = nearest(keyframes_s, t)
    axes = frame.at(t) @ sensor.R_bm
    carried = np.einsum("nij,nj->ni", axes, fields.values - sensor.hard_iron)
    used, mean, count = _group(k, np.column_stack([carried, axes.reshape(-1, 9)]))
    R_k = frame.at(keyframes_s[used]).transpose(0, 2, 1)
    z = np.einsum("nij,nj->ni", R_k, mean[:, :3])
    own = MICRO_TESLA * (R_k @ mean[:, 3:].reshape(-1, 3, 3)).reshape(-1, 9)
    model, data = "magnetometer", np.full((len(used), 1), north_direction(x_axis_azimuth))
    # samples average their noise away, but not the disturbance that they share
    lasting = sensor.disturbance**2 * _dependence(keyframes_s, sensor.disturbance_time)[used]
    sigma = np.sqrt(sensor.sigma**2 / count + lasting)[:, None]
    if sensor.hard_iron_sd_ut:
        model, data = "magnetic_field", np.column_stack([data, own, np.full(len(used), horizontal)])
    return Rows(fields.sensor, model, used, used, z, data, sigma, calib, count, sensor.loss)


def horizontal_field(
    sensor: Magnetometer, fields: Samples, frame: GyroFrame, R_start: Floats, tilt_sd: float
) -> tuple[float, float]:
    """Length of the Earth's horizontal field and its sd [T], by the attitude at the start ``R_start`` (3, 3), known to
    ``tilt_sd`` [rad]. Carried there by the gyro, the fields are the Earth's and the sensor's axes times an own one with
    the rig's prior: where the machine does not turn, the sd is that prior's."""
    t = fields.t_s - sensor.clock_offset
    begin = t < t[0] + LEVEL_S
    axes = R_start @ frame.at(t[begin]) @ sensor.R_bm
    field_n = np.einsum("nij,nj->ni", axes, fields.values[begin] - sensor.hard_iron)
    noise = sensor.sigma * float(np.median(np.hypot(field_n[:, 0], field_n[:, 1])))
    A = np.concatenate([np.tile(np.eye(3), (len(axes), 1, 1)), axes], axis=2).reshape(-1, 6)
    prior = np.diag([0.0] * 3 + [(noise / sensor.hard_iron_sd) ** 2] * 3)
    cov = np.linalg.inv(A.T @ A + prior)
    earth_n = (cov @ A.T @ field_n.ravel())[:3]
    H = float(np.hypot(earth_n[0], earth_n[1]))
    along = earth_n[:2] / H
    variance = noise**2 * along @ cov[:2, :2] @ along + (earth_n[2] * tilt_sd) ** 2
    return H, float(np.sqrt(variance))


def laser_rows(
    sensor: Laser,
    spots: Samples,
    keyframes_s: Floats,
    frame: GyroFrame,
    acc: Floats,
    gravity: float,
    origin_n: Floats,
    calib: slice,
) -> Rows:
    """Spots averaged to the nearest keyframe, and with them the detector as the IMU carries it there: ``acc`` (n, 3)
    compensated specific force in b. A machine that shakes by millimetres moves its detector under the spot."""
    t = spots.t_s - sensor.clock_offset
    k = nearest(keyframes_s, t)
    lag = t - keyframes_s[k]
    R_k = frame.at(keyframes_s)[k].transpose(0, 2, 1)
    R = R_k @ frame.at(t) @ sensor.T_bd.R
    arm = np.einsum("nij,nj->ni", R_k @ frame.at(t), np.tile(sensor.T_bd.xyz, (len(t), 1)))
    # displacement by the specific force between keyframe and spot, resolved at the keyframe
    force = np.einsum("nij,nj->ni", frame.R_0t[:-1], acc)
    edges, dt = frame.steps.edges_s, frame.steps.dt[:, None]
    velocity = _cumulative(force * dt)
    way = _cumulative(velocity[:-1] * dt + 0.5 * force * dt**2)
    at_t, at_k, v_k = (
        _interpolate(edges, v, x) for v, x in ((way, t), (way, keyframes_s[k]), (velocity, keyframes_s[k]))
    )
    moved = np.einsum("nij,nj->ni", R_k, at_t - at_k - v_k * lag[:, None])
    fall = -0.5 * gravity * lag**2
    used, mean, count = _group(k, np.column_stack([spots.values, lag, fall, arm + moved, R[:, :, 0], R[:, :, 1]]))
    # tilted, the line passes the origin of the problem's heights elsewhere than that of n
    line = sensor.line + sensor.tilt * origin_n[2] - origin_n[:2]
    data = np.column_stack([mean[:, 2:], np.tile(line, (len(used), 1))])
    sigma = np.tile((sensor.sigma / np.sqrt(count))[:, None], 2)
    return Rows(spots.sensor, "laser", used, used, mean[:, :2], data, sigma, calib, count, sensor.loss)


def barometer_rows(
    sensor: Barometer,
    heights: Samples,
    keyframes_s: Floats,
    origin_n: Floats,
    drift: int,
    reference: float,
    calib: slice,
) -> Rows:
    """Pressure heights averaged to the nearest keyframe; ``heights.values`` (n,) m; ``drift`` the index of the bias,
    ``reference`` the height above ``origin_n`` from which on the scale counts. It holds at the median height."""
    t = heights.t_s - sensor.clock_offset
    k = nearest(keyframes_s, t)
    used, mean, count = _group(k, np.column_stack([heights.values - origin_n[2], t - keyframes_s[k]]))
    middle = np.median(heights.values) - origin_n[2]
    data = np.column_stack([mean[:, 1], np.tile([float(drift), reference, middle], (len(used), 1))])
    sigma = (sensor.sigma / np.sqrt(count))[:, None]
    return Rows(heights.sensor, "barometer", used, used, mean[:, :1], data, sigma, calib, count, sensor.loss)


def survey_times(points: tuple[SurveyPoint, ...], steps: Steps) -> Floats:
    """When the machine stood at each point, s, (n,). Raises RigError for a time outside the log."""
    ends = {"start": float(steps.edges_s[0]), "end": steps.end_s}
    t = np.array([ends.get(point.at, point.at) for point in points], dtype=float)
    for k in np.flatnonzero((t < ends["start"]) | (t > ends["end"])):
        raise RigError(f"survey.{k}.at: {t[k]:g} s is outside the log, which ends at {ends['end']:.1f} s")
    return t


def survey_rows(points: tuple[SurveyPoint, ...], t_s: Floats, keyframes_s: Floats, origin_n: Floats) -> Rows:
    """Surveyed points at the keyframes that lie at their times, those up to the last keyframe."""
    order = [k for k in np.argsort(t_s, kind="stable") if t_s[k] <= keyframes_s[-1] + 1e-9]
    at = nearest(keyframes_s, t_s[order])
    z = np.array([points[k].position for k in order]).reshape(-1, 3) - origin_n
    sigma = np.array([np.full(3, points[k].sigma) for k in order]).reshape(-1, 3)
    ones = np.ones(len(order), dtype=int)
    return Rows("survey", "position", at, at, z, np.zeros((len(order), 0)), sigma, slice(0, 0), ones)


def velocity_rows(keyframes_s: Floats, intervals: list[tuple[float, float]], sigma: Floats) -> Rows:
    """Zero velocity at the keyframes inside ``intervals``; ``sigma`` (3,) m/s per axis of n."""
    k = np.flatnonzero(_stretch_of(keyframes_s, intervals) >= 0)
    empty, zero = np.zeros((len(k), 0)), np.zeros((len(k), 3))
    return Rows("zero_velocity", "velocity", k, k, zero, empty, zero + sigma, slice(0, 0), np.ones(len(k), dtype=int))


def rotation_rows(keyframes_s: Floats, intervals: list[tuple[float, float]], walk: float, shaking: float) -> Rows:
    """No turn between neighbouring keyframes inside one of ``intervals``, but for a random ``walk`` [rad/sqrt(s)] and
    vibration of ``shaking`` rms [rad] per axis. A steady turn at the gyro's bias would look the same to the IMU."""
    stretch = _stretch_of(keyframes_s, intervals)
    i = np.flatnonzero((stretch[:-1] >= 0) & (stretch[:-1] == stretch[1:]))
    sigma = np.sqrt(walk**2 * (keyframes_s[i + 1] - keyframes_s[i]) + 2.0 * shaking**2)
    empty, ones = np.zeros((len(i), 0)), np.ones(len(i), dtype=int)
    return Rows("zero_rotation", "rotation", i, i + 1, empty, empty, np.tile(sigma[:, None], 3), slice(0, 0), ones)


def within(t_s: Floats, start: float, end: float) -> slice:
    """Which of the times, which are in order, lie from ``start`` to ``end``."""
    return slice(np.searchsorted(t_s, start), np.searchsorted(t_s, end, side="right"))


def _stretch_of(t_s: Floats, intervals: list[tuple[float, float]]) -> np.ndarray:
    """Number of the interval that each of the times, which are in order, lies in, -1 outside of all."""
    found = np.full(len(t_s), -1)
    for number, interval in enumerate(intervals):
        found[within(t_s, *interval)] = number
    return found


def bounded_rows(keyframes_s: Floats, centre_n: Floats, radius: float, speed: float) -> Rows:
    """A body that stays within ``radius`` of ``centre_n`` and below ``speed``, read as sds, at every keyframe.

    It crosses its volume in radius / speed: keyframes closer than that tell the same thing again.
    """
    k = np.arange(len(keyframes_s))
    z = np.tile(np.concatenate([centre_n, np.zeros(3)]), (len(k), 1))
    repeated = np.sqrt(_dependence(keyframes_s, radius / speed))
    sigma = repeated[:, None] * np.repeat([radius, speed], 3)
    ones = np.ones(len(k), dtype=int)
    return Rows("motion", "bounded", k, k, z, np.zeros((len(k), 0)), sigma, slice(0, 0), ones)


def _group(k: np.ndarray, values: Floats) -> tuple[np.ndarray, Floats, np.ndarray]:
    """Distinct keyframes, mean of ``values`` (n, m) at each, and how many."""
    used, inverse, count = np.unique(k, return_inverse=True, return_counts=True)
    total = np.zeros((len(used), values.shape[1]))
    np.add.at(total, inverse, values)
    return used, total / count[:, None], count


def _dependence(keyframes_s: Floats, correlation_s: float) -> Floats:
    """Factor on the variance at each keyframe (n,) with which rows taken as independent weigh no more than an error of
    that correlation time: 2 tau / interval, the density of a first-order Gauss-Markov process at low frequency."""
    if len(keyframes_s) < 2:
        return np.ones(len(keyframes_s))
    return np.maximum(1.0, 2.0 * correlation_s / np.gradient(keyframes_s))


def _running_mean(values: Floats, count: int) -> Floats:
    """Mean of ``count`` samples centred on each; fewer at the ends."""
    window = np.ones(min(max(count, 1), len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")


def _cumulative(values: Floats) -> Floats:
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


def _interpolate(x: Floats, values: Floats, at: Floats) -> Floats:
    """Linear interpolation of (n, ...) values."""
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    share = ((at - x[k]) / (x[k + 1] - x[k])).reshape(-1, *(1,) * (values.ndim - 1))
    return values[k] + share * (values[k + 1] - values[k])
