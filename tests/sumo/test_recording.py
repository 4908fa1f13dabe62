"""Vehicles in recorded scenes, compared with copies of the network in SUMO."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import msgspec
import numpy as np
import platformdirs
import pytest

import safevar_sumo as sv
from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome
from safevar_sumo.scenarios import SCENARIOS
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo import Engine, reason_for_sumo, recording, simulate_all_points
from safevar_sumo.sumo.recorded_world import distance_covered
from safevar_sumo.sumo.recording import record_scenes
from safevar_sumo.sumo.system import System, assemble

CLAIM = """
from safevar_sumo.scenarios import PedestrianCrossing


class Claims(PedestrianCrossing, frozen=True, kw_only=True):
    reactive_actors = False
"""


def assert_same(system: System, number: int, seed: int) -> list[str]:
    """Assert that recorded scenes and SUMO give the same bits; returns all outcomes."""
    characteristics, rng = system.characteristics, np.random.default_rng(seed)
    settings = characteristics.filter(
        rng.uniform(characteristics.lower, characteristics.upper, (number, len(characteristics)))
    )
    settings[0] = characteristics.original
    outcomes = []
    results = (simulate_all_points(system, settings, engine) for engine in (Engine.RECORDED, Engine.LIBSUMO))
    for recorded, copies in zip(*results, strict=True):
        here, there = recorded.evaluations, copies.evaluations
        assert here.outcome.tolist() == there.outcome.tolist()
        np.testing.assert_array_equal(here.collision_speed, there.collision_speed)
        for name, values in there.metrics.items():
            np.testing.assert_array_equal(here.metrics[name], values, err_msg=name)
        for ours, theirs in zip(recorded.runs.contact, copies.runs.contact, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        outcomes += here.outcome.tolist()
    return outcomes


def test_vehicles_in_recorded_scenes_give_the_same_bits_as_in_sumo(any_system: System) -> None:
    assert reason_for_sumo(any_system) == ""
    assert_same(any_system, 60, 5)


def test_the_distance_of_a_step_has_sumos_order_of_operations() -> None:
    """The mean of both speeds gave positions 1.4e-14 m off for 2 of 7,168 settings: their positions before and after a
    step in SUMO.
    """
    before, after = np.array([0.0, 0.49783446695015615]), np.array([0.4348049848410796, 1.0073508794958133])
    there = np.array([28.196, 28.208445861673756]) + distance_covered(before, after, 0.05)
    assert there.tolist() == [28.206870124621027, 28.246075495334903]


def test_a_scene_from_the_cache_equals_the_scene_that_sumo_played(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In an empty cache: SUMO plays the scene, and the next process reads the file."""
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda name: tmp_path)
    scenario = assemble(load_study("sun")).scenario

    def scene() -> str:
        recording._recordings.clear()
        return repr(record_scenes([scenario], ()))

    played = scene()
    assert [*tmp_path.glob("networks/scenes-*/scenes.msgpack")]
    monkeypatch.setattr(recording, "_play", None)
    assert scene() == played


def test_contacts_are_those_that_sumo_finds() -> None:
    """Vehicles that brake at various gaps: they hit with the front, a corner or the side, or miss."""
    study, rng, outcomes = load_study("sun"), np.random.default_rng(6), []
    for gap in rng.uniform(3.0, 9.0, 6):
        ads = {
            **study.ads.parameters,
            "brake_gap": float(gap),
            "brake_gap_before": 1.0,
            "first_command": float(rng.uniform(0, 1.5)),
        }
        outcomes += assert_same(
            assemble(msgspec.structs.replace(study, ads=msgspec.structs.replace(study.ads, parameters=ads))), 40, 6
        )
    assert 40 < outcomes.count(Outcome.COLLISION) < 220


def test_a_shipped_scenario_on_a_users_network_is_simulated_in_sumo() -> None:
    scenario = SCENARIOS["crossing"](network="my_town")
    (scene,) = record_scenes([scenario], ())
    assert "my_town" in str(scene)


@pytest.fixture
def reacting(in_tmp: Path) -> Path:
    """A network whose pedestrian stops before a vehicle, as SUMO's pedestrians do by default."""
    shutil.copytree(NETWORKS / "pedestrian_crossing", in_tmp / "reacting")
    options = in_tmp / "reacting" / "scenario.sumocfg"
    lines = options.read_text().splitlines()
    options.write_text("\n".join(line for line in lines if "mingap-to-vehicle" not in line))
    return in_tmp


def test_a_scenario_whose_pedestrian_reacts_is_simulated_in_sumo_by_default(reacting: Path) -> None:
    study = load_study(
        "smoke",
        scenario={"parameters": {"network": "reacting"}},
        search={"runs": 1, "algorithms": ["rs"], "evaluations": 20},
        title="",
        published={},
    )
    sv.run(study, out="results/it", jobs=1)
    engine = json.loads(Path("results/it/manifest.json").read_text())["engine"]
    assert engine["name"] == "sumo"
    assert "'reacting'" in engine["reason"]


@pytest.mark.slow
def test_a_false_claim_that_no_actor_reacts_is_detected(reacting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(reacting)
    Path("claims.py").write_text(CLAIM)
    study = load_study(
        "native",
        scenario={"model": "claims:Claims", "parameters": {"network": "reacting"}},
        name="mine",
        title="",
        search={"runs": 1, "algorithms": ["rs"], "evaluations": 60},
        published={},
    )
    with pytest.raises(
        InputError, match=r"outcome is \w+ instead of \w+ in SUMO and in the recorded scene, with mass = "
    ):
        sv.run(study, out="results/it", jobs=1)
