"""What other people's code is given: copies that it cannot write to, so that nothing it does reaches what is logged and measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np


def lent(value: Any) -> Any:
    """A copy of a record and of the records in it, in which every array is a read-only copy."""
    if isinstance(value, np.ndarray):
        copy = value.copy()
        copy.flags.writeable = False
        return copy
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(lent, value))
    if type(value) is tuple:
        return tuple(map(lent, value))
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: lent(getattr(value, field.name)) for field in fields(value)})
    if isinstance(value, Mapping):
        return MappingProxyType({key: lent(inner) for key, inner in value.items()})
    return value
