"""LiDAR scans to measured steps: odometry once per log, and the rows that tie its poses to the keyframes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from tbmfg.inertial.steps import Steps, to_ns
from tbmfg.lidar import clouds
from tbmfg.lidar.motion import Inertia
from tbmfg.lidar.odometry import Odometry, Pose
from tbmfg.measure import Samples, nearest
from tbmfg.prepare import turning
from tbmfg.prepare.samples import hidden
from tbmfg.prepare.start import Setup
from tbmfg.rig import Lidar, Odometer, Rig, kind_of
from tbmfg.sensors import Rows
from tbmfg.state import Health, Interval
from tbmfg.timeseries import Floats, Log, seconds

CARRIED_S = 0.5  # longest time that the IMU carries a keyframe to a scan
WORTH_SAYING = 0.05  # share of the scans from which a fault is a warning
DUSTY = 0.4  # share of the nearer points without a plane from which dust is said


def present(log: Log, rig: Rig, without: tuple[str, ...]) -> list[str]:
    """The LiDARs that there are scans of and that are not to be left out."""
    return [name for name, s in rig.sensors.items() if kind_of(name) == "lidar" and name not in without
            and s.topic in log.clouds]  # fmt: skip


def register(
    log: Log, name: str, setup: Setup, outages: tuple[tuple[str, float, float], ...], tell: Callable[[float], None]
) -> None:
    """Register the scans of the LiDAR ``name`` on a map, and put its poses (n, 48) among the samples of ``setup``: R,
    p, and the square root of the information of the step from the pose before. Scans are read one by one, and can be
    read again from ``setup.scans``; what they lacked, where they did not fit, and whether they turn as the gyro does is
    put beside."""
    sensor: Lidar = setup.rig.sensors[name]
    source, steps = log.clouds[sensor.topic], setup.steps
    stamps_s = seconds(source.t_ns, steps.t0_ns) - sensor.clock_offset
    out = hidden(name, stamps_s + sensor.clock_offset, outages)
    inside = (stamps_s >= steps.edges_s[0]) & (stamps_s <= steps.end_s)
    period_s = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 0.1
    setup.scans[name] = scans = clouds.Scans(sensor, source, stamps_s, inside & ~out, period_s)
    odometry = Odometry(sensor, Inertia(steps.edges_s, setup.frame.R_0t, _way(setup), sensor.T_bl.R, sensor.T_bl.xyz))
    points, faults, few, poses = Counter(), Counter(), 0, []
    for k, (start_s, scan) in enumerate(scans):
        if k % 50 == 0:
            tell(k / len(scans))
        points.update(
            taken=len(scan.points), nonfinite=scan.nonfinite, zero=scan.zero, beyond=scan.beyond, astray=scan.astray
        )
        faults.update([scan.fault] if scan.fault else [])
        pose = odometry.register(scan, start_s)
        few += pose is None
        poses += [pose] if pose is not None and pose.t_s <= steps.end_s else []
    setup.counts[name].outage = int(out.sum())
    for what, number in (("hold too few points, or repeat a time", few), *faults.items()):
        if number > WORTH_SAYING * len(scans):
            setup.warnings.append(f"{name}: {number} of {len(scans)} scans: {what}")
    setup.warnings += [f"{name}: {line}" for line in (*_of_points(points, sensor), *_of_poses(poses, odometry))]
    setup.intervals += [
        Interval(name, "lost", *(int(t) for t in to_ns(steps, np.array(ends)))) for ends in _astray(poses)
    ]
    if poses:
        setup.health[name] = _health(poses, steps)
    placed = [pose for pose in poses if pose.placed]
    if len(placed) < 2:
        setup.warnings.append(f"{name}: {len(placed)} of {len(source)} scans can be registered; it is not used")
        return
    values = np.array([np.concatenate([pose.R.ravel(), pose.p, pose.root.ravel()]) for pose in placed])
    setup.samples[name] = Samples(name, np.array([pose.t_s for pose in placed]), values)
    found = turning.against_gyro(sensor, setup.samples[name], setup.frame)
    if found is not None:
        setup.calibration |= turning.calibrations(name, sensor, found)
        setup.warnings += [f"{name}: {line}" for line in turning.contradictions(name, sensor, found)]
        setup.intervals += turning.since_steps(name, found, steps)


def _of_points(points: Counter, sensor: Lidar) -> list[str]:
    """What was left out of the scans."""
    total = points.total()
    if total - points["taken"] <= WORTH_SAYING * total:
        return []
    parts = {
        "not finite": points["nonfinite"],
        "at zero": points["zero"],
        f"nearer than {sensor.min_range:g} or farther than {sensor.max_range:g} m": points["beyond"],
        "with times periods from the others'": points["astray"],
    }
    said = ", ".join(f"{number / total:.0%} {what}" for what, number in parts.items() if number)
    return [f"of its {total} points {said}; left out"]


def _of_poses(poses: list[Pose], odometry: Odometry) -> list[str]:
    """Where the scans did not fit, what the walls do not tell, and dust."""
    lines, count = [], len(poses)
    astray = [pose for pose in poses if not pose.healthy]
    if astray:
        lines.append(
            f"{len(astray)} of {count} scans do not fit the map as scans usually do, the first at {astray[0].t_s:.1f} s"
            f"; no step into them is used, and {odometry.restarts} times the map was begun anew"
        )
    untold = sum(pose.weak > 0 for pose in poses if pose.healthy)
    if untold > WORTH_SAYING * count:
        lines.append(f"in {untold} of {count} scans the walls leave a direction untold: there the others must tell it")
    dusty = sum(pose.dust > DUSTY for pose in poses)
    if dusty > WORTH_SAYING * count:
        lines.append(f"dust: in {dusty} of {count} scans over {DUSTY:.0%} of the nearer points hang in the air")
    return lines


def _health(poses: list[Pose], steps: Steps) -> Health:
    """What the registration tells of every scan."""
    parts = ("t_s", "overlap", "sigma", "weak", "dust", "healthy")
    t_s, *told = (np.array([getattr(pose, part) for pose in poses]) for part in parts)
    return Health(to_ns(steps, t_s), *told)


def _astray(poses: list[Pose]) -> list[tuple[float, float]]:
    """Stretches of scans that do not fit the map, s: from the last that did to the last that did not."""
    stretches: list[tuple[float, float]] = []
    for before, pose in pairwise(poses):
        if pose.healthy:
            continue
        if stretches and stretches[-1][1] == before.t_s:
            stretches[-1] = stretches[-1][0], pose.t_s
        else:
            stretches.append((before.t_s, pose.t_s))
    return stretches


def _way(setup: Setup) -> Floats | None:
    """Way of b in the gyro's frame by the first odometer, (n + 1, 3) at the edges; None without one."""
    for name, speeds in setup.samples.items():
        sensor = setup.rig.sensors[name]
        if isinstance(sensor, Odometer):
            speed = np.interp(setup.steps.edges_s[:-1], speeds.t_s - sensor.clock_offset, speeds.values)
            ahead = setup.frame.R_0t[:-1] @ sensor.ahead
            step = ahead * (speed / (1.0 + sensor.scale) * setup.steps.dt)[:, None]
            contact = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
            return contact - setup.frame.R_0t @ sensor.arm
    return None


def lidar_rows(sensor: Lidar, poses: Samples, keyframes_s: Floats, setup: Setup, calib: slice) -> Rows:
    """Steps from scan to scan, each between the keyframe of its scan and the one before that.

    The earlier scan is then carried from its keyframe, which need not be its own, by the IMU over some hundredths of a
    second. Steps that tell nothing, or are too long for that, are left out.
    """
    t, R, p = poses.t_s, poses.values[:, :9].reshape(-1, 3, 3), poses.values[:, 9:12]
    roots = poses.values[:, 12:].reshape(-1, 6, 6)
    j = nearest(keyframes_s, t[1:])
    i = np.maximum(j - 1, 0)
    far = np.maximum(np.abs(t[:-1] - keyframes_s[i]), np.abs(t[1:] - keyframes_s[j]))
    told = np.flatnonzero((j > 0) & (far <= CARRIED_S) & roots[1:].any(axis=(1, 2)))
    i, j = i[told], j[told]
    before = R[told].swapaxes(1, 2)
    step = (before @ (p[told + 1] - p[told])[:, :, None])[:, :, 0]
    z = np.hstack([(before @ R[told + 1]).reshape(-1, 9), step])
    sway = _sway(setup)
    data = np.hstack(
        [
            _carried(setup, sway, keyframes_s[i], t[told]),
            _carried(setup, sway, keyframes_s[j], t[told + 1]),
            np.tile(sensor.T_bl.R.ravel(), (len(told), 1)),
            roots[told + 1].reshape(-1, 36),
        ]
    )
    ones = np.ones(len(told), dtype=int)
    sigma = np.full((len(told), 6), sensor.times)
    return Rows(poses.sensor, "lidar", i, j, z, data, sigma, calib, ones, sensor.loss)


def _sway(setup: Setup) -> tuple[Floats, Floats]:
    """Velocity and position by the accelerometers alone in the gyro's frame, (n + 1, 3) each: only differences over
    fractions of a second mean something."""
    dt = setup.steps.dt[:, None]
    force = (setup.frame.R_0t[:-1] @ setup.acc[:, :, None])[:, :, 0]
    gravity = setup.R_start.T @ [0.0, 0.0, -setup.rig.origin.gravity]
    velocity = np.concatenate([np.zeros((1, 3)), np.cumsum((force + gravity) * dt, axis=0)])
    middle = 0.5 * (velocity[1:] + velocity[:-1])
    return velocity, np.concatenate([np.zeros((1, 3)), np.cumsum(middle * dt, axis=0)])


def _carried(setup: Setup, sway: tuple[Floats, Floats], start_s: Floats, end_s: Floats) -> Floats:
    """dt, s and C of the model ``lidar`` from keyframes to scans, (n, 13)."""
    edges = setup.steps.edges_s
    velocity, position = (
        [np.stack([np.interp(t, edges, part[:, a]) for a in range(3)], axis=1) for t in (start_s, end_s)]
        for part in sway
    )
    dt = end_s - start_s
    R, R_end = setup.frame.at(start_s).swapaxes(1, 2), setup.frame.at(end_s)
    s = (R @ (position[1] - position[0] - velocity[0] * dt[:, None])[:, :, None])[:, :, 0]
    return np.hstack([dt[:, None], s, (R @ R_end).reshape(-1, 9)])
