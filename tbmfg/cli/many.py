"""The command for many logs: batch."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tbmfg.cli.options import Name, Names, Output, command, known, selection, split_names
from tbmfg.cli.terminal import Terminal, number


@command(options=selection)
def batch(
    logs: Annotated[
        list[str], typer.Argument(metavar="LOG|DIR|GLOB|URL...", help="Logs, and folders of logs.", show_default=False)
    ],
    output: Output,
    options: dict[str, Any],
    out: Terminal,
    estimator: Name = "batch",
    estimators: Names = "",
    jobs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Logs at a time; else one per processor.", show_default=False)
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Run on the workers of this Dask scheduler.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace results of other inputs.")] = False,
) -> None:
    """Estimate many logs, in parallel; started again it goes on.

    One estimator writes to DIR/LOG, several to DIR/LOG/NAME. Exit code 0: every log is done; 1: at least one failed,
    the others are done and batch.json says which.

    \b
    Examples:
      tbmfg batch recordings/ --rig tbm -o out
      tbmfg batch "shift-*.mcap" --estimators batch,ins --jobs 4 -o out
      tbmfg batch s3://mine/logs/ --scheduler tcp://head:8786 -o s3://mine/results
    """
    names = split_names(estimators) or [estimator]
    known(names, "--estimators" if estimators else "--estimator")
    from tbmfg import batch as many

    with out.progress("logs") as progress:

        def tell(outcome: Any, number: int, total: int) -> None:
            _print_outcome(out, outcome, number, total)
            if progress:
                progress("logs", number / total)

        report = many.run(
            logs, output=output, estimators=names, jobs=jobs, scheduler=scheduler, force=force, tell=tell, **options
        )
    out.data(report)
    _print_batch(out, report, output)
    if report[many.FAILED]:
        raise typer.Exit(1)


def _print_outcome(out: Terminal, outcome: Any, number: int, total: int) -> None:
    """The line of one log, when it has ended."""
    first = next((result for result in outcome.results if "not_run" not in result), None)
    spent = f", {first['duration_s']:.1f} s in {first['wall_s']:.1f} s" if first and outcome.status == "done" else ""
    out.say(f"[{number}/{total}] {outcome.name}: {outcome.reason or outcome.status}{spent}")


def _print_batch(out: Terminal, report: dict[str, Any], output: str) -> None:
    """One row per log and estimator; logs that failed below."""
    rows = []
    for log in report["logs"]:
        for result in log["results"]:
            ran = "not_run" not in result
            columns = ("keyframes", "duration_s", "realtime_factor", "warnings", "ape_rms_m", "attitude_rms_deg")
            shown = (number(result[name]) for name in columns) if ran else ("-" for _ in columns)
            rows.append((log["name"], result["estimator"], log["status"], *shown))
    titles = ["log", "estimator", "status", "keyframes", "s", "x real time", "warnings", "APE m", "attitude deg"]
    out.table(titles, rows, justify="right")
    for log in report["logs"]:
        if log["status"] == "failed":
            out.say(f"failed: {log['log']}: {log['reason']}")
        for result in log["results"]:
            if "not_run" in result:
                out.say(f"{log['name']}: {result['estimator']} not run: {result['not_run']}")
    out.say(
        f"{report['done']} done, {report['kept']} kept from before, {report['failed']} failed"
        f" of {report['logs_found']} logs in {report['wall_s']:.1f} s"
    )
    out.say(f"results: {output}")
