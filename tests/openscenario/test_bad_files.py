# ruff: noqa: E501 (lines of XML)
"""Files with what they should not have: refused by name, never with a traceback."""

from __future__ import annotations

import ast
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo import openscenario
from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import play
from safevar_sumo.openscenario.guard import guarded
from tests.in_process import refused
from tests.openscenario import writing
from tests.openscenario.writing import (
    AT_ONCE,
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

SECTION = slice("<laneSection", "</laneSection>")
TRIGGER = trigger(AT_ONCE.format(3), delay="{}")  # type: ignore[arg-type]
DEEP = "<Story name='a'>" * 5000 + "</Story>" * 5000
TRAJECTORY = "<RoutingAction><FollowTrajectoryAction><TrajectoryRef><Trajectory><Shape>{}</Shape></Trajectory></TrajectoryRef></FollowTrajectoryAction></RoutingAction>"


def without(text: str, part: slice) -> str:
    """A text without what is between two marks."""
    before, _, rest = text.partition(part.start)
    return before + rest.partition(part.stop)[2]


@pytest.mark.parametrize(
    ("road", "problem"),
    [
        (lambda text: without(text, SECTION), "the road 1 has no laneSection"),
        (lambda text: text.replace(STRAIGHT, ""), "the road 1 has no geometry"),
        (lambda text: text.replace('lane id="-1"', 'lane id="x"'), "lane: id = 'x'"),
        (lambda text: text.replace('lane id="-1"', f'lane id="-{"1" * 4400}"'), "lane: id = '-1111"),
        (lambda text: text.replace('lane id="-2"', 'lane id="-3"').replace('lane id="-1"', 'lane id="-2"'), "the road 1 has a lane -2 without -1"),
        (lambda text: text.replace('hdg="0"', 'hdg="inf"'), "geometry: hdg = 'inf'"),
        (lambda text: text.replace("2000", "1e300"), "geometry: length = '1e300'"),
        (lambda text: text.replace("<line/>", "<paramPoly3 aU='0' bU='0' cU='0' dU='0' aV='0' bV='0' cV='0' dV='0'/>"), "a polynomial of a road stands still"),
    ],
)  # fmt: skip
def test_a_road_that_cannot_be_driven_is_refused(
    tmp_path: Path, road: Callable[[str], str], problem: str
) -> None:
    file = write(tmp_path)
    path = tmp_path / "road.xodr"
    path.write_text(road(path.read_text()))
    with pytest.raises(InputError, match=problem) as caught:
        play(file, {})
    assert caught.value.legal
    assert "cannot be played" not in caught.value.problem  # not by the guard


@pytest.mark.parametrize(
    ("parts", "problem"),
    [
        ({"car": (teleport(at(-2, 1e300)), speed(10))}, r"LanePosition: s = '1e\+300'"),
        ({"stop": trigger(AT_ONCE.format(3), "", delay="nan")}, "Condition: delay = 'nan'"),
        ({"events": group(event(speed(5), TRIGGER.format(-20)))}, "Condition: delay = '-20'"),
        ({"events": group(event(speed(5, "linear", "time", "1e308")))}, "SpeedActionDynamics: value = '1e308'"),
        ({"events": group(event(lane_change(-1, "cubic", "time", "1e308")))}, "LaneChangeActionDynamics: value = '1e308'"),
        ({"events": DEEP}, "elements within each other"),
        ({"car": (teleport(at("1" * 4400, 9)), speed(10))}, "LanePosition: laneId = '1111"),
        ({"car": (teleport(at(-2, "1_0")), speed(10))}, "LanePosition: s = '1_0'"),
        ({"car": (TRAJECTORY.format("<Polyline/>"), speed(10))}, "Polyline has no Vertex"),
        ({"car": (teleport(at(-2, 9)), TRAJECTORY.format("<ClothoidSpline/>"))}, "ClothoidSpline has no ClothoidSplineSegment"),
        ({"minor": "x"}, "FileHeader: revMinor = 'x'"),
        ({"minor": "7"}, "FileHeader: revMinor = '7'"),
        ({"minor": '2" revMinr="0'}, None),
        ({"car": (teleport(at(-2, 100)), speed("${1 + 2"))}, "the expression \\${1 \\+ 2 is not closed"),
        ({"ego": private("Ego", speed(20), teleport('<LanePosition roadId="1" laneId="-1"/>'))}, "LanePosition has no s"),
        ({"stop": trigger("<SimulationTimeCondition value='3'/>", "")}, "SimulationTimeCondition has no rule"),
    ],
)  # fmt: skip
def test_what_is_illegal_is_refused_where_it_stands(
    tmp_path: Path, parts: dict[str, str], problem: str | None
) -> None:
    file = write(tmp_path, **parts)  # type: ignore[arg-type]
    if problem is None:
        play(file, {})
        return
    with pytest.raises(InputError, match=problem) as caught:
        play(file, {})
    assert caught.value.legal
    assert "cannot be played" not in caught.value.problem
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("v = [1, 2]", ("scenario.values.v = [1, 2]", "a text, or a number")),
        ("v = 1e300", ("scenario.values.v = 1e+300", "at most 1e+09")),
        ("v = nan", ("scenario.values.v = nan", "at most 1e+09")),
        (f"v = {'1' * 400}", ("scenario.values.v = 1111", "at most 1e+09")),
        (f"v = {'1' * 4400}", ("mine.toml", "")),
    ],
)
def test_values_of_a_study_are_texts_or_numbers(
    tmp_path: Path, values: str, message: tuple[str, ...]
) -> None:
    write(tmp_path, parameters=writing.PARAMETER)
    study = tmp_path / "mine.toml"
    study.write_text(
        f'extends = "wear"\nname = "mine"\n[scenario]\nfile = "scenario.xosc"\nvalues = {{ {values} }}\n'
    )
    refused("check", str(study), message=message)


@pytest.mark.parametrize("kind", ["integer", "unsignedInt", "double"])
def test_a_whole_number_cannot_be_searched(tmp_path: Path, kind: str) -> None:
    parameter = writing.PARAMETER.replace("double", kind)
    write(tmp_path, event(speed("$v")), parameters=parameter)
    study = tmp_path / "mine.toml"
    search = "search.v = { lower = 1.0, upper = 9.0 }"
    study.write_text(
        f'extends = "wear"\nname = "mine"\n[scenario]\nfile = "scenario.xosc"\n{search}\n'
    )
    if kind != "double":
        message = "scenario.search.v: the file declares v as a whole number", "type double"
        refused("simulate", str(study), message=message)


def test_the_guard_names_the_error_and_its_line(caplog: pytest.LogCaptureFixture) -> None:
    @guarded
    def fails() -> None:
        raise KeyError("x")

    with (
        caplog.at_level(logging.INFO),
        pytest.raises(InputError, match=r"KeyError in test_bad_files\.py:\d+"),
    ):
        fails()
    assert "KeyError" in caplog.text


def test_every_refusal_says_what_is_expected() -> None:
    for path in Path(openscenario.__path__[0]).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                needed = {"unsupported": 2, "InputError": 3, "Unplaced": 3}.get(node.func.id, 0)
                assert len(node.args) >= needed, f"{path.name}:{node.lineno}"


LIGHT = trigger("<TrafficSignalCondition name='1' state='on'/>", "")
TURN = '<geometry s="0" x="0" y="0" hdg="0" length="2000"><arc curvature="0.001"/></geometry>'


def test_that_ego_turns_is_said_before_what_a_trigger_needs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="TrafficSignalCondition is not supported"):
        play(write(tmp_path, stop=LIGHT), {})
    with pytest.raises(InputError, match="Ego does not drive straight on"):
        play(write(tmp_path, stop=LIGHT, geometry=TURN), {})


@pytest.mark.parametrize(
    ("condition", "edge", "again"),
    [
        (AT_ONCE.format(3), "none", True),
        (AT_ONCE.format(3), "rising", False),
        ("<SimulationTimeCondition rule='lessThan' value='1'/>", "none", False),
        (watching("Ego", '<TraveledDistanceCondition value="9"/>'), "none", True),
    ],
)
@pytest.mark.parametrize("counted", ["Event", "ManeuverGroup"])
def test_an_event_that_could_begin_again_is_refused(
    tmp_path: Path, condition: str, edge: str, again: bool, counted: str
) -> None:
    events = group(event(speed(5, "linear", "time", 2), trigger(condition, edge=edge)))
    once = events.replace(' maximumExecutionCount="1"', "")
    often = once.replace(f"<{counted} ", f'<{counted} maximumExecutionCount="3" ')
    if again:
        with pytest.raises(InputError, match=r"could begin again after \d\.\d s, up to 3 times"):
            play(write(tmp_path, events=often), {})
    else:
        assert "is played once, of up to 3 times" in " ".join(
            play(write(tmp_path, events=often), {}).remarks
        )


def line_to(x: float) -> str:
    vertices = "".join(
        f"<Vertex time='0'><Position>{writing.world(at, 14)}</Position></Vertex>" for at in (110, x)
    )
    return TRAJECTORY.format(f"<Polyline>{vertices}</Polyline>")


KEEPS = """<LongitudinalAction><LongitudinalDistanceAction entityRef="Car" freespace="false" distance="30"
displacement="trailingReferencedEntity" continuous="true"/></LongitudinalAction>"""


@pytest.mark.parametrize("kind", ["lane", "trajectory"])
def test_who_follows_a_trajectory_on_a_straight_road_is_on_the_road(
    tmp_path: Path, kind: str
) -> None:
    """A Truck 30 m behind it in the next lane, and a Van beside it by a RelativeLanePosition."""
    car = teleport(at(-2, 100)) if kind == "lane" else line_to(900)
    beside = '<RelativeLanePosition entityRef="Car" dLane="3" ds="5"/>'
    init = (
        writing.EGO
        + private("Car", car, speed(10))
        + private("Truck", teleport(at(-1, 300)), KEEPS, speed(10))
        + private("Van", teleport(beside), speed(0))
    )
    entities = "".join(map(body, ("Ego", "Car", "Truck", "Van")))
    car_, truck, van = play(write(tmp_path, init=init, entities=entities), {}).others
    origins = [one.place - 1.5 * one.facing for one in (car_, truck, van)]
    assert np.abs(origins[0] - origins[1] - (30 - 4j)).max() < 1e-6
    assert origins[2][0] == pytest.approx(115 + 26j)


def test_who_is_placed_in_the_plane_changes_lanes_of_a_straight_road(tmp_path: Path) -> None:
    found = []
    for place in (at(-2, 100), writing.world(110, 14), writing.world(110, 14, 0.5)):
        change = event(lane_change(-1, "linear", "time", 3), AT_ONCE.format(1))
        file = write(tmp_path, change, car=(teleport(place), speed(10)))
        if "0.5" in place:
            with pytest.raises(InputError, match="LaneChangeAction of Car, which is not on a road"):
                play(file, {})
        else:
            found.append(play(file, {}).others[0].place)
    assert np.abs(found[0] - found[1]).max() < 1e-6


@pytest.mark.parametrize("action", ["lane change", "offset", "position"])
def test_a_mirror_image_of_left_hand_traffic_is_the_mirror_image(
    tmp_path: Path, action: str
) -> None:
    """Lane n of left-hand traffic is where lane -n is in the mirror."""
    offset = """<LateralAction><LaneOffsetAction><LaneOffsetActionDynamics dynamicsShape="step"/><LaneOffsetTarget>
    <AbsoluteTargetLaneOffset value="{}"/></LaneOffsetTarget></LaneOffsetAction></LateralAction>"""
    found = []
    for sign, rule in ((-1, "RHT"), (1, "LHT")):
        does = {
            "lane change": lane_change(
                sign, "cubic", "time", 3, 'RelativeTargetLane entityRef="Ego"'
            ),
            "offset": offset.format(0.5 * sign),
            "position": speed(5, "linear", "time", 3),
        }[action]
        ego = private("Ego", teleport(at(sign * 1, 100)), speed(20))
        place = (
            f'<RelativeLanePosition entityRef="Ego" dLane="{sign}" ds="40" offset="{0.3 * sign}"/>'
        )
        file = write(
            tmp_path / "..",
            event(does, AT_ONCE.format(1)),
            ego=ego,
            car=(teleport(place), speed(10)),
        )
        road = tmp_path / ".." / "road.xodr"
        road.write_text(road.read_text().replace("<road ", f'<road rule="{rule}" '))
        played = play(file, {})
        found.append(((played.others[0].place - 20j), played.others[0].facing, played.start.facing))
    right, left = found
    assert right[2] == left[2] == 1
    assert np.abs(right[0] - left[0].conjugate()).max() < 1e-9
    assert np.abs(right[1] - left[1].conjugate()).max() < 1e-9
