"""What other people's code does to the process that it runs in is undone, or refused."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np

from safevar_sumo.errors import ForeignError

OURS = __name__.partition(".")[0]
LEGAL = "code that leaves what others import as it is: a function of its own, or a class derived from theirs"


@contextmanager
def guard_process_state(source: str, names: Sequence[str]) -> Iterator[None]:
    """Within, plug-ins of such names may run, as the study `source` calls them; without any, nothing is done.

    Working directory, environment, numpy's error state and the recursion limit are put back at the end. `os._exit`, which
    nobody could tell from a program that is over, is an exception like `sys.exit`.

    Raises
    ------
    ForeignError
        If a function or a class of numpy or of this package has been replaced: nothing that is computed with it counts.
    """
    if not names:
        yield
        return
    before, folder, environment, limit, state = _callables(), os.getcwd(), dict(os.environ), sys.getrecursionlimit(), np.geterr()
    leave = os._exit
    os._exit = _exception_instead(leave)  # type: ignore[assignment]
    try:
        yield
    finally:
        os._exit = leave
        sys.setrecursionlimit(limit)
        np.seterr(**state)
        os.chdir(folder)
        if dict(os.environ) != environment:
            os.environ.clear()
            os.environ.update(environment)
        _refuse_replaced(before, source, names)


def _exception_instead(leave: Callable[[int], NoReturn]) -> Callable[[int], NoReturn]:
    """For this thread of this process: another one, a forked process say, is left as it wants."""
    here = os.getpid(), threading.get_ident()

    def end(status: int) -> NoReturn:
        if (os.getpid(), threading.get_ident()) != here:
            leave(status)
        raise SystemExit(f"os._exit({status})")

    return end


def _callables() -> list[tuple[Any, str, Any]]:
    """Owner, name and value of every function and class of ours, of their methods, and of numpy's own."""
    modules = [module for name, module in list(sys.modules.items()) if name == OURS or name.startswith(f"{OURS}.")]
    found = [(module, name, value) for module in (np, *modules) for name, value in list(vars(module).items()) if callable(value)]
    classes = {value for _, _, value in found if isinstance(value, type) and value.__module__.startswith(f"{OURS}.")}
    return [*found, *((one, name, value) for one in classes for name, value in list(vars(one).items()) if callable(value))]


def _refuse_replaced(before: list[tuple[Any, str, Any]], source: str, names: Sequence[str]) -> None:
    for owner, name, value in before:
        if vars(owner).get(name) is not value:
            changed = f"{owner.__module__}.{owner.__qualname__}" if isinstance(owner, type) else owner.__name__
            raise ForeignError(source, f"{' or '.join(names)} has replaced {changed}.{name}", LEGAL)
