"""Where the machine was: plan, profile, space, and its states over time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from tbmfg.report.content import Report, deviations
from tbmfg.report.panels import (
    BLACK,
    SIGMAS,
    TIME,
    Figure,
    Pen,
    add_band,
    add_line,
    axis,
    layout,
    point_of_truth,
    stacked,
)
from tbmfg.report.thin import broken, extremes, packed, segments
from tbmfg.timeseries import Floats

TRUTH = Pen("truth", "truth", BLACK, "solid", 0, 1.2)
WIDTH_PX = 940  # of the area that a plan fills
MAP_POINTS = 60_000  # of a map, more than this many are drawn no better
STEEP = np.deg2rad(60.0)  # pitch from which roll and yaw say little
THINNEST = 0.35  # side of the box that a path in space is shown in, of 1.7 for the longest
FAR = 1000.0  # coordinates this much larger than the path are shown less a round number


def plan(report: Report, pen: dict[str, Pen]) -> Figure:
    """The path from above, in equal scales."""
    figure = Figure("Plan", "The path seen from above, in equal scales.")
    across, up = np.ptp(report.tracks[0].path.position_n[:, :2], axis=0)
    height = int(np.clip(WIDTH_PX * up / max(across, up, 1e-9), 220, 620)) + 110
    figure.layout = layout(
        height,
        xaxis=axis("x of n, m", constrain="domain"),
        yaxis=axis("y of n, m", scaleanchor="x", constrain="domain"),
    )
    _paths(report, pen, figure, lambda position_n: position_n[:, :2])
    return figure


def section(report: Report, pen: dict[str, Pen]) -> Figure:
    """Height over the distance along the path's main horizontal direction."""
    first = report.tracks[0].path.position_n
    centre = first[:, :2].mean(axis=0)
    main = np.linalg.svd(first[:, :2] - centre, full_matrices=False)[2][0]
    main = main * (1 if main @ (first[-1, :2] - first[0, :2]) >= 0 else -1)
    start = first[0, :2] @ main
    direction = np.rad2deg(np.arctan2(main[1], main[0]))
    figure = Figure(
        "Profile",
        f"The path seen from the side: height over the distance from the start along {direction:.0f}° from x "
        "(counter-clockwise), the way it mainly runs. The two scales differ.",
    )
    figure.layout = layout(330, xaxis=axis("along the main direction, m"), yaxis=axis("z of n, m"))
    _paths(report, pen, figure, lambda p: np.column_stack([p[:, :2] @ main - start, p[:, 2]]))
    return figure


def _paths(report: Report, pen: dict[str, Pen], figure: Figure, project: Callable[[Floats], Floats]) -> None:
    """Every trajectory, and the truth, in the plane of ``project``."""
    curves = [(pen[track.label], track.path.t_ns, track.path.position_n) for track in report.tracks]
    if report.truth is not None:
        curves.append((TRUTH, report.truth.t_ns, report.truth.position_n))
        if report.truth.arm_b.any():
            figure.caption += f" {point_of_truth(report.truth)}"
    for one, t_ns, position_n in reversed(curves):  # the first lies on top
        points = project(position_n)
        rows = extremes(points)
        figure.thinned(len(points), len(rows))
        x, y = broken(segments((t_ns - report.t0_ns) * 1e-9)[rows], *points[rows].T)
        figure.data.append(
            {
                "type": "scatter", "mode": "lines", "name": one.name, "legendgroup": one.group, "line": one.line(),
                "x": packed(x), "y": packed(y), "hovertemplate": "%{x:.3f}, %{y:.3f} m", "legendrank": one.rank,
            }
        )  # fmt: skip
    _ends(report, figure, project)


def _ends(report: Report, figure: Figure, project: Callable[[Floats], Floats]) -> None:
    """Marks where the first trajectory begins and ends."""
    ends = project(report.tracks[0].path.position_n)[[0, -1]]
    for name, symbol, at in zip(("start", "end"), ("circle", "square"), ends, strict=True):
        marker = {"symbol": symbol, "size": 10, "color": "#ffffff", "line": {"color": BLACK, "width": 1.8}}
        figure.data.append(
            {
                "type": "scatter", "mode": "markers", "name": name, "x": packed(at[:1]), "y": packed(at[1:]),
                "hovertemplate": f"{name}: %{{x:.3f}}, %{{y:.3f}} m", "marker": marker, "cliponaxis": False,
                "legendrank": 2000,
            }
        )  # fmt: skip


def space(report: Report, pen: dict[str, Pen]) -> Figure:
    """The path in three dimensions, with the map where there is one."""
    figure = Figure("In space", "Drag to turn, scroll to zoom.")
    middle = report.tracks[0].path.position_n.mean(axis=0)
    shift = np.where(np.abs(middle) > FAR, np.round(middle, -2), 0.0)
    if report.map_n is not None:
        every = -(-len(report.map_n) // MAP_POINTS)
        points = report.map_n[::every] - shift
        share = f"; one in {every} of its {len(report.map_n)} points is drawn" if every > 1 else ""
        figure.caption += f" Grey: {report.map_label}{share}."
        marker = {"size": 1.2, "color": "#9a9a9a"}
        figure.data.append(_spatial(points) | {"mode": "markers", "marker": marker, "name": "map", "hoverinfo": "skip"})
    curves = [(pen[track.label], track.path.position_n) for track in report.tracks]
    if report.truth is not None:
        curves.append((TRUTH, report.truth.position_n))
    for one, position_n in reversed(curves):
        rows = extremes(position_n)
        figure.thinned(len(position_n), len(rows))
        # lines of WebGL know no long dashes
        line = {"color": one.colour, "width": 4, "dash": "dot" if one.dash == "dot" else "solid"}
        figure.data.append(
            _spatial(position_n[rows] - shift)
            | {"mode": "lines", "line": line, "name": one.name}
            | {"legendrank": one.rank}
        )
    titles = [f"{name}{f' − {s:.0f}' if s else ''}, m" for name, s in zip("xyz", shift, strict=True)]
    scene = {f"{name}axis": axis(title) for name, title in zip("xyz", titles, strict=True)}
    drawn = report.tracks[0].path.position_n if report.map_n is None else report.map_n
    size = np.ptp(drawn, axis=0)
    ratio = np.maximum(1.7 * size / max(size.max(), 1e-9), THINNEST)
    if (ratio <= THINNEST).any():
        figure.caption += " Not in equal scales: what is flat or narrow is stretched."
    scene |= {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True))}
    figure.layout = layout(
        560, scene={**scene, "camera": {"eye": {"x": 1.15, "y": -1.85, "z": 1.05}, "center": {"z": -0.15}}}
    )
    figure.layout["margin"] = {"l": 0, "r": 0, "t": 45, "b": 0}
    return figure


def _spatial(points: Floats) -> dict:
    return {"type": "scatter3d", **{name: packed(column) for name, column in zip("xyz", points.T, strict=True)}}


def states(report: Report, pen: dict[str, Pen]) -> Figure:
    """Position and attitude with their bands."""
    levelled = Rotation.from_quat(report.tracks[0].path.quat_xyzw[:1])
    pitch = np.abs(levelled.as_euler("ZYX")[0, 1])
    relative = pitch > STEEP
    turned = "roll, pitch and yaw against the first attitude, about its axes" if relative else "roll, pitch and yaw"
    figure = Figure(
        "Position and attitude",
        f"Position in n and {turned}, with ± 3 sigma: bands thinner than a line are not to be seen here.",
    )
    figure.layout = stacked(["x, m", "y, m", "z, m", "roll, deg", "pitch, deg", "yaw, deg"], TIME, 125)
    for track in reversed(report.tracks):
        t_s = (track.path.t_ns - report.t0_ns) * 1e-9
        attitude = Rotation.from_quat(track.path.quat_xyzw)
        if relative:
            attitude = levelled[0].inv() * attitude
        angles = attitude.as_euler("ZYX")[:, ::-1]
        rates = angle_rates(angles)
        angle_cov = rates @ track.path.cov[:, :3, :3] @ rates.transpose(0, 2, 1)
        values = np.hstack([track.path.position_n, np.rad2deg(np.unwrap(angles, axis=0))])
        half = SIGMAS * np.hstack([track.position_sd(), np.rad2deg(deviations(angle_cov))])
        for panel in range(6):
            add_band(figure, pen[track.label], t_s, values[:, panel], half[:, panel], panel)
            add_line(figure, pen[track.label], t_s, values[:, panel], panel, shown=panel == 0)
    return figure


def angle_rates(angles: Floats) -> Floats:
    """How roll, pitch and yaw (n, 3) rad change with a small turn about the body's axes, (n, 3, 3): Groves (2013)
    eq. 2.58. Undefined at 90 deg of pitch, where it is cut off."""
    roll, pitch = angles[:, 0], angles[:, 1]
    sin, cos = np.sin(roll), np.cos(roll)
    cos_pitch = np.maximum(np.cos(pitch), 1e-3)
    out = np.zeros((len(angles), 3, 3))
    out[:, 0, 0] = 1.0
    out[:, 0, 1], out[:, 0, 2] = sin * np.tan(pitch), cos * np.tan(pitch)
    out[:, 1, 1], out[:, 1, 2] = cos, -sin
    out[:, 2, 1], out[:, 2, 2] = sin / cos_pitch, cos / cos_pitch
    return out
