"""The command line: options in, tables out. What it does is in :mod:`tbmfg.pipeline`.

Heavy imports are inside the commands, so that ``--help`` and completion answer at once.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from tbmfg import __version__
from tbmfg.errors import TbmfgError, reason

app = typer.Typer(
    help="Where is the machine, and how sure are we? Smoothing of recorded underground logs.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Log = Annotated[str, typer.Argument(metavar="LOG", help="An .mcap file or a rosbag2 folder.", show_default=False)]
Output = Annotated[str, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results.")]
Names = Annotated[str, typer.Option(metavar="A,B,...", help="Names from `tbmfg estimators`.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing results.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def selection(
    rig: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="A shipped rig or a rig.yaml; else the log's, else a guess."),
    ] = None,
    truth: Annotated[
        str,
        typer.Option(metavar="auto|none|TOPIC|FILE", help="Reference to compare with; auto: the rig's, or by name."),
    ] = "auto",
    outage: Annotated[
        list[str],
        typer.Option(metavar="SENSOR:START:END", help="Hide a sensor; seconds from the first IMU sample. Repeatable."),
    ] = [],  # noqa: B006 - typer reads defaults, never changes them
    without: Annotated[list[str], typer.Option(metavar="SENSOR", help="Drop a sensor. Repeatable.")] = [],  # noqa: B006
    only: Annotated[str, typer.Option(metavar="A,B", help="Keep just these sensors and the IMU.")] = "",
    start: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="Leave out what was logged before; from the log's start.")
    ] = None,
    end: Annotated[float | None, typer.Option(metavar="S", help="Leave out what was logged from there on.")] = None,
    overrides: Annotated[
        list[str],
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="Override a value of the rig. Repeatable."),
    ] = [],  # noqa: B006
) -> dict[str, Any]:
    """What every command that estimates takes: the options of :func:`tbmfg.pipeline.run`."""
    if end is not None and not (start or 0.0) < end:
        raise typer.BadParameter(f"{end:g} s is not after --start {start or 0.0:g} s", param_hint="--end")
    return {
        "rig": rig,
        "truth": truth,
        "outages": [parse_outage(text) for text in outage],
        "without": [name for names in without for name in split_names(names)],
        "only": split_names(only),
        "overrides": [checked_override(text) for text in overrides],
        "start_s": start,
        "end_s": end,
    }


def with_selection(command: Callable[..., None]) -> Callable[..., None]:
    """Give ``command`` the options of :func:`selection`, which it gets parsed as ``options``."""
    shared = inspect.signature(selection, eval_str=True).parameters
    own = [p for p in inspect.signature(command, eval_str=True).parameters.values() if p.name != "options"]

    @functools.wraps(command)
    def wrapper(**given: Any) -> None:
        command(options=selection(**{name: given.pop(name) for name in shared}), **given)

    parameters = sorted([*own, *shared.values()], key=lambda p: p.default is not p.empty)  # required ones first
    wrapper.__signature__ = inspect.Signature(parameters)
    wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
    return wrapper


def main() -> None:
    app(prog_name="tbmfg")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"tbmfg {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    pass


@app.command()
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
    with _errors_in_one_line(debug):
        from tbmfg.mcap import info_text

        typer.echo(info_text(log))
        if allan:
            _print_allan(log, rig)


@app.command()
def init(
    log: Log,
    output: Annotated[str, typer.Option("--output", "-o", metavar="FILE", help="The rig file to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    debug: Debug = False,
) -> None:
    """Write a starter rig for a log: what it shows, and what had to be guessed."""
    with _errors_in_one_line(debug):
        from tbmfg import pipeline

        for line in pipeline.init(log, output, force=force):
            typer.echo(line)
        typer.echo(f"rig: {output}")


@app.command()
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
    _known([estimator], "--estimator")
    with _errors_in_one_line(debug):
        from tbmfg import pipeline

        with _progress_bar("reading") as progress:
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


@app.command()
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
    _known(names, "--estimators")
    with _errors_in_one_line(debug):
        from tbmfg import pipeline

        with _progress_bar("reading") as progress:
            summaries = pipeline.compare(
                log, estimators=names, output=output, force=force, progress=progress, **options
            )
        _print_comparison(summaries, output)


@app.command()
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
    _known(names, "--estimators" if estimators else "--estimator")
    with _errors_in_one_line(debug):
        from tbmfg import batch as many

        with _progress_bar("logs") as progress:

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


@app.command("map")
def map_(
    log: Log,
    trajectory: Annotated[str, typer.Option(metavar="DIR", help="Folder of a result of `tbmfg run`.")],
    output: Annotated[str, typer.Option("--output", "-o", metavar="FILE", help="The .ply or .pcd to write.")],
    lidar: Annotated[str | None, typer.Option(metavar="NAME", help="Which LiDAR of the rig; else the first.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing map.")] = False,
    debug: Debug = False,
) -> None:
    """Make the map of a log's LiDAR scans along an estimated trajectory, and a picture of it."""
    with _errors_in_one_line(debug):
        from tbmfg import mapping

        with _progress_bar("mapping") as progress:
            sharp, points = mapping.make(log, trajectory, output, lidar=lidar, force=force, progress=progress)
        typer.echo(f"{points} points; surfaces are {1e3 * sharp.thickness_m:.1f} mm thick (median of {sharp.voxels}")
        typer.echo(f"voxels of {mapping.THICK_M:g} m), mean map entropy {sharp.entropy:.2f}")
        typer.echo(f"map: {output}, picture: {Path(output).with_suffix('.png')}")


@app.command()
def estimators(debug: Debug = False) -> None:
    """The estimators: what each needs, and where it is from."""
    with _errors_in_one_line(debug):
        from tbmfg.estimators import ESTIMATORS

        rows = [(name, e.summary, _words(e.needs), e.source) for name, e in ESTIMATORS.items()]
        _print_table(["name", "", "needs", "source"], rows)


# ---- reading options ----


def _known(estimators: list[str], hint: str) -> None:
    """Refuse a name that no estimator has."""
    from tbmfg.estimators import ESTIMATORS

    for name in estimators:
        if name not in ESTIMATORS:
            raise typer.BadParameter(f"no {name!r}; there are {', '.join(ESTIMATORS)}", param_hint=hint)


def parse_outage(text: str) -> tuple[str, float, float]:
    """``SENSOR:START:END`` -> (sensor, start, end) in seconds."""
    sensor, *times = text.split(":")
    try:
        start, end = map(float, times)
    except ValueError:
        start, end = 0.0, 0.0
    if not sensor or not start < end < float("inf"):
        raise typer.BadParameter(f"{text!r} is not SENSOR:START:END with START < END in seconds", param_hint="--outage")
    return sensor, start, end


def checked_override(text: str) -> str:
    key, equals, _ = text.partition("=")
    if not equals or not key.strip():
        raise typer.BadParameter(f"{text!r} is not KEY.PATH=VALUE", param_hint="--set")
    return text


def split_names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


# ---- errors and progress ----


@contextmanager
def _errors_in_one_line(debug: bool) -> Iterator[None]:
    """Turn what a command raises into a message on stderr and exit code 1."""
    try:
        yield
    except BrokenPipeError:
        raise  # the reader of our output has left: nobody to tell
    except Exception as error:
        if debug:
            import traceback

            traceback.print_exc()
        else:
            foreseen = isinstance(error, TbmfgError | OSError)
            typer.echo(
                f"tbmfg: {reason(error)}{'' if foreseen else '; rerun with --debug for the traceback'}", err=True
            )
        raise typer.Exit(1) from None


@contextmanager
def _progress_bar(first: str) -> Iterator[Callable[[str, float], None] | None]:
    """A callback that draws stage (at the beginning ``first``) and fraction on a terminal; None in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, redirect_stdout=sys.stdout.isatty()) as bar:
        task = bar.add_task(first, total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


# ---- printing ----


def _print_allan(log: str, rig: str | None) -> None:
    """What the standing IMU shows of its noise, beside what the rig says of it."""
    from tbmfg import pipeline
    from tbmfg.inertial.allan import against_rig

    found, imu = pipeline.allan(log, rig)
    typer.echo(f"\nAllan variance, standing from {found.start_s:.1f} to {found.end_s:.1f} s")
    rows = [
        (name, "not seen" if value is None else _number(value), _number(said))
        for name, value, said in against_rig(found, imu)
    ]
    _print_table(["", "found", "rig"], rows, justify="right")


def _print_summary(summary: dict[str, Any], output: str) -> None:
    typer.echo(
        f"{summary['estimator']}: {summary['keyframes']} keyframes over {summary['duration_s']:.1f} s"
        f" in {summary['wall_s']:.1f} s ({summary['realtime_factor']:.1f} x real time)"
    )
    calibration = [
        (name, _number(value["value"]), _number(value["sd"]) if value["estimated"] else "not estimated")
        for name, value in summary["calibration"].items()
    ]
    _print_table(["calibration", "value", "sd"], calibration)
    counted = ["received", "used"] + [
        part
        for part in ("gated", "late", "duplicate", "nonfinite", "outage", "unused")
        if any(counts[part] for counts in summary["sensors"].values())
    ]
    sensors = [(name, *(str(counts[part]) for part in counted)) for name, counts in summary["sensors"].items()]
    _print_table(["sensor", *counted], sensors, justify="right")
    if deviation := summary.get("deviation"):
        spent = ", ".join(f"{level} {duration:.1f} s" for level, duration in deviation["level_s"].items())
        last = deviation["timeline"][-1]
        typer.echo(f"deviation: {spent}; at the end {last['direction']}, {last['level']}")
    for key in ("metrics", "metrics_smoothed"):
        metrics = summary.get(key) or {}
        known = [(name, _number(value)) for name, value in metrics.items() if value is not None]
        _print_table([f"{key} against {summary['truth']}", ""], known)
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
    _print_table(
        ["estimator", *(column.title for column in columns), "own time s"],
        [(row.label, *(_number(column.of(row.metrics)) for column in columns), f"{row.own_s:.2f}") for row in rows],
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
            shown = (_number(result[name]) for name in columns) if ran else ("-" for _ in columns)
            rows.append((log["name"], result["estimator"], log["status"], *shown))
    titles = ["log", "estimator", "status", "keyframes", "s", "x real time", "warnings", "APE m", "attitude deg"]
    _print_table(titles, rows, justify="right")
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


def _print_table(header: list[str], rows: list[tuple[str, ...]], *, justify: str = "left") -> None:
    """Columns under their titles, all but the first justified; nothing where there are no rows."""
    if not rows:
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column, title in enumerate(header):
        table.add_column(title, overflow="fold", justify=justify if column else "left")
    for row in rows:
        table.add_row(*row)
    # a pipe has no width: rows stay on one line there
    width = None if sys.stdout.isatty() else 200
    Console(highlight=False, markup=False, width=width).print(table)


def _number(value: float | tuple[float, ...] | None) -> str:
    if value is None:
        return "-"
    return " ".join(f"{x:.4g}" for x in value) if isinstance(value, list | tuple) else f"{value:.4g}"


def _words(value: Any) -> str:
    return value if isinstance(value, str) else ", ".join(value)
