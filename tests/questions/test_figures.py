"""Figures of answers whose numbers are made up: each mark lies where its number says."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.questions.answer import Answer, AnswerTable
from safevar_sumo.questions.explain import draw_needed
from safevar_sumo.questions.explain.smallest import draw_staircase

STUDY: Any = SimpleNamespace(name="made-up")


def answer_with(**frames: pd.DataFrame) -> Answer:
    return Answer(
        question="",
        study=STUDY,
        verdict="",
        numbers={"analysed": 7},
        tables={name: AnswerTable(frame, "Ages") for name, frame in frames.items()},
    )


def test_intervals_are_drawn_around_their_values_from_the_top_down() -> None:
    columns = ["part", "the_age", "the_age_low", "the_age_high", "mass"]
    rows = [("a$", 2.0, 1.0, 5.0, 3.0), ("b", 4.0, 3.5, 4.25, 3.0)]
    frame = pd.DataFrame(rows, columns=columns)
    figure = answer_with(ages=frame).figure()
    (axis,) = figure.axes
    ((values, _, (bars,)),) = axis.containers
    assert values.get_xydata().tolist() == [[2, 2], [4, 1]]
    assert [bar[:, 0].tolist() for bar in bars.get_segments()] == [[1, 5], [3.5, 4.25]]
    assert [text.get_text() for text in axis.get_yticklabels()] == [r"a\$", "b"]
    assert (axis.get_xlabel(), figure.get_suptitle()) == ("the age", "Ages")
    assert figure.get_size_inches() == pytest.approx([5.2, 1.8])
    for empty in frame[:0], frame.assign(the_age=np.nan), frame[["part", "mass"]]:
        with pytest.raises(InputError, match="nothing to draw"):
            answer_with(ages=empty).figure()


def test_the_staircase_names_the_parts_where_they_change() -> None:
    """At 20 % of the way nothing is unsafe, at 40 % two changes, from 60 % on one of them."""
    rows = [
        (1.0, 1, 9, ["a", "b"]),
        (0.8, 1, 9, ["a"]),
        (0.6, 1, 9, ["a"]),
        (0.4, 2, 9, ["a, b"]),
        (0.2, None, 1234, []),
    ]
    frame = pd.DataFrame(rows, columns=["share", "fewest", "tried", "causes"])
    (axis,) = draw_staircase(answer_with(staircase=frame)).axes
    steps = axis.lines[0].get_xydata()
    assert steps == pytest.approx(np.array([(40, 2), (60, 1), (80, 1), (100, 1)]))
    texts = {
        text.get_text(): getattr(text, "xy", text.get_position()) for text in axis.texts
    }
    assert texts == {
        "a\nb": (40, 2),
        "a": (60, 1),
        "none of 1,234\ncombinations\nis unsafe": (20, 1.1),
    }
    assert (axis.get_xlim(), axis.get_ylim()) == ((0, 125), (0.5, 3.6))
    assert axis.get_xticks().tolist() == [0, 20, 40, 60, 80, 100]
    (axis,) = draw_staircase(answer_with(staircase=frame[:1])).axes
    assert [text.get_text() for text in axis.texts] == ["a\n(1 of 2)"]


def test_bars_show_how_often_a_characteristic_is_needed() -> None:
    shares = {"changed": [1.0, 0.5], "in_some": [0.75, 0.25], "needed": [0.5, 0.0]}
    frame = pd.DataFrame({"characteristic": ["a", "b"], **shares})
    figure = draw_needed(answer_with(characteristics=frame))
    (axis,) = figure.axes
    widths = [[bar.get_width() for bar in bars] for bars in axis.containers]
    assert widths == [[50, 100], [25, 75], [0, 50]], "the first one is at the top"
    assert [text.get_text() for text in axis.get_yticklabels()] == ["b", "a"]
    assert axis.get_xlabel() == "share of 7 failures [%]"
    assert figure.get_size_inches() == pytest.approx([6.4, 2.6])
