"""README and tutorials true to the letter: every block of every page is put where it says, and run in the order of the page."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from click.testing import CliRunner

from safevar_sumo.ads import ADS
from safevar_sumo.cli.program import commands
from safevar_sumo.study import load_study, study_names
from safevar_sumo.vehicles import VEHICLES

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]
PROGRAM = "python -m safevar_sumo "


class Block(NamedTuple):
    """A fenced block: its language, the file that it is the content of (or ""), and its text."""

    language: str
    title: str
    text: str


def blocks(page: str) -> list[Block]:
    result = re.findall(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```$', (ROOT / page).read_text(), flags=re.DOTALL | re.MULTILINE)
    return [Block(*one) for one in result]


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_a_map_of_the_code_names_every_package_and_nothing_that_is_not_there(page: str) -> None:
    text, package = (ROOT / page).read_text(), ROOT / "safevar_sumo"
    tree = text.split("```")[1]
    folders = {path.parent.name for path in (*package.glob("*/__init__.py"), *package.glob("analysis/*/__init__.py"))}
    assert folders - set(re.findall(r"\w+", tree)) == set()
    named = re.findall(r"(?<![\w/])(\w+)/(?=[\s,;])", tree)
    assert [name for name in named if not any((place / name).is_dir() for place in (ROOT, package, ROOT / "tests"))] == []
    files = re.findall(r"`?((?:[a-z_]+/)+[a-z_]+\.py)\b", text)
    assert [name for name in files if not any((place / name).is_file() for place in (ROOT, package))] == []


def test_every_generated_table_of_a_page_is_made_from_the_code() -> None:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    text = "\n".join(generate.on_page_markdown((ROOT / page).read_text()) for page in PAGES)
    assert "<!-- generated" not in text
    for heading in (*VEHICLES, *ADS, "SearchTable"):
        assert f"\n### {heading}\n" in text
    assert "| `evaluations` | integer, at least 1, at most 1e+07 | required |" in text


class Numbers(NamedTuple):
    """A comment of a page: commands, and of the last one's JSON the values at some paths, as the page's next paragraph has them."""

    page: str
    commands: list[str]
    values: dict[str, str]
    paragraph: str


def marked(page: str) -> list[Numbers]:
    """Every comment that begins with `numbers:`: lines of commands, then lines of `path = number`."""
    result = []
    for comment, paragraph in re.findall(r"<!-- numbers:\n(.*?)-->\n+(.*?)(?=\n\n|\Z)", (ROOT / page).read_text(), flags=re.DOTALL):
        lines = [line.strip() for line in comment.splitlines() if line.strip()]
        values = dict(line.split(" = ") for line in lines if not line.startswith(PROGRAM))
        result.append(Numbers(page, [line for line in lines if line.startswith(PROGRAM)], values, paragraph))
    return result


MARKED = [one for page in PAGES for one in marked(page)]


def test_marked_numbers_stand_in_the_paragraph_below_them() -> None:
    assert MARKED
    for one in MARKED:
        for value in one.values.values():
            assert value in one.paragraph, f"{one.page}: {value}"


@pytest.mark.slow
@pytest.mark.parametrize("numbers", MARKED, ids=lambda one: one.page)
def test_marked_numbers_are_those_that_their_commands_print(numbers: Numbers, in_tmp: Path) -> None:
    """Shares are given in whole per cent."""
    for command in numbers.commands:
        done = CliRunner().invoke(commands, shlex.split(command.removeprefix(PROGRAM)), catch_exceptions=False)
        assert done.exit_code == 0, f"{command}\n{done.output}"
    records = json.loads(done.stdout)
    for path, value in numbers.values.items():
        result = records
        for key in path.split("."):
            result = result[int(key) if isinstance(result, list) else key]
        assert f"{100 * result:.0f} %" == value, f"{numbers.page}: {path}"
