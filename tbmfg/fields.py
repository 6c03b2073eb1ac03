"""What configuration models are made of: strict values, SI beside the written units, faults in one line."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainValidator, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from tbmfg.yamltext import KeyPath, dotted

STANDARD_GRAVITY = 9.80665  # m/s^2
DEG = math.pi / 180
MM, PPM, MICRO_G, MICRO_TESLA = 1e-3, 1e-6, 1e-6 * STANDARD_GRAVITY, 1e-6


# ---- values: strict, so that neither "3" nor true passes for a number ----


def _triple(value: Any) -> Any:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise PydanticCustomError("triple", "should be three numbers [x, y, z]")
    return value


def _noise_factor(value: Any) -> float | Literal["auto"]:
    if value == "auto" or (_is_number(value) and value > 0):
        return value if value == "auto" else float(value)
    raise PydanticCustomError("noise_factor", "should be auto or a number greater than 0")


def _moment(value: Any) -> float | Literal["start", "end"]:
    if value in ("start", "end") or _is_number(value):
        return float(value) if _is_number(value) else value
    raise PydanticCustomError("moment", "should be start, end or seconds from the first IMU sample")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
CalibrationSd = Annotated[NotNegative, BeforeValidator(lambda value: 0.0 if value is None else value)]
Triple = Annotated[tuple[Number, Number, Number], BeforeValidator(_triple)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(strict=True, min_length=1)]
NoiseFactor = Annotated[float | Literal["auto"], PlainValidator(_noise_factor)]
Moment = Annotated[float | Literal["start", "end"], PlainValidator(_moment)]
Loss = Literal["none", "huber", "cauchy", "gnc"]

ZERO = (0.0, 0.0, 0.0)


def si(field: str, unit: float = 1.0) -> property:
    """``field`` in SI: a float, a triple as (3,), None where it is null."""

    def value(self: Node) -> Any:
        given = getattr(self, field)
        if given is None:
            return None
        return np.array(given) * unit if isinstance(given, tuple) else given * unit

    return property(value, doc=f"``{field}`` in SI.")


def noise(field: str, unit: float = 1.0) -> property:
    """``field``, a sensor's noise, in SI and times its ``noise_factor``; None where it is null."""

    def value(self: Node) -> float | None:
        given = getattr(self, field)
        return None if given is None else given * unit * self.times

    return property(value, doc=f"``{field}`` in SI, times the noise factor.")


class Node(BaseModel):
    """A mapping of the rig file: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


# ---- faults ----

OURS = "rig"  # type of the faults that say their values themselves


def fault(path: KeyPath, reason: str, value: Any = None, kind: str = OURS) -> InitErrorDetails:
    """One line of a pydantic error, at ``path`` below the model that finds it."""
    return InitErrorDetails(type=PydanticCustomError(kind, reason), loc=path, input=value)


def or_raise(value: Any, faults: list[InitErrorDetails]) -> Any:
    """``value`` if there are no faults; all of them at once otherwise."""
    if faults:
        raise ValidationError.from_exception_data("rig", faults)
    return value


def explain(error: Any, keys_beside: Callable[[KeyPath], Iterable[str]]) -> str:
    """``key.path: reason, got value`` of one pydantic error; ``keys_beside`` gives the known keys at a path."""
    path, value = error["loc"], error["input"]
    if error["type"] == "extra_forbidden":
        return f"{dotted(path)}: unknown key{near(str(path[-1]), keys_beside(path))}"
    if error["type"] == "missing":
        return f"{dotted(path)}: is required"
    if error["type"] in ("model_type", "dict_type"):
        reason = "should be a mapping"
    else:
        reason = error["msg"].removeprefix("Input ")
    return f"{dotted(path)}: {reason}" + ("" if error["type"] == OURS else f", got {_shown(value)}")


def near(word: str, known: Iterable[str]) -> str:
    """A hint at what ``word`` was meant to be, empty where nothing in ``known`` is like it."""
    matches = difflib.get_close_matches(word, list(known), n=2)
    return f"; did you mean {' or '.join(matches)}?" if matches else ""


def _shown(value: Any) -> str:
    text = json.dumps(value, default=repr, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
