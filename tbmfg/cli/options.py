"""Options that several commands share, and how their text is read."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

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


def known(estimators: list[str], hint: str) -> None:
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
