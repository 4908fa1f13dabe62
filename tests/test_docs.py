"""README and tutorials true to the letter: every block of every page is put where it says, and run in the order of the page."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from click.testing import CliRunner

from safevar_sumo.cli.program import commands
from safevar_sumo.study import load_study, study_names

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]
PROGRAM = "python -m safevar_sumo "


class Block(NamedTuple):
    """A fenced block: its language, the file that it is the content of (or ""), and its text."""

    language: str
    title: str
    text: str


def blocks(page: str) -> list[Block]:
    found = re.findall(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```$', (ROOT / page).read_text(), flags=re.DOTALL | re.MULTILINE)
    return [Block(*one) for one in found]


@pytest.mark.parametrize("page", [
    pytest.param(page, marks=[] if page == "README.md" else [pytest.mark.slow]) for page in PAGES if blocks(page)])
def test_every_block_of_a_page_does_what_it_says(page: str, in_tmp: Path) -> None:
    names: dict[str, Any] = {}
    for block in blocks(page):
        if block.title:
            Path(block.title).write_text(block.text)
        elif block.language == "python":
            exec(compile(block.text, page, "exec"), names)
        elif block.language == "bash":
            for line in block.text.splitlines():
                run(line)
        else:
            assert block.language in ("text", "bibtex"), f"{page}: a block of {block.language!r} that nothing runs"


def run(line: str) -> None:
    """A line of a shell; what a reader's machine is set up with is not run."""
    if line.startswith(PROGRAM):
        done = CliRunner().invoke(commands, shlex.split(line.removeprefix(PROGRAM), comments=True), catch_exceptions=False)
        assert done.exit_code == 0, f"{line}\n{done.output}"
    elif line.startswith("make "):
        assert re.search(rf"^{line.split()[1]}:", (ROOT / "Makefile").read_text(), flags=re.MULTILINE), line
    else:
        assert line.startswith(("pip install", "eval ", "#")) or not line, f"a line that nothing runs: {line}"


def test_every_command_that_a_page_names_exists() -> None:
    for page in PAGES:
        for command in re.findall(r"python -m safevar_sumo ([a-z]+)", (ROOT / page).read_text()):
            assert commands.get_command(None, command) is not None, f"{page}: {command}"  # type: ignore[arg-type]


@pytest.mark.parametrize("name", study_names())
def test_every_shipped_characteristic_is_explained_in_its_study_and_in_the_glossary(name: str) -> None:
    glossary = (ROOT / "docs" / "glossary.md").read_text()
    for key, row in load_study(name).vehicle.characteristics.items():
        assert row.meaning, key
        assert f"| `{key}` | {row.meaning} | {row.counterpart} |" in glossary
