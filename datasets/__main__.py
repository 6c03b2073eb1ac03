"""``python -m datasets``: list the datasets, make one, import one, corrupt a log."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from datasets import MACHINES, RECORDINGS, defaults, faults, load, make, own_duration, summary
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
    maker.add_argument("--duration", type=float, metavar="S", help="seconds (default: as in the list)")
    importer = commands.add_parser("import", help="write a public recording as MCAP, a rig attached")
    importer.add_argument("name", metavar="NAME", help="as in the list")
    importer.add_argument("source", type=Path, metavar="SRC", help="its npz, or the folder that holds it")
    importer.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the .mcap to write")
    for command in (maker, importer):
        command.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            dest="assignments",
            help="an option of the dataset, or with dots a value of its rig: sensors.prism.sigma_mm=2",
        )
    corrupter = commands.add_parser("corrupt", help="copy a log with faults, told in its attachment faults.json")
    corrupter.add_argument("source", type=Path, metavar="LOG", help="an .mcap file or a rosbag2 folder")
    corrupter.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the .mcap to write")
    corrupter.add_argument("--seed", type=int, default=0, help="of every draw (default 0)")
    corrupter.add_argument(
        "--fault",
        action="append",
        required=True,
        metavar="KIND[:KEY=VALUE,..]",
        help=f"repeatable; {', '.join(faults.KINDS)}; keys topic, start, end, and of the kind: gross:share=0.3,size=2",
    )
    given = parser.parse_args(arguments)
    try:
        if given.command == "corrupt":
            for told in faults.corrupt(given.source, given.output, [*map(faults.parse, given.fault)], seed=given.seed):
                print("{topic}: {kind}, {start_s:.1f}-{end_s:.1f} s".format(**told), end="")
                print(f", {len(told['stamps_ns'])} of {told['messages']} messages")
            return 0
        if given.command == "list":
            print("\n".join(describe(name) for name in (*MACHINES, *RECORDINGS)))
            return 0
        settings, options = sort(given.name, given.assignments)
        if given.command == "make":
            log = make(given.name, seed=given.seed, duration=given.duration, settings=settings, **options)
        else:
            log = load(given.name, given.source, settings=settings, **options)
        log.write(given.output)
        counts = ", ".join(f"{part.topic} {len(part)}" for part in (*log.log_series, *log.clouds))
        print(f"{given.output}: {counts}")
    except (TbmfgError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def describe(name: str) -> str:
    """One dataset in two lines: what it is, how long if it is simulated, and its options."""
    kind, length = ("make", f" {own_duration(name):g} s.") if name in MACHINES else ("import", "")
    options = " ".join(f"{key}={_written(value)}" for key, value in defaults(name).items())
    return f"{kind} {name}  {summary(name)}{length}" + f"\n    {options}" * bool(options)


def sort(name: str, assignments: list[str]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Assignments to the rig (their key has dots), and the dataset's own options in the types of their defaults."""
    settings = tuple(text for text in assignments if "." in text.partition("=")[0])
    options: dict[str, Any] = {}
    known = defaults(name) if name in MACHINES or name in RECORDINGS else {}
    for text in assignments:
        key, _, value = text.partition("=")
        if "." in key:
            continue
        try:
            options[key] = _read(value, known.get(key, ""))
        except ValueError:
            what = "numbers" if isinstance(known[key], tuple) else "a number"
            such = "" if known[key] is None else f" such as {_written(known[key])}"
            raise TbmfgError(f"--set {text}: {key} should be {what}{such}") from None
    return settings, options


def _read(text: str, default: Any) -> Any:
    """``text`` as what ``default`` is: text, a number (for none as well), or as many numbers between commas."""
    if not isinstance(default, tuple):
        return (float if default is None else type(default))(text)
    values = tuple(float(part) for part in text.split(","))
    if len(values) != len(default):
        raise ValueError
    return values


def _written(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


if __name__ == "__main__":
    sys.exit(main())
