"""``python -m benchmarks``: measure, print, and hold to the baseline."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from benchmarks import BENCHMARKS, gate
from benchmarks.page import page
from benchmarks.rows import print_tables, to_text
from tbmfg.errors import TbmfgError


def main(arguments: list[str] | None = None) -> int:
    """Run one benchmark. Exit code 0: done; 1: the input is at fault, or the gate is not held; 2: usage."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="How good and how fast tbmfg is.")
    commands = parser.add_subparsers(dest="name", required=True)
    for name, module in BENCHMARKS.items():
        _add(commands, name, importlib.import_module(module))
    given = parser.parse_args(arguments)
    try:
        return _run(given)
    except (TbmfgError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _add(commands: argparse._SubParsersAction, name: str, module) -> None:
    """The command of one benchmark: its own options, and those that all have."""
    summary, _, text = module.__doc__.partition("\n")
    command = commands.add_parser(
        name, help=summary, description=summary + text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    module.options(command)
    command.add_argument("--json", type=Path, metavar="FILE", help="write the rows")
    command.add_argument("--html", type=Path, metavar="FILE", help="write them as charts and tables")
    command.set_defaults(module=module, gate=False, update_baseline=False)
    if hasattr(module, "GATE"):
        choice = command.add_mutually_exclusive_group()
        choice.add_argument("--gate", action="store_true", help="repeat the baseline's run and compare: exit code 1")
        choice.add_argument("--update-baseline", action="store_true", help="make this run the baseline")
        command.add_argument("--baseline", type=Path, default=gate.BASELINE, metavar="FILE", help="another baseline")


def _run(given: argparse.Namespace) -> int:
    module, baseline = given.module, []
    if given.gate:
        held, baseline = gate.load(given.baseline, given.name)
        vars(given).update(held)
    elif given.update_baseline:
        vars(given).update(module.GATE)
    rows = module.measure(given)
    print_tables(rows)
    if given.json:
        given.json.write_text(to_text(rows), "utf-8")
    if given.html:
        given.html.write_text(page(f"benchmarks {given.name}", rows), "utf-8")
    if given.update_baseline:
        gate.save(given.baseline, given.name, module.GATE, rows)
        print(f"baseline: {given.baseline}")
    if not given.gate:
        return 0
    faults = gate.compare(rows, baseline, module.tolerance)
    print(*faults, f"gate: {len(faults)} of {len(baseline)} rows are not held" if faults else "gate: held", sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
