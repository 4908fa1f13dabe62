"""An answer in every format, a question from outside the package, and one set of options, from
which flags, Python functions, the report's calls and printed commands follow.
"""

from __future__ import annotations

import io
import json
import re
import shlex
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace as replace_in

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.cli.program import commands
from safevar_sumo.questions.answer import (
    Answer,
    Column,
    Wide,
    contents,
    tabulate,
    with_interval,
)
from safevar_sumo.questions.ask import QUESTIONS, Question, find_question
from safevar_sumo.questions.permit.answer import SHOWN_WHOLE
from safevar_sumo.questions.render import MAX_LINES, MAX_ROWS
from safevar_sumo.questions.sentence import Verdict, answer as said, note
from safevar_sumo.questions.words import change_texts
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import json_of, rows_of, run
from tools.manual import ROOT

COLUMNS = {
    "part": "part of the vehicle",
    **with_interval("length", Column("m", "its length", ".2f")),
    "age": Column("s", "its age"),
    "changes": "what is changed",
}
ROWS = [
    ("a < b & 1 %", 1.234, 1.0, np.inf, np.nan, {"mass": 2600.0}),
    ("c_d", np.nan, np.nan, np.nan, np.nan, {}),
]
TABLES = {"parts": tabulate("Parts & ages", COLUMNS, ROWS)}
OTHERS = tabulate("Others", {"name": "it"}, [("none",)])
ANSWER = Answer(
    question="parts",
    study=load_study("smoke"),
    verdict="Two parts <are> old.",
    numbers={
        "probability": np.float64(0.25),
        "interval": (0.1, np.nan),
        "driven": True,
    },
    tables=TABLES,
)


def test_json_names_units_and_meanings_and_has_no_value_where_none_is_defined() -> None:
    answer = json.loads(ANSWER.render("json"))
    assert list(answer) == ["question", "study", "verdict", "numbers", "tables"]
    assert answer["numbers"] == {
        "probability": 0.25,
        "interval": [0.1, None],
        "driven": True,
    }
    table = answer["tables"]["parts"]
    assert table["columns"]["length_low"] == {
        "unit": "m",
        "meaning": "lower end of length",
    }
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
    assert "1.23 (from 1.00)" in text
    assert "mass 2600" in text
    assert "age" not in text.replace("ages", "")
    assert max(map(len, text.splitlines())) <= 80


def test_readers_are_told_of_a_table_that_is_too_long_for_them() -> None:
    frame = tabulate(
        "Many",
        {"number": "it"},
        [(number,) for number in range(MAX_ROWS + 1)],
    )
    long = replace(ANSWER, tables={**TABLES, "many": frame})
    for form in ("text", "html"):
        shown = long.render(form, details=True)
        assert f"--format csv --table NAME: many ({MAX_ROWS + 1} rows)" in shown
        assert "Many" not in shown
    assert len(long.render("csv", "many").splitlines()) == MAX_ROWS + 2
    assert "--table" not in ANSWER.render("text", details=True) + ANSWER.render("html")


def test_one_screen_has_as_many_rows_as_there_are_lines_for() -> None:
    """The first ones; a column that says the same in each row is left out."""
    rows = [(str(row), "words " * 40, "same") for row in range(15)]
    columns = {name: name for name in ("name", "text", "constant")}
    answer = replace(ANSWER, tables={"long": tabulate("Long", columns, rows)})
    text = answer.render("text")
    assert len(text.splitlines()) <= MAX_LINES
    assert "constant" not in text
    last = 14 - int(re.search(r"^(\d+) more rows: --details\.$", text, re.MULTILINE)[1])
    assert f"{last} " in text
    assert f"│ {last + 1} " not in text
    assert "same" in answer.render("text", details=True)
    alone = answer.render("text", "long").splitlines()
    assert (
        len(alone)
        <= MAX_LINES
        < len(answer.render("text", "long", details=True).splitlines())
    )
    assert alone[-1].endswith("more rows: --details.")


@pytest.mark.parametrize(("number", "shown"), [(13, 13), (50, 50), (51, 12)])
def test_a_list_of_up_to_50_cars_is_whole(number: int, shown: int) -> None:
    rows = [[f"<{row}>"] for row in range(number)]
    table = tabulate("Cars", {"car": ""}, rows, shown_whole=SHOWN_WHOLE)
    answer = replace(ANSWER, tables={"cars": table})
    text = answer.render("text")
    assert len(re.findall("<[0-9]+>", text)) == shown
    assert ("39 more rows: --details" in text) == (number == 51)


def test_one_screen_says_how_many_sentences_it_leaves_out_and_none_of_what_is_valid() -> (
    None
):
    """Also of a copy, as answers of other processes are."""
    valid = (
        "A vehicle counts only if it satisfies the constraints of the study: a below b."
    )
    tested = Verdict([said("All corners."), said("How it was."), note(valid)])
    verdict = Verdict(map(said, "abcdefg"))
    text = deepcopy(replace(ANSWER, verdict=verdict, tested=tested)).render("text")
    assert "More: --details (2 more sentences" in text
    assert "a b c d e\n" in text
    assert valid in text
    assert "How it was" not in text


def test_a_lead_is_a_declared_table_or_none() -> None:
    with pytest.raises(sv.InputError, match="did you mean 'parts'"):
        contents("number", lead="part", parts=["name"])
    assert "┏" in ANSWER.render("text")
    assert "┏" not in replace(ANSWER, lead=None).render("text")
    assert "┏" in replace(ANSWER, lead=None).render("text", details=True)


def test_a_long_table_has_a_column_for_each_value_and_its_intervals() -> None:
    """Part a holds up to 20: from 1 to 2; to 30 it has no room. Of part b one end is known, and
    nothing up to 30.
    """
    columns = {
        "part": "it",
        "by": "value",
        "length_low": Column("m", "least"),
        "length_high": Column("m", "largest"),
    }
    rows = [
        ("a", 20.0, 1.0, 2.0),
        ("a", 30.0, 1.5, 1.5),
        ("b", 20.0, np.nan, 2.0),
        ("b", 30.0, np.nan, np.nan),
    ]
    frame = tabulate(
        "Lengths", columns, rows, wide=Wide(["part"], "by", ["length"], "to {:g} km/h")
    )
    answer = replace(ANSWER, tables={"lengths": frame})
    page = answer.render("html").partition("<details>")[0]
    assert re.findall("<th.*?>([^<]*)</th>", page) == [
        "part",
        "to 20 km/h",
        "to 30 km/h",
    ]
    assert re.findall("<td.*?>([^<]*)</td>", page) == [
        "a",
        "1 to 2",
        "1.5",
        "b",
        "up to 2",
        "-",
    ]
    assert len(rows_of(answer.to_dict(), "lengths")) == 4


def test_html_and_latex_are_escaped_and_csv_reads_back() -> None:
    page, latex = ANSWER.render("html"), ANSWER.render("latex")
    assert "<p>Two parts &lt;are&gt; old.</p>" in page
    assert ">a &lt; b &amp; 1 %</td>" in page
    assert '<td data-head="length [m]">' in page, (
        "on a phone a cell carries its heading"
    )
    assert page == ANSWER._repr_html_()
    assert r"a < b \& 1 \%" in latex
    assert r"c\_d" in latex
    assert r"\caption{Parts \& ages}" in latex
    assert "\\noindent" not in latex, "nothing was tested"
    tested = replace(ANSWER, tested="1,228 vehicles; 5 % failed.").render("latex")
    assert "How this was tested: 1,228 vehicles; 5 \\% failed." in tested
    assert pd.read_csv(io.StringIO(ANSWER.render("csv", "parts")))["length"][0] == 1.234


@pytest.mark.parametrize("form", ["text", "csv", "latex", "html"])
def test_no_control_character_of_a_name_reaches_a_reader(form: str) -> None:
    columns = {"name": "it\x1b]0;x\x07"}
    names = tabulate("Names\x1b[2J", columns, [("\x1b[31mred\u202e\r\x9b",)])
    answer = replace(ANSWER, verdict="Old\x1b[2J parts.", tables={"names": names})
    printed = answer.render(form)
    assert "31mred" in printed
    assert not re.search("[\\0-\\x08\\x0b-\\x1f\\x7f-\\x9f\u202e]", printed)


def test_a_spreadsheet_calculates_no_cell_of_a_csv() -> None:
    cells = [
        "=1+1",
        "@SUM(A1)",
        "+cmd",
        "-2+3",
        "\t=1",
        "\r=1",
        "-2.5e3",
        "+4",
        "-inf",
        "a=1",
    ]
    names = tabulate("Names", {"name": "it"}, [(cell,) for cell in cells])
    printed = replace(ANSWER, tables={"names": names}).render("csv")
    cells_there = pd.read_csv(io.StringIO(printed), dtype=str)["name"].tolist()
    assert cells_there == [
        "'=1+1",
        "'@SUM(A1)",
        "'+cmd",
        "'-2+3",
        "'\t=1",
        "'?=1",
        *cells[6:],
    ]


def test_one_table_can_be_asked_for_with_the_remarks_on_it() -> None:
    rows = [("parts", "one is old"), ("others", "none is"), ("all", "they are made up")]
    remarks = tabulate("Remarks", {"table": "table", "remark": "remark"}, rows)
    tables = {**TABLES, "others": OTHERS, "remarks": remarks}
    answer = replace(ANSWER, tables=tables).only("parts")
    assert list(answer.tables) == ["parts", "remarks"]
    assert [*answer.tables["remarks"]["remark"]] == ["one is old", "they are made up"]
    assert r"\noindent{\footnotesize one is old\par}" in answer.render("latex"), (
        "no table, whose label would repeat"
    )
    on_others = remarks.with_rows(remarks.frame[1:2])
    others = replace(answer, tables={**TABLES, "others": OTHERS, "remarks": on_others})
    for form in ("text", "html"):
        assert "Remarks" in answer.render(form, details=True)
        without = replace(others, folded=("others",))
        assert "Remarks" not in without.render(form, details=True), "an empty table"
        assert "Remarks" not in others.render(form, "parts")
    assert "Others" not in ANSWER.render("latex", "parts")
    sentence = "All of them are made up. " * 5
    long = tabulate("Remarks", {"remark": "remark"}, [(sentence,)])
    text = replace(ANSWER, tables={"remarks": long}).render("text", details=True)
    assert "made up. \n" in text
    with pytest.raises(sv.InputError, match="did you mean 'parts'"):
        ANSWER.only("part")


def test_readers_see_folded_tables_only_if_they_ask() -> None:
    answer = replace(ANSWER, tables={**TABLES, "others": OTHERS}, folded=("others",))
    for form in ("text", "latex", "html"):
        assert "Others" not in answer.render(form, details=True)
        assert "Others" in answer.render(form, "others")
    assert "By --table NAME: others." in answer.render("text", details=True)
    assert [*json.loads(answer.render("json"))["tables"]] == ["parts", "others"]


def test_a_label_is_that_of_one_study_question_table_and_command() -> None:
    def label(**changes: Any) -> str:
        (found,) = re.findall(
            r"\\label\{(.*)\}", replace(ANSWER, **changes).render("latex")
        )
        return found

    other = load_study("rain")
    labels = [
        label(),
        label(study=other),
        label(question="other"),
        label(command="one"),
        label(command="two"),
    ]
    assert len({*labels}) == len(labels)
    assert label(command="one") == labels[3], "the same command, the same label"
    assert label(study=other).startswith(f"tab:rain-{ANSWER.question}-parts")


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("probability", [0.25]),
        ("interval.0", [0.1]),
        ("interval.1", [np.nan]),
        ("parts.length", [1.234, None]),
    ],
)
def test_a_key_names_numbers(key: str, values: list[Any]) -> None:
    assert ANSWER.values(key) == pytest.approx(values, nan_ok=True)


def test_an_unknown_key_is_refused_with_the_nearest() -> None:
    with pytest.raises(sv.InputError, match="did you mean 'probability'"):
        ANSWER.values("probabilty")


def test_every_question_is_called_by_its_name() -> None:
    assert [find_question(name) for name in QUESTIONS] == [
        getattr(sv, name) for name in QUESTIONS
    ]


def test_the_question_that_the_manual_adds_from_outside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has at most 60 lines, and gets a command with the shared options and every format."""
    code = (ROOT / "examples/own_question/my_questions.py").read_text("utf-8")
    assert code.count("\n") <= 60
    (tmp_path / "my_questions.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    name = "my_questions:ends"
    assert isinstance(find_question(name), Question)
    command = f"{name} smoke --unsafe below=2.2 --jobs 1"
    failed = run(f"{command} --fail-if 'unsafe_ends > 0'", expect=3)
    assert "Unsafe at an end of the domain: " in failed.stdout
    assert "failed: unsafe_ends = " in failed.stderr
    answer = json_of(command)
    assert answer["question"] == name
    rows = rows_of(answer, "ends")
    assert len(rows) == 2 * len(load_study("smoke").vehicle.characteristics)
    assert answer["numbers"]["unsafe_ends"] == sum(
        row["safety_degree"] < 2.2 for row in rows
    )


def test_a_question_from_outside_takes_results_alone_if_its_first_parameter_says_so() -> (
    None
):
    """However the module writes the type: as a class, or as a text with or without its module."""

    def ask(case: sv.Results, evaluator: Any, /, other: Path) -> sv.Answer: ...

    with_text = dict(ask.__annotations__)
    with_class = with_text | {"case": sv.Results, "other": Path}
    for types in (with_text, with_class, with_text | {"case": "Results"}):
        ask.__annotations__ = types
        assert Question(ask).takes_results_only
        assert Question(ask).others == {"other": True}
    ask.__annotations__ = with_text | {"case": "Subject"}
    assert not Question(ask).takes_results_only


def test_a_printed_command_asks_the_same() -> None:
    """The command, parsed by its own flags, has the values that printed it, and no flag for a
    default.
    """
    ask = find_question("tolerance")
    values = {
        "unsafe": "collision",
        "characteristics": ("mass", "tireFric"),
        "margin": 0.5,
        "fits": ask.options["fits"].default,
    }
    typed = shlex.split(
        ask.command_line(["its results"], {"point": "CPNA, night"}, values)
    )
    assert typed[:5] == ["python", "-m", "safevar_sumo", "tolerance", "its results"]
    assert "--fits" not in typed
    command = commands.get_command(None, "tolerance")  # type: ignore[arg-type]
    given = command.make_context("tolerance", typed[4:]).params
    assert given["point"] == "CPNA, night"
    assert {name: given[name] for name in values} == values


def test_a_change_has_no_share_of_an_original_that_is_0() -> None:
    changes = {"recognition_delay": 0.1, "mass": 2644.4}
    texts = change_texts(
        CharacteristicSet.of(load_study("sun", encounters="ranges")), changes
    )
    assert texts == [
        "vehicle mass from 2404 to 2644 kg (+10.0 %)",
        "additional time that the sensors need in this weather from 0 to 0.100 s",
    ]


def test_a_change_over_decades_or_next_to_the_original_is_no_other_value() -> None:
    items = CharacteristicSet.of(load_study("sun"))
    mass = replace_in(
        items.members[items.names.index("mass")], original=1e-9, lower=0, upper=0.1
    )
    texts = (change_texts([mass], {"mass": value}) for value in (3.2e-6, 0.051, 1.1e-9))
    assert [text.split(" to ")[1].split()[0] for [text] in texts] == [
        "3.2e-06",
        "0.051",
        "1.1e-09",
    ]


def test_limits_are_rounded_to_the_safe_side() -> None:
    one = CharacteristicSet.of(load_study("wear")).members[0]
    assert one.rounded(2.3178, upwards=True) == 2.32
    assert one.rounded(2.3278, upwards=False) == 2.32
    assert one.rounded(7.999, upwards=True) == 8
    worn = replace_in(one, original=7.9992)
    assert worn.rounded(7.999, upwards=True) == 7.9992, "not beyond the original"
