"""Every sentence that users read keeps the rules that a pattern can check."""

from __future__ import annotations

import re
from collections.abc import Iterable

import click
import pytest

from safevar_sumo.cli.program import COMMANDS, commands
from tests.manual import written
from tests.pages import PAGES
from tests.sentences import broken_rules, sentences_in, split

MAX_WORDS = 30_000
"""Largest number of words of all pages, beside lists that the code makes."""


def found(sentences: Iterable[str]) -> list[tuple[str, list[str]]]:
    """The sentences that break rules, with the reasons."""
    return [(one, broken) for one in sentences if (broken := broken_rules(one))]


@pytest.mark.parametrize("page", PAGES)
def test_the_sentences_of_a_page_keep_the_rules(page: str) -> None:
    assert not found(sentences_in(written(page)))


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_keeps_the_rules(name: str) -> None:
    command = commands.get_command(click.Context(commands), name)
    for text in (command.help, *(getattr(option, "help", "") for option in command.params)):
        plain = re.sub("`[^`]*`", "X", str(text)).partition("\n\nExample")[0]
        assert not found(split(re.sub(r"  \[.*", "", plain)))


def test_all_pages_together_are_short_enough_to_be_read() -> None:
    words = [word for page in PAGES for word in written(page).split() if re.search(r"\w", word)]
    assert len(words) <= MAX_WORDS


@pytest.mark.parametrize(
    ("sentence", "reason"),
    [
        ("Of the 264 pairs, 12 were simulated.", "a count stands before its verb"),
        ("It collides in 14 of 20 parameter sets.", "no noun at the beginning"),
        ("These are the limits of the car.", "no noun beside it"),
        ("Nearly all of them collide, as the brakes are weak.", "which number, of what?"),
        ("The value of tireFric is 1.", "a key in a sentence"),
        ("Left out, as it is above the limit.", "because, so, although"),
        ("The limit holds; the car keeps 0.3 m.", "a semicolon: two sentences"),
        ("The vehicle " + "and the car " * 8 + "collide.", "27 words"),
    ],
)
def test_a_broken_rule_is_found(sentence: str, reason: str) -> None:
    assert reason in broken_rules(sentence)
    assert not broken_rules("Valid for: the tests CPFA, CPNA and CPNCO at 10 to 60 km/h; by day.")
    assert [*sentences_in(f"# A head of five words\n\n```\n{sentence}\n```\n- {sentence}")] == [
        sentence
    ]
