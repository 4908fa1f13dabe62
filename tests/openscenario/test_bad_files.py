# ruff: noqa: E501 (lines of XML)
"""Files with what they should not have: refused by name, never with a traceback."""

from __future__ import annotations

import ast
import logging
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo import openscenario
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import play
from safevar_sumo.openscenario.guard import guarded
from tests.in_process import refused
from tests.openscenario import writing
from tests.openscenario.writing import (
    AT_ONCE,
    at,
    body,
    event,
    group,
    lane_change,
    private,
    speed,
    staged,
    teleport,
    trigger,
    write,
)

DEEP = "<Story name='a'>" * 5000 + "</Story>" * 5000
TRAJECTORY = "<RoutingAction><FollowTrajectoryAction><TrajectoryRef><Trajectory><Shape>{}</Shape></Trajectory></TrajectoryRef></FollowTrajectoryAction></RoutingAction>"


def test_what_is_too_long_or_too_deep_is_refused_in_a_short_message(tmp_path: Path) -> None:
    for parts, problem in (
        ({"events": DEEP}, "elements within each other"),
        ({"car": (teleport(at("1" * 4400, 9)), speed(10))}, "LanePosition: laneId = '1111"),  # type: ignore[arg-type]
    ):
        with pytest.raises(InputError, match=problem) as caught:
            staged(tmp_path, **parts)  # type: ignore[arg-type]
        assert len(str(caught.value)) < 400
    file = write(tmp_path, parameters=writing.PARAMETER)
    road = tmp_path / "road.xodr"
    road.write_text(road.read_text().replace('lane id="-1"', f'lane id="-{"1" * 4400}"'))
    with pytest.raises(InputError, match="lane: id = '-1111"):
        play(file, {})
    study = tmp_path / "mine.toml"
    for digits, told in (
        (400, ("scenario.values.v = 1111", "at most 1e+09")),
        (4400, ("mine.toml",)),
    ):
        values = f"values = {{ v = {'1' * digits} }}"
        study.write_text(f'extends = "wear"\n[scenario]\nfile = "scenario.xosc"\n{values}\n')
        refused("check", str(study), message=told)


def test_what_no_element_has_is_passed_over(tmp_path: Path) -> None:
    """A searched number, too, need not be declared as one more than others."""
    staged(tmp_path, minor='2" revMinr="0')
    write(tmp_path, event(speed("$v")), parameters=writing.PARAMETER)
    search = {"v": {"lower": 1.0, "upper": 9.0}}
    load_study(
        "wear",
        scenario={"file": str(tmp_path / "scenario.xosc"), "over": search},
        encounters="ranges",
    )


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
    with pytest.raises(InputError, match="Ego does not drive straight on"):
        staged(tmp_path, stop=LIGHT, geometry=TURN)


@pytest.mark.parametrize(
    ("condition", "edge"),
    [
        (AT_ONCE.format(3), "rising"),
        ("<SimulationTimeCondition rule='lessThan' value='1'/>", "none"),
    ],
)
@pytest.mark.parametrize("counted", ["Event", "ManeuverGroup"])
def test_an_event_that_could_not_begin_again_is_played_once(
    tmp_path: Path, condition: str, edge: str, counted: str
) -> None:
    events = group(event(speed(5, "linear", "time", 2), trigger(condition, edge=edge)))
    once = events.replace(' maximumExecutionCount="1"', "")
    often = once.replace(f"<{counted} ", f'<{counted} maximumExecutionCount="3" ')
    assert "is played once, of up to 3 times" in " ".join(staged(tmp_path, events=often).remarks)


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
    car_, truck, van = staged(tmp_path, init=init, entities=entities).others
    origins = [one.place - 1.5 * one.facing for one in (car_, truck, van)]
    assert np.abs(origins[0] - origins[1] - (30 - 4j)).max() < 1e-6
    assert origins[2][0] == pytest.approx(115 + 26j)


def test_who_is_placed_in_the_plane_changes_lanes_of_a_straight_road(tmp_path: Path) -> None:
    found = []
    change = event(lane_change(-1, "linear", "time", 3), AT_ONCE.format(1))
    for place in (at(-2, 100), writing.world(110, 14)):
        file = write(tmp_path, change, car=(teleport(place), speed(10)))
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
