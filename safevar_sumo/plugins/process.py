"""User code in this process: what user code has changed here, and which files it opens. (The text
of user code does not always name the files.)
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import source_from_cache
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any
from uuid import uuid4

import platformdirs

from safevar_sumo.errors import settable_interrupts
from safevar_sumo.plugins.files import CACHE, is_user_file, name_of_file
from safevar_sumo.shipped import PACKAGE

if TYPE_CHECKING:
    from safevar_sumo.plugins.modules import Modules

SYSTEM_FOLDERS = ("/usr/", "/etc/", "/lib", "/proc/", "/sys/", "/dev/", "/var/")
"""Folders of the system. Libraries read files there, such as time zones, that are no files of the
user.
"""
WRITING = os.O_WRONLY | os.O_RDWR
"""Flags of a file that is opened for writing."""


@dataclass
class _Process:
    """The state of this process that user code may change. All studies in this process share the
    state.

    Attributes
    ----------
    added_folders
        Folders that were added to Python's path for user code.
    shown_modules, running_modules
        The modules of user code in `sys.modules`, and those of the code that runs now.
    named_files
        Files of the modules that studies name. Errors also quote lines of installed modules, if a
        study names them.
    opened
        Paths that user code has opened for reading; None while nobody records them.
    is_listening
        Whether this process has a hook that notices opened files.
    last_words
        In a worker: the file in which this process notes its work. After a crash or an exceeded
        time limit, the file says what the worker was doing.
    is_limited
        Whether a time limit is running.
    attempts
        In a worker: the folder in which this process notes what it simulates, in case workers die
        of it.
    mark
        The text by which child processes of simulators in this process can be found.
    worker
        The number of this process among the processes that simulate on this machine.
    descriptor
        An open file. If it is closed, user code has closed descriptors of this process.
    """

    added_folders: list[str] = field(default_factory=list)
    shown_modules: Modules | None = None
    running_modules: Modules | None = None
    named_files: set[str] = field(default_factory=set)
    opened: set[str] | None = None
    is_listening: bool = False
    last_words: IO[str] | None = None
    is_limited: bool = False
    worker: int = 0
    attempts: Path | None = None
    mark: str = field(default_factory=lambda: uuid4().hex)
    descriptor: int = field(default_factory=lambda: os.open(os.devnull, os.O_RDONLY))

    @property
    def is_worker(self) -> bool:
        """Whether this process is a worker of a pool."""
        return self.last_words is not None


this_process = _Process()
MARK = "SAFEVAR_WORKER"
"""The environment variable with the `mark`, which child processes of a simulator inherit."""
MAX_DEATHS = 1
"""Number of workers that may die of a job before the job fails. Another process may have killed a
worker by mistake.
"""
REPRODUCED_BY = "; to reproduce it: "
"""The text before a command that simulates a setting again."""
CLOSED = "user code has closed descriptors of its process"
"""The last words of a worker that cannot send results any more."""


def note_work(text: str) -> None:
    """Note the work of this process, if it is a worker, in case that it dies of this work."""
    words = this_process.last_words
    if words is not None:
        words.seek(0)
        words.truncate()
        words.write(f"{text}\n")
        words.flush()


@contextmanager
def temporary_entries(
    mapping: MutableMapping[str, Any], entries: Mapping[str, Any]
) -> Iterator[None]:
    """Within the block, a mapping, such as the environment, has these entries. Afterwards it has
    the earlier entries again.
    """
    earlier_values = {name: mapping.get(name) for name in entries}
    mapping.update(entries)
    try:
        yield
    finally:
        for name, value in earlier_values.items():
            if value is None:
                mapping.pop(name, None)
            else:
                mapping[name] = value


@contextmanager
def find_damage() -> Iterator[list[str]]:
    """Give a list. After the block, the list says which parts of its process user code has closed.

    If user code replaces a stream by None, the stream is restored. A worker without descriptors
    ends.
    """
    damage = list[str]()
    streams = sys.stdout, sys.stderr
    try:
        yield damage
    finally:
        if None in (sys.stdout, sys.stderr) and None not in streams:
            damage.append("user code has set sys.stdout or sys.stderr to None")
            sys.stdout, sys.stderr = streams
        try:
            os.fstat(this_process.descriptor)
        except OSError:
            damage.append(CLOSED)
            _end_without_pipes()


def _end_without_pipes() -> None:
    """End this process, if it is a worker, after its last words."""
    words = this_process.last_words
    if words is not None:
        with suppress(OSError), Path(words.name).open("r+", encoding="utf-8") as file:
            file.seek(0, os.SEEK_END)
            file.write(f"{CLOSED}\n")
        os._exit(1)


def end_children(mark: str) -> None:
    """Kill the processes that inherited a mark, on systems that show the environment of
    processes.
    """
    entry = f"{MARK}={mark}".encode()
    # A process that has just started does not show its environment yet: the second round finds it.
    for pause in (0.0, 0.02):
        time.sleep(pause)
        for path in Path("/proc").glob("[0-9]*/environ"):
            with suppress(OSError):
                process = int(path.parent.name)
                if entry in path.read_bytes().split(b"\0") and process != os.getpid():
                    os.kill(process, signal.SIGKILL)


class Interrupt(KeyboardInterrupt):
    """A KeyboardInterrupt from a signal. (User code may raise a KeyboardInterrupt, too.)"""


@contextmanager
def mark_interrupts() -> Iterator[None]:
    """Within the block, a signal such as Ctrl-C raises an `Interrupt` instead of a
    KeyboardInterrupt.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        try:
            handlers[number](number, frame)
        except KeyboardInterrupt:
            raise Interrupt from None

    # Python interrupts only the main thread.
    handlers: dict[int, Any] = {}
    for number in settable_interrupts():
        handler = signal.getsignal(number)
        if callable(handler):
            handlers[number] = handler
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        for code, handler in handlers.items():
            # If user code has set a handler of its own, this handler stays.
            if signal.getsignal(code) is interrupt:
                signal.signal(code, handler)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Within the block, Ctrl-C and similar signals wait until the end of the block. Otherwise a
    compiler would print the exception, and go on.
    """
    waiting: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        waiting.append(number)

    handlers = {}
    for interrupt in settable_interrupts():
        # A handler that Python has not set (None) could not be set again.
        if signal.getsignal(interrupt) is not None:
            handlers[interrupt] = signal.signal(interrupt, note)
    try:
        yield
    finally:
        for interrupt, handler in handlers.items():
            signal.signal(interrupt, handler)
        # The first signal ends the command: further ones would say nothing more.
        if waiting:
            signal.raise_signal(waiting[0])


@contextmanager
def record_opened(folders: Sequence[str]) -> Iterator[list[str]]:
    """Give a list. After the block, the list has the names of the files that user code opened for
    reading within the block.

    `folders` are the folders of the study's file and of the files that the study extends.
    """
    if not this_process.is_listening:
        # A hook cannot be removed: a process needs only one.
        sys.addaudithook(_listen)
        this_process.is_listening = True

    start = time.time()
    names = list[str]()
    opened = set[str]()
    this_process.opened = opened
    try:
        yield names
    finally:
        this_process.opened = None

    own_folders = tuple(
        f"{os.path.abspath(folder)}{os.sep}" for folder in (*folders, os.getcwd())
    )
    # In these folders, libraries keep files of their own, such as lists of fonts.
    caches = (platformdirs.user_cache_path(), platformdirs.user_config_path())
    foreign_folders = (*SYSTEM_FOLDERS, *(f"{path}{os.sep}" for path in caches))
    for path in opened:
        if not is_user_file(path):
            continue
        is_of_user = path.startswith(own_folders) or not path.startswith(
            foreign_folders
        )
        is_cache = path.endswith(".pyc") or f"{os.sep}{CACHE}{os.sep}" in path
        # A file that is newer than the beginning of the block was written by the user code itself.
        is_older = os.path.isfile(path) and os.path.getmtime(path) < start
        if is_of_user and is_older and not is_cache:
            names.append(name_of_file(Path(path), folders))
    names.sort()


def file_of_module(name: str) -> str:
    """The file of a loaded module, or the folder of a package without __init__.py. "" for a module
    that is part of the interpreter.
    """
    module = sys.modules.get(name)
    return str(
        getattr(module, "__file__", None)
        or next(iter(getattr(module, "__path__", ())), "")
    )


def _listen(event: str, arguments: tuple[Any, ...]) -> None:
    """Note a file or database that user code opens for reading."""
    if event not in ("open", "sqlite3.connect") or this_process.opened is None:
        return
    path, mode, flags = arguments if event == "open" else (_database(*arguments), "", 0)
    is_read = not (set(mode or "") & set("wax+") or (flags or 0) & WRITING)
    if is_read and isinstance(path, str | bytes) and _is_from_user_code():
        name = os.path.abspath(os.fsdecode(path))
        # A module may have been compiled by an earlier process: its source counts.
        if f"{os.sep}{CACHE}{os.sep}" in name and name.endswith(".pyc"):
            name = source_from_cache(name)
        this_process.opened.add(name)


def _database(name: Any) -> Any:
    """The file of a database. sqlite3 gets the path, or a text `file:PATH?OPTIONS`."""
    if isinstance(name, os.PathLike):
        name = os.fspath(name)
    if isinstance(name, str) and name.startswith("file:"):
        return name.removeprefix("file:").partition("?")[0]
    return name


def _is_from_user_code() -> bool:
    """Return whether user code makes the present call, directly or through a library, without code
    of this package in between.
    """
    frame = sys._getframe(2)  # noqa: SLF001 - inspect.currentframe is slower, and this is a hook
    while frame is not None:
        file = frame.f_code.co_filename
        if is_user_file(file):
            return True
        if file.startswith(f"{PACKAGE}{os.sep}") and file != __file__:
            return False
        frame = frame.f_back  # type: ignore[assignment]
    return False
