"""What other people's code is given: copies that it cannot write to, so that nothing it does reaches what is logged and measured."""

from __future__ import annotations

import importlib
import multiprocessing
import traceback
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import ForeignError, InputError, told
from safevar_sumo.plugins.reading import watch
from safevar_sumo.records import BoolArray, FloatArray


def read_only_copy(value: Any) -> Any:
    """A copy of a record and of the records in it, in which every array is a read-only copy."""
    if isinstance(value, np.ndarray):
        copy = value.copy()
        copy.flags.writeable = False
        return copy
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(read_only_copy, value))
    if type(value) is tuple:
        return tuple(map(read_only_copy, value))
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: read_only_copy(getattr(value, field.name)) for field in fields(value)})
    if isinstance(value, Mapping):
        return MappingProxyType({key: read_only_copy(inner) for key, inner in value.items()})
    return value


_OURS = str(Path(__file__).resolve().parents[1])
_IMPORTS = str(Path(importlib.__file__).parent)
INSTALLED = "site-packages"
INFINITE = float("inf")


class Guard(NamedTuple):
    """Calls one plug-in and checks what it returns.

    Attributes
    ----------
    source
        The study, as errors call it.
    name
        The plug-in as the study names it, such as `ads.model = 'my_ads:Careful'`.
    folder
        Where its sources lie: the innermost line of them is told when it fails.
    """

    source: str
    name: str
    folder: str = ""

    def call(self, method: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """What the function returns.

        Raises
        ------
        ForeignError
            Whatever it raises, an attempt to end the process included.
        """
        watch.inside += 1
        try:
            return function(*arguments)
        except ForeignError:
            raise
        except KeyboardInterrupt as error:
            if multiprocessing.parent_process() is None:
                raise
            raise self.failed(method, error) from error  # Ctrl-C does not reach a worker: the plug-in has raised it
        except BaseException as error:
            raise self.failed(method, error) from error
        finally:
            watch.inside -= 1

    def failed(self, method: str, error: BaseException) -> ForeignError:
        """The error that tells of an exception."""
        place = self._place(error)
        legal = error.legal if isinstance(error, InputError) else ""
        return ForeignError(self.source, f"{self.name} raised in {method}: {told(error)}{f' ({place})' if place else ''}", legal)

    def wrong(self, method: str, what: str, got: object, expected: str) -> ForeignError:
        """The error that tells of a result; one wording for all of them."""
        return ForeignError(self.source, f"{self.name} returned {what} = {_short(got)} from {method}", expected)

    def parts(self, method: str, value: Any, expected: str, number: int = 2) -> tuple[Any, ...]:
        """A result of several parts."""
        if not isinstance(value, tuple | list) or len(value) != number:
            raise ForeignError(self.source, f"{self.name} returned {_short(value)} from {method}", expected)
        return tuple(value)

    def field(self, method: str, value: Any, name: str) -> Any:
        """An attribute that a result has to have."""
        try:
            return getattr(value, name)
        except BaseException:
            problem = f"{self.name} returned {_short(value)} from {method}"
            raise ForeignError(self.source, problem, f"an object with the attribute {name}") from None

    def numbers(self, method: str, what: str, value: Any, shape: tuple[int, ...], lowest: float = -INFINITE, highest: float = INFINITE,
                *, above: bool = False, infinite: bool = False, undefined: bool = False) -> FloatArray:
        """A result as an array of its own, float64.

        Parameters
        ----------
        shape
            What it must have; a plain number stands for all elements.
        lowest, highest
            Bounds, the lowest itself excluded if `above`.
        infinite, undefined
            Whether infinities and NaN are legal.
        """
        expected = f"numbers{_range(lowest, highest, above=above)}, {'' if infinite else 'finite, '}shape {shape}"
        found = self._array(method, what, value, shape, "biuf", expected).astype(float)
        good = (found > lowest) if above else (found >= lowest)
        good &= found <= highest
        if not infinite:
            good &= np.isfinite(found)
        if undefined:
            good |= np.isnan(found)
        if not good.all():
            raise self.wrong(method, what, float(found[~good][0]), expected)
        return found

    def truths(self, method: str, what: str, value: Any, shape: tuple[int, ...]) -> BoolArray:
        """A result as an array of its own, bool."""
        return self._array(method, what, value, shape, "b", f"truth values, shape {shape}").astype(bool)

    def _array(self, method: str, what: str, value: Any, shape: tuple[int, ...], kinds: str, expected: str) -> np.ndarray:
        try:
            found = np.asarray(value)
        except BaseException:
            raise self.wrong(method, what, value, expected) from None
        if found.dtype.kind not in kinds:
            raise self.wrong(method, what, value, expected)
        if found.shape not in (shape, ()):
            raise ForeignError(self.source, f"{self.name} returned {what} of shape {found.shape} from {method}", expected)
        return np.broadcast_to(found, shape)

    def _place(self, error: BaseException) -> str:
        """File and line of the innermost frame that is the plug-in's own, else of the innermost that is not ours."""
        frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
        if isinstance(error, SyntaxError) and error.filename:
            frames.append((error.filename, error.lineno))
        outside = [frame for frame in frames if not frame[0].startswith((_OURS, _IMPORTS, "<frozen"))]
        own = [frame for frame in outside if self.folder and frame[0].startswith(self.folder)
               and (INSTALLED in self.folder or INSTALLED not in frame[0])]
        return "{}:{}".format(*(own or outside)[-1]) if outside else ""


def _range(lowest: float, highest: float, *, above: bool) -> str:
    if lowest == -INFINITE and highest == INFINITE:
        return ""
    if highest == INFINITE:
        return f" {'above' if above else 'from'} {lowest:g}"
    return f" in {'(' if above else '['}{lowest:g}, {highest:g}]"


def _short(value: object) -> str:
    """What was returned, in a few words on one line."""
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of {value.dtype}, shape {value.shape}"
    try:
        text = " ".join(repr(value).split())
    except BaseException:
        text = ""
    return text if text and len(text) <= 80 else f"a {type(value).__name__}"
