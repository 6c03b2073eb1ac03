"""The commands that estimate one log: run, compare."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tbmfg.cli.options import Debug, Force, Log, Names, Output, known, split_names, with_selection
from tbmfg.cli.terminal import errors_in_one_line, number, print_table, progress_bar


@with_selection
def run(
    log: Log,
    output: Output,
    options: dict[str, Any],
    estimator: Annotated[str, typer.Option(metavar="NAME", help="See `tbmfg estimators`.")] = "batch",
    report: Annotated[bool, typer.Option("--report", help="Write report.html too.")] = False,
    into: Annotated[
        str | None, typer.Option(metavar="FILE", help="Copy the log to this .mcap, the poses among its messages.")
    ] = None,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Estimate the trajectory of one log and write it to a folder."""
    known([estimator], "--estimator")
    with errors_in_one_line(debug):
        from tbmfg import pipeline

        with progress_bar("reading") as progress:
            summary = pipeline.run(
                log,
                estimator=estimator,
                output=output,
                report=report,
                into=into,
                force=force,
                progress=progress,
                **options,
            )
        _print_summary(summary, output)


@with_selection
def compare(
    log: Log,
    output: Output,
    options: dict[str, Any],
    estimators: Names = "batch,fixed-lag,ins",
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Run several estimators on one prepared log, side by side."""
    names = split_names(estimators)
    known(names, "--estimators")
    with errors_in_one_line(debug):
        from tbmfg import pipeline

        with progress_bar("reading") as progress:
            summaries = pipeline.compare(
                log, estimators=names, output=output, force=force, progress=progress, **options
            )
        _print_comparison(summaries, output)


def _print_summary(summary: dict[str, Any], output: str) -> None:
    typer.echo(
        f"{summary['estimator']}: {summary['keyframes']} keyframes over {summary['duration_s']:.1f} s"
        f" in {summary['wall_s']:.1f} s ({summary['realtime_factor']:.1f} x real time)"
    )
    calibration = [
        (name, number(value["value"]), number(value["sd"]) if value["estimated"] else "not estimated")
        for name, value in summary["calibration"].items()
    ]
    print_table(["calibration", "value", "sd"], calibration)
    counted = ["received", "used"] + [
        part
        for part in ("gated", "late", "duplicate", "nonfinite", "outage", "unused")
        if any(counts[part] for counts in summary["sensors"].values())
    ]
    sensors = [(name, *(str(counts[part]) for part in counted)) for name, counts in summary["sensors"].items()]
    print_table(["sensor", *counted], sensors, justify="right")
    if deviation := summary.get("deviation"):
        spent = ", ".join(f"{level} {duration:.1f} s" for level, duration in deviation["level_s"].items())
        last = deviation["timeline"][-1]
        typer.echo(f"deviation: {spent}; at the end {last['direction']}, {last['level']}")
    for key in ("metrics", "metrics_smoothed"):
        metrics = summary.get(key) or {}
        known = [(name, number(value)) for name, value in metrics.items() if value is not None]
        print_table([f"{key} against {summary['truth']}", ""], known)
    for warning in summary["warnings"]:
        typer.echo(f"warning: {warning}")
    typer.echo(f"results: {output}")


def _print_comparison(summaries: dict[str, dict[str, Any]], output: str) -> None:
    """One row per trajectory: an online solver has a causal one and its last estimates."""
    from tbmfg import comparison
    from tbmfg.results import REPORT

    ran, rows = comparison.ran(summaries), comparison.rows(summaries)
    first = next(iter(ran.values()))
    typer.echo(f"{first['log']}: {first['keyframes']} keyframes over {first['duration_s']:.1f} s, rig {first['rig']}")
    columns = comparison.columns(rows)
    print_table(
        ["estimator", *(column.title for column in columns), "own time s"],
        [(row.label, *(number(column.of(row.metrics)) for column in columns), f"{row.own_s:.2f}") for row in rows],
        justify="right",
    )
    if first["metrics"] is not None:
        typer.echo(f"against {first['truth']}; NEES of a consistent estimator: {first['metrics']['nees_dof']}")
        if any(column.key.endswith("_over_bound") for column in columns):
            typer.echo("bound: Cramer-Rao, from the whole log for batch and (last), from the past alone for the others")
    typer.echo(f"reading and preparing, once for all: {first['shared_s']:.2f} s")
    for name, why in comparison.not_run(summaries).items():
        typer.echo(f"{name} not run: {why}")
    for warning in dict.fromkeys(warning for summary in ran.values() for warning in summary["warnings"]):
        typer.echo(f"warning: {warning}")
    typer.echo(f"results: {output}, to read: {output}/{REPORT}")
