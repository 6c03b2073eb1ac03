"""The rig as a file to edit: every key with its meaning, and beside it why it was guessed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tbmfg.fields import Node
from tbmfg.inference.draft import Inferred, one_line
from tbmfg.rig import Mounting
from tbmfg.yamltext import inline


def starter(inferred: Inferred, log_path: str) -> str:
    """The rig as a file to edit: every key with its meaning, and beside it why it was guessed."""
    reasons: dict[str, list[str]] = {}
    for one in inferred.assumptions:
        reasons.setdefault(one.key, []).append(one.reason)
    lines = [
        f"# Written by `tbmfg init` from {one_line(Path(log_path).name)}.",
        "# GUESSED: from what the log shows, or in place of what it does not say: check it. The rest are defaults.",
    ]
    lines += _lines(inferred.rig.model_dump(mode="json"), inferred.rig, (), reasons)
    if inferred.unused:
        lines += ["", "# Topics that are not used:"]
        lines += [f"#   {one_line(topic)}: {one_line(reason)}" for topic, reason in inferred.unused.items()]
    return "\n".join(lines) + "\n"


def _lines(data: dict, model: Any, path: tuple[str, ...], reasons: dict[str, list[str]]) -> Iterator[str]:
    """YAML of ``data`` key by key, beside each its ``reasons``, or what it means."""
    indent = "  " * len(path)
    for key, value in data.items():
        here = (*path, key)
        below = model[key] if isinstance(model, dict) else getattr(model, key)
        guessed = "; ".join(map(one_line, reasons.get(".".join(here), [])))
        meaning = type(model).model_fields[key].description if isinstance(model, Node) else ""
        comment = f"  # GUESSED: {guessed}" if guessed else f"  # {meaning}" if meaning else ""
        if key == "sensors" or (isinstance(below, Node) and not isinstance(below, Mounting)):
            yield f"{indent}{key}:{comment}"
            yield from _lines(value, below, here, reasons)
        else:
            yield f"{indent}{inline({key: value})}{comment}"
