"""What a reader of OpenSCENARIO refuses, and how it says so."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from safevar_sumo import openscenario
from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import open_file, play
from safevar_sumo.openscenario.expressions import evaluate, literal
from tests.manual import ROOT
from tests.openscenario.writing import (
    AT_ONCE,
    EGO,
    at,
    event,
    lane_change,
    private,
    speed,
    staged,
    teleport,
    write,
)
from tests.refusals.test_refusals import prepare, rows

LIMITED = (
    '<ParameterDeclaration name="v" parameterType="double" value="10"><ConstraintGroup>'
    '<ValueConstraint rule="lessThan" value="5"/></ConstraintGroup></ParameterDeclaration>'
)
GENERATE = runpy.run_path(str(ROOT / "docs" / "generate.py"))
TEMPLATES = [
    ".+".join(map(re.escape, message.split("...")))
    for _, message, _ in GENERATE["messages"](Path(openscenario.__path__[0]))
]
"""The refusals that a page of the manual lists."""


def test_the_manual_lists_every_refusal_of_the_tables_and_none_is_the_guards(
    tmp_path: Path,
) -> None:
    problems = []
    for number, row in enumerate(rows("openscenario")):
        folder = tmp_path / str(number)
        folder.mkdir()
        prepare(folder, row.values[0])
        try:
            play(str(folder / "scenario.xosc"), {})
        except InputError as error:
            problems.append(error.problem)
    assert len(problems) > 60
    for problem in problems:
        assert "cannot be played" not in problem
        assert any(re.fullmatch(template, problem) for template in TEMPLATES), problem


def test_what_happens_less_than_the_file_says_is_remarked(tmp_path: Path) -> None:
    late = event(lane_change(-1, "linear", "time", 1), AT_ONCE.format(99))
    actions = (
        "<GlobalAction><EnvironmentAction/></GlobalAction>"
        + EGO
        + private("Car", teleport(at(-2, 1900)), speed(30))
    )
    played = staged(tmp_path, late, init=actions)
    assert "without effect here: EnvironmentAction" in played.remarks
    assert "the event Event never fires" in played.remarks
    often = late.replace("<Event ", '<Event maximumExecutionCount="3" ')
    assert "the event Event is played once, of up to 3 times" in staged(tmp_path, often).remarks
    assert any(
        "the scene ends at 3.3 s, when Car is at the end of its road" in remark
        for remark in played.remarks
    )
    assert played.duration == pytest.approx(3.33)


def test_a_parameter_that_is_not_declared_is_refused_with_the_next_name(tmp_path: Path) -> None:
    file = write(tmp_path, parameters=LIMITED.replace('value="5"', 'value="50"'))
    assert play(file, {"v": "20"}).duration == 14
    with pytest.raises(InputError, match="declares no parameter V; did you mean 'v'"):
        play(file, {"V": "20"})


def test_expressions() -> None:
    values = {"a": "3", "b": "-4", "text": "left"}
    for text, expected in {
        "$a": "3",
        "${sqrt($a * $a + $b * $b)}": "5.0",
        "${-2 * ($a + 1) / 4}": "-2.0",
        "${not ($a > 2 and $b < 0)}": "false",
        "${round(2.5)}": "3",
        "${sign($b) * pow($a, 2)}": "-9.0",
        "${5 % 3}": "2.0",
        "left": "left",
    }.items():
        assert literal(text, values) == expected
    for wrong in (
        "__import__('os')",
        "1 / 0",
        "$text + 1",
        "(1).real",
        "9 ** 9",
        "+",
        "max()",
        "1" * 1001,
    ):
        with pytest.raises(InputError, match="has no value"):
            evaluate(wrong, values)


def test_combinations_leave_out_what_constraints_exclude() -> None:
    """600 combinations of our own file, 50 of which it excludes."""
    source = open_file(str(Path(__file__).parent / "files" / "cut_in_logical.xosc"))
    assert len([*source.combinations({})]) == 550
    assert source.range_of("gap_m") == (5, 45)
    assert len([*source.without({"gap_m": 1, "body": 1}).combinations({})]) == 4 * 3 * 5 * 2 - 2 * 5
