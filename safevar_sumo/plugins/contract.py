"""What a class has to have before anything of it is called."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Self


class Contract(NamedTuple):
    """A contract, read off the protocol or base class that documents it.

    Attributes
    ----------
    title
        What the thing is, such as "an ADS".
    methods, optional
        The parameters of every method that must be there, and of those that may.
    attributes
        What an instance must have beside methods.
    base
        The class that it must derive from, if it must.
    """

    title: str
    methods: Mapping[str, tuple[str, ...]]
    optional: Mapping[str, tuple[str, ...]]
    attributes: tuple[str, ...]
    base: type | None = None

    @classmethod
    def of(cls, protocol: type, title: str, optional: Iterable[str] = ()) -> Self:
        """The public methods and annotated attributes of a protocol, or of a base class; those in `optional` may be missing."""
        may = set(optional)
        functions = {name: _parameters(member) for name, member in vars(protocol).items()
                     if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, classmethod))}
        return cls(
            title, {name: parameters for name, parameters in functions.items() if name not in may},
            {name: parameters for name, parameters in functions.items() if name in may},
            tuple(name for name in inspect.get_annotations(protocol) if name not in may),
            None if getattr(protocol, "_is_protocol", False) else protocol)

    def concerns(self, what: Any) -> bool:
        """Whether a class derives from the base; without a base this is everybody's contract."""
        return self.base is None or (inspect.isclass(what) and issubclass(what, self.base))

    def lacking(self, what: Any) -> str:
        """Why `what` does not meet the contract, as far as a class tells without being called; "" if it does."""
        if not inspect.isclass(what):
            return f"is {_kind_of(what)}, not a class"
        for name, parameters in {**self.methods, **self.optional}.items():
            member = getattr(what, name, None)
            if member is None and name in self.optional:
                continue
            if member is None or name in getattr(what, "__abstractmethods__", ()):
                return f"has no method {_spelled(name, parameters)}"
            if not callable(member):
                return f"has {name} = {member!r} instead of a method {_spelled(name, parameters)}"
            if not _takes(what, name, len(parameters)):
                return f"has a method {name} that does not take ({', '.join(parameters)})"
        return ""

    def __str__(self) -> str:
        if self.base is not None:
            missing = [_spelled(*one) for one in self.methods.items() if one[0] in getattr(self.base, "__abstractmethods__", ())]
            return f"a subclass of {self.base.__module__.rpartition('.')[0]}.{self.base.__name__} with {', '.join(missing)}"
        return f"{self.title}: a class with {', '.join([*(_spelled(*one) for one in self.methods.items()), *self.attributes])}"


def _spelled(name: str, parameters: tuple[str, ...]) -> str:
    return f"{name}({', '.join(parameters)})"


def _parameters(member: Any) -> tuple[str, ...]:
    """Names of a method's parameters without the first, which is the instance or the class, and those that may be missing."""
    parameters = inspect.signature(getattr(member, "__func__", member)).parameters.values()
    return tuple(one.name for one in parameters if one.default is one.empty)[1:]


def _takes(what: type, name: str, number: int) -> bool:
    """Whether a method can be called with so many arguments."""
    static = inspect.getattr_static(what, name)
    own = 1 if inspect.isfunction(static) else 0
    return takes(getattr(what, name), own + number)


def takes(function: Any, number: int) -> bool:
    """Whether a function can be called with so many arguments, as far as its signature tells."""
    try:
        inspect.signature(function).bind(*[None] * number)
    except TypeError:
        return False
    except ValueError:  # a method without a signature, of a compiled class say
        return True
    return True


def _kind_of(what: Any) -> str:
    if inspect.ismodule(what):
        return "a module"
    return "a function" if callable(what) else f"a value of type {type(what).__name__}"
