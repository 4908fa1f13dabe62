"""README and tutorials true to the letter: every block of every page is put where it says, and run
in the order of the page.
"""

from __future__ import annotations

import configparser
import importlib
import json
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from click.testing import CliRunner
from PIL import Image

from safevar_sumo.api.simulation import load_study
from safevar_sumo.cli.program import commands
from safevar_sumo.records.driving import Nominal
from safevar_sumo.study import (
    WITHOUT_EFFECT,
    CharacteristicTable,
    SearchTable,
    Study,
    keys_with,
    study_names,
)
from tests.support.in_process import SLOW
from tests.support.needs import need_library
from tools.manual import PROGRAM, ROOT, blocks, written
from tools.pages import PAGES, run_page

LIBRARY_OF_PAGE = {"docs/tools.md": "optuna"}
"""Pages whose blocks need a library of the extra `test-all`."""


@SLOW
@pytest.mark.usefixtures("pools_in_this_process")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)])
def test_every_block_of_a_page_does_and_shows_what_it_says(
    page: str, in_tmp: Path
) -> None:
    """`make docs-outputs` fills it in. Every change of the package changes the digest of a pack."""
    if page in LIBRARY_OF_PAGE:
        need_library(LIBRARY_OF_PAGE[page])
    digest = re.compile(r"\b[0-9a-f]{64}\b")
    for block, output in run_page(page, options_of_tests=True):
        assert digest.sub("", block.text) == digest.sub("", output)


def test_lines_of_prose_have_at_most_100_characters() -> None:
    """Tables, headings, pictures, badges and blocks apart."""
    for page in PAGES:
        text = re.sub(
            r"(?s)^```.*?^```$|<!--.*?-->", "", written(page), flags=re.MULTILINE
        )
        for line in text.splitlines():
            assert len(line) <= 100 or line.startswith(("|", "#", "![", "[![")), (
                f"{page}: {line}"
            )


@pytest.mark.parametrize("name", study_names())
def test_lines_of_a_shipped_study_have_at_most_100_characters(name: str) -> None:
    lines = (ROOT / "studies" / f"{name}.toml").read_text("utf-8").splitlines()
    assert not [line for line in lines if len(line) > 100]


def script_of_docs(name: str) -> Any:
    """A script beside the pages, as a module."""
    return importlib.import_module(f"docs.{name}")


def test_every_picture_has_its_command_and_its_page() -> None:
    texts = "".join((ROOT / page).read_text() for page in PAGES)
    assert (
        {path.name for path in (ROOT / "docs" / "pictures").iterdir()}
        == script_of_docs("scripts.pictures").COMMANDS.keys()
        == set(re.findall(r"pictures/([\w.]+)\)", texts))
    )


@SLOW
@pytest.mark.parametrize(
    "name",
    [
        "failure.png",
        "failure.gif",
        "sawtooth.png",
        "boundary.png",
        "stops.png",
        "encounters.png",
    ],
)
def test_a_picture_is_drawn_anew_as_large_as_it_stands_on_its_page(
    name: str, tmp_path: Path
) -> None:
    """That of a page of `report` takes minutes; tests/report/test_browser.py looks at pages."""
    drawn_anew = script_of_docs("scripts.pictures").draw(name, tmp_path)
    with (
        Image.open(drawn_anew) as drawn,
        Image.open(ROOT / "docs" / "pictures" / name) as stored,
    ):
        assert drawn.size == stored.size
        assert getattr(drawn, "n_frames", 1) == getattr(stored, "n_frames", 1)


def test_the_version_of_setup_cfg_is_that_of_results_citation_and_changelog() -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    version = config["metadata"]["version"]
    output = CliRunner().invoke(commands, ["--version"]).stdout
    assert output.endswith(f", version {version}\n"), (
        "install again: pip install --editable ."
    )
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert (
        re.findall("^## (.*) [(]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
        == version
    )


def test_the_changelog_is_short_enough_to_be_read() -> None:
    sections = (ROOT / "CHANGELOG.md").read_text("utf-8").split("\n## ")
    newest, *older = [len(section.splitlines()) for section in sections[1:]]
    assert newest <= 120
    assert sum(older) <= 150


@pytest.mark.parametrize("name", study_names())
def test_every_shipped_characteristic_is_explained(name: str) -> None:
    for key, row in load_study(name).vehicle.characteristics.items():
        assert all((row.meaning, row.counterpart, row.measurement, row.remedy)), key


def test_the_map_of_the_code_names_every_package_and_no_drawing_a_folder_that_is_not_there() -> (
    None
):
    package = ROOT / "safevar_sumo"
    tree, drawing = (
        (ROOT / page).read_text().split("```")[1]
        for page in ("CONTRIBUTING.md", "docs/architecture.md")
    )
    assert {path.parent.name for path in package.glob("*/**/__init__.py")} <= set(
        re.findall(r"\w+", tree)
    )
    there = {
        path.name
        for path in (*ROOT.iterdir(), *(ROOT / "tests").iterdir(), *package.rglob("*"))
        if path.is_dir()
    }
    assert set(re.findall(r"(?<![\w/])(\w+)/(?=[\s,;`])", tree + drawing)) <= there


MENTION = re.compile(
    r"((?:`[\w.]+`(?:,|\s+and)\s+)*`[\w.]+`)\s+(?:in\s+|of\s+|\()`([\w/]+\.py)`"
)
"""Names of code, and the file that a page says they are in."""


def test_every_name_of_code_that_a_page_mentions_is_in_the_file_that_it_names() -> None:
    for page in ("CONTRIBUTING.md", *PAGES):
        for names, file in MENTION.findall((ROOT / page).read_text()):
            places = [ROOT / "safevar_sumo" / file, ROOT / file]
            source = next(place for place in places if place.is_file()).read_text()
            for name in re.findall(r"(\w+)`", names):
                defined = rf"^ *(def |class )?{name}\b *[(:=]"
                assert re.search(defined, source, re.MULTILINE), (
                    f"{page}: {name} in {file}"
                )


def test_every_file_of_code_that_is_named_exists() -> None:
    """In a page, a study or the package; a page may also make the file that it names."""
    code = [*(ROOT / "studies").rglob("*.toml"), *(ROOT / "safevar_sumo").rglob("*.py")]
    there = [*code, *ROOT.glob("[bcdet]*/**/*.py")]
    for file in [
        "CONTRIBUTING.md",
        *PAGES,
        *(str(path.relative_to(ROOT)) for path in code),
    ]:
        made = {block.title for block in blocks(file)}
        for name in re.findall(
            r"(?<![\w/.])((?:[a-z_]+/)*(?:[a-z_]+/[a-z_]+|test_\w+)\.py)\b",
            (ROOT / file).read_text(),
        ):
            assert name in made or any(
                path.as_posix().endswith(f"/{name}") for path in there
            ), f"{file}: {name}"


@pytest.mark.parametrize(
    "page",
    [
        "CONTRIBUTING.md",
        "sumo_nets/README.md",
        *(str(path.relative_to(ROOT)) for path in ROOT.glob("examples/**/*.md")),
    ],
)
def test_every_link_of_a_page_outside_of_the_site_leads_to_a_file(page: str) -> None:
    """`mkdocs build --strict` follows the links of the site."""
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", (ROOT / page).read_text())
    for link in links:
        assert (ROOT / page).parent.joinpath(link).exists(), link


def test_the_page_on_results_lists_every_key_that_may_change() -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    (listed,) = re.findall(
        r"You may change these keys at any time[^:]*: (.*?)\. ", page, flags=re.DOTALL
    )
    assert sorted(re.findall(r"`\[*(\w+)\]*`", listed)) == sorted(
        key
        for record in (Study, CharacteristicTable, SearchTable)
        for key in keys_with(WITHOUT_EFFECT, record)
    )


def test_a_driving_system_can_read_every_name_of_the_original_car() -> None:
    page = written("docs/tutorials/own_ads.md")
    rows = page.partition("| `self.nominal.` |")[2].partition("\n\n")[0]
    for name in re.findall(r"`(\w+)`", rows):
        assert hasattr(Nominal, name)


def test_every_generated_list_of_a_page_is_that_of_the_code() -> None:
    filled = script_of_docs("generate").filled
    for page in PAGES:
        text = (ROOT / page).read_text()
        assert text == filled(text), f"{page}: `make docs-outputs` writes it"


class Numbers(NamedTuple):
    """A comment of a page: commands, and of the last one's JSON the values at some paths, as the
    page's next paragraph has them.
    """

    page: str
    commands: list[str]
    values: dict[str, str]
    paragraph: str


def marked(page: str) -> list[Numbers]:
    """Every comment that begins with `numbers:`: lines of commands, then lines of `path =
    number`.
    """
    result = []
    for comment, paragraph in re.findall(
        r"<!-- numbers:\n(.*?)-->\n+(?:<!--.*?-->\n+)*(.*?)(?=\n\n|\Z)",
        written(page),
        flags=re.DOTALL,
    ):
        lines = [line.strip() for line in comment.splitlines() if line.strip()]
        values = dict(
            line.split(" = ") for line in lines if not line.startswith(PROGRAM)
        )
        result.append(
            Numbers(
                page,
                [line for line in lines if line.startswith(PROGRAM)],
                values,
                paragraph,
            )
        )
    return result


MARKED = [one for page in PAGES for one in marked(page)]


def test_marked_numbers_stand_in_the_paragraph_below_them() -> None:
    assert MARKED
    for one in MARKED:
        for value in one.values.values():
            assert value in one.paragraph, f"{one.page}: {value}"


@SLOW
@pytest.mark.parametrize(
    "lines",
    sorted({tuple(one.commands) for one in MARKED}),
    ids=lambda lines: lines[-1],
)
def test_marked_numbers_are_those_that_their_commands_print(
    lines: tuple[str, ...], in_tmp: Path
) -> None:
    """Shares are given in whole per cent, limits as they are rounded, others with two decimals and
    their unit.
    """
    for command in lines:
        done = CliRunner().invoke(
            commands, shlex.split(command.removeprefix(PROGRAM)), catch_exceptions=False
        )
        assert done.exit_code == 0, f"{command}\n{done.output}"
    records = json.loads(done.stdout)
    for page, path, value in (
        (one.page, *item)
        for one in MARKED
        if tuple(one.commands) == lines
        for item in one.values.items()
    ):
        result = records
        for key in path.split("."):
            if isinstance(result, list) and not key.isdecimal():  # a row by its name
                result = next(row for row in result if key in row.values())
            else:
                result = result[int(key) if isinstance(result, list) else key]
        unit = value.partition(" ")[2]
        text = (
            f"{result:.10g}"
            if path.startswith("tables.limits.")
            else f"{result:.2f} {unit}".strip()
        )
        assert value == (f"{100 * result:.0f} %" if unit == "%" else text), (
            f"{page}: {path}"
        )
