"""Write docs/rig.md from the models that read a rig: python docs/make_rig_reference.py"""

from __future__ import annotations

from inspect import cleandoc, isclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from tbmfg.rig import OWN_KINDS, Rig

FILE = Path(__file__).with_name("rig.md")
HEAD = """# The rig file

Every key that a rig may hold, written from the code by `python docs/make_rig_reference.py`. Keys that are not here are
refused. Units are part of the names; a standard deviation (`_sd`) of 0 or null means: not estimated.
Vectors are `[x, y, z]`, mountings `{xyz_m: [x, y, z], rpy_deg: [roll, pitch, yaw]}`; the frames are those of
[conventions](conventions.md).
"""


def reference() -> str:
    """The page."""
    parts = [HEAD, section("The whole", Rig, skip=("sensors",))]
    for name, field in Rig.model_fields.items():
        model = nested(field)
        if model is not None and name != "sensors":
            parts.append(section(f"`{name}`", model))
    parts += [section(f"`sensors.{kind}`", model) for kind, model in OWN_KINDS.items()]
    return "\n".join(parts)


def section(title: str, model: type[BaseModel], skip: tuple[str, ...] = ()) -> str:
    """A heading, what the model says of itself, and a row for each of its keys."""
    rows = [
        f"| `{name}` | {default(field)} | {cell((field.description or about(field)) + choices(field))} |"
        for name, field in model.model_fields.items()
        if name not in skip
    ]
    words = " ".join(cleandoc(model.__doc__ or "").split("\n\n")[0].split())
    return "\n".join([f"## {title}", "", words, "", "| key | default | |", "|---|---|---|", *rows, ""])


def nested(field: FieldInfo) -> type[BaseModel] | None:
    """The model that a key's value is, or a list of it."""
    found: list[Any] = [field.annotation]
    for one in found:
        found += get_args(one)
        if isclass(one) and issubclass(one, BaseModel):
            return one
    return None


def about(field: FieldInfo) -> str:
    """What the model of a key's value says of itself."""
    model = nested(field)
    return " ".join(cleandoc(model.__doc__ or "").split("\n\n")[0].split()) if model else ""


def choices(field: FieldInfo) -> str:
    """The words that a key may hold, where these are listed."""
    listed = get_origin(field.annotation) is Literal
    return f" One of {', '.join(f'`{word}`' for word in get_args(field.annotation))}." if listed else ""


def default(field: FieldInfo) -> str:
    """The default as it stands in YAML."""
    if field.is_required():
        return "**required**"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return "see below"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, tuple | list):
        return "`[" + ", ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in value) + "]`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`" if value != {} else "`{}`"


def cell(text: str) -> str:
    """Text that cannot end a cell of a table."""
    return text.replace("|", "\\|")


if __name__ == "__main__":
    FILE.write_text(reference(), "utf-8")
