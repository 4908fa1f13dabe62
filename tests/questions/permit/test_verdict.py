"""Answers of `permit` from facts that are written by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import safevar_sumo as sv
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import Fleet, read_fleet
from safevar_sumo.questions.permit.found import (
    DRIVE,
    Example,
    Found,
    FoundCar,
    Permit,
    Reached,
    WorstEnd,
)
from safevar_sumo.questions.permit.speed_search import STANDING, LimitingFailure
from safevar_sumo.questions.permit.tell import tell
from safevar_sumo.questions.permit.verdict import assumed_sentences
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.made_up_studies import drives_of

STUDY = with_ranges(sv.load_study("wear"))
VEHICLE = CharacteristicSet.of(STUDY).vehicle
HITS = Example("the vehicle hits a child", "CPNCO", "speed 41 km/h", 0.5, "hits", "run")


def fleet_of(**cars: dict[str, float]) -> Fleet:
    return read_fleet(
        STUDY, VEHICLE, cars, (), others="new", ignore=(), answer_columns=()
    )


def car(safe_value: float | None, at: float = 41.0, degree: float = -0.2) -> FoundCar:
    """A car that is safe up to a speed, and fails in parameter set 3 at a greater one."""
    failure = LimitingFailure(at, drives_of([0.0]), degree)
    in_sets = [Reached(0, 60.0, None), Reached(3, safe_value, failure, HITS)]
    return FoundCar("a", Permit(in_sets))


SAFE = FoundCar("a", Permit([Reached(0, 60.0, None)]))
FOUND = Found(
    study=STUDY,
    scope="the test CPNCO",
    digest="0123456789ab",
    span=Span("speed", "km/h", 10.0, 60.0, [], []),
    need=None,
    step=1.0,
    vehicle=VEHICLE,
    unsafe=Unsafe(keep=0.1),
    sets=4,
    values=np.arange(10.0, 61.0),
    is_listed=False,
    attacked=4000,
    fleet=fleet_of(a=VEHICLE.named(VEHICLE.original)),
    new_car=50.0,
    cars=[car(40.0)],
    phases="",
    is_quick=False,
    is_rough=False,
    is_box=False,
    has_worst_ends=True,
)
TWO = {"cars": [car(None), car(50.0)], "fleet": fleet_of(a={"payload": 80}, b={})}
ASSUMED = {"fleet": fleet_of(a={"brakeTorque": 0.9})}
TOLD: list[tuple[dict[str, Any], list[str]]] = [
    (
        {},
        [
            'The car "a" may drive from 10 up to 40 km/h. A new car may drive from 10 up to 50'
            " km/h. At a higher speed, the vehicle hits a child.",
            "Valid for: the test CPNCO.",
            "Safe means: the car keeps at least 0.1 m of clearance with parameter set 0 of the"
            " vehicle model (that of the study). With the 3 other parameter sets, the car touches"
            " nobody.",
            "In each test, 51 values from 10 to 60 km/h were simulated. 4,000 simulations",
        ],
    ),
    ({"cars": [SAFE]}, ["The car is safe from 10 up to 60 km/h, the highest speed"]),
    (
        {"cars": [car(50.0)]},
        ["The car may drive as fast as a new car, from 10 up to 50 km/h. At a higher"],
    ),
    (
        {"cars": [car(40.0)], "need": 30.0},
        [
            "is safe from 10 up to 40 km/h, and 30 km/h is needed.",
            "0 cars may not drive",
        ],
    ),
    (
        {"cars": [car(None)]},
        ['The car "a" may not drive.', "Already at 10 km/h, the vehicle hits a child."],
    ),
    (
        {"cars": [car(None, -np.inf)]},
        ["In a test with a speed of its own, the vehicle hits a child."],
    ),
    (
        {"cars": [car(None, -np.inf, STANDING)]},
        ["No speed can be given, because the vehicle hits a child."],
    ),
    (
        TWO,
        [
            "1 of 2 cars may drive up to 60 km/h, or as fast as a new car.",
            "1 of 2 cars may not drive, not even at 10 km/h.",
        ],
    ),
    (
        {**TWO, "need": 45.0, "is_quick": True, "is_rough": True},
        [
            "1 of 2 cars may drive only up to a lower speed, which the table states.",
            "1 car may not drive at 45 km/h.",
            "Nothing else was simulated.",
        ],
    ),
    (
        ASSUMED,
        [
            "within the measuring error of relative brake torque (measured to within 0.05).",
            "No assumed value lowers the speed",
        ],
    ),
    (
        {
            **ASSUMED,
            "cars": [car(40.0)._replace(worst_end=WorstEnd("payload", "525 kg", 9.0))],
        },
        [
            "with 525 kg in place of the assumed 75 kg, the car would be unsafe already at 10 km/h."
        ],
    ),
    (
        {"study": sv.load_study("r152"), "sets": 1},
        [
            'The car "a" can pass the test up to 40 km/h.',
            "A new car can pass the test up to 50 km/h.",
            "Passing means: the car keeps at least 0.1 m of clearance.",
        ],
    ),
    (
        {
            "fleet": FOUND.fleet._replace(is_rough=True),
            "span": FOUND.span._replace(ending=["CPNA"], tests_above=["CPLA", "CPFA"]),
            "unsafe": Unsafe(),
            "phases": "At once.",
        },
        [
            "the list is a rough answer (rough = yes)",
            "Nothing was simulated above 60 km/h, where these tests end: CPNA.",
            "because they begin above 60 km/h: CPLA and CPFA.",
            "Safe means: the car touches nobody in 4 parameter sets of the vehicle model.",
            "At once.",
        ],
    ),
    (
        {"unsafe": Unsafe.parse("drac > 6"), "is_listed": True},
        ["the car is not unsafe (drac > 6, or a collision)", "values (10, 11, 12, 13,"],
    ),
]


@pytest.mark.parametrize(("facts", "sentences"), TOLD)
def test_the_sentences_say_what_was_found(
    facts: dict[str, Any], sentences: list[str]
) -> None:
    answer = tell(replace(FOUND, **facts))
    text = f"{answer.verdict} {answer.tested}"
    for sentence in sentences:
        assert sentence in text
    assert ("may drive" in text) == (FOUND.study.name == answer.study.name)


def test_a_needed_speed_is_no_less_where_the_new_car_is_unsafe_too() -> None:
    for up_to, need, verdict in (
        (50, 55, "up to"),
        (55, 55, "drive"),
        (50, None, "drive"),
        (49, None, "up to"),
        (None, None, "stop"),
    ):
        found = replace(FOUND, cars=[car(up_to)], need=need)
        assert tell(found).tables["cars"]["verdict"].tolist() == [verdict]
        assert not replace(found, is_quick=True).counts[DRIVE]


def test_what_is_assumed_is_named_with_its_value_and_where_that_is_from() -> None:
    fleet = fleet_of(
        a={"treadDepth": 3.0, "sensorRange": 20.0}, b={"sensorRange": 30.0}
    )
    found = replace(FOUND, fleet=fleet, cars=[SAFE, SAFE])
    own = "brakeTorque 1, brakeResponse 0.2 s, payload 75 kg, payloadCentre 2.6 m"
    assert tell(found).tables["cars"]["assumed"].tolist() == [
        f"{own}, sensorLatency 0.1 s",
        f"treadDepth 8 mm, {own}, sensorLatency 0.1 s",
    ]
    assert Verdict(assumed_sentences(found)) == (
        "This answer assumes values that were not measured, as the study states under [unmeasured]:"
        " brake actuator delay 0.2 s, longitudinal position of the payload 2.6 m and perception"
        " latency 0.1 s. This answer assumes values that were not measured, as in a new car:"
        " relative brake torque 1 and payload 75 kg. In 1 of 2 cars, further values are assumed,"
        ' which the column "assumed" names (--details).'
    )
    assert not any(assumed_sentences(FOUND))
