# ruff: noqa: E501 (lines of XML, and formulas)
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
    PARAMETER,
    STRAIGHT,
    at,
    body,
    event,
    group,
    lane_change,
    private,
    speed,
    teleport,
    trigger,
    watching,
    write,
)

CATALOG = '<CatalogReference catalogName="cars" entryName="mine"/>'
SPLINE = STRAIGHT.replace("<line/>", "<bezier/>")
TURN = '<geometry s="0" x="0" y="0" hdg="0" length="2000"><arc curvature="0.001"/></geometry>'
ACTIVATE = "<ActivateControllerAction longitudinal='true'/>"
BOMB = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
EXTERNAL = '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
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
TRAILER = body("Car").replace("</Vehicle>", "<Trailer>{}</Trailer></Vehicle>")
STATE = trigger(
    "<StoryboardElementStateCondition storyboardElementType='event' storyboardElementRef='{}' state='runningState'/>",
    "",
)
BACKWARDS = """<SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster><LanePosition roadId="1" laneId="-1" s="250"/></TargetPositionMaster>
<TargetPosition><LanePosition roadId="1" laneId="-2" s="200"/></TargetPosition><FinalSpeed><AbsoluteSpeed value="-2"/></FinalSpeed></SynchronizeAction>"""
COLLISION = "<CollisionCondition><EntityRef entityRef='Car'/></CollisionCondition>"


@pytest.mark.parametrize(
    ("parts", "problem"),
    [
        ({"geometry": SPLINE}, "the road 1 has a bezier"),
        ({"geometry": TURN}, "Ego does not drive straight on: it turns by"),
        ({"ego": private("Ego", teleport(at(-1, 50)), speed(-1.11))}, r"Ego drives backwards \(-1.11 m/s\)"),
        ({"ego": private("Ego", teleport(at(-1, 50)))}, "Ego stands at the start"),
        ({"ego": private("Ego", teleport(at(-1, 50)), speed(20), ACTIVATE), "groups": group(event(speed(5), AT_ONCE.format(3)), actor="Ego")}, "SpeedAction of Ego after the start"),
        ({"events": group(event(speed(5), watching("Ego", COLLISION)))}, "the event Event waits for a CollisionCondition of Ego"),
        ({"entities": body("Car1") + body("Car2"), "init": ""}, "no ScenarioObject is named 'Ego'; there are: Car1, Car2"),
        ({"car": ("<LongitudinalAction><SpeedProfileAction/></LongitudinalAction>",)}, "SpeedProfileAction is not supported"),
        ({"car": (teleport("<GeoPosition/>"),)}, "GeoPosition is not supported"),
        ({"stop": "<ConditionGroup><Condition><ByValueCondition><UserDefinedValueCondition/></ByValueCondition></Condition></ConditionGroup>"}, "UserDefinedValueCondition is not supported"),
        ({"entities": f'<ScenarioObject name="Ego">{CATALOG}</ScenarioObject>'}, "there is no catalog cars in"),
        ({"car": (teleport(at(-2, 2010)), speed(1))}, "s = 2010.0 m is not on road 1, which is 2000 m long"),
        ({"parameters": LIMITED}, "the file's constraints exclude v = 10"),
        ({"entities": body("Ego"), "init": EGO}, "nobody but Ego is in the file"),
        ({"road": "gone.xodr"}, "the road .*gone.xodr' is not there"),
        ({"version": "2"}, "is no OpenSCENARIO XML 1.x"),
        ({"prolog": BOMB}, "has a document type or entities"),
        ({"prolog": EXTERNAL}, "has a document type or entities"),
        ({"prolog": "<"}, "is no XML"),
        ({"car": (speed(10),)}, "Car has no place in Init"),
        ({"car": (teleport(at(-3, 100)), speed(10))}, "road 1 has no lane -3"),
        ({"car": (teleport(at(-2, 100)), speed("$v"))}, "the file declares no parameter v"),
        ({"car": (teleport(at(-2, 100)), speed("fast"))}, "value = 'fast'"),
        ({"entities": body("Ego") + TRAILER.format('<TrailerRef entityRef="Cart"/>')}, "the Trailer of Car is not supported"),
        ({"entities": body("Ego") + TRAILER.format('<Trailer name="Cart"/>')}, "the Trailer of Car is not supported"),
        ({"entities": body("Ego") + 2 * body("Car")}, "2 entities are named 'Car'"),
        ({"parameters": 2 * PARAMETER}, "2 parameters are named 'v'"),
        ({"parameters": LIMITED.replace("lessThan", "below")}, "ValueConstraint: rule = 'below'"),
        ({"stop": STATE.format("Evnt")}, "storyboardElementRef = 'Evnt'"),
        ({"stop": STATE.format("Act::Other::Event")}, "storyboardElementRef = 'Act::Other::Event'"),
        ({"events": group(event(BACKWARDS))}, r"Car drives backwards \(-2.00 m/s\)"),
        ({"stop": trigger(watching("Ego", f'<DistanceCondition freespace="true" value="5" rule="lessThan"><Position>{at(-1, 100)}</Position></DistanceCondition>'), "")}, "DistanceCondition with freespace = true is not supported"),
        ({"stop": trigger(watching("Ego", '<SpeedCondition direction="lateral" value="5" rule="lessThan"/>'), "")}, "SpeedCondition with direction = lateral is not supported"),
    ],
)  # fmt: skip
def test_a_refusal_names_what_is_not_supported(
    tmp_path: Path, parts: dict[str, str], problem: str
) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        play(write(tmp_path, **parts), {})  # type: ignore[arg-type]
    assert str(caught.value).count("\n") <= 1
    assert any(re.fullmatch(template, caught.value.problem) for template in TEMPLATES), (
        caught.value.problem
    )


def test_what_happens_less_than_the_file_says_is_remarked(tmp_path: Path) -> None:
    late = event(lane_change(-1, "linear", "time", 1), AT_ONCE.format(99))
    actions = (
        "<GlobalAction><EnvironmentAction/></GlobalAction>"
        + EGO
        + private("Car", teleport(at(-2, 1900)), speed(30))
    )
    played = play(write(tmp_path, late, init=actions), {})
    assert "without effect here: EnvironmentAction" in played.remarks
    assert "the event Event never fires" in played.remarks
    often = late.replace("<Event ", '<Event maximumExecutionCount="3" ')
    assert (
        "the event Event is played once, of up to 3 times"
        in play(write(tmp_path, often), {}).remarks
    )
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


LOGICAL = """<OpenSCENARIO><FileHeader revMajor="1" revMinor="2"/><ParameterValueDistribution>
<ScenarioFile filepath="scenario.xosc"/>{}</ParameterValueDistribution></OpenSCENARIO>"""
ROW = '<DeterministicSingleParameterDistribution parameterName="{}">{}</DeterministicSingleParameterDistribution>'
RANGE = (
    '<DistributionRange stepWidth="{}"><Range lowerLimit="{}" upperLimit="{}"/></DistributionRange>'
)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("<Stochastic/>", "Stochastic distributions are not supported"),
        (
            "<Deterministic>" + ROW.format("w", RANGE.format(1, 0, 5)) + "</Deterministic>",
            "declares no parameter w",
        ),
        (
            "<Deterministic>" + 2 * ROW.format("v", RANGE.format(1, 0, 5)) + "</Deterministic>",
            "2 parameters with values",
        ),
        (
            "<Deterministic>" + ROW.format("v", RANGE.format(0, 0, 5)) + "</Deterministic>",
            "v: a range from 0 to 5 by 0",
        ),
        (
            "<Deterministic>" + ROW.format("v", "<UserDefinedDistribution/>") + "</Deterministic>",
            "UserDefinedDistribution",
        ),
    ],
)
def test_a_file_of_values_is_refused(tmp_path: Path, content: str, problem: str) -> None:
    write(tmp_path, parameters=LIMITED)
    path = tmp_path / "values.xosc"
    path.write_text(LOGICAL.format(content))
    with pytest.raises(InputError, match=problem):
        open_file(str(path))


def test_combinations_leave_out_what_constraints_exclude() -> None:
    """600 combinations of our own file, 50 of which it excludes."""
    source = open_file(str(Path(__file__).parent / "files" / "cut_in_logical.xosc"))
    assert len([*source.combinations({})]) == 550
    assert source.range_of("gap_m") == (5, 45)
    assert len([*source.without({"gap_m": 1, "body": 1}).combinations({})]) == 4 * 3 * 5 * 2 - 2 * 5
