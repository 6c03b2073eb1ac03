"""What commands do with a terminal or a pipe: errors in one line, progress, tables."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from tbmfg.errors import TbmfgError, reason


@contextmanager
def errors_in_one_line(debug: bool) -> Iterator[None]:
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
def progress_bar(first: str) -> Iterator[Callable[[str, float], None] | None]:
    """A callback that draws stage (at the beginning ``first``) and fraction on a terminal; None in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, redirect_stdout=sys.stdout.isatty()) as bar:
        task = bar.add_task(first, total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


def print_table(header: list[str], rows: list[tuple[str, ...]], *, justify: str = "left") -> None:
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


def number(value: float | tuple[float, ...] | None) -> str:
    if value is None:
        return "-"
    return " ".join(f"{x:.4g}" for x in value) if isinstance(value, list | tuple) else f"{value:.4g}"
