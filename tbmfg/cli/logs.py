"""The commands beside an estimate: info and init before it, map after it, and what estimators there are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tbmfg.cli.options import Debug, Log
from tbmfg.cli.terminal import errors_in_one_line, number, print_table, progress_bar


def info(
    log: Log,
    allan: Annotated[
        bool, typer.Option("--allan", help="Noise of the IMU by Allan variance over its longest standstill.")
    ] = False,
    rig: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Of --allan: else the log's rig, else a guess.")
    ] = None,
    debug: Debug = False,
) -> None:
    """Topics, roles, rates, gaps and clock problems of a log."""
    with errors_in_one_line(debug):
        from tbmfg.mcap import info_text

        typer.echo(info_text(log))
        if allan:
            _print_allan(log, rig)


def init(
    log: Log,
    output: Annotated[str, typer.Option("--output", "-o", metavar="FILE", help="The rig file to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    debug: Debug = False,
) -> None:
    """Write a starter rig for a log: what it shows, and what had to be guessed."""
    with errors_in_one_line(debug):
        from tbmfg import pipeline

        for line in pipeline.init(log, output, force=force):
            typer.echo(line)
        typer.echo(f"rig: {output}")


def map_(
    log: Log,
    trajectory: Annotated[str, typer.Option(metavar="DIR", help="Folder of a result of `tbmfg run`.")],
    output: Annotated[str, typer.Option("--output", "-o", metavar="FILE", help="The .ply or .pcd to write.")],
    lidar: Annotated[str | None, typer.Option(metavar="NAME", help="Which LiDAR of the rig; else the first.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing map.")] = False,
    debug: Debug = False,
) -> None:
    """Make the map of a log's LiDAR scans along an estimated trajectory, and a picture of it."""
    with errors_in_one_line(debug):
        from tbmfg import mapping

        with progress_bar("mapping") as progress:
            sharp, points = mapping.make(log, trajectory, output, lidar=lidar, force=force, progress=progress)
        typer.echo(f"{points} points; surfaces are {1e3 * sharp.thickness_m:.1f} mm thick (median of {sharp.voxels}")
        typer.echo(f"voxels of {mapping.THICK_M:g} m), mean map entropy {sharp.entropy:.2f}")
        typer.echo(f"map: {output}, picture: {Path(output).with_suffix('.png')}")


def estimators(debug: Debug = False) -> None:
    """The estimators: what each needs, and where it is from."""
    with errors_in_one_line(debug):
        from tbmfg.estimators import ESTIMATORS

        rows = [(name, e.summary, ", ".join(e.needs), e.source) for name, e in ESTIMATORS.items()]
        print_table(["name", "", "needs", "source"], rows)


def _print_allan(log: str, rig: str | None) -> None:
    """What the standing IMU shows of its noise, beside what the rig says of it."""
    from tbmfg import pipeline
    from tbmfg.inertial.allan import against_rig

    found, imu = pipeline.allan(log, rig)
    typer.echo(f"\nAllan variance, standing from {found.start_s:.1f} to {found.end_s:.1f} s")
    rows = [
        (name, "not seen" if value is None else number(value), number(said))
        for name, value, said in against_rig(found, imu)
    ]
    print_table(["", "found", "rig"], rows, justify="right")
