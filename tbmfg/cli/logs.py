"""The commands beside an estimate: info and init before it, map after it, and what estimators there are."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from tbmfg.cli.options import Log, RigName, command
from tbmfg.cli.terminal import Terminal, number


@command()
def info(
    log: Log,
    out: Terminal,
    allan: Annotated[
        bool, typer.Option("--allan", help="Noise of the IMU by Allan variance over its longest standstill.")
    ] = False,
    rig: Annotated[str | None, RigName] = None,
) -> None:
    """Topics, roles, rates, gaps and clock problems of a log.

    \b
    Examples:
      tbmfg info drive.mcap
      tbmfg info standing.mcap --allan --rig tbm        noise of the IMU beside what the rig says
      tbmfg info drive.mcap --json | jq '.topics[].rate_hz'
    """
    from tbmfg.mcap import describe, info_text

    with out.progress("reading") as progress:
        about = describe(log, progress=(lambda share: progress("reading", share)) if progress else None)
    out.say(info_text(about))
    noise = _allan(log, rig) if allan else None
    if noise is not None:
        _print_allan(out, noise)
    out.data(asdict(about) | ({"allan": noise} if noise is not None else {}))


@command()
def init(
    log: Log,
    out: Terminal,
    output: Annotated[str, typer.Option("--output", "-o", metavar="FILE", help="The rig file to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write a starter rig for a log, and say what was guessed.

    \b
    Examples:
      tbmfg init drive.mcap -o rig.yaml                 edit what is marked GUESSED, then
      tbmfg run drive.mcap --rig rig.yaml -o out
    """
    from tbmfg import pipeline

    assumed = pipeline.init(log, output, force=force)
    for line in assumed:
        out.say(line)
    out.say(f"rig: {output}")
    out.data({"rig": output, "assumed": assumed})


@command()
def map_(
    log: Log,
    out: Terminal,
    trajectory: Annotated[str, typer.Option(metavar="DIR", help="Folder of a result of `tbmfg run`.")],
    output: Annotated[str, typer.Option("--output", "-o", metavar="FILE", help="The .ply or .pcd to write.")],
    lidar: Annotated[str | None, typer.Option(metavar="NAME", help="Which LiDAR of the rig; else the first.")] = None,
    keep_air: Annotated[bool, typer.Option("--keep-air", help="Leave no return out, not even dust.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing map.")] = False,
) -> None:
    """Make the map of a log's scans along a result, and its picture.

    \b
    Examples:
      tbmfg map drive.mcap --trajectory out -o map.ply
    """
    from tbmfg import mapping

    with out.progress("mapping") as progress:
        made = mapping.make(log, trajectory, output, lidar=lidar, keep_air=keep_air, force=force, progress=progress)
    picture = str(Path(output).with_suffix(".png"))
    points, sharp = len(made.points), made.sharpness
    if not keep_air:
        out.say(f"{made.in_air} of {made.returns} returns ({made.in_air / made.returns:.1%}) hang in the air, as dust")
        out.say("does: most rays through their place went on; they are left out")
    if not sharp.voxels:
        out.say(
            f"{points} points; too thin to judge how sharp it is: no voxel of {mapping.THICK_M:g} m holds a surface"
        )
    else:
        out.say(f"{points} points; surfaces are {1e3 * sharp.thickness_m:.1f} mm thick (median of {sharp.voxels}")
        out.say(f"voxels of {mapping.THICK_M:g} m), mean map entropy {sharp.entropy:.2f}")
    out.say(f"map: {output}, picture: {picture}; made along {trajectory}/{made.along}.npz")
    out.data(
        {"map": output, "picture": picture, "points": points, "returns": made.returns, "in_air": made.in_air}
        | {"along": made.along}
        | (asdict(sharp))
    )


@command()
def estimators(out: Terminal) -> None:
    """The estimators: what each needs, and where it is from.

    \b
    Examples:
      tbmfg estimators
      tbmfg estimators --json | jq keys
    """
    from tbmfg.estimators import ESTIMATORS

    out.table(
        ["name", "", "needs", "source"],
        [(name, e.summary, ", ".join(e.needs), e.source) for name, e in ESTIMATORS.items()],
    )
    out.data({name: {"summary": e.summary, "needs": e.needs, "source": e.source} for name, e in ESTIMATORS.items()})


def _allan(log: str, rig: str | None) -> dict[str, Any]:
    """What the standing IMU shows of its noise, beside what the rig says of it."""
    from tbmfg import pipeline
    from tbmfg.inertial.allan import against_rig

    found, imu = pipeline.allan(log, rig)
    noise = {name: {"found": value, "sd": sd, "rig": said} for name, value, sd, said in against_rig(found, imu)}
    return {"start_s": found.start_s, "end_s": found.end_s, "noise": noise}


def _print_allan(out: Terminal, allan: dict[str, Any]) -> None:
    out.say(f"\nAllan variance, standing from {allan['start_s']:.1f} to {allan['end_s']:.1f} s")
    rows = [
        (name, "not seen" if one["found"] is None else number(one["found"]), number(one["sd"]), number(one["rig"]))
        for name, one in allan["noise"].items()
    ]
    out.table(["", "found", "sd", "rig"], rows, justify="right")
