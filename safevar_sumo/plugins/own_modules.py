"""A user's modules as one of many vehicles has them: loaded for it alone, so that what they keep is its own."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from safevar_sumo.plugins.lookup import Member, foreign_modules, remember


class OwnModules:
    """The modules from users' folders, and the package that a member was found in, once more.

    Parameters
    ----------
    attribute
        What the member is called in its module.
    places
        Folders that are the user's, as for `Lookup`.
    others
        Names of modules that are known not to be from there; they are added to.
    """

    def __init__(self, member: Member, attribute: str, places: Sequence[str], others: set[str]) -> None:
        self._member, self._attribute, self._places, self._others = member, attribute, places, others
        self._modules: dict[str, ModuleType] = {}

    def load(self) -> Any:
        """The member, from a module of its own; to be called `inside`."""
        return getattr(importlib.import_module(self._member.module), self._attribute)

    @contextmanager
    def inside(self) -> Iterator[None]:
        """Within, an import finds these modules, and loads those anew that are not among them."""
        shared = self._taken_out()
        sys.modules.update(self._modules)
        number, writes_bytecode, sys.dont_write_bytecode = len(sys.modules), sys.dont_write_bytecode, True
        try:
            yield
        finally:
            sys.dont_write_bytecode = writes_bytecode
            if len(sys.modules) != number:
                remember(sys.modules.keys() - self._others, self._places)
            self._modules = self._taken_out()
            if len(sys.modules) + len(self._modules) != number:
                self._others.update(sys.modules)
            sys.modules.update(shared)

    def _taken_out(self) -> dict[str, ModuleType]:
        names = foreign_modules(self._member.module.partition(".")[0])
        return {name: sys.modules.pop(name) for name in names if name in sys.modules}
