"""Every sentence that users read keeps the rules that a pattern can check."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator

import click
import pytest

from safevar_sumo.cli.program import COMMANDS, commands
from tools.manual import ROOT, written
from tools.pages import PAGES
from tools.sentences import broken_rules, sentences_in, split
from tools.size import sources_of

SOURCES = sources_of("safevar_sumo")


def found(sentences: Iterable[str]) -> list[tuple[str, list[str]]]:
    """The sentences that break rules, with the reasons."""
    return [(one, broken) for one in sentences if (broken := broken_rules(one))]


def texts_in(source: str) -> Iterator[str]:
    """The whole sentences and the meanings of columns in a module; a slot is X."""
    yield from re.findall(r'Column\(\s*"[^"]*",\s*"([^"]+)"', source)
    tree = ast.parse(source)
    docstrings = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant | ast.JoinedStr)
            and id(node) not in docstrings
        ):
            text = re.sub("(?<=[a-z]){.*?}", "", ast.unparse(node).strip("f'\""))
            for sentence in split(re.sub("{.*?}", "X", text)):
                if re.match("[A-Z].*[.]$", sentence):
                    yield sentence


@pytest.mark.parametrize("page", PAGES)
def test_the_sentences_of_a_page_keep_the_rules(page: str) -> None:
    assert not found(sentences_in(written(page)))


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_keeps_the_rules(name: str) -> None:
    command = commands.get_command(click.Context(commands), name)
    for text in (
        command.help,
        *(getattr(option, "help", "") for option in command.params),
    ):
        plain = re.sub("`[^`]*`", "X", str(text)).partition("\n\nExample")[0]
        assert not found(split(re.sub(r"  \[.*", "", plain)))


@pytest.mark.parametrize("path", sorted(SOURCES))
def test_the_templates_and_the_meanings_of_columns_of_a_module_keep_the_rules(
    path: str,
) -> None:
    assert not found(texts_in(SOURCES[path]))


def test_the_meanings_of_columns_in_a_file_keep_the_rules() -> None:
    text = (ROOT / "safevar_sumo/questions/columns.toml").read_text(encoding="utf-8")
    assert not found(re.findall(r'(?:meaning|^\w+) = "(.*?)"', text, re.MULTILINE))


def test_all_pages_together_are_short_enough_to_be_read() -> None:
    """Beside lists that the code makes, and blocks that are files of examples."""
    example = re.compile(r"^<!-- file: \S+ -->\n```.*?^```$", re.DOTALL | re.MULTILINE)
    texts = [example.sub("", written(page)) for page in PAGES]
    assert len(re.findall(r"\S*\w\S*", " ".join(texts))) <= 30_000


def test_a_broken_rule_is_found() -> None:
    broken = (
        "Nearly all of them collide, as the value of tireFric is 1; it keeps 0.3"
        " m of clearance."
    )
    page = f"# A head of five words\n\n```\nIt is not read.\n```\n- {broken}\n- {'and ' * 23}."
    assert [len(reasons) for _, reasons in found(sentences_in(page))] == [4, 1]
    assert not broken_rules(
        "Valid for: the tests CPFA, CPNA and CPNCO at 10 to 60 km/h; by day."
    )
