"""The command line: options in, tables out. What it does is in :mod:`tbmfg.pipeline`.

Heavy imports are inside the commands, so that ``--help`` and completion answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from tbmfg import __version__
from tbmfg.errors import TbmfgError

app = typer.Typer(
    help="Where is the machine, and how sure are we? Smoothing of recorded underground logs.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

LogPath = Annotated[Path, typer.Argument(metavar="LOG", help="An .mcap file or a rosbag2 folder.", show_default=False)]
RigName = Annotated[
    str | None,
    typer.Option("--rig", metavar="NAME|FILE", help="A shipped rig or a rig.yaml; else the log's, else a guess."),
]
Truth = Annotated[
    str, typer.Option(metavar="auto|none|TOPIC|FILE", help="Reference to compare with; auto: the rig's, or by name.")
]
Output = Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results.")]
Outages = Annotated[
    list[str],
    typer.Option(
        "--outage", metavar="SENSOR:START:END", help="Hide a sensor; seconds from the first IMU sample. Repeatable."
    ),
]
Without = Annotated[list[str], typer.Option("--without", metavar="SENSOR", help="Drop a sensor. Repeatable.")]
Only = Annotated[str, typer.Option("--only", metavar="A,B", help="Keep just these sensors and the IMU.")]
Overrides = Annotated[
    list[str], typer.Option("--set", metavar="KEY.PATH=VALUE", help="Override a value of the rig. Repeatable.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing results.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


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
def info(log: LogPath, debug: Debug = False) -> None:
    """Topics, roles, rates, gaps and clock problems of a log."""
    with _errors_in_one_line(debug):
        from tbmfg.mcap import info_text

        typer.echo(info_text(log))


@app.command()
def init(
    log: LogPath,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The rig file to write.")],
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
def run(
    log: LogPath,
    output: Output,
    rig: RigName = None,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="See `tbmfg estimators`.")] = "batch",
    truth: Truth = "auto",
    outage: Outages = [],  # noqa: B006 - typer reads defaults, never changes them
    without: Without = [],  # noqa: B006
    only: Only = "",
    overrides: Overrides = [],  # noqa: B006
    report: Annotated[bool, typer.Option("--report", help="Write report.html too.")] = False,
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Estimate the trajectory of one log and write it to a folder."""
    options = _options(outage, without, only, overrides)
    _known(estimator, "--estimator")
    with _errors_in_one_line(debug):
        from tbmfg import pipeline

        with _progress_bar() as progress:
            summary = pipeline.run(
                log,
                rig=rig,
                estimator=estimator,
                truth=truth,
                output=output,
                report=report,
                force=force,
                progress=progress,
                **options,
            )
        _print_summary(summary, output)


@app.command()
def compare(
    log: LogPath,
    output: Output,
    rig: RigName = None,
    estimators: Annotated[
        str, typer.Option(metavar="A,B,...", help="Names from `tbmfg estimators`.")
    ] = "batch,fixed-lag,ins",
    truth: Truth = "auto",
    outage: Outages = [],  # noqa: B006
    without: Without = [],  # noqa: B006
    only: Only = "",
    overrides: Overrides = [],  # noqa: B006
    force: Force = False,
    debug: Debug = False,
) -> None:
    """Run several estimators on one prepared log, side by side."""
    options = _options(outage, without, only, overrides)
    names = split_names(estimators)
    for name in names:
        _known(name, "--estimators")
    with _errors_in_one_line(debug):
        from tbmfg import pipeline

        with _progress_bar() as progress:
            summaries = pipeline.compare(
                log, rig=rig, estimators=names, truth=truth, output=output, force=force, progress=progress, **options
            )
        _print_comparison(summaries, output)


@app.command()
def estimators(debug: Debug = False) -> None:
    """The estimators: what each needs, and where it is from."""
    with _errors_in_one_line(debug):
        from tbmfg.estimators import ESTIMATORS

        rows = [(name, e.summary, _words(e.needs), e.source) for name, e in ESTIMATORS.items()]
        _print_table(["name", "", "needs", "source"], rows)


# ---- reading options ----


def _options(outage: list[str], without: list[str], only: str, overrides: list[str]) -> dict[str, Any]:
    """What ``run`` and ``compare`` share, parsed."""
    return {
        "outages": [parse_outage(text) for text in outage],
        "without": [name for names in without for name in split_names(names)],
        "only": split_names(only),
        "overrides": [checked_override(text) for text in overrides],
    }


def _known(estimator: str, hint: str) -> None:
    """Refuse a name that no estimator has."""
    from tbmfg.estimators import ESTIMATORS

    if estimator not in ESTIMATORS:
        raise typer.BadParameter(f"no {estimator!r}; there are {', '.join(ESTIMATORS)}", param_hint=hint)


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
        elif isinstance(error, TbmfgError | OSError):
            typer.echo(f"tbmfg: {error}", err=True)
        else:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            typer.echo(f"tbmfg: internal error: {reason}; rerun with --debug for the traceback", err=True)
        raise typer.Exit(1) from None


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, float], None] | None]:
    """A callback that draws stage and fraction on a terminal; None in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


# ---- printing ----


def _print_summary(summary: dict[str, Any], output: Path) -> None:
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


def _print_comparison(summaries: dict[str, dict[str, Any]], output: Path) -> None:
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
    typer.echo(f"reading and preparing, once for all: {first['shared_s']:.2f} s")
    for name, reason in comparison.not_run(summaries).items():
        typer.echo(f"{name} not run: {reason}")
    for warning in dict.fromkeys(warning for summary in ran.values() for warning in summary["warnings"]):
        typer.echo(f"warning: {warning}")
    typer.echo(f"results: {output}, to read: {output / REPORT}")


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
