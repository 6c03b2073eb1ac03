"""The command for many logs: batch."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tbmfg.cli.options import Debug, Output, known, split_names, with_selection
from tbmfg.cli.terminal import errors_in_one_line, number, print_table, progress_bar


@with_selection
def batch(
    logs: Annotated[
        list[str], typer.Argument(metavar="LOG|DIR|GLOB|URL...", help="Logs, and folders of logs.", show_default=False)
    ],
    output: Output,
    options: dict[str, Any],
    estimator: Annotated[str, typer.Option(metavar="NAME", help="One estimator, its files in DIR/LOG.")] = "batch",
    estimators: Annotated[str, typer.Option(metavar="A,B,...", help="Several, each in DIR/LOG/NAME.")] = "",
    jobs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Logs at a time; else one per processor.", show_default=False)
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Run on the workers of this Dask scheduler.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace results of other inputs.")] = False,
    debug: Debug = False,
) -> None:
    """Estimate many logs, each in a process of its own; finished ones are kept when started again.

    Exit code 0: every log is done; 1: at least one failed, the others are done and batch.json says which.
    """
    names = split_names(estimators) or [estimator]
    known(names, "--estimators" if estimators else "--estimator")
    with errors_in_one_line(debug):
        from tbmfg import batch as many

        with progress_bar("logs") as progress:

            def tell(outcome: Any, number: int, total: int) -> None:
                _print_outcome(outcome, number, total)
                if progress:
                    progress(f"{number} of {total} logs", number / total)

            report = many.run(
                logs, output=output, estimators=names, jobs=jobs, scheduler=scheduler, force=force, tell=tell, **options
            )
        _print_batch(report, output)
    if report[many.FAILED]:
        raise typer.Exit(1)


def _print_outcome(outcome: Any, number: int, total: int) -> None:
    """The line of one log, when it has ended."""
    first = next((result for result in outcome.results if "not_run" not in result), None)
    spent = f", {first['duration_s']:.1f} s in {first['wall_s']:.1f} s" if first and outcome.status == "done" else ""
    typer.echo(f"[{number}/{total}] {outcome.name}: {outcome.reason or outcome.status}{spent}")


def _print_batch(report: dict[str, Any], output: str) -> None:
    """One row per log and estimator; logs that failed below."""
    rows = []
    for log in report["logs"]:
        for result in log["results"]:
            ran = "not_run" not in result
            columns = ("keyframes", "duration_s", "realtime_factor", "warnings", "ape_rms_m", "attitude_rms_deg")
            shown = (number(result[name]) for name in columns) if ran else ("-" for _ in columns)
            rows.append((log["name"], result["estimator"], log["status"], *shown))
    titles = ["log", "estimator", "status", "keyframes", "s", "x real time", "warnings", "APE m", "attitude deg"]
    print_table(titles, rows, justify="right")
    for log in report["logs"]:
        if log["status"] == "failed":
            typer.echo(f"failed: {log['log']}: {log['reason']}")
        for result in log["results"]:
            if "not_run" in result:
                typer.echo(f"{log['name']}: {result['estimator']} not run: {result['not_run']}")
    typer.echo(
        f"{report['done']} done, {report['kept']} kept from before, {report['failed']} failed"
        f" of {report['logs_found']} logs in {report['wall_s']:.1f} s"
    )
    typer.echo(f"results: {output}")
