# ruff: noqa: E501, E731 (lines of XML, and formulas)
"""Motions of OpenSCENARIO against closed forms, and the numbers of a second simulator for files of
our own.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import STEP, Moved, Played, play
from safevar_sumo.openscenario.lines import Piece, Pose
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
    watching,
    world,
    write,
)

FILES = Path(__file__).parent / "files"
REAR = 1.5
"""The middle of a body is so far before its origin [m]."""


DONE = "<StoryboardElementStateCondition storyboardElementType='{}' storyboardElementRef='{}' state='completeState'/>"


def only(played: Played) -> Moved:
    (car,) = played.others
    return car


def car_of(folder: Path, *events: str, **parts: Any) -> Moved:
    """The Car in the scene of such a file."""
    return only(staged(folder, *events, **parts))


def origin(car: Moved) -> np.ndarray:
    return car.place - REAR * car.facing


def times_of(car: Moved) -> np.ndarray:
    return np.arange(len(car.speed)) * STEP


SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "linear": lambda x: x,
    "sinusoidal": lambda x: (1 - np.cos(np.pi * x)) / 2,
    "cubic": lambda x: 3 * x**2 - 2 * x**3,
    "step": lambda x: np.ones_like(x),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_lane_change_has_its_shape_and_the_body_keeps_its_speed(
    tmp_path: Path, shape: str
) -> None:
    car = car_of(tmp_path, event(lane_change(-1, shape, "time", 4.0), AT_ONCE.format(1)))
    times, place = times_of(car), origin(car)
    left = 20 - 6 + 4 * SHAPES[shape](np.clip((times - 1) / 4, 0, 1)) * (times >= 1)
    assert np.abs(place.imag - left).max() < 1e-9
    if shape != "step":
        assert np.abs(np.abs(np.diff(place)) - 10 * STEP).max() < 1e-9
        assert np.abs(car.facing.imag - np.gradient(place.imag, STEP) / 10)[105:495].max() < 0.01


@pytest.mark.parametrize(
    ("shape", "dimension", "amount", "duration"),
    [
        ("sinusoidal", "rate", 2.0, math.pi / 2 * 4 / 2),
        ("linear", "rate", -2.0, 2.0),
        ("cubic", "rate", 3.0, 1.5 * 4 / 3),
        ("linear", "distance", 30.0, 3.0),
    ],
)
def test_a_rate_is_the_largest_one_and_a_distance_is_driven(
    tmp_path: Path, shape: str, dimension: str, amount: float, duration: float
) -> None:
    done = "<StoryboardElementStateCondition storyboardElementType='event' storyboardElementRef='Event' state='completeState'/>"
    file = write(tmp_path, event(lane_change(-1, shape, dimension, amount)), stop=trigger(done, ""))
    played = play(file, {})
    assert played.duration - 4 == pytest.approx(duration, abs=STEP)
    assert origin(only(played))[-1].imag == pytest.approx(18)


@pytest.mark.parametrize(
    ("final", "half", "end"),
    [(4, 5 - math.sqrt(10), 3 + 9 / 4), (16, math.sqrt(40) - 5, math.sqrt(55) - 5)],
)
def test_a_lane_change_over_a_distance_takes_it_whatever_the_speed_does(
    tmp_path: Path, final: float, half: float, end: float
) -> None:
    """30 m, while the speed changes by 2 m/s^2 from 10 m/s; after 15 m the body is between the
    lanes.
    """
    change = event(lane_change(-1, "cubic", "distance", 30.0))
    faster = event(speed(final, "linear", "rate", 2.0), name="Faster", priority="parallel")
    played = staged(tmp_path, change, faster, stop=trigger(DONE.format("event", "Event"), ""))
    assert played.duration - 4 == pytest.approx(end, abs=STEP)
    assert origin(only(played))[round(half / STEP)].imag == pytest.approx(16, abs=0.02)


@pytest.mark.parametrize(
    ("dimension", "amount", "duration"),
    [("rate", 2.0, 5.0), ("time", 5.0, 5.0), ("distance", 75.0, 5.0)],
)
def test_a_linear_change_of_the_speed(
    tmp_path: Path, dimension: str, amount: float, duration: float
) -> None:
    """From 10 to 20 m/s in 5 s, by 2 m/s^2, on 75 m."""
    car = car_of(tmp_path, event(speed(20, "linear", dimension, amount), AT_ONCE.format(2)))
    times = times_of(car)
    since = np.clip(times - 2, 0, duration)
    later = np.maximum(times - 2 - duration, 0)
    assert np.abs(car.speed - (10 + 2 * since)).max() < 1e-9
    way = 10 * np.minimum(times, 2) + 10 * since + since**2 + 20 * later
    assert np.abs(origin(car).real - (110 + way)).max() < 1e-9


def test_a_rate_of_zero_never_ends_and_is_said(tmp_path: Path) -> None:
    played = staged(tmp_path, event(speed(20, "linear", "rate", 0.0)))
    assert set(only(played).speed) == {10.0}
    assert any("rate 0" in remark for remark in played.remarks)


SYNCHRONIZE = """<SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster>{}</TargetPositionMaster>
<TargetPosition>{}</TargetPosition><FinalSpeed><AbsoluteSpeed value="{}">{}</AbsoluteSpeed></FinalSpeed></SynchronizeAction>"""


@pytest.mark.parametrize("start", [0.0, 10.0])
@pytest.mark.parametrize(
    "steady",
    ["", "<TargetDistanceSteadyState distance='30'/>", "<TargetTimeSteadyState time='2'/>"],
)
def test_both_are_at_their_positions_at_the_same_time(
    tmp_path: Path, start: float, steady: str
) -> None:
    action = SYNCHRONIZE.format(at(-1, 250), at(-2, 190), 15, steady)
    played = staged(tmp_path, event(action), car=(teleport(at(-2, 100)), speed(start)))
    car, arrival = only(played), (250 - 50) / 20
    index = round(arrival / STEP)
    assert origin(car)[index].real == pytest.approx(200, abs=0.02)
    assert car.speed[index] == pytest.approx(15)
    before = {"": 0.0, "<TargetDistanceSteadyState distance='30'/>": 2.0}.get(steady, 2.0)
    assert played.depends_until == pytest.approx(arrival - before)
    assert np.abs(car.speed[round((arrival - before) / STEP) : index] - 15).max(initial=0) < 1e-9


def test_a_final_speed_relative_to_ego_is_one_of_that_size(tmp_path: Path) -> None:
    car = (teleport(at(-2, 100)), speed(10))
    action = SYNCHRONIZE.format(at(-1, 250), at(-2, 190), 15, "")
    absolute = car_of(tmp_path, event(action), car=car)
    for value, kind in (-5, "delta"), (0.75, "factor"):
        relative = f'<RelativeSpeedToMaster value="{value}" speedTargetValueType="{kind}"/>'
        action = SYNCHRONIZE.replace('<AbsoluteSpeed value="{}">{}</AbsoluteSpeed>', relative)
        found = car_of(tmp_path, event(action.format(at(-1, 250), at(-2, 190))), car=car)
        assert np.array_equal(found.place, absolute.place)


def polyline(*vertices: tuple[float, float, float], timing: str) -> str:
    points = "".join(
        f'<Vertex time="{time}"><Position>{world(x, y)}</Position></Vertex>'
        for time, x, y in vertices
    )
    trajectory = f'<Trajectory name="" closed="false"><Shape><Polyline>{points}</Polyline></Shape></Trajectory>'
    return (
        f"<RoutingAction><FollowTrajectoryAction><TrajectoryRef>{trajectory}</TrajectoryRef><TimeReference>{timing}"
        "</TimeReference></FollowTrajectoryAction></RoutingAction>"
    )


VERTICES = (0.0, 100.0, 0.0), (2.0, 106.0, 8.0), (5.0, 118.0, 8.0)


def test_a_trajectory_with_times_and_without(tmp_path: Path) -> None:
    timing = "<Timing domainAbsoluteRelative='relative' scale='2' offset='1'/>"
    place = origin(car_of(tmp_path, car=(polyline(*VERTICES, timing=timing),)))
    at_times = {0.5: 100, 1.0: 100, 3.0: 103 + 4j, 5.0: 106 + 8j, 8.0: 112 + 8j, 11.0: 118 + 8j}
    for time, where in at_times.items():
        assert abs(place[round(time / STEP)] - where) < 0.03
    free = car_of(tmp_path, car=(polyline(*VERTICES, timing="<None/>"), speed(5)))
    for time, where in {2.0: 106 + 8j, 1.0: 103 + 4j, 4.0: 116 + 8j, 6.0: 126 + 8j}.items():
        assert abs(origin(free)[round(time / STEP)] - where) < 1e-6


def test_a_trajectory_ends_where_its_line_ends(tmp_path: Path) -> None:
    """10 + 12 m at 5 m/s from 1 s on; what waits for its end begins then."""
    along = event(polyline(*VERTICES, timing="<None/>"), AT_ONCE.format(1))
    then = event(speed(9), DONE.format("event", "Event"), "Then")
    played = staged(tmp_path, along, then, car=(teleport(at(-2, 90)), speed(5)))
    assert played.events[0][3] == pytest.approx(5.4)
    assert np.flatnonzero(only(played).speed > 5)[0] * STEP == pytest.approx(5.4)


def test_who_leaves_a_trajectory_with_times_keeps_its_speed(tmp_path: Path) -> None:
    """6 m/s in lane -2 by times; the lane change begins at 1 s and takes 2 s."""
    vertices = (0.0, 100.0, 14.0), (4.0, 124.0, 14.0)
    timing = "<Timing domainAbsoluteRelative='absolute' scale='1' offset='0'/>"
    change = event(lane_change(-1, "linear", "time", 2), AT_ONCE.format(1))
    car = car_of(tmp_path, change, car=(polyline(*vertices, timing=timing),))
    assert np.abs(np.abs(np.diff(origin(car))) - 6 * STEP).max() < 1e-6
    assert origin(car)[300:].imag == pytest.approx(18)


def test_a_clothoid_has_times(tmp_path: Path) -> None:
    """24 m in 3 s, straight on."""
    clothoid = f'<Clothoid curvature="0" curvaturePrime="0" length="24" startTime="1" stopTime="4"><Position>{world(100, 14)}</Position></Clothoid>'
    action = polyline(timing="<Timing domainAbsoluteRelative='absolute' scale='1' offset='0'/>")
    action = re.sub("<Polyline>.*</Polyline>", clothoid, action)
    assert origin(car_of(tmp_path, car=(action,)))[[0, 100, 250, 400]] == pytest.approx(
        np.array([100, 100, 112, 124]) + 14j, abs=0.05
    )
    closed = action.replace('closed="false"', 'closed="true"')
    with pytest.raises(InputError, match="a closed Trajectory is not supported"):
        staged(tmp_path, car=(closed,))


def test_a_distance_is_kept_between_bodies(tmp_path: Path) -> None:
    action = """<LongitudinalAction><LongitudinalDistanceAction entityRef="Ego" freespace="true" distance="30"
    displacement="leadingReferencedEntity" continuous="false"/></LongitudinalAction>"""
    played = staged(tmp_path, car=(action, teleport(at(-1, 500)), speed(20)))
    assert only(played).place[0].real - 2.5 - played.start.place.real == pytest.approx(30)


@pytest.mark.parametrize(
    ("condition", "when"),
    [
        (
            '<RelativeDistanceCondition entityRef="Car" relativeDistanceType="longitudinal" freespace="true" rule="lessThan" value="20.5"/>',
            2.5,
        ),
        (
            '<TimeHeadwayCondition entityRef="Car" freespace="false" rule="lessThan" value="1"/>',
            3.0,
        ),
        (
            '<TimeToCollisionCondition freespace="true" rule="lessThan" value="2.5"><TimeToCollisionConditionTarget><EntityRef entityRef="Car"/></TimeToCollisionConditionTarget></TimeToCollisionCondition>',
            2.05,
        ),
        ('<TraveledDistanceCondition value="40"/>', 2.0),
        (
            f'<ReachPositionCondition tolerance="1"><Position>{at(-1, 111)}</Position></ReachPositionCondition>',
            3.0,
        ),
    ],
)
def test_a_trigger_that_watches_ego(tmp_path: Path, condition: str, when: float) -> None:
    """Ego, 4 m long, drives at 20 m/s, 50 m behind the origin of a Car of 5 m at 10 m/s in the next
    lane.
    """
    played = staged(
        tmp_path, event(lane_change(-1, "linear", "time", 2), watching("Ego", condition))
    )
    begins = np.flatnonzero(np.abs(np.diff(origin(only(played)).imag)) > 1e-9)[0] * STEP
    assert begins == pytest.approx(when, abs=2 * STEP)
    assert played.depends_until == pytest.approx(begins)


@pytest.mark.parametrize(
    ("edge", "delay", "when"), [("none", 0.0, 3.0), ("rising", 1.5, 4.5), ("falling", 0.0, 5.0)]
)
def test_edges_and_delays(tmp_path: Path, edge: str, delay: float, when: float) -> None:
    rule = "lessThan' value='5" if edge == "falling" else "greaterOrEqual' value='3"
    start = trigger(f"<SimulationTimeCondition rule='{rule}'/>", edge=edge, delay=delay)
    car = car_of(tmp_path, event(speed(20, "linear", "rate", 2), start))
    assert np.flatnonzero(car.speed > 10)[0] * STEP == pytest.approx(when, abs=2 * STEP)


def test_one_event_ends_another(tmp_path: Path) -> None:
    begun = "<StoryboardElementStateCondition storyboardElementType='event' storyboardElementRef='First' state='startTransition'/>"
    first = event(lane_change(-1, "linear", "time", 4), AT_ONCE.format(1), "First")
    second = event(speed(20, "linear", "time", 1), trigger(begun, delay=2), "Second", "{}")
    for priority, left in (("override", 16.0), ("parallel", 18.0)):
        car = car_of(tmp_path, first, second.format(priority))
        assert origin(car)[-1].imag == pytest.approx(left, abs=0.02)
        assert car.speed[-1] == 20


@pytest.mark.parametrize(
    "stop", ["", trigger(watching("Ego", '<StandStillCondition duration="1"/>'), "")]
)
def test_an_empty_trigger_starts_at_once_and_never_stops(tmp_path: Path, stop: str) -> None:
    """Without a StopTrigger, and with one that waits for how Ego drives, a remark says when the
    scene ends.
    """
    faster = event(speed(20, "linear", "time", 2), "<StartTrigger></StartTrigger>")
    empty = staged(tmp_path, faster, act_trigger="<StartTrigger/><StopTrigger/>", stop=stop)
    assert only(empty).speed[[100, 250]].tolist() == [pytest.approx(15), 20]
    assert (empty.duration, "the scene ends at 60 s" in empty.remarks[0]) == (60, True)


BESIDE = 'RelativeTargetLane entityRef="Ego"'
OFFSET = """<LateralAction><LaneOffsetAction><LaneOffsetActionDynamics dynamicsShape="step"/><LaneOffsetTarget>
<RelativeTargetLaneOffset entityRef="Ego" value="1.5"/></LaneOffsetTarget></LaneOffsetAction></LateralAction>"""


@pytest.mark.parametrize(
    ("action", "ego", "its_lane", "left"),
    [
        (lane_change(-1, "step", "time", 0, BESIDE), -1, -1, -6),
        (lane_change(1, "step", "time", 0, BESIDE), 2, 2, 2),
        (lane_change(1, "step", "time", 0, BESIDE.replace("Ego", "Car")), -1, 2, 2),
        (lane_change(-1, "step", "time", 0, BESIDE), -1, 2, -6),
        (OFFSET, -1, 2, -0.5),  # offsets count along t
        (OFFSET, 2, -1, 7.5),
    ],
)
def test_lanes_count_to_the_left_of_an_entity_as_it_faces(
    tmp_path: Path, action: str, ego: int, its_lane: int, left: float
) -> None:
    """On lanes with a number above 0 they drive against the others."""
    start = private("Ego", teleport(at(ego, 900)), speed(20))
    played = staged(
        tmp_path, event(action), ego=start, car=(teleport(at(its_lane, 900)), speed(10))
    )
    assert origin(only(played))[-1].imag == pytest.approx(20 + left)


IN_LANE = '<LanePosition roadId="1" laneId="{}" s="500"><Orientation h="0.5" {}/></LanePosition>'
ON_LINE = """<TrajectoryPosition s="1"><Orientation h="0.5" {}/><TrajectoryRef><Trajectory><Shape><Polyline>
<Vertex><Position><WorldPosition x="0" y="0"/></Position></Vertex><Vertex><Position><WorldPosition x="-9" y="0"/></Position></Vertex>
</Polyline></Shape></Trajectory></TrajectoryRef></TrajectoryPosition>"""


@pytest.mark.parametrize(
    ("minor", "place", "turned"),
    [
        ("2", IN_LANE.format(1, ""), 0),
        ("3", IN_LANE.format(-1, ""), 0),
        ("3", IN_LANE.format(1, ""), 1),
        ("3", IN_LANE.format(1, 'type="absolute"'), 0),
        ("1", IN_LANE.format(1, 'type="relative"'), 1),
        ("2", ON_LINE.format(""), 0),
        ("3", ON_LINE.format(""), 1),
    ],
)
def test_an_orientation_is_absolute_or_relative(
    tmp_path: Path, minor: str, place: str, turned: int
) -> None:
    """The road leads to the east, lane 1 and the trajectory to the west. A remark says how lanes
    are understood.
    """
    played = staged(tmp_path, car=(teleport(place), speed(0)), minor=minor)
    assert only(played).facing[0] == pytest.approx(np.exp(1j * (0.5 + turned * math.pi)))
    assert any("driving direction" in remark for remark in played.remarks) == (
        turned and "Lane" in place
    )


def test_a_spiral_is_the_integral_of_its_curvature() -> None:
    for first, last in ((0.0, 0.02), (0.02, -0.01), (-0.01, -0.03)):
        piece = Piece(Pose.at(3.0, -2.0, 0.7), 80.0, first, last)
        for distance in (0.0, 31.0, 80.0):
            turn = lambda at, first=first, last=last: (
                0.7 + first * at + (last - first) / 160 * at * at
            )
            x = quad(lambda at, turn=turn: math.cos(turn(at)), 0, distance)[0]
            y = quad(lambda at, turn=turn: math.sin(turn(at)), 0, distance)[0]
            pose = piece.pose(distance)
            assert pose.place == pytest.approx(3 + x + 1j * (y - 2), abs=1e-9)
            assert pose.facing == pytest.approx(np.exp(1j * turn(distance)))
            assert piece.reversed().pose(80 - distance).place == pytest.approx(pose.place, abs=1e-9)


def test_the_way_through_a_bend_counts_where_the_body_is(tmp_path: Path) -> None:
    """A quarter of a circle to the left with a radius of 100 m, in lane -1, 2 m outside."""
    bend = 50 * math.pi
    geometry = (
        f'<geometry s="0" x="0" y="0" hdg="0" length="{bend}"><arc curvature="0.01"/></geometry>'
    )
    ego = private("Ego", teleport(world(0, -300)), speed(20))
    car = (teleport(at(-1, 0)), speed(10))
    played = staged(tmp_path, car=car, ego=ego, geometry=geometry, length=bend)
    place, angle = origin(only(played)), 10 * times_of(only(played)) / 102
    assert np.abs(place - (100j + 102 * np.exp(1j * (angle - math.pi / 2)))).max() < 1e-3


def test_files_of_our_own_have_the_numbers_of_a_second_simulator() -> None:
    """Checked with esmini 3.6.0: within 0.08 m everywhere."""
    leader = play(str(FILES / "braking_leader.xosc"), {})
    car = only(leader)
    assert car.place[0].real - 2.1 - leader.start.place.real == pytest.approx(25)
    assert np.argmax(car.speed <= 0) * STEP == pytest.approx(7.0, abs=0.02)
    assert car.place[0].imag == pytest.approx(50 - 1.75 + 0.3)
    assert not leader.depends_until
    cut = play(str(FILES / "cut_in.xosc"), {})
    begins = 4 + (20 - 4.2) / (25 / 3.6)
    assert cut.depends_until == pytest.approx(begins, abs=0.02)
    assert only(cut).place[-1].imag == pytest.approx(cut.start.place.imag)
    assert cut.duration - 4 == pytest.approx(begins + math.pi / 2 * 3.5 / 1.5 + 6, abs=0.03)
    lorry = play(str(FILES / "cut_in.xosc"), {"side": "1", "body": "lorry"})
    assert only(lorry).place[0].imag == pytest.approx(50 - 1.75)
    walk = play(str(FILES / "crossing_pedestrian.xosc"), {})
    walker = only(walk)
    ahead = walker.place.real - 0.25 - walk.start.place.real - walk.speed * times_of(walker)
    impact = int(np.argmax(ahead <= 0))
    assert impact * STEP == pytest.approx((250 - 100 - 3.4 - 0.25) / (50 / 3.6), abs=0.02)
    assert abs(walker.place[impact].imag - walk.start.place.imag) < 0.02
    assert walk.depends_until == pytest.approx(impact * STEP - 4 / 1.5, abs=0.02)


def test_an_ego_in_the_left_lane_drives_against_s(tmp_path: Path) -> None:
    played = staged(tmp_path, ego=private("Ego", teleport(at(1, 500)), speed(20)))
    assert played.start.facing == -1
    assert played.start.place == pytest.approx(10 + 500 - 3.5 + 22j)


def test_a_state_is_that_of_the_element_with_its_whole_path(tmp_path: Path) -> None:
    """A story has ended with its last act."""
    for name in (
        "Event",
        "Maneuver of Car::Event",
        "Story::Act::Group of Car::Maneuver of Car::Event",
    ):
        file = write(
            tmp_path,
            event(speed(20, "linear", "time", 3), AT_ONCE.format(2)),
            stop=trigger(DONE.format("event", name), ""),
        )
        assert play(file, {}).duration == pytest.approx(5 + 4, abs=2 * STEP)
    later = "</Act><Act name='Later'>" + group(
        event(speed(5, "linear", "time", 2), AT_ONCE.format(6))
    )
    file = write(
        tmp_path,
        event(speed(8)),
        act_trigger=later,
        stop=trigger(DONE.format("story", "Story"), ""),
    )
    assert play(file, {}).duration == pytest.approx(8 + 4, abs=STEP)


def test_a_selection_acts_and_is_watched_as_its_members(tmp_path: Path) -> None:
    members = '<Members><EntityRef entityRef="Car"/></Members>'
    entities = (
        body("Ego") + body("Car", 5.0) + f'<EntitySelection name="All">{members}</EntitySelection>'
    )
    far = watching("All", '<TraveledDistanceCondition value="30"/>')
    slower = group(event(speed(5, "linear", "time", 2.0), far), actor="All")
    of_all = car_of(tmp_path, groups=slower, entities=entities)
    of_car = car_of(tmp_path, groups=slower.replace("All", "Car"))
    assert of_all.speed[-1] == 5
    assert np.array_equal(of_all.place, of_car.place)


def test_who_acquires_a_position_straight_ahead_drives_on(tmp_path: Path) -> None:
    goal = f"<RoutingAction><AcquirePositionAction><Position>{at(-2, 900)}</Position></AcquirePositionAction></RoutingAction>"
    end = trigger(watching("Ego", '<EndOfRoadCondition duration="1"/>'), "")
    found = car_of(tmp_path, car=(goal, teleport(at(-2, 100)), speed(10)), stop=end)
    assert np.array_equal(found.place, car_of(tmp_path, stop="").place)
