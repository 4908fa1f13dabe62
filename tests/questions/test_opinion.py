"""The second vehicle model against the package's equations and closed forms, its tables, and what it says of planted
failures.
"""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.multi_body import (
    MultiBodyState,
    Plant,
    advance,
    balanced_state,
    build_plant,
    derivatives,
    load_bmw_parameters,
    tyre_forces,
)
from safevar_sumo.questions.opinion import assemble_both_systems, judge_causes
from safevar_sumo.questions.second_vehicle import MAPPINGS, OUTSIDE
from safevar_sumo.records import GRAVITY
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.vehicles import LEVEL, VEHICLES
from tests.in_process import json_of
from tests.report.conftest import page_of

ONE = np.ones(1)


def causes(*rows: tuple[str, dict[str, float], float, float]) -> pd.DataFrame:
    """Causes of solutions, as `explain` finds them."""
    return pd.DataFrame(rows, columns=["solution", "changes", "fraction", "robust_share"])


def bmw() -> Plant:
    """The package's vehicle 2 with its own masses."""
    p = parameters_vehicle2()
    plant = build_plant(
        p.m * ONE,
        p.m,
        LEVEL,
        radius=p.R_w,
        wheel_inertia=p.I_y_w,
        friction=p.tire.p_dx1,
        brake_torque=9 * p.m * p.R_w,
        front_brake_share=p.T_sb,
        front_drive_share=p.T_se,
    )
    return plant._replace(sprung_mass=p.m_s * ONE, unsprung_mass=p.m_uf * ONE, height=p.h_s * ONE)


@pytest.mark.parametrize("seed", range(5))
def test_the_right_hand_side_is_the_packages(seed: int) -> None:
    p, rng = parameters_vehicle2(), np.random.default_rng(seed)
    x = [0.0] * 29
    x[3] = rng.uniform(0.5, 30)
    for column, size in {8: 0.02, 9: 0.1, 11: 0.02, 12: 0.1, 17: 0.1, 22: 0.1}.items():
        x[column] = size * rng.normal()
    x[16], x[21] = 0.02 + 0.003 * rng.normal(size=2)
    front, rear = x[3] / p.R_w * rng.uniform(0.4, 1.1, 2)
    x[23:27] = [front, front, rear, rear]
    acceleration = rng.uniform(-9, 3)
    theirs = vehicle_dynamics_mb(list(x), [0.0, acceleration], p)
    torque, share = p.m * p.R_w * acceleration * ONE, p.T_sb if acceleration < 0 else p.T_se
    body = MultiBodyState(
        x[3] * ONE,
        *(
            np.array([values]).T
            for values in ((x[11], x[8], x[16], x[21]), (x[12], x[9], x[17], x[22]), (front, rear), (1.0, 1.0))
        ),
    )
    torques = np.stack([share * torque, (1 - share) * torque])
    speed, heights, wheels = derivatives(bmw(), body, torques, tyre_forces(bmw(), body)[0])
    flat = np.concatenate([speed, *heights, *wheels])
    assert flat == pytest.approx([theirs[column] for column in (3, 12, 9, 17, 22, 23, 25)], rel=1e-9)


def stopping_distance(study: str, speed: float, road: float, **changes: float) -> float:
    """Full braking of the second model's vehicle, from when the brake acts [m]."""
    setting = {name: row.original * ONE for name, row in load_study(study).vehicle.characteristics.items()}
    _, second = assemble_both_systems(load_study(study))
    plant = second.prepare({**setting, **{name: value * ONE for name, value in changes.items()}}, road, 0.05).plant
    body, way = balanced_state(plant, speed * ONE), 0.0
    while body.speed[0] > 0:
        before, body = body.speed[0], advance(plant, body, ONE, 0 * ONE, 1e-3)
        way += (before + body.speed[0]) / 2 * 1e-3
    return way


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "changes", "deceleration"),
    [
        ("wear", {"brakeTorque": 0.3}, 0.3 * 16500 / 1575),
        ("wear", {"brakeTorque": 0.5, "payload": 525.0}, 0.5 * 16500 / 2025),
        ("sun", {"mass": 2700.0, "radius": 37.0, "maxBrakeTorque": 1200.0}, 4 * 1200 / 0.37 / 2700),
        ("native", {"decel": 4.0, "mass": 1800.0}, 4.0 * 1500 / 1800),
    ],
)
def test_below_the_tyres_limit_braking_is_the_closed_form(
    study: str, changes: dict[str, float], deceleration: float
) -> None:
    """v^2 / 2a with a = F / m, within 3 %."""
    assert stopping_distance(study, 12.0, 1.0, **changes) == pytest.approx(12.0**2 / (2 * deceleration), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.9, 0.4])
def test_at_the_limit_the_anti_lock_controller_uses_the_friction(friction: float) -> None:
    """UN Regulation 13-H, annex 6: at least 0.75 of what the friction would give; and never more than all of it."""
    best = 20.0**2 / (2 * friction * GRAVITY)
    assert best <= stopping_distance("wear", 20.0, friction / VEHICLES["worn"]().tyre_friction) < best / 0.75


@pytest.mark.parametrize("name", VEHICLES)
def test_every_characteristic_acts_or_is_outside(name: str) -> None:
    study = load_study(MAPPINGS[name][0])
    system, vehicle = assemble_both_systems(study)
    assert system.vehicle.second_model == name
    original = {one.name: one.original * ONE for one in system.characteristics}

    def constants(**changes: float) -> list[float]:
        prepared = vehicle.prepare(
            {**original, **{key: value * ONE for key, value in changes.items()}}, 0.8, 0.05, LEVEL, 1.0
        )
        tau = vehicle.sumo_type(prepared).tau
        flat = [
            *prepared.plant,
            getattr(prepared.vehicle, "lift", 0),
            prepared.engine_mass,
            *(vehicle.sensors(prepared) or ()),
            0 if tau is None else tau,
        ]
        return [float(value) for part in flat for value in np.ravel(part)]

    for member in system.characteristics:
        value = member.lower if member.lower != member.original else member.upper
        assert (constants(**{member.name: value}) != constants()) == (member.name not in OUTSIDE), member.name


GLITCHY = """
import numpy as np
from safevar_sumo.vehicles import LEVEL
from safevar_sumo.vehicles.sensing import WornVehicle


class Made(WornVehicle, frozen=True, kw_only=True):
    def prepare(self, c, road_friction, step, slope=LEVEL, water=0.0):
        p = super().prepare(c, road_friction, step, slope, water)
        return p._replace(brake=np.where(np.abs(c["payload"] - 300) < 60, 0.3 * p.brake, p.brake))

"""
ONE_TEST = {"tests": [{"name": "CPNA", "parameters": {"test": "CPNA", "speed": 40}}]}


@pytest.mark.slow
def test_the_gap_stands_beside_a_safety_degree_from_centre_to_centre() -> None:
    """The vehicle is 4.7 m long."""
    frame, ends = judge_causes(load_study("native"), causes(("nsga2:0:0", {"maxSpeed": 12.0}, 0.99, 1.0)), Unsafe())
    gap = f"safety degree {frame['a_degree'][0]:.2f} m from centre to centre (gap {frame['a_degree'][0] - 4.7:.2f} m)"
    assert gap in frame["because"][0]
    assert ends["a_outcome"] == ends["b_outcome"]


@pytest.mark.slow
def test_a_failure_that_our_model_alone_has_is_contradicted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A vehicle of a user's whose brakes fail for payloads around 300 kg; without brakes at all it fails there too."""
    (tmp_path / "glitch.py").write_text(GLITCHY)
    monkeypatch.syspath_prepend(tmp_path)
    rows = {
        name: {"unit": row.unit, "original": row.original, "lower": row.lower, "upper": row.upper}
        for name, row in load_study("wear").vehicle.characteristics.items()
    }
    study = load_study(
        {
            "extends": "wear",
            "name": "glitch",
            "matrix": ONE_TEST,
            "vehicle": {"model": "glitch:Made", "characteristics": rows},
        }
    )
    two = ("nsga2:0:0", {"payload": 300.0}, 0.9, 1.0), ("nsga2:0:1", {"brakeResponse": 0.4}, 0.9, 1.0)
    frame, _ = judge_causes(study, causes(*two), Unsafe())
    planted, true = frame.itertuples()
    assert (planted.solution, planted.changes, planted.opinion) == ("nsga2:0:0", {"payload": 300.0}, "contradicted")
    assert (planted.a_outcome, planted.b_outcome, planted.unsafe_in) == ("collision", "stopped", "a")
    assert (true.opinion, true.unsafe_in) == ("confirmed", "both")


WORN_TYRES = {"mass": 2686.0, "tireFric": 1.0, "radius": 31.85, "maxBrakeTorque": 1216.0}


@pytest.mark.slow
def test_a_car_whose_wheels_spin_confirms_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the limit of its torque, worn tyres' rims are 300 m/s faster than the car and push it into a collision at
    8 m/s.
    """
    cause = causes(("nsga2:24:1", WORN_TYRES, 0.99, 1.0))
    (calm,) = judge_causes(load_study("rain"), cause, Unsafe())[0].itertuples()
    monkeypatch.setattr("safevar_sumo.questions.multi_body.TRACTION_SHARE", np.inf)
    (spinning,) = judge_causes(load_study("rain"), cause, Unsafe())[0].itertuples()
    assert (spinning.opinion, spinning.b_outcome) == ("outside", "collision")
    assert "spin" in spinning.because
    assert calm.b_degree > -4 > -7 > spinning.b_degree


@pytest.mark.slow
def test_a_cause_that_is_borderline_in_either_model_is_called_borderline() -> None:
    """In ours by its robustness; in the second by the neighbours, here of the smallest change at which it collides."""
    study = load_study("sun")
    (here,) = judge_causes(study, causes(("nsga2:0:0", WORN_TYRES, 0.99, 0.79)), Unsafe())[0].itertuples()
    assert here.opinion == "borderline"
    assert "; with our model borderline: only 79 % of its neighbours are unsafe too;" in here.because
    system, vehicle = assemble_both_systems(study)
    frictions, characteristics = np.linspace(1.0, 3.5, 60), system.characteristics
    settings = np.stack([characteristics.setting({**WORN_TYRES, "tireFric": one}) for one in frictions])
    runs = evaluate(replace(system, vehicle=vehicle), settings)
    least = float(frictions[runs.collided].max())
    cause = causes(("nsga2:0:0", {**WORN_TYRES, "tireFric": least}, 0.99, 1.0))
    (there,) = judge_causes(study, cause, Unsafe())[0].itertuples()
    assert (there.opinion, there.b_outcome) == ("borderline", "collision")
    assert re.search(r"with the second model only \d\d% of the neighbours are unsafe, too; also unsafe", there.because)


@pytest.mark.slow
def test_the_command_asks_about_the_failures_or_about_those_named(slippery: Path) -> None:
    """Changes of the engine are outside, with their names."""

    def asked(*flags: str) -> list[dict[str, Any]]:
        answer = json_of("opinion", str(slippery), *flags)
        rows: list[dict[str, Any]] = answer["tables"]["settings"]["rows"]
        numbers = answer["numbers"]
        assert numbers["outside"] + numbers["only_a_unsafe"] + numbers["both"] == len(rows)
        return rows

    every, outside = asked(), set(OUTSIDE)
    for one in every:
        assert (one["opinion"] == "outside") == bool(outside & set(one["changes"])) == (one["b_outcome"] is None)
        assert all(name in one["because"] for name in outside & set(one["changes"]))
    first, other, *_ = dict.fromkeys(one["solution"] for one in every)
    named = [one for one in every if one["solution"] in (first, other)]
    assert asked("--solution", first, "--solution", other) == named


@pytest.mark.slow
def test_a_report_has_the_opinion_or_says_how_to_install(slippery: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = page_of(slippery, ask=["opinion"], jobs=1)
    assert "multi-body vehicle confirms" in page
    assert f"opinion {slippery}" in page
    load_bmw_parameters.cache_clear()
    monkeypatch.setitem(sys.modules, "vehiclemodels.parameters_vehicle2", None)
    with pytest.raises(InputError, match="opinion"):
        page_of(slippery, ask=["opinion"], jobs=1)
