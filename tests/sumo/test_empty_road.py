"""With nobody in sight the original vehicle must drive to the encounter; else no command gives a verdict on its driving
system.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.ads import Ads
from safevar_sumo.records import Command, FloatArray, Nominal, Observation
from safevar_sumo.study import Study, load_study, study_names
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.matrix import study_at
from safevar_sumo.sumo.system import assemble
from tests.in_process import run

STANDS = "The original vehicle never reaches the encounter (it gets 0.0 of 11.9 m): no verdict."
SIMPLE_STUDIES = [name for name in study_names() if load_study(name).matrix is None]


class Pedals(Ads):
    """A driving system whose pedals are a function of the observation."""

    def __init__(self, pedals: Callable[[Observation], tuple[object, object]]) -> None:
        self._pedals = pedals

    def start(self, n: int, nominal: Nominal, step: float) -> None: ...

    def drive(self, seen: Observation, memory: None) -> tuple[Command, None]:
        throttle, brake = (np.zeros(len(seen.speed)) + value for value in self._pedals(seen))
        return Command(throttle, brake), None


def reason(study: str | Study, pedals: Callable[[Observation], tuple[object, object]]) -> str:
    return why_no_verdict(replace(assemble(load_study(study)), ads=Pedals(pedals)))


@pytest.mark.parametrize(
    "name", [name if name in SIMPLE_STUDIES else pytest.param(name, marks=pytest.mark.slow) for name in study_names()]
)
def test_the_original_vehicle_of_every_shipped_study_drives_to_the_encounter(name: str) -> None:
    assert why_no_verdict(assemble(load_study(name))) == ""


@pytest.mark.parametrize(
    ("pedals", "expected"),
    [
        (lambda seen: (0, 1), STANDS),
        (lambda seen: (0, 0), STANDS),
        (lambda seen: (0.02, seen.gap < 5), STANDS.replace("0.0 of", "0.5 of")),
        (
            lambda seen: (0.9 * (seen.time < 1.5), seen.time > 1.5),
            "The original vehicle brakes without an obstacle: no verdict.",
        ),
        (lambda seen: (seen.speed < 5, seen.speed > 5), ""),  # a cruise control with the pedals' full strokes
        # Stands on its brake, but only because of the pedestrian.
        (lambda seen: (0.9, np.isfinite(seen.gap)), ""),
    ],
)
def test_who_stands_creeps_or_brakes_for_nobody_gets_no_verdict(
    pedals: Callable[[Observation], tuple[FloatArray, FloatArray]], expected: str
) -> None:
    assert reason("smoke", pedals) == expected


def test_a_robot_drives_who_does_nothing_to_the_target_but_braking_for_nobody_is_told_with_its_points() -> None:
    test = study_at(load_study("euro_ncap_car_to_car"), "CCRm, speed 50, impact_location 50, clear", "test")
    assert reason(test, lambda seen: (0, 0)) == ""
    assert reason(test, lambda seen: (0, 1)) == "The original vehicle brakes without an obstacle: no verdict."
    assert reason(test, lambda seen: (0, 0.1 * (seen.time == 0))).startswith(
        "The original vehicle never reaches the encounter (it gets "
    )


@pytest.mark.slow
def test_the_reason_counts_the_points_and_names_one() -> None:
    said = reason("euro_ncap_car_to_car", lambda seen: (0, seen.speed > 3))  # not at 10 km/h
    assert said.startswith(
        "The original vehicle brakes without an obstacle at 24 of 27 points, such as CCRs, speed 20, "
    )


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ("traci.vehicle.setSpeed(vehicle_id, 0)", "it gets 0.0 of 60.3 m"),
        ("traci.vehicle.setSpeed(vehicle_id, 0 if traci.vehicle.getLeader(vehicle_id, 100) else 12)", ""),
    ],
)
def test_a_traci_controller_sees_nobody(
    step: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("controller.py").write_text(f"def step(traci, vehicle_id):\n    {step}\n")
    Path("mine.toml").write_text(
        'extends = "native"\nname = "mine"\n[ads]\nkind = "traci"\nmodel = "controller:step"\n'
    )
    said = why_no_verdict(assemble(load_study("mine.toml")))
    assert expected in said
    assert bool(said) == bool(expected)


@pytest.fixture
def still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A study file whose driving system does nothing."""
    monkeypatch.chdir(tmp_path)
    Path("still.py").write_text(
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Still(ScalarAds):\n    def drive(self, seen):\n"
        "        return 0.0, 0.0\n"
    )
    Path("still.toml").write_text('extends = "smoke"\nname = "still"\n[ads]\nmodel = "still:Still"\nparameters = {}\n')
    return "still.toml"


def begins_with_the_reason(*command: str) -> None:
    assert run(*command).stdout.splitlines()[0] == STANDS
    answer = json.loads(run(*command, "--json").stdout)
    assert (answer["driven"] if isinstance(answer, dict) else answer[-1]["summary"]["driven"]) is False


def test_an_answer_begins_with_the_reason(still: str) -> None:
    begins_with_the_reason("rules", still, "--samples", "32", "--unsafe", "collision")
    begins_with_the_reason("simulate", still)


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_every_command_begins_with_the_reason(still: str) -> None:
    for command in (
        ("tolerance", still),
        ("risk", still, "--samples", "100"),
        ("explain", still),
        ("simulate", still, "--set", "mass=2400..2600"),
    ):
        begins_with_the_reason(*command)
    assert (
        run("study", still, "--runs", "1", "--evaluations", "20", "--out", "results").stdout.splitlines()[0] == STANDS
    )
    begins_with_the_reason("opinion", "results")
    run("check", still, expect=1)
    run("report", "results", "--out", "page.html")
    page = Path("page.html").read_text()
    assert 0 < page.index(STANDS) < page.index("<main")
    assert "driven" not in json.loads(run("tolerance", "smoke", "--characteristics", "mass", "--json").stdout)


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_a_rating_begins_with_the_reason_and_a_robot_drives_who_does_nothing(still: str) -> None:
    rated = json.loads(run("rating", still, "--json").stdout)
    assert rated.get("driven", True) is (rated["variants"][0]["points"] == 0)  # 0 points: everything collides
