# ruff: noqa: E501 (lines of XML)
"""Euro NCAP's tests as classes and as files of OpenSCENARIO: the same gaps and outcomes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.records import SimulationRuns
from safevar_sumo.scenarios import OpenScenario, TrackScenario
from safevar_sumo.scenarios.ahead import CarToCar
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.tracks import BODIES, PERSONS, VUT_LENGTH, VUT_WIDTH
from safevar_sumo.sumo.system import assemble
from tests.made_up import original_of
from tests.openscenario.writing import (
    AT_ONCE,
    at,
    body,
    event,
    person,
    private,
    speed,
    teleport,
    world,
    write,
)
from tests.scenarios.holding import Pedals, driven

WEAR = assemble(load_study("wear"))
S, LANE = 50.0, 18.0
FRONT = 10 + S + 1.5 + VUT_LENGTH / 2
"""Where the front of the vehicle is at the start, and the middle of its lane [m]."""
SYNCHRONIZE = """<SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster>{}</TargetPositionMaster><TargetPosition>{}
</TargetPosition><FinalSpeed><AbsoluteSpeed value="{}"><TargetDistanceSteadyState distance="{}"/></AbsoluteSpeed></FinalSpeed>
</SynchronizeAction>"""


def as_file(folder: Path, scenario: TrackScenario, time_to_impact: float = 0.0) -> OpenScenario:
    """The file of a test whose first track is its target; others stand."""
    (target, *standing) = scenario.tracks(np.array([[0.0], [time_to_impact]]))
    x, y = (np.broadcast_to(value, (2, 1))[:, 0] for value in (target.x, target.y))
    ego = private("Ego", teleport(at(-1, S)), speed(scenario.start_speed))
    entities = body("Ego", VUT_LENGTH, VUT_WIDTH)
    length, width = BODIES[target.kind]
    first = float(np.broadcast_to(target.speed, (2, 1))[0, 0])
    init = ""
    for one in standing:
        if one.kind == "car":
            entities += body(one.name, float(one.length), float(one.width))
            place = world(FRONT + np.ravel(one.x)[0] - 1.5, LANE + np.ravel(one.y)[0])
            init += private(one.name, teleport(place))
    if target.kind in PERSONS:
        final = 5 / 3.6
        way, east, north = float(y[1] - y[0]), FRONT + float(x[0]), LANE + float(y[0])
        goal = world(10 + S + scenario.start_speed * time_to_impact, LANE)
        action = SYNCHRONIZE.format(goal, world(east, LANE + float(y[1])), final, abs(way) - 1)
        car = teleport(world(east, north, np.copysign(np.pi / 2, way))), speed(0)
        return OpenScenario(
            write(
                folder,
                event(action),
                car=car,
                ego=ego + init,
                entities=entities + person("Car", length, width),
            )
        )
    brakes = [event(speed(2 / 3.6, "linear", "rate", 4.0), AT_ONCE.format(3))] if first else []
    car = teleport(world(FRONT + float(x[0]) - 1.5, LANE + float(y[0]))), speed(first)
    return OpenScenario(
        write(folder, *brakes, car=car, ego=ego, entities=entities + body("Car", length, width))
    )


def least_gap(runs: SimulationRuns) -> float:
    counts = runs.encounter.in_conflict[:, 0] & runs.trace.active[:, 0]
    return float(runs.encounter.separation[counts, 0].min())


@pytest.mark.parametrize("scale", [1.0, 0.25])
@pytest.mark.parametrize(
    ("scenario", "time_to_impact"),
    [
        (CarToCar(test="CCRs", speed=50.0), 0.0),
        (CarToCar(test="CCRb", speed=50.0), 0.0),
        (Crossing(test="CPNA", speed=40.0), 6.0),
        (Crossing(test="CPNCO", speed=40.0), 6.0),
    ],
)
def test_a_class_and_its_file_have_the_same_gap(
    tmp_path: Path, scenario: TrackScenario, time_to_impact: float, scale: float
) -> None:
    """With the brakes as they are, and with a quarter of their torque."""
    settings = original_of(WEAR).copy()
    settings[0, [*WEAR.characteristics.names].index("brakeTorque")] *= scale
    mine = driven(scenario, WEAR.ads, settings, WEAR)
    its = driven(as_file(tmp_path, scenario, time_to_impact), WEAR.ads, settings, WEAR)
    assert its.outcome[0] == mine.outcome[0]
    assert its.collision_speed[0] == pytest.approx(mine.collision_speed[0], abs=0.05, nan_ok=True)
    assert least_gap(its) == pytest.approx(least_gap(mine), abs=0.06)


def test_the_two_parked_cars_of_a_file_hide_the_child(tmp_path: Path) -> None:
    """Who brakes as soon as it sees somebody within 40 m stops 6 to 8 m before the child, and 20 m
    earlier without.
    """
    settings = original_of(WEAR)
    scenario = Crossing(test="CPNCO", speed=40.0)
    sight = Pedals(lambda seen: (0.0, 1.0 * (seen.gap < 40)))
    seen, hidden, in_file = (
        driven(one, sight, settings, WEAR)
        for one in (replace(scenario, hidden=False), scenario, as_file(tmp_path, scenario, 6.0))
    )
    assert least_gap(seen) > least_gap(hidden) + 20
    assert least_gap(in_file) == pytest.approx(least_gap(hidden), abs=0.06)
