"""Names to things, some of tbmfg's own and some that other packages add by an entry point."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Mapping
from functools import cached_property
from importlib.metadata import entry_points
from typing import TypeVar

from tbmfg.errors import TbmfgError

T = TypeVar("T")


class Registry(UserDict[str, T]):
    """``own`` first, then what installed packages declare under the entry point ``group``, in the order of names.

    Those are loaded on first use, so that a module that is registered may import the one that holds the registry.
    Raises TbmfgError where one cannot be loaded, or takes a name that is taken.
    """

    def __init__(self, group: str, own: Mapping[str, T]) -> None:
        self._group, self._own = group, dict(own)

    @cached_property
    def data(self) -> dict[str, T]:  # what UserDict looks everything up in
        found = dict(self._own)
        for point in sorted(entry_points(group=self._group)):
            source = f"{point.value} (entry point {self._group} of {point.dist.name if point.dist else 'a package'})"
            if point.name in found:
                raise TbmfgError(f"{source}: the name {point.name} is taken; rename it in that package")
            try:
                found[point.name] = point.load()
            except Exception as error:
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                raise TbmfgError(f"{source} cannot be loaded ({reason}); mend or uninstall that package") from error
        return found
