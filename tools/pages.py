"""The manual's pages: their blocks, run in the order of the page, and the outputs that they show.

`python -m tools.pages [PAGE]...`, which is `make docs-outputs`, runs pages, by default all, and
fills in their outputs. Two comments say what a block is:

`<!-- output: verdict; Minimal causes: 4 -->` above a block of text: the block has these parts of
what the block of code before it prints. A part is `verdict`, all that stands before the first
table, or the beginning of a table's title or of a line; a number limits its rows. Without parts
the block has everything.

`<!-- in tests: --runs 1 -->` above a block of commands: it takes long. Tests add these options, if
any, search for counterexamples with the fewest simulations, and do not compare its output. `<!--
exit code 3 -->`: the commands end with it.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import sys
import tempfile
import textwrap
import traceback
import warnings
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safevar_sumo.cli.program import commands
from tests.support.in_process import allow_few_simulations
from tools.manual import PROGRAM, ROOT, Block, blocks

PAGES = [
    "README.md",
    *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md"))),
]
WIDTH = 84
"""Width of the text of an output [characters]."""
TABLE_WIDTH = "100"
"""Width in which commands print their tables [characters]."""


def parts(output: str) -> Iterator[list[str]]:
    """The parts of an output: what stands before the first table; each table with the line above
    it, which is its title, and the tables that follow it at once; and what follows a table.
    """
    lines = output.rstrip().splitlines()
    starts = {0, len(lines)}
    for number, (above, line) in enumerate(pairwise(["", *lines])):
        if line.startswith("┏") and not above.startswith("└"):
            starts.add(max(number - 1, 0))
        elif above.startswith("└") and not line.startswith("┏"):
            starts.add(number)
    yield from (lines[start:end] for start, end in pairwise(sorted(starts)))


def shortened(output: str, comment: str) -> str:
    """What a page shows of an output, by the comment above the block."""
    found = [*parts(output)]
    shown = list[str]()
    for choice in filter(None, comment.removeprefix("output").strip(": ").split(";")):
        name, _, limit = choice.strip().partition(": ")
        lines = (
            found[0] if name == "verdict" else next(_beginning_with(name, found), None)
        )
        if lines is None:
            raise LookupError(
                f"no part begins with {name!r}, but {[part[0] for part in found]}"
            )
        shown += _first_rows(lines, int(limit)) if limit else lines
    lines = shown or output.rstrip().splitlines()
    wrapped = (
        [line]
        if len(line) <= WIDTH or line[0] in "┏┃┡│└"
        else textwrap.wrap(line, WIDTH)
        for line in lines
    )
    return "".join(f"{line.rstrip()}\n" for one in wrapped for line in one)


def _beginning_with(name: str, found: list[list[str]]) -> Iterator[list[str]]:
    """A table by its title, otherwise a single line."""
    yield from (
        part for part in found if part[0].startswith(name) and part[-1].startswith("└")
    )
    yield from ([line] for part in found for line in part if line.startswith(name))


def _first_rows(lines: list[str], count: int) -> list[str]:
    """A table's first rows, or a text's first lines."""
    head = next(
        (number + 1 for number, line in enumerate(lines) if line.startswith("┡")), 0
    )
    return lines if len(lines) <= head + count + 1 else [*lines[: head + count], "..."]


def run_page(page: str, options_of_tests: bool) -> Iterator[tuple[Block, str]]:
    """Run the blocks of a page in the working directory.

    Yields each block of output with what it should show; with the options of tests, blocks whose
    commands these shorten are left out. Commands whose output no block shows have these options
    always.
    """
    names = dict[str, Any]()
    printed, is_shortened = "", False
    found = blocks(page)
    for block, below in zip_longest(found, found[1:]):
        if block.comment.startswith("output"):
            if not is_shortened or not options_of_tests:
                yield block, shortened(printed, block.comment)
        elif block.title:
            Path(block.title).parent.mkdir(parents=True, exist_ok=True)
            Path(block.title).write_text(block.text, encoding="utf-8")
        elif block.language == "python":
            with redirect_stdout(io.StringIO()) as out:
                exec(compile(block.text, page, "exec"), names)
            printed, is_shortened = out.getvalue(), False
        elif block.language == "bash":
            code = int(block.comment.partition("exit code ")[2][:1] or 0)
            is_shortened = block.comment.startswith("in tests")
            is_shown = below is not None and below.comment.startswith("output")
            added = ""
            with pytest.MonkeyPatch.context() as patch:
                if is_shortened and (options_of_tests or not is_shown):
                    allow_few_simulations(patch)
                    added = block.comment.removeprefix("in tests").replace(":", "", 1)
                printed = "".join(
                    _run(line, added, code) for line in block.text.splitlines()
                )
        else:
            assert block.language in ("text", "bibtex"), (
                f"{page}: a block of {block.language!r} that nothing runs"
            )


def _run(line: str, added: str, code: int) -> str:
    """What a line of a shell prints; what a reader's machine is set up with is not run."""
    if line.startswith(PROGRAM):
        arguments = shlex.split(line.removeprefix(PROGRAM) + added, comments=True)
        done = CliRunner(env={"COLUMNS": TABLE_WIDTH}).invoke(commands, arguments)
        if done.exit_code != code:
            if done.exc_info:
                traceback.print_exception(*done.exc_info)
            raise AssertionError(
                f"{line}{added}: exit code {done.exit_code}\n{done.output}"
            )
        return done.stdout or done.stderr
    if line.startswith("make "):
        target = rf"^{re.escape(line.split()[1])}:|^\.PHONY:.* {line.split()[1]}\b"
        assert re.search(target, (ROOT / "Makefile").read_text(), flags=re.MULTILINE), (
            line
        )
        return ""
    assert (
        line.startswith(("pip install", "eval ", "#", "git clone", "cd ", "source "))
        or not line
    ), f"a line that nothing runs: {line}"
    return ""


def main() -> None:
    """Fill in the outputs of pages."""
    warnings.simplefilter("ignore")  # as the filters of pytest do
    for page in sys.argv[1:] or PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            sys.path.insert(0, os.getcwd())
            shown = [*run_page(page, options_of_tests=False)]
            sys.path.pop(0)
        for block, output in reversed(shown):
            text = text[: block.place[0]] + output + text[block.place[1] :]
        (ROOT / page).write_text(text, encoding="utf-8")
        print(page, len(shown))


if __name__ == "__main__":
    main()
