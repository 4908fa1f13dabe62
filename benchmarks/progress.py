"""Record the progress of commands, with nothing in the cache, for tests/questions/test_progress.py.

    python benchmarks/progress.py [COMMAND...]

Each command is carried out as typed. At most 50 lines of a command are printed: the command, the
time [s], what is done, and the total; the last one is its end. `report` needs results/rain.
"""

from __future__ import annotations

import csv
import os
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

from safevar_sumo import terminal

COMMANDS = (
    "study rain --out results/rain",
    "report results/rain --fresh",
    "tolerance rain --fresh",
    "tolerance wear --fresh",
    'repair wear --promise "treadDepth >= 2" --promise "brakeTorque >= 0.55" --fresh',
)
LINES = 50


def record(command: str) -> list[tuple[float, int, int]]:
    """The time, what is done and the total, whenever a command shows its progress."""
    rows = list[tuple[float, int, int]]()

    @contextmanager
    def open_progress(
        progress: bool | terminal.Progress, console: object = None
    ) -> Iterator[terminal.Progress]:
        def note(phase: str, done: int, total: int) -> None:
            rows.append((time.monotonic() - start, done, total))

        yield note if progress is True else progress or terminal.show_no_progress

    terminal.open_progress = (
        open_progress  # before the commands' modules take it from there
    )
    from safevar_sumo.cli.program import run_command_line

    start = time.monotonic()
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        try:
            sys.argv[1:] = shlex.split(command)
            run_command_line()
        except SystemExit:
            pass
    _, done, total = rows[-1]
    return [*rows, (time.monotonic() - start, done, total)]


def main(commands: list[str]) -> None:
    """Print a selection of what is recorded: the last line of each of equal intervals."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    for command in commands or COMMANDS:
        rows = record(command)
        end = rows[-1][0]
        kept = {int((LINES - 1) * row[0] / end): row for row in rows}
        for seconds, done, total in kept.values():
            writer.writerow(
                (command.partition(" --")[0], f"{seconds:.1f}", done, total)
            )


if __name__ == "__main__":
    main(sys.argv[1:])
