"""The files of a results directory: their names, contents and writers, and functions that write a whole file or
nothing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.output import whole_file
from safevar_sumo.study import refuse_other_than_file

MANIFEST, SOLUTIONS, RUNS = "manifest.json", "solutions.csv", "runs"
ORIGINAL = "original"
"""Name of the original vehicle's journal."""


class ResultsFile(NamedTuple):
    """A file of a results directory: its name, or a pattern of names; its content; and the command that writes it."""

    name: str
    content: str
    writer: str


FILES = (
    ResultsFile(
        MANIFEST,
        "the study as it was run, the original vehicle's metrics, versions, digests of files, and folders of your own "
        "code and files: [what results depend on](results.md)",
        "`study`, `import`",
    ),
    ResultsFile(SOLUTIONS, "a row for each solution of each finished run", "`study` after its last run, `import`"),
    ResultsFile(
        f"{RUNS}/*-*.jsonl",
        "every evaluation of the run ALGORITHM-NN, from which an interrupted study continues",
        "`study` after each batch",
    ),
    ResultsFile(f"{RUNS}/{ORIGINAL}.jsonl", "the original vehicle's evaluation", "`study` before its first run"),
)
"""Every file of a results directory; the manual lists them."""


def run_name(algorithm: str, run: int) -> str:
    """The name of an algorithm's run in its journal and in messages, such as nsga2-03."""
    return f"{algorithm}-{run:02d}"


def journal_file(directory: Path, run: str) -> Path:
    """The journal of a run, by the run's name, or of the `ORIGINAL`."""
    return directory / RUNS / f"{run}.jsonl"


def stored_runs(directory: Path) -> set[str]:
    """Names of the runs that have a journal."""
    return {path.stem for path in (directory / RUNS).glob("*.jsonl")} - {ORIGINAL}


def make_directory(path: Path) -> None:
    """Make a directory for results, if there is none, and check that it can be written.

    Raises
    ------
    InputError
        If the directory cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        is_dangling = path.is_symlink() and not path.exists()
        problem = "it is a link whose target does not exist" if is_dangling else error.strerror
        raise InputError("out", f"cannot write to {path}: {problem}", "a directory that can be written") from None


def write_whole(path: Path, text: str) -> None:
    """Write a file as a whole or not at all.

    Raises
    ------
    SafevarError
        If the file cannot be written.
    """
    try:
        refuse_other_than_file(path)
        with whole_file(path) as temporary_file, open(temporary_file, "x", encoding="utf-8", newline="") as file:
            file.write(text)
    except OSError as error:
        raise SafevarError(f"{path}: cannot be written: {error.strerror}; earlier data stays valid") from None
