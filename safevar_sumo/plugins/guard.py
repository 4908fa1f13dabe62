"""The contracts of users' classes, and the guard that calls user code and checks its results."""

from __future__ import annotations

import inspect
import os
import traceback
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np

from safevar_sumo.errors import InputError, UserCodeError, describe_error
from safevar_sumo.plugins.files import audit_hook, is_user_file
from safevar_sumo.records import BoolArray, FloatArray, IntArray

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
UserValue = Any
"""What user code returns, before it is checked."""
INFINITY = float("inf")
_open_runs: ContextVar[BoolArray | None] = ContextVar("open_runs", default=None)
"""Which of N runs have not ended yet, shape (N,); None outside a simulation."""


def violation(candidate: Any, base: type) -> str:
    """The reason why a class does not meet the contract of a base class, found by inspection only; "" if it does.

    The abstract methods of the base must exist, and every method of the base must take the parameters that it takes
    there. The class need not derive from the base: see `completed`.
    """
    if not inspect.isclass(candidate):
        value = f"value of type {type(candidate).__name__}"
        return (
            f"is a {'module' if inspect.ismodule(candidate) else 'function' if callable(candidate) else value}, "
            "not a class"
        )
    for name, parameters in _methods(base).items():
        attribute, signature = getattr(candidate, name, getattr(base, name)), ", ".join(parameters)
        if getattr(attribute, "__isabstractmethod__", False):
            return f"has no method {name}({signature})"
        if not callable(attribute):
            return f"has {name} = {attribute!r} instead of a method {name}({signature})"
        takes_self = inspect.isfunction(inspect.getattr_static(candidate, name, getattr(base, name)))
        if not accepts(attribute, takes_self + len(parameters)):
            return f"has a method {name} that does not take ({signature})"
    return ""


def contract_of(base: type) -> str:
    """What a class of this base must have, in words."""
    methods = [
        f"{name}({', '.join(parameters)})"
        for name, parameters in _methods(base).items()
        if getattr(getattr(base, name), "__isabstractmethod__", False)
    ]
    return f"a class such as {base.__module__.rpartition('.')[0]}.{base.__name__} with {', '.join(methods)}"


def completed(candidate: type, base: type) -> type:
    """A class with the defaults of a base class for all members that it lacks."""
    return candidate if issubclass(candidate, base) else types.new_class(candidate.__name__, (candidate, base))


def _methods(base: type) -> dict[str, tuple[str, ...]]:
    """The public methods of a class, and the names of their parameters without default."""
    functions = {
        name: value for name, value in vars(base).items() if inspect.isfunction(value) and not name.startswith("_")
    }
    return {
        name: tuple(
            parameter.name
            for parameter in inspect.signature(function).parameters.values()
            if parameter.default is parameter.empty
        )[1:]
        for name, function in functions.items()
    }


def accepts(function: Any, count: int) -> bool:
    """Whether a function can be called with `count` positional arguments; True if the function has no signature."""
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # compiled code, without a signature
        return True
    return True


def read_only_copy(value: UserValue) -> Any:
    """A deep copy of a record in which every array is read-only."""
    if isinstance(value, np.ndarray):
        copy = value.copy()
        copy.flags.writeable = False
        return copy
    if isinstance(value, tuple):
        copies = map(read_only_copy, value)
        return type(value)(*copies) if hasattr(value, "_fields") else tuple(copies)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: read_only_copy(getattr(value, field.name)) for field in fields(value)})
    if isinstance(value, Mapping):
        return MappingProxyType({key: read_only_copy(inner) for key, inner in value.items()})
    return value


@contextmanager
def check_open_runs(are_open: BoolArray) -> Iterator[None]:
    """Within the block, ignore wrong values of runs that have ended: a vehicle still moves while others in its batch
    drive.

    `are_open`, shape (N,), may change during the block.
    """
    token = _open_runs.set(are_open)
    try:
        yield
    finally:
        _open_runs.reset(token)


def open_rows(holds: BoolArray) -> IntArray:
    """The indices at which `holds` is true, shape (N,), without those of runs that have ended."""
    are_open = _open_runs.get()
    return np.flatnonzero(holds if are_open is None or are_open.shape != holds.shape else holds & are_open)


class Guard(NamedTuple):
    """Calls user code and checks the results.

    Attributes
    ----------
    source
        The study, as errors name it.
    name
        The user code as the study names it, such as `ads.model = 'my_ads:Careful'`.
    folder
        Folder of the user code; an error names the innermost line in this folder.
    target
        The class, function or record; the error for a wrong result names the line where the method begins.
    """

    source: str
    name: str
    folder: str = ""
    target: Any = None

    def call(
        self,
        method: str,
        function: Callable[Parameters, Result],
        *arguments: Parameters.args,
        **keywords: Parameters.kwargs,
    ) -> Result:
        """Call a function and return its result.

        Raises
        ------
        UserCodeError
            If the function raises anything but Ctrl-C.
        """
        audit_hook.call_depth += 1
        try:
            return function(*arguments, **keywords)
        except (UserCodeError, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise self.failure(method, error) from error
        finally:
            audit_hook.call_depth -= 1

    def failure(self, method: str, error: BaseException) -> UserCodeError:
        """The error for an exception that user code raised."""
        place = self._place(error) or self.definition(method)
        reason = f"{error.source}: {error.problem}" if isinstance(error, InputError) else describe_error(error)
        problem = f"{self.name} raised in {method}: {reason}{f' ({place})' if place else ''}"
        return UserCodeError(self.source, problem, error.legal if isinstance(error, InputError) else "", place)

    def wrong_value(self, method: str, quantity: str, value: object, expected: str) -> UserCodeError:
        """The error for a result with a wrong value of `quantity`."""
        return self._wrong_result(f"{quantity} = {_short_text(value)}", method, expected)

    def _wrong_result(self, result: str, method: str, expected: str) -> UserCodeError:
        place = self.definition(method)
        return UserCodeError(
            self.source, f"{self.name} returned {result} from {method}{f' ({place})' if place else ''}", expected, place
        )

    def definition(self, method: str) -> str:
        """File and line at which a method begins, else the class or function; "" for FMUs and compiled code."""
        target = getattr(self.target, "function", self.target)
        function = inspect.unwrap(getattr(target, method, target))
        code = getattr(function, "__code__", None)
        try:
            return (
                f"{code.co_filename}:{code.co_firstlineno}"
                if code
                else f"{inspect.getfile(target)}:{inspect.getsourcelines(target)[1]}"
            )
        except (OSError, TypeError):
            return ""

    def elements(self, method: str, value: UserValue, expected: str, count: int = 2) -> tuple[Any, ...]:
        """The elements of a result that must be a tuple or list of `count` elements."""
        if not isinstance(value, tuple | list) or len(value) != count:
            raise self._wrong_result(_short_text(value), method, expected)
        return tuple(value)

    def field(self, method: str, value: UserValue, name: str) -> Any:
        """An attribute that a result must have."""
        try:
            return getattr(value, name)
        except AttributeError:
            raise self._wrong_result(_short_text(value), method, f"an object with the attribute {name}") from None

    def numbers(
        self,
        method: str,
        quantity: str,
        value: UserValue,
        shape: tuple[int, ...],
        lowest: float = -INFINITY,
        highest: float = INFINITY,
        *,
        above: bool = False,
        infinite: bool = False,
        undefined: bool = False,
    ) -> FloatArray:
        """A result as a new array of float64; wrong values of runs that have ended become 0.

        Parameters
        ----------
        shape
            Expected shape; a single number is accepted as the value of all elements.
        lowest, highest
            Bounds; `above` excludes `lowest` itself.
        infinite, undefined
            Whether infinities and NaN are legal.
        """
        bounds = f"{'above' if above else 'from'} {lowest:g} to {highest:g}"
        expected = f"numbers {bounds}, {'' if infinite else 'finite, '}shape {shape}"
        numbers = self._array(method, quantity, value, shape, "biuf", expected).astype(float)
        is_valid = (numbers > lowest) if above else (numbers >= lowest)
        is_valid &= numbers <= highest
        if not infinite:
            is_valid &= np.isfinite(numbers)
        if undefined:
            is_valid |= np.isnan(numbers)
        if not is_valid.all():
            for row in open_rows(~is_valid)[:1]:
                raise self.wrong_value(method, quantity, float(numbers.flat[row]), expected)
            numbers[~is_valid] = 0.0
        return numbers

    def booleans(self, method: str, quantity: str, value: UserValue, shape: tuple[int, ...]) -> BoolArray:
        """A result as a new array of bool."""
        return self._array(method, quantity, value, shape, "b", f"truth values, shape {shape}").astype(bool)

    def _array(
        self, method: str, quantity: str, value: UserValue, shape: tuple[int, ...], kinds: str, expected: str
    ) -> np.ndarray:
        try:
            array = np.asarray(value)
        except ValueError:
            raise self.wrong_value(method, quantity, value, expected) from None
        if array.dtype.kind not in kinds:
            raise self.wrong_value(method, quantity, value, expected)
        if array.shape not in (shape, ()):
            raise self._wrong_result(f"{quantity} of shape {array.shape}", method, expected)
        return np.broadcast_to(array, shape)

    def _place(self, error: BaseException) -> str:
        """File and line of the innermost frame in user code; "" if there is none."""
        frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
        if isinstance(error, SyntaxError) and error.filename:
            frames.append((error.filename, error.lineno))
        for file, line in reversed(frames):
            if os.path.isabs(file) and (is_user_file(file) or (self.folder and file.startswith(self.folder))):
                return f"{file}:{line}"
        return ""


def _short_text(value: object) -> str:
    """A returned value in a few words on one line."""
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of {value.dtype}, shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"a {type(value).__name__}"
