"""Sentences that several questions say."""

from __future__ import annotations

import math

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics.words import degree_in_words, impact_in_words, value_on_side
from safevar_sumo.questions.sentence import answer
from safevar_sumo.questions.tables import cell_text
from safevar_sumo.questions.words import (
    MAX_POINTS_NAMED,
    count_in_words,
    percentage,
    points_in_words,
    two_decimals,
    undecidable_in_words,
)
from safevar_sumo.vehicles import CharacteristicSet


def test_a_limit_nearer_to_the_original_than_its_measurement_is_not_decidable() -> None:
    brakes = next(
        item for item in CharacteristicSet.of(load_study("wear")) if item.precision
    )
    assert (brakes.original, brakes.lower, brakes.upper) == (1, 0.5, 1)
    ends = (0.9, 1.0), (0.96, 1.0), (0.5, 1.0), (1.0, 1.0)
    is_decidable = [True, False, True, True]
    assert [brakes.is_decidable(*both) for both in ends] == is_decidable
    assert "the measuring error (0.05)" in undecidable_in_words([brakes])


def test_a_count_is_all_or_none_only_if_it_is_exactly_that() -> None:
    counts = [count_in_words(number, 24) for number in (0, 2.5, 24)]
    assert counts == ["none of the 24", "2.5 of the 24", "all 24"]


def test_a_share_has_the_digits_that_decide() -> None:
    shares = (0.00043, 0.0994, 0.0995, 0.37)
    assert [*map(percentage, shares)] == ["0.043", "9.9", "10", "37"]
    assert cell_text(1259.0, ".3g") == "1,259", "no exponent"
    values = (None, math.nan, -0.004, 1.006)
    assert [*map(two_decimals, values)] == ["-", "-", "0.00", "1.01"]


def test_large_numbers_in_sentences_have_no_exponent() -> None:
    assert degree_in_words(4321.4) == "4321 m"
    assert impact_in_words(1000.0, 500.0) == "impact at 3600 km/h where 1800 is allowed"
    assert value_on_side(1234.4, 1234.0, "g", 3) == "1234.4"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tyre friction", "Tyre friction"),
        ("a", "A"),
        ("ABS delay", "ABS delay"),
        ("brake_force", "The characteristic brake_force"),
        ("sensorLatency", "The characteristic sensorLatency"),
        ("none of the {2}", "None of the {2}"),
    ],
)
def test_each_sentence_begins_with_a_capital_letter(name: str, text: str) -> None:
    both = answer("{name} is wide. {name} is {size:.1f} times as wide as {name}.")
    said = both(name=name, size=2)
    assert said.text == f"{text} is wide. {text} is 2.0 times as wide as {name}."


@pytest.mark.parametrize(
    ("failing", "count", "said"),
    [
        (0, 1, "no test case"),
        (0, 2, "none of the 2 test cases"),
        (1, 1, "1 of 1 test cases: a"),
        (MAX_POINTS_NAMED, 9, "6 of 9 test cases: a; b; c; d; e; f"),
        (MAX_POINTS_NAMED + 1, 9, "7 of 9 test cases: a; b; c; d; e; f and 1 more"),
    ],
)
def test_a_sentence_names_the_first_failing_test_cases(
    failing: int, count: int, said: str
) -> None:
    sentence = points_in_words("It", [*"abcdefghi"[:failing]], count)
    assert sentence == f"It fails in {said}."
