"""Rigs from files and back, and single values of them replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import resources
from inspect import isclass
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from tbmfg import yamltext
from tbmfg.errors import RigError
from tbmfg.fields import Node, explain, near
from tbmfg.rig.machine import Rig
from tbmfg.rig.sensors import KINDS, kind_of
from tbmfg.yamltext import KeyPath, dotted

Switches = TypeVar("Switches", bound=Node)


def shipped() -> list[str]:
    """Names of the rigs that come with tbmfg."""
    return sorted(item.name.removesuffix(".yaml") for item in _rigs().iterdir() if item.name.endswith(".yaml"))


def load_rig(name_or_path: str | Path) -> Rig:
    """A shipped rig by its name, or a rig file. A file that is called like a shipped rig needs its path: ``./tbm``."""
    given = str(name_or_path)
    if given in shipped():
        return parse_rig((_rigs() / f"{given}.yaml").read_text("utf-8"), f"{given}.yaml")
    try:
        return parse_rig(Path(given).read_text("utf-8-sig"), given)
    except FileNotFoundError:
        known = shipped()
        hint = near(given, known) or f"; shipped are {', '.join(known)}"
        raise RigError(f"{given}: neither a file nor a shipped rig{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"{given}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8 text'}") from error


def parse_rig(text: str, source: str) -> Rig:
    """The rig in ``text``; ``source`` names it in messages."""
    data, lines = yamltext.parse(text, source)

    def where(path: KeyPath) -> tuple[str, int]:
        return source, next(lines[path[:n]] for n in range(len(path), -1, -1) if path[:n] in lines)

    return _validated(data, where)


def dump_rig(rig: Rig) -> str:
    """The rig as YAML, defaults written out; :func:`parse_rig` gives an equal rig back."""
    return yamltext.dump(_plain(rig))


def override(rig: Rig, assignments: Iterable[str]) -> Rig:
    """``rig`` with values replaced: ``sensors.prism.sigma_mm=2``; the value is YAML, numbers index lists."""
    data = _plain(rig)
    by_path: dict[KeyPath, str] = {}
    for assignment in assignments:
        source = f"--set {assignment}"
        key, equals, text = assignment.partition("=")
        if not equals or not all(key.strip().split(".")):
            raise RigError(f"{source}: should read key.path=value")
        path = tuple(key.strip().split("."))
        by_path[_assign(data, path, yamltext.parse(text, source)[0], source)] = source

    def where(path: KeyPath) -> tuple[str]:
        touching = (source for at, source in by_path.items() if at[: len(path)] == path[: len(at)])
        return (next(touching, rig.name),)

    return _validated(data, where)


def switches(rig: Rig, estimator: str, model: type[Switches]) -> Switches:
    """The rig's switches of one estimator, ``estimators.NAME`` in the file, as its model. Raises RigError for keys and
    values that the estimator does not know."""
    try:
        return model.model_validate(rig.estimators.get(estimator, {}))
    except ValidationError as error:
        faults = [explain(e, lambda path: model.model_fields) for e in error.errors(include_url=False)]
    raise RigError("\n".join(f"{rig.name}: estimators.{estimator}.{reason}" for reason in faults))


def _assign(data: Any, path: tuple[str, ...], value: Any, source: str) -> KeyPath:
    """Put ``value`` at ``path`` of ``data``; the path with list indices as integers. The last key may be new."""
    done: list[str | int] = []
    for position, key in enumerate(path):
        last = position == len(path) - 1
        if isinstance(data, list):
            if not (key.isdecimal() and int(key) < len(data)):
                raise RigError(f"{source}: {dotted(tuple(done))} has no item {key!r} (items 0 to {len(data) - 1})")
            key = int(key)
        elif not isinstance(data, dict):
            raise RigError(f"{source}: {dotted(tuple(done))} is a value, not a mapping")
        elif key not in data and not last and path[0] != "estimators":
            raise RigError(f"{source}: {dotted((*done, key))}: no such key{near(key, data)}")
        done.append(key)
        if last:
            data[key] = value
        else:
            if isinstance(data, dict) and data.get(key) is None:
                data[key] = {}  # a part that is null by default, such as truth
            data = data[key]
    return tuple(done)


def _plain(rig: Rig) -> dict[str, Any]:
    return rig.model_dump(mode="json")


def _rigs() -> Any:
    return resources.files("tbmfg") / "rigs"


def _validated(data: Any, where: Callable[[KeyPath], tuple]) -> Rig:
    """The rig in ``data``, or every fault in it by the place ``where`` its key was given."""
    try:
        return Rig.model_validate(data)
    except ValidationError as error:
        faults = sorted((where(e["loc"]), explain(e, _keys_beside)) for e in error.errors(include_url=False))
    raise RigError("\n".join(f"{':'.join(map(str, place))}: {reason}" for place, reason in faults))


def _keys_beside(path: KeyPath) -> Iterable[str]:
    """The keys that the model knows beside the unknown one at the end of ``path``."""
    model: type[BaseModel] = Rig
    parents = [key for key in path[:-1] if isinstance(key, str)]
    if parents[:1] == ["sensors"]:
        model, parents = KINDS[kind_of(parents[1])], parents[2:]
    for key in parents:
        annotation = model.model_fields[key].annotation
        model = next(a for a in (annotation, *get_args(annotation)) if isclass(a) and issubclass(a, Node))
    return model.model_fields
