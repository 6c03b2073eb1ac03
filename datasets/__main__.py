"""``python -m datasets``: list the datasets, make one."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

from datasets import MACHINES, defaults, make
from tbmfg.errors import TbmfgError


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 the input is at fault (argparse itself exits with 2)."""
    parser = argparse.ArgumentParser(prog="python -m datasets", description="Logs with known truth.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="the datasets, and the options of each with their defaults")
    maker = commands.add_parser("make", help="simulate one and write it as MCAP, its rig attached")
    maker.add_argument("name", metavar="NAME", help="as in the list")
    maker.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the .mcap to write")
    maker.add_argument("--seed", type=int, default=0, help="of every draw (default 0)")
    maker.add_argument("--duration", type=float, default=120.0, metavar="S", help="seconds (default 120)")
    maker.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="assignments",
        help="an option of the dataset, or with dots a value of its rig: sensors.prism.sigma_mm=2",
    )
    given = parser.parse_args(arguments)
    try:
        if given.command == "list":
            print("\n".join(describe(name) for name in MACHINES))
        else:
            settings, options = sort(given.name, given.assignments)
            simulation = make(given.name, seed=given.seed, duration=given.duration, settings=settings, **options)
            simulation.write(given.output)
            counts = ", ".join(f"{series.topic} {len(series)}" for series in simulation.log_series)
            print(f"{given.output}: {counts}")
    except (TbmfgError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def describe(name: str) -> str:
    """One dataset in two lines: what it is, and its options."""
    summary = (importlib.import_module(MACHINES[name]).__doc__ or "").partition("\n")[0]
    return f"{name}  {summary}\n    " + " ".join(f"{key}={value}" for key, value in defaults(name).items())


def sort(name: str, assignments: list[str]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Assignments to the rig (their key has dots), and the dataset's own options as numbers."""
    settings = tuple(text for text in assignments if "." in text.partition("=")[0])
    options: dict[str, Any] = {}
    known = defaults(name) if name in MACHINES else {}
    for text in assignments:
        key, _, value = text.partition("=")
        if "." in key:
            continue
        try:
            options[key] = type(known.get(key, ""))(value)
        except ValueError:
            raise TbmfgError(f"--set {text}: {key} should be a number such as {known[key]}") from None
    return settings, options


if __name__ == "__main__":
    sys.exit(main())
