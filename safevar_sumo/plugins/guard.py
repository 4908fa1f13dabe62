"""The contracts of users' classes, and the guard that calls user code and checks its results."""

from __future__ import annotations

import inspect
import traceback
import types
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np

from safevar_sumo.errors import InputError, UserCodeError, describe_error
from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.records import BoolArray, FloatArray, IntArray

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
UserValue = Any
"""What user code returns, before it is checked."""
INFINITY = float("inf")
ABSTRACT = "__isabstractmethod__"
"""Attribute of an abstract method."""
MAX_QUOTED_ELEMENTS, MAX_QUOTE = 4, 80
"""Largest size of an array, and of any other value's text [characters], that an error quotes."""
_open_runs: ContextVar[BoolArray | None] = ContextVar("open_runs", default=None)
"""Which of N runs have not ended yet, shape (N,); None outside a simulation."""


def violation(candidate: Any, base: type) -> str:
    """The reason why a class does not meet the contract of a base class, found by inspection only; "" if it does.

    The abstract methods of the base must exist, and every method of the base must take the parameters that it takes
    there. The class need not derive from the base: see `completed`.
    """
    if not inspect.isclass(candidate):
        return f"is a {type(candidate).__name__}, not a class"
    for name, parameters in _methods(base).items():
        attribute, method = getattr(candidate, name, getattr(base, name)), f"{name}({', '.join(parameters)})"
        if hasattr(attribute, ABSTRACT) or not callable(attribute):
            return f"has no method {method}"
        # A static or class method takes no `self`.
        takes_self = inspect.isfunction(inspect.getattr_static(candidate, name, getattr(base, name)))
        if not accepts(attribute, takes_self + len(parameters)):
            return f"has a method {name} that does not take ({', '.join(parameters)})"
    return ""


def contract_of(base: type) -> str:
    """What a class of this base must have, in words."""
    methods = [f"{name}({', '.join(parameters)})" for name, parameters in abstract_methods(base).items()]
    return f"a class such as {base.__module__.rpartition('.')[0]}.{base.__name__} with {', '.join(methods)}"


def completed(candidate: type, base: type) -> type:
    """A class with the defaults of a base class for all members that it lacks."""
    return candidate if issubclass(candidate, base) else types.new_class(candidate.__name__, (candidate, base))


def abstract_methods(base: type) -> dict[str, list[str]]:
    """The methods that a class of this base must have, and the names of their parameters without default."""
    return {name: names for name, names in _methods(base).items() if hasattr(getattr(base, name), ABSTRACT)}


def _methods(base: type) -> dict[str, list[str]]:
    """The public methods of a class, and the names of their parameters without default and without `self`."""
    return {
        name: [
            parameter.name
            for parameter in list(inspect.signature(method).parameters.values())[1:]
            if parameter.default is parameter.empty
        ]
        for name, method in vars(base).items()
        if inspect.isfunction(method) and not name.startswith("_")
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
    """Within the block, wrong values are ignored unless their run is open, `are_open`, shape (N,).

    A vehicle whose run has ended still moves while others in its batch drive. `are_open` may change during the block.
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


class Legal(NamedTuple):
    """Legal numbers: from `lowest`, or above it, to `highest`; `infinite` and `undefined` allow infinities and NaN."""

    lowest: float = -INFINITY
    highest: float = INFINITY
    above: bool = False
    infinite: bool = False
    undefined: bool = False
    kinds: str = "biuf"  # numpy's letters of the legal types

    def __str__(self) -> str:
        bounds = f"{'above' if self.above else 'from'} {self.lowest:g} to {self.highest:g}"
        return "truth values" if self is TRUTH else f"numbers {bounds}{'' if self.infinite else ', finite'}"

    def holds(self, numbers: FloatArray) -> BoolArray:
        """Which numbers are legal."""
        is_legal = (numbers > self.lowest) if self.above else (numbers >= self.lowest)
        is_legal &= (numbers <= self.highest) & (self.infinite | np.isfinite(numbers))
        return np.asarray(is_legal | (self.undefined & np.isnan(numbers)))


FINITE, POSITIVE, SHARE, TRUTH = Legal(), Legal(0.0, above=True), Legal(0.0, 1.0), Legal(kinds="b")


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
        try:
            return function(*arguments, **keywords)
        except (UserCodeError, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise self.failure(method, error) from error

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
        try:
            return f"{inspect.getfile(function)}:{inspect.getsourcelines(function)[1]}"
        except (OSError, TypeError):
            return ""

    def elements(self, method: str, value: UserValue, expected: str) -> tuple[Any, ...]:
        """The elements of a result that must be a tuple or list of two."""
        if not isinstance(value, tuple | list) or len(value) != 2:
            raise self._wrong_result(_short_text(value), method, expected)
        return tuple(value)

    def field(self, method: str, value: UserValue, name: str) -> Any:
        """An attribute that a result must have."""
        try:
            return getattr(value, name)
        except AttributeError:
            raise self._wrong_result(_short_text(value), method, f"an object with the attribute {name}") from None

    def columns(
        self,
        method: str,
        value: UserValue,
        shape: tuple[int, ...],
        legal: Mapping[str, Legal],
        scalars: Collection[str] = (),
    ) -> dict[str, Any]:
        """The attributes of a result that are named in `legal`, each checked; those in `scalars` are single numbers."""
        columns = dict[str, float | np.ndarray]()
        for name, legal_numbers in legal.items():
            is_scalar, attribute = name in scalars, self.field(method, value, name)
            column = self.numbers(method, name, attribute, () if is_scalar else shape, legal_numbers)
            columns[name] = column.item() if is_scalar else column
        return columns

    def numbers(
        self, method: str, quantity: str, value: UserValue, shape: tuple[int, ...], legal: Legal = FINITE
    ) -> np.ndarray:
        """A result as a new array of float64, or of bool; wrong values of runs that have ended become 0.

        A single value is accepted as the value of all elements.
        """
        expected = f"{legal}, shape {shape}"
        try:
            array = np.asarray(value)
        except ValueError:
            raise self.wrong_value(method, quantity, value, expected) from None
        if array.dtype.kind not in legal.kinds:
            raise self.wrong_value(method, quantity, value, expected)
        if array.shape not in (shape, ()):
            raise self._wrong_result(f"{quantity} of shape {array.shape}", method, expected)
        numbers = np.broadcast_to(array, shape).astype(bool if legal is TRUTH else float)
        is_legal = legal.holds(numbers)
        wrong_rows = open_rows(~is_legal)
        if len(wrong_rows):
            raise self.wrong_value(method, quantity, float(numbers.flat[wrong_rows[0]]), expected)
        numbers[~is_legal] = 0
        return numbers

    def _place(self, error: BaseException) -> str:
        """File and line of the innermost frame in user code; "" if there is none."""
        frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
        if isinstance(error, SyntaxError) and error.filename:
            frames.append((error.filename, error.lineno))
        for file, line in reversed(frames):
            if is_user_file(file) or (self.folder and file.startswith(self.folder)):
                return f"{file}:{line}"
        return ""


def _short_text(value: object) -> str:
    """A returned value in a few words on one line."""
    if isinstance(value, np.ndarray) and value.size > MAX_QUOTED_ELEMENTS:
        return f"an array of {value.dtype}, shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= MAX_QUOTE else f"a {type(value).__name__}"
