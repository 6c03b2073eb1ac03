"""Options that several commands share, and how their text is read."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from tbmfg.cli.terminal import Level, Terminal


def estimator_names(typed: str) -> list[str]:
    """For completion: names after the last comma."""
    from tbmfg.estimators import ESTIMATORS

    before, comma, last = typed.rpartition(",")
    return [f"{before}{comma}{name}" for name in ESTIMATORS if name.startswith(last)]


def rig_names(typed: str) -> list[str]:
    """For completion: the shipped rigs; the shell itself completes files."""
    from tbmfg.rig import shipped

    return [name for name in shipped() if name.startswith(typed)]


Log = Annotated[str, typer.Argument(metavar="LOG", help="An .mcap file or a rosbag2 folder.", show_default=False)]
Output = Annotated[str, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results.")]
Name = Annotated[
    str, typer.Option(metavar="NAME", help="A name from `tbmfg estimators`.", autocompletion=estimator_names)
]
Names = Annotated[
    str, typer.Option(metavar="A,B,...", help="Names from `tbmfg estimators`.", autocompletion=estimator_names)
]
RigName = typer.Option(
    metavar="NAME|FILE", help="A shipped rig or a rig.yaml; else the log's, else a guess.", autocompletion=rig_names
)
Force = Annotated[bool, typer.Option("--force", help="Replace existing results.")]


def terminal(
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
    level: Annotated[
        Level,
        typer.Option("--log-level", help="info: also every stage and its time; debug: also tracebacks."),
    ] = Level.warning,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error; as --log-level debug.")
    ] = False,
) -> Terminal:
    """What every command takes: how much is said, and to whom."""
    if quiet and debug:
        raise typer.BadParameter("--quiet and --debug contradict each other", param_hint="--quiet")
    return Terminal(Level.error if quiet else Level.debug if debug else level, json)


def selection(
    rig: Annotated[str | None, RigName] = None,
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


def command(**groups: Callable[..., Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of functions, and turn what it raises into a line.

    A parameter of the command that is named here gets what its function makes of its options; ``out`` is the
    :class:`Terminal` of every command.
    """
    groups = {**groups, "out": terminal}

    def decorate(body: Callable[..., None]) -> Callable[..., None]:
        shared = {name: inspect.signature(made, eval_str=True).parameters for name, made in groups.items()}
        own = [p for p in inspect.signature(body, eval_str=True).parameters.values() if p.name not in groups]

        @functools.wraps(body)
        def wrapper(**given: Any) -> None:
            made = {name: groups[name](**{key: given.pop(key) for key in keys}) for name, keys in shared.items()}
            with made["out"].errors():
                body(**made, **given)

        options = [p for parameters in shared.values() for p in parameters.values()]
        parameters = sorted([*own, *options], key=lambda p: p.default is not p.empty)  # required ones first
        wrapper.__signature__ = inspect.Signature(parameters)
        wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
        return wrapper

    return decorate


def known(estimators: list[str], hint: str) -> None:
    """Refuse a name that no estimator has."""
    from tbmfg.estimators import ESTIMATORS

    if not estimators:
        raise typer.BadParameter("names none; see `tbmfg estimators`", param_hint=hint)
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
