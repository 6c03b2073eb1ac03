"""Where a command speaks: results on stdout, errors, stages and progress on stderr.

A terminal gets colour and a progress bar with the time that remains. A pipe gets neither, and NO_COLOR turns colour off
(https://no-color.org).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import IO, Any

import typer

from tbmfg.errors import TbmfgError, reason


class Level(StrEnum):
    """How much is said: nothing but errors; results and warnings; also every stage and its time; also tracebacks."""

    error = "error"
    warning = "warning"
    info = "info"
    debug = "debug"


@dataclass(frozen=True, slots=True)
class Terminal:
    """What a command may say. With ``json`` stdout holds one JSON value and nothing else."""

    level: Level = Level.warning
    json: bool = False

    # ---- results ----

    def say(self, text: str) -> None:
        """A line of the result, for people."""
        if self._talks:
            typer.echo(text)

    def warn(self, text: str) -> None:
        """A warning, which is part of the result."""
        if self._talks:
            typer.echo(f"{coloured('warning:', 'yellow', sys.stdout)} {text}")

    def table(self, header: list[str], rows: list[tuple[str, ...]], *, justify: str = "left") -> None:
        """Columns under their titles, all but the first justified; nothing where there are no rows."""
        if not rows or not self._talks:
            return
        from rich.console import Console
        from rich.table import Table

        table = Table(box=None, pad_edge=False, header_style="bold" if has_colour(sys.stdout) else "")
        for column, title in enumerate(header):
            table.add_column(title, overflow="fold", justify=justify if column else "left")
        for row in rows:
            table.add_row(*row)
        # a pipe has no width: rows stay on one line there
        width = None if sys.stdout.isatty() else 200
        Console(highlight=False, markup=False, width=width).print(table)

    def data(self, value: Any) -> None:
        """The result for programs: what ``--json`` prints."""
        if self.json:
            from tbmfg.results import to_json

            typer.echo(to_json(value), nl=False)

    @property
    def _talks(self) -> bool:
        return not self.json and self.level != Level.error

    # ---- progress ----

    @contextmanager
    def progress(self, first: str) -> Iterator[Callable[[str, float], None] | None]:
        """A callback that shows stage (at the beginning ``first``) and done fraction, None where nobody would see it:
        a bar on a terminal, and from the level info on a line for every stage that has ended."""
        bar = self.level != Level.error and sys.stderr.isatty()
        if bar and not _compiled():
            typer.echo("first run here: what has to be fast is compiled, which takes a minute or two", err=True)
        lines = self.level in (Level.info, Level.debug)
        with _bar(first) if bar else _nothing() as draw, _stages(first) if lines else _nothing() as tell:
            shown = [show for show in (draw, tell) if show]
            yield (lambda stage, fraction: [show(stage, fraction) for show in shown]) if shown else None

    # ---- errors ----

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn what a command raises into a message on stderr and exit code 1; wrong usage stays wrong usage."""
        try:
            yield
        except (typer.Exit, typer.Abort, typer.BadParameter, BrokenPipeError):
            raise  # what typer ends with; and nobody to tell where the reader of our output has left
        except Exception as error:
            if self.level == Level.debug:
                import traceback

                traceback.print_exc()
            else:
                foreseen = isinstance(error, TbmfgError | OSError)
                more = "" if foreseen else "; rerun with --debug for the traceback"
                typer.echo(f"{coloured('tbmfg:', 'red', sys.stderr)} {reason(error)}{more}", err=True)
            raise typer.Exit(1) from None


def has_colour(stream: IO[str]) -> bool:
    """Whether ``stream`` is a terminal that may be coloured."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def coloured(text: str, colour: str, stream: IO[str]) -> str:
    return typer.style(text, fg=colour, bold=True) if has_colour(stream) else text


def number(value: float | tuple[float, ...] | None) -> str:
    if value is None:
        return "-"
    return " ".join(f"{x:.4g}" for x in value) if isinstance(value, list | tuple) else f"{value:.4g}"


def _compiled() -> bool:
    """Whether numba has compiled tbmfg before; yes also where it keeps that in a place that only numba knows."""
    package = Path(__file__).parents[1]
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or package)
    return not os.access(folder, os.W_OK) or next(folder.rglob("*.nbi"), None) is not None


@contextmanager
def _bar(first: str) -> Iterator[Callable[[str, float], None]]:
    """A bar for the stage at hand, with the time that it took so far and that remains."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True, no_color=not has_colour(sys.stderr))
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as bar:
        task, here = bar.add_task(first, total=1.0), first

        def draw(stage: str, fraction: float) -> None:
            nonlocal here
            if stage != here:
                bar.reset(task, description=stage)  # its speed is its own
                here = stage
            bar.update(task, completed=fraction)

        yield draw


@contextmanager
def _stages(first: str) -> Iterator[Callable[[str, float], None]]:
    """A line on stderr for every stage when it has ended."""
    here, since = first, time.perf_counter()

    def end(stage: str) -> None:
        nonlocal here, since
        now = time.perf_counter()
        typer.echo(f"tbmfg: {here}: {now - since:.2f} s", err=True)
        here, since = stage, now

    def tell(stage: str, fraction: float) -> None:
        if stage != here:
            end(stage)

    yield tell
    end("")


@contextmanager
def _nothing() -> Iterator[None]:
    yield None
