"""Contracts of users' classes (the methods that a class must have, and what these methods may
return), and errors of user code.

`checked_class` completes a user's class with the defaults of its base class. The methods of the
completed class get read-only arguments, and their results are checked. An exception of user code
becomes an error with its file and line. User code may change numpy's handling of floating-point
errors (`np.seterr`): `np.errstate()` restores the handling at the end of each call.
"""

from __future__ import annotations

import functools
import inspect
import traceback
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import (
    EnvironmentFault,
    InputError,
    SimulationError,
    UserCodeError,
    about,
    describe_error,
)
from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.plugins.modules import Modules
from safevar_sumo.plugins.process import (
    Interrupt,
    find_damage,
    mark_interrupts,
    this_process,
)
from safevar_sumo.records import BoolArray, FloatArray, IntArray

UserValue = Any
"""A value that user code returned, and that nobody has checked yet."""
INFINITY = float("inf")
ABSTRACT = "__isabstractmethod__"
"""The attribute that Python sets on abstract methods."""
MAX_QUOTED_ELEMENTS = 4
"""Largest number of elements of an array that an error quotes."""
MAX_QUOTED_TEXT = 80
"""Largest length of the text of any other value that an error quotes [characters]."""
_open_runs: ContextVar[BoolArray | None] = ContextVar("open_runs", default=None)
"""Which of N runs have not ended yet, shape (N,); None outside of a simulation."""


@contextmanager
def user_errors(source: str) -> Iterator[None]:
    """Within the block, turn every exception of user code into a `UserCodeError`, except Ctrl-C.
    Errors name the study `source`.
    """
    with about(source), mark_interrupts():
        try:
            with find_damage() as damage:
                yield
        except (UserCodeError, SimulationError, EnvironmentFault, Interrupt):
            raise
        except BaseException as error:
            if user_error := user_error_of(error):
                raise user_error from error
            raise
        for problem in damage:
            raise UserCodeError(
                source,
                problem,
                "code that leaves streams and descriptors of its process open",
            )


def user_error_of(error: BaseException) -> UserCodeError | None:
    """The error that names the innermost line of user code that an exception passed; None if the
    exception passed no user code.
    """
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError) and error.filename:
        frames.append(traceback.FrameSummary(error.filename, error.lineno, "import"))
    for frame in reversed(frames):
        file = frame.filename
        if _is_named_or_users(file):
            method = frame.name.replace("<module>", "import")
            place = f"{file}:{frame.lineno}"
            reason, legal = _reason_of(error)
            return UserCodeError(
                "", f"user code raised in {method}: {reason} ({place})", legal, place
            )
    return None


def _is_named_or_users(file: str) -> bool:
    """Whether a file is the user's, or that of a module that a study names."""
    return is_user_file(file) or file in this_process.named_files


def _reason_of(error: BaseException) -> tuple[str, str]:
    """Describe an exception, and what is expected instead ("" if unknown)."""
    if isinstance(error, InputError):
        return f"{error.source}: {error.problem}", error.legal
    return describe_error(error), ""


@contextmanager
def check_open_runs(are_open: BoolArray) -> Iterator[None]:
    """Within the block, ignore wrong values of runs that have ended. `are_open`, shape (N,), says
    which runs have not ended.

    A vehicle whose run has ended still moves while other vehicles of its batch drive. `are_open`
    may change during the block.
    """
    token = _open_runs.set(are_open)
    try:
        yield
    finally:
        _open_runs.reset(token)


def open_rows(holds: BoolArray) -> IntArray:
    """Return the indices at which `holds` is true, shape (N,), except indices of runs that have
    ended.
    """
    are_open = _open_runs.get()
    if are_open is not None and are_open.shape == holds.shape:
        holds = holds & are_open
    return np.flatnonzero(holds)


class Legal(NamedTuple):
    """A range of legal numbers.

    Attributes
    ----------
    lowest, highest
        The ends of the range.
    is_open
        Whether `lowest` itself is illegal.
    infinite, undefined
        Whether infinities, and NaN, are legal.
    scalar
        Whether a single number for all vehicles is legal.
    """

    lowest: float = -INFINITY
    highest: float = INFINITY
    is_open: bool = False
    infinite: bool = False
    undefined: bool = False
    scalar: bool = False
    kinds: str = "biuf"
    """The letters of the legal types, as numpy's `dtype.kind`."""

    def __str__(self) -> str:
        if self.kinds == "b":
            return "truth values"
        begin = "above" if self.is_open else "from"
        text = f"numbers {begin} {self.lowest:g} to {self.highest:g}"
        if self.infinite:
            return text
        return f"{text}, finite"

    def holds(self, numbers: FloatArray) -> BoolArray:
        """Return which numbers are legal."""
        is_legal = numbers >= self.lowest
        if self.is_open:
            is_legal = numbers > self.lowest
        is_legal &= (numbers <= self.highest) & (self.infinite | np.isfinite(numbers))
        return is_legal | (self.undefined & np.isnan(numbers))


FINITE = Legal()
POSITIVE = Legal(0.0, is_open=True)
SHARE = Legal(0.0, 1.0)
TRUTH = Legal(kinds="b")


class UserCode(NamedTuple):
    """User code, as errors name it: `name` is its key and name in the study, such as `ads.model =
    'my_ads:Careful'`. `target` is the class, function or record, and `modules` are its modules.
    """

    name: str
    target: Any = None
    modules: Modules = Modules(())

    def definition(self, method: str = "") -> str:
        """The file and line at which a method begins, or else the class or function. "" if Python
        knows no source in a file of the user, as for FMUs, compiled code and inherited methods.
        """
        target = getattr(self.target, "function", self.target)
        for candidate in (getattr(target, method, target), target):
            function = inspect.unwrap(candidate)
            try:
                # Python finds the file of a class by its module, which must be loaded.
                with self.modules.active():
                    file = inspect.getfile(function)
                    line = inspect.getsourcelines(function)[1]
            except (OSError, TypeError):
                continue
            if _is_named_or_users(file):
                return f"{file}:{line}"
        return ""

    def wrong(self, method: str, result: str, expected: str) -> UserCodeError:
        """The error that says that a method returned a wrong result."""
        place = self.definition(method)
        problem = f"{self.name} returned {result} from {method}"
        if place:
            problem += f" ({place})"
        return UserCodeError("", problem, expected, place)

    def call(self, method: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of user code. Any exception becomes a `UserCodeError`, even if no line of
        user code is in its traceback, as with an FMU.
        """
        try:
            return function(*arguments)
        except (UserCodeError, KeyboardInterrupt):
            raise
        except BaseException as error:
            if user_error := user_error_of(error):
                raise user_error from error
            reason, legal = _reason_of(error)
            raise UserCodeError(
                "", f"{self.name} raised in {method}: {reason}", legal
            ) from error

    def check_numbers(
        self,
        method: str,
        quantity: str,
        value: UserValue,
        shape: tuple[int, ...] | None,
        legal: Legal = FINITE,
    ) -> np.ndarray:
        """Check the type, shape and numbers of a result, and return the result as an array.

        Parameters
        ----------
        shape
            The shape that the result must have; None accepts any shape.
        """
        expected = str(legal)
        if shape is not None:
            expected += f", shape {shape}"
        try:
            array = np.asarray(value)
            if array.dtype.kind not in legal.kinds:
                raise ValueError
        except ValueError:
            raise self.wrong(
                method, f"{quantity} = {quoted(value)}", expected
            ) from None
        if (
            shape is not None
            and array.shape != shape
            and not (legal.scalar and not array.ndim)
        ):
            raise self.wrong(method, f"{quantity} of shape {array.shape}", expected)
        wrong_rows = open_rows(~legal.holds(array))
        if len(wrong_rows):
            raise self.wrong(
                method, f"{quantity} = {float(array.flat[wrong_rows[0]])}", expected
            )
        return array

    def checked_function(
        self, function: Callable[..., UserValue], method: str, legal: Legal
    ) -> Callable[..., FloatArray]:
        """Wrap a function of user code: the wrapped function gets read-only arguments, and its
        result of shape (N,) is checked. N is the length of the first argument.
        """

        def checked(*arguments: Any) -> FloatArray:
            views = [read_only(argument) for argument in arguments]
            with np.errstate():
                values = function(*views)
            return self.check_numbers(
                method, "values", values, (len(arguments[0]),), legal
            ).astype(float)

        return checked


class Returned(NamedTuple):
    """A description of what a method must return: an object, or a tuple of objects, with
    attributes.

    Attributes
    ----------
    parts
        For each object, the names of its attributes, with their legal numbers. The name "" stands
        for the object itself.
    like
        The index of an argument. The attributes must have the shape of the speeds or pedals of this
        argument, and the method gets this argument read-only. None without such an argument.
    then
        A further check, which gets the code, the method's name, the result and the arguments. The
        value that `then` returns replaces the result.
    """

    parts: tuple[Mapping[str, Legal], ...] = ()
    like: int | None = None
    then: Callable[..., UserValue] | None = None

    def check(
        self, code: UserCode, method: str, result: UserValue, arguments: Sequence[Any]
    ) -> UserValue:
        """Check a result, and return it, or what `then` makes of it."""
        values = result
        if len(self.parts) <= 1:
            values = (result,)
        elif not (isinstance(result, tuple | list) and len(result) == len(self.parts)):
            names = " and ".join(
                ", ".join(columns) or "memory" for columns in self.parts
            )
            raise code.wrong(
                method, quoted(result), f"a tuple of {len(self.parts)}: {names}"
            )

        shape = None
        if self.like is not None and self.parts:
            shape = _shape_of(arguments[self.like])
        for columns, value in zip(self.parts, values, strict=False):
            for name, legal in columns.items():
                if name and not hasattr(value, name):
                    raise code.wrong(
                        method,
                        quoted(result),
                        f"an object with the attributes {', '.join(columns)}",
                    )
                numbers = getattr(value, name) if name else value
                code.check_numbers(method, name or "values", numbers, shape, legal)
        if self.then is None:
            return result
        return self.then(code, method, result, *arguments)


Contract = Mapping[str, Returned]
"""What the methods of a class must return, by the methods' names."""


def _shape_of(argument: Any) -> tuple[int, ...]:
    """The shape of an argument: of an array, of the speeds or pedals of a record, or of the speeds
    in a world.
    """
    if hasattr(argument, "speeds"):
        return np.shape(argument.speeds())
    return np.shape(getattr(argument, "speed", getattr(argument, "throttle", argument)))


def checked_class(code: UserCode, base: type) -> type:
    """Complete a user's class with the defaults of a base class. The result also checks what those
    methods return that the base lists in its `RETURNS`.
    """
    candidate = code.target

    def checked_method(name: str, returned: Returned) -> Callable[..., UserValue]:
        """Make a method that calls the user's method with read-only arguments, and checks its
        result.
        """

        # Errors name the line of the user's method, which `inspect.unwrap` finds.
        @functools.wraps(getattr(candidate, name))
        def method(self: Any, *arguments: Any) -> UserValue:
            call_arguments = list(arguments)
            if returned.like is not None:
                call_arguments[returned.like] = read_only(arguments[returned.like])
            with np.errstate():
                result = getattr(super(cls, self), name)(*call_arguments)
            is_optional = returned.then is None and not hasattr(
                getattr(base, name), ABSTRACT
            )
            if result is None and is_optional:
                return None
            return returned.check(code, name, result, arguments)

        return method

    methods = {
        name: checked_method(name, returned)
        for name, returned in getattr(base, "RETURNS", {}).items()
        if getattr(candidate, name, getattr(base, name)) is not getattr(base, name)
    }
    bases = (candidate,) if issubclass(candidate, base) else (candidate, base)
    cls = types.new_class(
        candidate.__name__,
        bases,
        exec_body=lambda namespace: namespace.update(
            methods, is_user_code=True, __module__=candidate.__module__
        ),
    )
    return cls


def violation(candidate: Any, base: type) -> str:
    """The reason why a class violates the contract of a base class; "" if the class fulfils the
    contract. No code of the class is run.

    The class must define the abstract methods of the base. Every method of the base must take the
    same parameters in the class. The class need not derive from the base.
    """
    if not inspect.isclass(candidate):
        return f"is a {type(candidate).__name__}, not a class"
    for name, parameters in _methods(base).items():
        attribute = getattr(candidate, name, getattr(base, name))
        method = f"{name}({', '.join(parameters)})"
        if hasattr(attribute, ABSTRACT) or not callable(attribute):
            return f"has no method {method}"
        # A static method or a class method is called without `self`.
        takes_self = not isinstance(
            vars(base)[name], classmethod
        ) and inspect.isfunction(
            inspect.getattr_static(candidate, name, getattr(base, name))
        )
        # The names stand for values: only the signature is compared.
        arguments = ["self", *parameters] if takes_self else parameters
        try:
            inspect.signature(attribute).bind(*arguments)
        except TypeError:
            return f"has a method {name} that does not take ({', '.join(parameters)})"
    return ""


def contract_of(base: type) -> str:
    """Describe the class and the abstract methods that a user's class must have."""
    methods = [
        f"{name}({', '.join(parameters)})"
        for name, parameters in _methods(base).items()
        if hasattr(getattr(base, name), ABSTRACT)
    ]
    return (
        f"a class such as {base.__module__.rpartition('.')[0]}.{base.__name__} with"
        f" {', '.join(methods)}"
    )


def _methods(base: type) -> dict[str, list[str]]:
    """The public methods of a base class except its helpers, with the names of their parameters.
    Parameters with a default are left out, and so is `self`.
    """
    helpers = getattr(base, "HELPERS", ())
    methods = {}
    for name, attribute in vars(base).items():
        function = (
            attribute.__func__ if isinstance(attribute, classmethod) else attribute
        )
        if (
            inspect.isfunction(function)
            and not name.startswith("_")
            and name not in helpers
        ):
            _, *parameters = inspect.signature(function).parameters.values()
            methods[name] = [
                item.name for item in parameters if item.default is item.empty
            ]
    return methods


def read_only(value: UserValue) -> Any:
    """Return a read-only version of a value: arrays become read-only views, also inside of tuples,
    records, mappings and worlds.
    """
    if isinstance(value, np.ndarray):
        view = value.view()
        view.flags.writeable = False
        return view
    if isinstance(value, tuple):
        return _read_only_tuple(value)
    if is_dataclass(value) and not isinstance(value, type):
        names = (field.name for field in fields(value))
        return replace(
            value, **{name: read_only(getattr(value, name)) for name in names}
        )
    if isinstance(value, Mapping):
        return MappingProxyType({key: read_only(item) for key, item in value.items()})
    if hasattr(value, "speeds"):
        return _ReadOnlyWorld(value)
    return value


def _read_only_tuple(items: tuple[UserValue, ...]) -> tuple[Any, ...]:
    """Return a tuple of the read-only versions of items. A named tuple stays a named tuple."""
    views = [read_only(item) for item in items]
    # Named tuples take their fields as arguments, and `tuple` takes a list.
    if hasattr(items, "_fields"):
        return type(items)(*views)
    return tuple(views)


class _ReadOnlyWorld:
    """A world whose methods return read-only arrays, for the scenarios of users."""

    def __init__(self, world: Any) -> None:
        self._world = world

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._world, name)
        return lambda *arguments: read_only(method(*arguments))


def quoted(value: object) -> str:
    """A returned value as a short text on one line."""
    if isinstance(value, np.ndarray) and value.size > MAX_QUOTED_ELEMENTS:
        return f"an array of {value.dtype}, shape {value.shape}"
    text = " ".join(repr(value).split())
    if len(text) <= MAX_QUOTED_TEXT:
        return text
    return f"a {type(value).__name__}"
