"""YAML of configuration files: plain data with the line of every key, and back.

Scalars are those of YAML 1.2, so that ``1e-5`` is a number, and ``1:30`` and ``on`` are text. Duplicate
keys, aliases and numbers that are not finite are refused: each is a slip of the pen far more often than meant.
"""

from __future__ import annotations

import math
import re
from typing import Any, ClassVar

import yaml

from tbmfg.errors import RigError

KeyPath = tuple[str | int, ...]


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}  # none but ours

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "aliases are not read", self.peek_event().start_mark)
        return super().compose_node(parent, index)


class _Dumper(yaml.SafeDumper):
    """Quotes whatever the loader would not read as text."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}  # none but ours


_DECIMAL = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
_SCALARS = (
    ("bool", "true|false", "tf"),
    ("null", "null|~|", ("n", "~", "")),
    ("int", "[-+]?(?:0|[1-9][0-9]{0,17})", "-+0123456789"),  # longer ones are floats
    ("float", rf"{_DECIMAL}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", "-+.0123456789"),
)
for _side in (_Loader, _Dumper):
    for _tag, _pattern, _first in _SCALARS:
        _side.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), list(_first))


def dump(data: Any) -> str:
    """``data`` as YAML, innermost collections on one line; :func:`parse` gives it back exactly."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)


def inline(data: dict[str, Any]) -> str:
    """A mapping as one line without its outer braces."""
    flow = {"default_flow_style": True, "width": math.inf, "sort_keys": False}
    return yaml.dump(data, Dumper=_Dumper, allow_unicode=True, **flow).strip()[1:-1]


def parse(text: str, source: str) -> tuple[Any, dict[KeyPath, int]]:
    """The data in ``text`` and the line of every key path, from 1; ``source`` names it in messages."""
    tree = _Tree(source)
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        data = None if node is None else tree.value(loader, node, ())
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{source}:{mark.line + 1}" if mark else source
        reason = getattr(error, "problem", None) or getattr(error, "reason", "cannot be parsed")
        raise RigError(f"{place}: not valid YAML: {reason}") from None
    except RecursionError:
        raise RigError(f"{source}: nested too deeply") from None
    if tree.faults:
        raise RigError("\n".join(tree.faults))
    return data, tree.lines


class _Tree:
    """Walks the nodes of one document."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.lines: dict[KeyPath, int] = {(): 1}
        self.faults: list[str] = []

    def value(self, loader: _Loader, node: yaml.Node, path: KeyPath) -> Any:
        if isinstance(node, yaml.MappingNode):
            return self._mapping(loader, node, path)
        if isinstance(node, yaml.SequenceNode):
            items = []
            for index, item in enumerate(node.value):
                self.lines[*path, index] = item.start_mark.line + 1
                items.append(self.value(loader, item, (*path, index)))
            return items
        scalar = loader.construct_object(node)
        if isinstance(scalar, float) and not math.isfinite(scalar):
            self._refuse(node, path, f"should be a finite number, got {node.value}")
        return scalar

    def _mapping(self, loader: _Loader, node: yaml.MappingNode, path: KeyPath) -> dict[str, Any]:
        data: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = loader.construct_object(key_node) if isinstance(key_node, yaml.ScalarNode) else None
            if not isinstance(key, str):
                self._refuse(key_node, path, f"a key should be a name, got {key_node.value}")
                continue
            here = (*path, key)
            if key in data:
                self._refuse(key_node, here, f"is given twice, first in line {self.lines[here]}")
            self.lines[here] = key_node.start_mark.line + 1
            data[key] = self.value(loader, value_node, here)
        return data

    def _refuse(self, node: yaml.Node, path: KeyPath, reason: str) -> None:
        self.faults.append(f"{self.source}:{node.start_mark.line + 1}: {dotted(path)}: {reason}")


def dotted(path: KeyPath) -> str:
    """``sensors.prism.arm_m.0``; the root is "the file"."""
    return ".".join(map(str, path)) or "the file"
