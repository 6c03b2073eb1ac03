"""The command about the installation: doctor."""

from __future__ import annotations

import sys
from dataclasses import asdict

import typer

from tbmfg.cli.options import command
from tbmfg.cli.terminal import Terminal, coloured

COLOURS = {"ok": "green", "absent": "yellow", "broken": "red"}


@command()
def doctor(out: Terminal) -> None:
    """Look whether everything is installed and works.

    Versions and imports, compiled code, and a short run. What is missing is said with how to get it. Exit code 0: all
    that is needed works; 1: something is broken.

    \b
    Examples:
      tbmfg doctor
      tbmfg doctor --json > about.json                  to send along with a question
    """
    from tbmfg import doctor as looks

    found = []
    for check in looks.checks():
        found.append(check)
        out.say(f"{coloured(f'{check.state:6}', COLOURS[check.state], sys.stdout)} {check.name}: {check.found}")
        if check.remedy:
            out.say(f"       {check.remedy}")
    out.data([asdict(check) for check in found])
    if any(check.state == looks.BROKEN for check in found):
        raise typer.Exit(1)
