"""Vehicles in recorded scenes, compared with SUMO; and with nobody in sight, where the original
vehicle must drive to the encounter, or no command gives a verdict on its driving system.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import platformdirs
import pytest

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import FloatArray, Observation
from safevar_sumo.results import read_manifest
from safevar_sumo.scenarios import SCENARIOS, Point, weather_of
from safevar_sumo.scenarios.ahead import CarToCar
from safevar_sumo.study import Study
from safevar_sumo.sumo import reason_against_scenes, recording
from safevar_sumo.sumo.bodies import distance_covered
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.recording import Scenes
from safevar_sumo.sumo.system import System
from tests.support.holding import Pedals
from tests.support.in_process import (
    SLOW,
    InlinePool,
    json_of,
    own_network,
    run,
    verify_everywhere,
    write,
)
from tests.support.made_up import drawn, original_of, system_of
from tests.support.same_runs import assert_same

CLAIM = """
from safevar_sumo.scenarios import PedestrianCrossing


class Claims(PedestrianCrossing, frozen=True, kw_only=True):
    reactive_actors = False
"""


def test_vehicles_in_recorded_scenes_give_the_same_bits_as_in_sumo(
    any_system: System,
) -> None:
    assert reason_against_scenes(any_system) == ""
    assert_same(any_system, drawn(any_system, 60, 5))


def test_the_distance_of_a_step_has_sumos_order_of_operations() -> None:
    """The mean of both speeds gave positions 1.4e-14 m off for 2 of 7,168 settings: their positions
    before and after a step in SUMO.
    """
    before = np.array([0.0, 0.49783446695015615])
    after = np.array([0.4348049848410796, 1.0073508794958133])
    there = np.array([28.196, 28.208445861673756]) + distance_covered(
        before, after, 0.05
    )
    assert there.tolist() == [28.206870124621027, 28.246075495334903]


def test_a_scene_from_the_cache_equals_the_scene_that_sumo_played(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In an empty cache: SUMO plays the scene, and the next process reads the file."""
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda name: tmp_path)
    scenario = system_of("sun").points[0].scenario

    def scene() -> str:
        return repr(Scenes().of(scenario))

    played = scene()
    assert [*tmp_path.glob("networks/scene-*/scene.msgpack")]
    monkeypatch.setattr(recording, "_play", None)
    assert scene() == played


def test_a_shipped_scenario_on_a_users_network_is_simulated_in_sumo() -> None:
    scenario = SCENARIOS["pedestrian_crossing"](network="my_town")
    assert "my_town" in Scenes().reason_against_scenes(
        [Point(scenario, weather_of("clear"))]
    )


@pytest.fixture
def reacting(in_tmp: Path) -> Path:
    """A network whose pedestrian stops before a vehicle, as SUMO's pedestrians do by default."""
    options = own_network(in_tmp / "reacting") / "scenario.sumocfg"
    lines = options.read_text().splitlines()
    options.write_text(
        "\n".join(line for line in lines if "mingap-to-vehicle" not in line)
    )
    return in_tmp


@SLOW
def test_a_scenario_whose_pedestrian_reacts_is_simulated_in_sumo_by_default(
    reacting: Path,
) -> None:
    study = load_study(
        "smoke",
        scenario={"parameters": {"network": "reacting"}},
        search={"runs": 1, "algorithms": ["rs"], "evaluations": 20},
        title="",
        published={},
    )
    sv.run(study, out="results/it", pool=InlinePool())
    engine = read_manifest(Path("results/it"))["engine"]
    assert engine["name"] == "sumo"
    assert "'reacting'" in engine["reason"]


def test_a_point_whose_runs_end_before_those_of_another_one_is_repeated_to_its_own_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A car that follows is under way to the end of both runs."""
    monkeypatch.setattr(CarToCar, "goes_on", False)
    tests = [
        {"name": f"{seconds:g}", "parameters": {"test": "CCRm", "time_after": seconds}}
        for seconds in (1.0, 2.0)
    ]
    ads = {"model": "idm", "parameters": {}}
    car = {"model": "car_to_car", "parameters": {}}
    system = system_of("wear", ads=ads, scenario=car, matrix={"tests": tests})
    assert drive_and_score(system, original_of(system)).outcome.tolist() == ["timeout"]
    verify_everywhere(system, original_of(system))


def test_driven_speeds_lead_to_the_same_places_and_collisions_in_sumo(
    any_system: System,
) -> None:
    verify_everywhere(any_system, drawn(any_system, 20, 7))


def test_who_reacts_against_the_claim_is_at_another_place_in_sumo(
    reacting: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(reacting)
    write("claims.py", CLAIM)
    scenario = {"model": "claims:Claims", "parameters": {"network": "reacting"}}
    system = system_of("native", scenario=scenario)
    with pytest.raises(
        InputError,
        match=r"at [\d.]+ s is .* in the recorded scene and .* in SUMO, with mass = ",
    ):
        verify_everywhere(system, drawn(system, 60, 5))


FIRST = "On a first drive, with nobody in sight, the original vehicle "
NO_VERDICT = ". So its drives with somebody in sight do not show how it reacts to them: no verdict."
STANDS = (
    f"{FIRST}never reaches the encounter (it gets 0.0 of 11.9 m, with at most 0 of the throttle and"
    f" 0 of the brake){NO_VERDICT}"
)
BRAKES = f"{FIRST}brakes without an obstacle"


def reason(
    study: str | Study, pedals: Callable[[Observation], tuple[object, object]]
) -> str:
    return why_no_verdict(replace(system_of(study), ads=Pedals(pedals)))


@pytest.mark.parametrize(
    ("pedals", "expected"),
    [
        (lambda seen: (0, 1), STANDS.replace("0 of the brake", "1 of the brake")),
        (lambda seen: (0, 0), STANDS),
        (
            lambda seen: (0.02, seen.gap < 5),
            STANDS.replace("0.0 of", "0.5 of").replace(
                "0 of the thr", "0.02 of the thr"
            ),
        ),
        (lambda seen: (0.9 * (seen.time < 1.5), seen.time > 1.5), BRAKES + NO_VERDICT),
        (
            lambda seen: (seen.speed < 5, seen.speed > 5),
            "",
        ),  # a cruise control with the pedals' full strokes
        # Stands on its brake, but only because of the pedestrian.
        (lambda seen: (0.9, np.isfinite(seen.gap)), ""),
    ],
)
def test_who_stands_creeps_or_brakes_for_nobody_gets_no_verdict(
    pedals: Callable[[Observation], tuple[FloatArray, FloatArray]], expected: str
) -> None:
    assert reason("smoke", pedals) == expected


def test_a_driving_system_that_brakes_for_nobody_is_named_with_its_points() -> None:
    test = at_point(
        load_study("euro_ncap_car_to_car"), "CCRm, speed 50, impact_location 50, clear"
    )
    assert reason(test, lambda seen: (0, 0)) == ""
    assert reason(test, lambda seen: (0, 1)) == BRAKES + NO_VERDICT
    assert reason(test, lambda seen: (0, 0.1 * (seen.time == 0))).startswith(
        f"{FIRST}never reaches the encounter (it gets "
    )


@SLOW
def test_the_reason_counts_the_points_and_names_one() -> None:
    said = reason(
        "euro_ncap_car_to_car", lambda seen: (0, seen.speed > 3)
    )  # not at 10 km/h
    assert said.startswith(f"{BRAKES} at 24 of 27 points, such as CCRs, speed 20, ")


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ("traci.vehicle.setSpeed(vehicle_id, 0)", "it gets 0.0 of 60.3 m"),
        (
            (
                "traci.vehicle.setSpeed(vehicle_id, 0 if traci.vehicle.getLeader(vehicle_id, 100)"
                " else 12)"
            ),
            "",
        ),
    ],
)
def test_a_traci_controller_sees_nobody(step: str, expected: str, in_tmp: Path) -> None:
    write("controller.py", f"def step(traci, vehicle_id):\n    {step}\n")
    write(
        "mine.toml",
        'extends = "native"\nname = "mine"\n[ads]\nkind = "traci"\nmodel = "controller:step"\n',
    )
    said = why_no_verdict(system_of("mine.toml"))
    assert expected in said
    assert bool(said) == bool(expected)


@pytest.fixture
def still(in_tmp: Path) -> str:
    """A study file whose driving system does nothing."""
    write(
        "still.py",
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Still(ScalarAds):\n    def drive(self,"
        " seen):\n        return 0.0, 0.0\n",
    )
    write(
        "still.toml",
        'extends = "smoke"\nname = "still"\n[ads]\nmodel = "still:Still"\nparameters = {}\n',
    )
    return "still.toml"


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_every_command_begins_with_the_reason(still: str) -> None:
    for command in (
        f"rules {still} --samples 32 --unsafe collision",
        f"explain {still} --quick",
        f"simulate {still} --set mass=2600",
    ):
        answer = json_of(command)
        assert answer["verdict"].startswith(STANDS)
        assert answer.get("numbers", answer)["driven"] is False
    printed = run(f"study {still} --runs 1 --evaluations 20 --out results").stdout
    assert printed.startswith(STANDS)
    run("report results --ask 'rules --samples 32 --unsafe collision' --out page.html")
    page = re.sub(
        "</?span>", "", Path("page.html").read_text()
    )  # a sentence has a line of its own
    assert f'<div class="first">\n<p>{STANDS}' in page
