"""Wrong arguments of public functions: an error names the argument and what is expected."""

from __future__ import annotations

import inspect
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import safevar_sumo as sv
from safevar_sumo.questions.ask import QUESTIONS
from tests.support.in_process import InlinePool

CALLS = tomllib.loads(Path(__file__).with_name("arguments.toml").read_text())
FUNCTIONS = [name for name in sv.__all__ if inspect.isfunction(getattr(sv, name))]
OF_NONE = {"question", "study_names", "load_study"}
"""Functions without named arguments, and the one that takes any name."""


def is_refused(name: str, values: list[Any], told: str, **options: Any) -> None:
    with pytest.raises(sv.InputError, match=f"(?s)^{told}"):
        getattr(sv, name)(*values, **options)


@pytest.mark.parametrize("row", CALLS["wrong"], ids=str)
def test_a_wrong_argument_is_named(row: dict[str, Any], in_tmp: Path) -> None:
    is_refused(row["call"], row["values"], row["told"], **row["options"])
    assert not [*in_tmp.iterdir()]


@pytest.mark.parametrize("row", CALLS["of_questions"], ids=str)
def test_every_question_names_a_wrong_argument(row: dict[str, Any]) -> None:
    for name in QUESTIONS:
        others = ["smoke"] * (name in ("compare", "validate"))
        is_refused(name, ["smoke", *others], row["told"], **row["options"])
        is_refused(name, [None, *others], rf"{name}\(\): source = None")


@pytest.mark.parametrize("name", sorted({*FUNCTIONS} - OF_NONE))
def test_every_function_refuses_an_unknown_argument(name: str) -> None:
    is_refused(name, [], rf"{name}\(\): there is no argument 'nothing'", nothing=1)


def test_true_is_no_number_and_none_is_no_text() -> None:
    is_refused("evaluate", ["smoke", np.ones((1, 12), bool)], "settings, row 0: .*True")
    is_refused("load_study", [{3: 4}], "study: the key 3\nexpected: keys")
    is_refused("load_study", [None], "study: None\nexpected: the name of a study")
    is_refused("risk", ["smoke"], "samples: None\nexpected: a whole", samples=None)
    is_refused("tolerance", ["smoke"], "limits: None\nexpected: a text", limits=None)
    is_refused("draw_comparison", [None], "comparison: None\nexpected: a Comparison")


def test_a_frame_in_place_of_an_answer_or_of_its_table_is_refused() -> None:
    frame = pd.DataFrame({"mass": [1.0]})

    @sv.question
    def plain(subject: Any, evaluator: Any) -> Any:
        return frame

    @sv.question
    def of_table(subject: Any, evaluator: Any) -> sv.Answer:
        text = {"question": "mine", "study": evaluator.study, "verdict": "Done."}
        return sv.Answer(**text, numbers={}, tables={"masses": frame})

    @sv.question
    def of_number(subject: Any, evaluator: Any) -> sv.Answer:
        text: Any = {"question": "mine", "study": evaluator.study, "verdict": 3}
        return sv.Answer(**text, numbers={}, tables={})

    for function, told in (
        (of_number, "(?s)verdict: 3.*expected: a text"),
        (plain, "returns DataFrame\nexpected: an Answer"),
        (of_table, "(?s)'masses' is a DataFrame.*expected: what tabulate"),
    ):
        with pytest.raises(sv.InputError, match=told):
            function("smoke", pool=InlinePool())
