"""The commands that estimate one log: run, compare."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tbmfg.cli.options import Force, Log, Name, Names, Output, command, known, selection, split_names
from tbmfg.cli.terminal import Terminal, number


@command(options=selection)
def run(
    log: Log,
    output: Output,
    options: dict[str, Any],
    out: Terminal,
    estimator: Name = "batch",
    report: Annotated[bool, typer.Option("--report", help="Write report.html too.")] = False,
    into: Annotated[
        str | None, typer.Option(metavar="FILE", help="Copy the log to this .mcap, the poses among its messages.")
    ] = None,
    force: Force = False,
) -> None:
    """Estimate the trajectory of one log and write it to a folder.

    \b
    Examples:
      tbmfg run drive.mcap -o out                        with the rig in the log, else a guess
      tbmfg run drive.mcap --rig tbm --report -o out2    with a shipped rig, and report.html
      tbmfg run drive.mcap --estimator ins --without magnetometer -o out3
      tbmfg run drive.mcap --outage prism:40:50 --set sensors.prism.sigma_mm=5 -o out4
      tbmfg run drive.mcap --json -o out5 | jq .calibration
    """
    known([estimator], "--estimator")
    from tbmfg import pipeline

    with out.progress("reading") as progress:
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
    out.data(summary)
    _print_summary(out, summary, output)


@command(options=selection)
def compare(
    log: Log,
    output: Output,
    options: dict[str, Any],
    out: Terminal,
    estimators: Names = "batch,fixed-lag,ins",
    force: Force = False,
) -> None:
    """Run several estimators on one prepared log, side by side.

    \b
    Examples:
      tbmfg compare drive.mcap -o out                    then open out/report.html
      tbmfg compare drive.mcap --estimators batch,tbm-ins-ts --truth /truth/pose -o out2
      tbmfg compare drive.mcap --outage prism:40:50 --outage prism:70:80 -o out3
    """
    names = split_names(estimators)
    known(names, "--estimators")
    from tbmfg import pipeline

    with out.progress("reading") as progress:
        summaries = pipeline.compare(log, estimators=names, output=output, force=force, progress=progress, **options)
    out.data(summaries)
    _print_comparison(out, summaries, output)


def _print_summary(out: Terminal, summary: dict[str, Any], output: str) -> None:
    from tbmfg.comparison import told

    out.say(
        f"{summary['estimator']}: {summary['keyframes']} keyframes over {summary['duration_s']:.1f} s"
        f" in {summary['wall_s']:.1f} s ({summary['realtime_factor']:.1f} x real time)"
    )
    calibration = [
        (
            name,
            number(value["value"]),
            number(value["sd"]) if value["estimated"] else "not estimated",
            " ".join(told(value)),
        )
        for name, value in summary["calibration"].items()
    ]
    out.table(["calibration", "value", "sd", "told by the log"], calibration)
    counted = ["received", "used"] + [
        part
        for part in ("gated", "late", "duplicate", "nonfinite", "outage", "unused")
        if any(counts[part] for counts in summary["sensors"].values())
    ]
    sensors = [(name, *(str(counts[part]) for part in counted)) for name, counts in summary["sensors"].items()]
    out.table(["sensor", *counted], sensors, justify="right")
    if deviation := summary.get("deviation"):
        spent = ", ".join(f"{level} {duration:.1f} s" for level, duration in deviation["level_s"].items())
        last = deviation["timeline"][-1]
        out.say(f"deviation: {spent}; at the end {last['direction']}, {last['level']}")
    for key in ("metrics", "metrics_smoothed"):
        metrics = summary.get(key) or {}
        known = [(name, number(value)) for name, value in metrics.items() if value is not None]
        out.table([f"{key} against {summary['truth']}", ""], known)
    _print_warnings(out, summary["log"], summary["warnings"])
    out.say(f"results: {output}")


def _print_comparison(out: Terminal, summaries: dict[str, dict[str, Any]], output: str) -> None:
    """One row per trajectory: an online solver has a causal one and its last estimates."""
    from tbmfg import comparison
    from tbmfg.results import REPORT

    ran, rows = comparison.ran(summaries), comparison.rows(summaries)
    first = next(iter(ran.values()))
    out.say(f"{first['log']}: {first['keyframes']} keyframes over {first['duration_s']:.1f} s, rig {first['rig']}")
    columns = comparison.columns(rows)
    out.table(
        ["estimator", *(column.title for column in columns), "own time s"],
        [(row.label, *(number(column.of(row.metrics)) for column in columns), f"{row.own_s:.2f}") for row in rows],
        justify="right",
    )
    if first["metrics"] is not None:
        out.say(f"against {first['truth']}; NEES of a consistent estimator: {first['metrics']['nees_dof']}")
        if any(column.key.endswith("_over_bound") for column in columns):
            out.say("bound: Cramer-Rao, from the whole log for batch and (last), from the past alone for the others")
    names = dict.fromkeys(name for summary in ran.values() for name in summary["calibration"])
    verdicts = [
        (name, *(" ".join(comparison.told(summary["calibration"].get(name))) for summary in ran.values()))
        for name in names
    ]
    out.table(["told by the log", *ran], [row for row in verdicts if {*row[1:]} != {"-"}])
    out.say(f"reading and preparing, once for all: {first['shared_s']:.2f} s")
    for name, why in comparison.not_run(summaries).items():
        out.say(f"{name} not run: {why}")
    told = comparison.together((name, line) for name, summary in ran.items() for line in summary["warnings"])
    lines = [line if len(names) == len(ran) else f"{', '.join(names)}: {line}" for line, names in told.items()]
    _print_warnings(out, first["log"], lines)
    out.say(f"results: {output}, to read: {output}/{REPORT}")


def _print_warnings(out: Terminal, log: str, lines: list[str]) -> None:
    """What was assumed where nobody said, then what is wrong."""
    assumed = [line for line in lines if line.startswith(("assumed ", "not used: "))]
    for line in assumed:
        out.say(line)
    if any(line.startswith("assumed sensors.") for line in assumed):
        out.say(f"to have this in a file and correct it: tbmfg init {log} -o rig.yaml")
    for line in lines:
        if line not in assumed:
            out.warn(line)
