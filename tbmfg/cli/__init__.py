"""The command line: options in, tables out. What it does is in :mod:`tbmfg.pipeline`.

Heavy imports are inside the commands, so that ``--help`` and completion answer at once.
"""

from __future__ import annotations

from typing import Annotated

import typer

from tbmfg import __version__
from tbmfg.cli.estimate import compare, run
from tbmfg.cli.logs import estimators, info, init, map_
from tbmfg.cli.many import batch
from tbmfg.cli.setup import doctor

app = typer.Typer(
    help="""Where is the machine, and how sure are we? Smoothing of recorded underground logs.

    \b
    Examples:
      tbmfg info drive.mcap                   what is in a log
      tbmfg compare drive.mcap -o out         smoother and filter side by side: out/report.html
      tbmfg init drive.mcap -o rig.yaml       a rig to edit, for the next run
      tbmfg doctor                            whether everything is installed
    """,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

for command in (info, init, run, compare, batch, map_, estimators, doctor):
    app.command(command.__name__.rstrip("_"))(command)


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
