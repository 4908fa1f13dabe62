"""An answer in every format, and a question from outside the package."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import safevar_sumo as sv
from safevar_sumo.analysis.answer import Answer, Column, tabulate, with_interval
from safevar_sumo.analysis.ask import QUESTIONS, Question, find_question
from safevar_sumo.cli.program import COMMANDS, commands
from safevar_sumo.study import load_study

COLUMNS = {
    "part": Column("", "part of the vehicle"),
    **with_interval("length", Column("m", "its length", ".2f")),
    "age": Column("s", "its age"),
    "changes": Column("", "what is changed"),
}
ROWS = [("a < b & 1 %", 1.234, 1.0, np.inf, np.nan, {"mass": 2600.0}), ("c_d", np.nan, np.nan, np.nan, np.nan, {})]
ANSWER = Answer(
    question="parts",
    study=load_study("smoke"),
    verdict="Two parts <are> old.",
    numbers={"probability": np.float64(0.25), "interval": (0.1, np.nan), "driven": True},
    tables={"parts": tabulate("Parts & ages", COLUMNS, ROWS)},
)
QUESTION = '''
from safevar_sumo.analysis.answer import Answer, Column, tabulate
from safevar_sumo.analysis.ask import Count, question


@question
def spread(subject, evaluator, *, samples: Count = 100) -> Answer:
    """Say how far safety degrees lie apart.

    Parameters
    ----------
    samples
        Number of vehicles drawn evenly over the domain.
    """
    degrees = evaluator.evaluate(evaluator.random_settings(samples), "vehicles").f_safe
    table = tabulate("Quartiles", {"degree": Column("m", "safety degree")}, [(float(degrees.min()),)])
    numbers = {"spread": float(degrees.max() - degrees.min())}
    tables = {"quartiles": table}
    return Answer(question="spread", study=evaluator.study, verdict="Far.", numbers=numbers, tables=tables)
'''


def test_json_names_units_and_meanings_and_has_no_value_where_none_is_defined() -> None:
    answer = json.loads(ANSWER.render("json"))
    assert list(answer) == ["question", "study", "verdict", "numbers", "tables"]
    assert answer["numbers"] == {"probability": 0.25, "interval": [0.1, None], "driven": True}
    table = answer["tables"]["parts"]
    assert table["columns"]["length_low"] == {"unit": "m", "meaning": "lower end of length"}
    assert table["rows"][0] == {
        "part": "a < b & 1 %",
        "length": 1.234,
        "length_low": 1.0,
        "length_high": None,
        "age": None,
        "changes": {"mass": 2600.0},
    }


def test_readers_see_units_and_intervals_and_no_column_without_values() -> None:
    text = ANSWER.render("text")
    assert "length [m]" in text
    assert "1.23 (1.00 to -)" in text
    assert "mass 2600" in text
    assert "age" not in text.replace("ages", "")
    assert max(map(len, text.splitlines())) <= 80


def test_html_and_latex_are_escaped_and_csv_reads_back() -> None:
    page, latex = ANSWER.render("html"), ANSWER.render("latex")
    assert "<p>Two parts &lt;are&gt; old.</p>" in page
    assert '<td class="label">a &lt; b &amp; 1 %</td>' in page
    assert page == ANSWER._repr_html_()
    assert r"a < b \& 1 \%" in latex
    assert r"c\_d" in latex
    assert r"\caption{Parts \& ages}" in latex
    text = ANSWER.render("csv", "parts")
    assert pd.read_csv(io.StringIO(text))["length"][0] == 1.234


@pytest.mark.parametrize(
    ("key", "values"),
    [("probability", [0.25]), ("interval.0", [0.1]), ("interval.1", [np.nan]), ("parts.length", [1.234, None])],
)
def test_a_key_names_numbers(key: str, values: list[Any]) -> None:
    assert ANSWER.values(key) == pytest.approx(values, nan_ok=True)


def test_an_unknown_key_is_refused_with_the_nearest() -> None:
    with pytest.raises(sv.InputError, match="did you mean 'probability'"):
        ANSWER.values("probabilty")


@pytest.mark.parametrize("name", QUESTIONS)
def test_help_and_call_have_the_same_sentence_and_options(name: str) -> None:
    ask = find_question(name)
    assert getattr(sv, name) is ask
    first, _, _ = (ask.__doc__ or "").partition("\n\n")
    assert COMMANDS[name][1] == " ".join(first.split())
    text = CliRunner().invoke(commands, [name, "--help"]).output
    for option in ask.options:
        assert option.meaning
        assert f"--{option.name.replace('_', '-')}" in text


def test_a_question_from_outside_is_a_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_questions.py").write_text(QUESTION)
    monkeypatch.syspath_prepend(str(tmp_path))
    name = "my_questions:spread"
    assert isinstance(find_question(name), Question)
    result = CliRunner().invoke(commands, [name, "smoke", "--samples", "8", "--jobs", "1", "--fail-if", "spread > 0"])
    assert result.exit_code == 3, result.output
    assert "Far." in result.output
    assert re.search(r"failed: spread = [0-9.]+ > 0", result.output)
    refused = CliRunner().invoke(commands, [name, "smoke", "--samples", "0"])
    assert "a whole number from 1 to 100,000,000" in str(refused.exception)
