"""User code in this process: what it has changed here, and files that it opens, though its text may
not tell.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO, Any
from uuid import uuid4

import platformdirs

from safevar_sumo.errors import INTERRUPTS
from safevar_sumo.plugins.files import CACHE, is_user_file, name_of_file
from safevar_sumo.shipped import PACKAGE

SYSTEM_FOLDERS = ("/usr/", "/etc/", "/lib", "/proc/", "/sys/", "/dev/", "/var/")
"""Folders of the system: what libraries read there, such as time zones, is no file of the user."""
WRITING = os.O_WRONLY | os.O_RDWR
"""Flags of a file that is not only read."""


@dataclass
class _Process:
    """The state of this process with regard to user code; all of its studies share it.

    Attributes
    ----------
    added_folders
        Folders that are on Python's path for user code.
    modules
        Names of all modules that user code has loaded, as far as is known.
    named_files
        Files of the modules that studies name: an error has a line of theirs also where they are
        installed.
    opened
        Paths that user code has opened to read, while they are recorded.
    is_listening
        Whether this process is told of files that are opened.
    last_words
        Where this process, if it is a worker, writes what it was doing when it crashed or exceeded
        a time limit.
    is_limited
        Whether a time limit is counting.
    attempts
        The folder in which this process, if it is a worker, notes what it simulates, in case that
        workers die of it.
    mark
        Marks the child processes of simulators in this process.
    worker
        The number of this process among those that simulate on this machine.
    descriptor
        A file that is open as long as user code leaves descriptors alone.
    """

    added_folders: list[str] = field(default_factory=list)
    modules: set[str] = field(default_factory=set)
    named_files: set[str] = field(default_factory=set)
    opened: set[str] | None = None
    is_listening: bool = False
    last_words: IO[str] | None = None
    is_limited: bool = False
    worker: int = 0
    attempts: Path | None = None
    mark: str = field(default_factory=lambda: uuid4().hex)
    descriptor: int = field(default_factory=lambda: os.open(os.devnull, os.O_RDONLY))


this_process = _Process()
MARK = "SAFEVAR_WORKER"
"""The environment variable that child processes of a simulator inherit."""
MAX_DEATHS = 1
"""Number of workers that may die of a job: another process may have killed one."""
REPRODUCED_BY = "; to reproduce it: "
"""What stands before a command that simulates a setting again."""
CLOSED = "user code has closed descriptors of its process"
"""What a worker that can send no result any more writes last."""


def note_work(text: str) -> None:
    """Note what this process, if it is a worker, works on, in case that it dies of it."""
    if (words := this_process.last_words) is not None:
        words.seek(0)
        words.truncate()
        words.write(f"{text}\n")
        words.flush()


@contextmanager
def temporary_entries(
    mapping: MutableMapping[str, Any], entries: Mapping[str, Any]
) -> Iterator[None]:
    """Within the block, a mapping, such as the environment, has these entries."""
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
    """Give a list that says after the block which parts of its process user code has closed.
    Streams that it has replaced by None are restored; a worker without descriptors ends.
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
    """End this process, if it is a worker, and say why."""
    if (words := this_process.last_words) is not None:
        with suppress(OSError), Path(words.name).open("r+", encoding="utf-8") as file:
            file.seek(0, os.SEEK_END)
            file.write(f"{CLOSED}\n")
        os._exit(1)


def end_children(mark: str) -> None:
    """Kill the processes that have inherited a mark, on systems that tell."""
    entry = f"{MARK}={mark}".encode()
    # What has just started tells nothing yet.
    for pause in (0.0, 0.02):
        time.sleep(pause)
        for path in Path("/proc").glob("[0-9]*/environ"):
            with suppress(OSError):
                process = int(path.parent.name)
                if entry in path.read_bytes().split(b"\0") and process != os.getpid():
                    os.kill(process, signal.SIGKILL)


class Interrupt(KeyboardInterrupt):
    """A KeyboardInterrupt that a signal has raised, not user code."""


@contextmanager
def mark_interrupts() -> Iterator[None]:
    """Within the block, Ctrl-C and the like raise an `Interrupt`, where they would raise a
    KeyboardInterrupt.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        try:
            handlers[number](number, frame)
        except KeyboardInterrupt:
            raise Interrupt from None

    # Only the main thread is interrupted, and only it may set handlers.
    is_main = threading.current_thread() is threading.main_thread()
    handlers = dict[int, Any]()
    for number in INTERRUPTS if is_main else ():
        if callable(handler := signal.getsignal(number)):
            handlers[number] = handler
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        for code, handler in handlers.items():
            # User code may have set a handler of its own.
            if signal.getsignal(code) is interrupt:
                signal.signal(code, handler)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Within the block, Ctrl-C and the like wait until its end: a compiler would print the
    exception, and go on.
    """
    waiting = list[int]()
    is_main = threading.current_thread() is threading.main_thread()
    handlers = {}
    for interrupt in INTERRUPTS if is_main else ():
        # A handler that was not set from Python could not be set again.
        if signal.getsignal(interrupt) is not None:
            handlers[interrupt] = signal.signal(
                interrupt, lambda number, _: waiting.append(number)
            )
    try:
        yield
    finally:
        for code, handler in handlers.items():
            signal.signal(code, handler)
        for number in waiting[:1]:
            signal.raise_signal(number)


@contextmanager
def record_opened(folders: Sequence[str]) -> Iterator[list[str]]:
    """Record the names of the files that user code opens to read within the block: the record is
    complete at its end.

    `folders` are those of the study's file and of the files that it extends.
    """
    if not this_process.is_listening:
        # A hook stays for the life of this process.
        sys.addaudithook(_listen)
        this_process.is_listening = True

    start = time.time()
    names = list[str]()
    modules = set(sys.modules)
    opened = this_process.opened = set[str]()
    try:
        yield names
    finally:
        this_process.opened = None
    this_process.modules |= sys.modules.keys() - modules

    own_folders = tuple(
        f"{os.path.abspath(folder)}{os.sep}" for folder in (*folders, os.getcwd())
    )
    # Libraries keep such files as lists of fonts there.
    caches = (platformdirs.user_cache_path(), platformdirs.user_config_path())
    not_the_users = (*SYSTEM_FOLDERS, *(f"{path}{os.sep}" for path in caches))
    for path in filter(is_user_file, opened):
        is_of_user = path.startswith(own_folders) or not path.startswith(not_the_users)
        is_cache = path.endswith(".pyc") or f"{os.sep}{CACHE}{os.sep}" in path
        # What is newer than the block was written by the code.
        is_older = os.path.isfile(path) and os.path.getmtime(path) < start
        if is_of_user and is_older and not is_cache:
            names.append(name_of_file(Path(path), folders))
    names.sort()


def file_of_module(name: str) -> str:
    """The file of a loaded module, or the folder of a package without __init__.py; "" for a module
    of the interpreter.
    """
    module = sys.modules.get(name)
    return str(
        getattr(module, "__file__", None)
        or next(iter(getattr(module, "__path__", ())), "")
    )


def _listen(event: str, arguments: tuple[Any, ...]) -> None:
    """Note a file or database that user code opens to read."""
    if event not in ("open", "sqlite3.connect") or this_process.opened is None:
        return
    path, mode, flags = arguments if event == "open" else (_database(*arguments), "", 0)
    is_read = not (set(mode or "") & set("wax+") or (flags or 0) & WRITING)
    if is_read and isinstance(path, str | bytes) and _is_from_user_code():
        this_process.opened.add(os.path.abspath(os.fsdecode(path)))


def _database(name: Any) -> Any:
    """The file of a database, which sqlite3 calls by its path or as `file:PATH?OPTIONS`."""
    if isinstance(name, os.PathLike):
        name = os.fspath(name)
    if isinstance(name, str) and name.startswith("file:"):
        return name.removeprefix("file:").partition("?")[0]
    return name


def _is_from_user_code() -> bool:
    """Whether user code calls, itself or through a library, and not this package."""
    frame = sys._getframe(2)
    while frame is not None:
        file = frame.f_code.co_filename
        if is_user_file(file):
            return True
        if file.startswith(f"{PACKAGE}{os.sep}") and file != __file__:
            return False
        frame = frame.f_back  # type: ignore[assignment]
    return False
