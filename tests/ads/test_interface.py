"""What a driving system gets from its base class and knows of bodies: pedals for an acceleration,
sizes of the obstacle and of its own vehicle, as an ADS, an FMU and a TraCI controller.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pythonfmu.builder import FmuBuilder

from safevar_sumo.ads import Ads, ScalarAds
from safevar_sumo.ads.base import Trim
from safevar_sumo.records import Command, FloatArray, Nominal, Observation
from safevar_sumo.scenarios.tracks import BODIES
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import drive_and_score
from tests.support.in_process import write
from tests.support.made_up import original_of, seen, system_of
from tests.support.pedals import BRAKING, COASTING, FULL, KNOWN

WISHES = [
    (1.0, (1.0 + COASTING) / (FULL + COASTING), 0.0),
    (-5.0, 0.0, (5.0 - COASTING) / BRAKING),
]
"""Accelerations, and the pedals of `KNOWN` for them."""
STANDING = {"model": "car_to_car", "parameters": {"test": "CCRs", "speed": 40.0}}


class Wishes(ScalarAds):
    def drive(self, seen: Observation) -> tuple[float, float]:
        return self.pedals(-3.0, seen.speed)


class ArrayWishes(Ads):
    def start(self, n: int, nominal: Nominal, step: float) -> None:
        self.nominal = nominal

    def drive(self, seen: Observation, memory: None) -> tuple[Command, None]:
        return self.pedals(np.full_like(seen.speed, -3.0), seen.speed), None


@pytest.mark.parametrize(("acceleration", "throttle", "brake"), WISHES)
def test_pedals_are_those_of_the_original_vehicles_tables(
    acceleration: float, throttle: float, brake: float
) -> None:
    one = Wishes()
    one.start(KNOWN, 0.05)
    pedals = one.pedals(acceleration, 10.0)
    assert pedals == pytest.approx((throttle, brake))
    assert [type(pedal) for pedal in pedals] == [float, float]
    many = ArrayWishes()
    many.start(2, KNOWN, 0.05)
    for nominal in (None, KNOWN):
        command = many.pedals(np.full(2, acceleration), np.full(2, 10.0), nominal)
        assert_allclose(command, [[throttle] * 2, [brake] * 2])
    tilted = one.pedals(acceleration, 10.0, Trim(np.array(0.1), np.array(0.0)))
    assert tilted == pytest.approx((throttle + (0.1 if throttle else 0.0), brake))


def test_a_class_may_have_another_method_of_that_name(in_tmp: Path) -> None:
    write(
        "own.py",
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Own(ScalarAds):\n"
        "    def pedals(self, wish):\n        return 0.0, min(-wish, 1.0)\n\n"
        "    def drive(self, seen):\n        return self.pedals(-0.5)\n",
    )
    system = system_of("wear", matrix=None, scenario=STANDING, ads={"model": "own:Own"})
    assert drive_and_score(system, original_of(system)).outcome.tolist() == ["stopped"]


class Listens(Ads):
    """Brakes, and keeps what it knows of bodies."""

    def __init__(self) -> None:
        self.sizes: list[FloatArray] = []

    def start(self, n: int, nominal: Nominal, step: float) -> Nominal:
        return nominal

    def drive(self, seen: Observation, memory: Nominal) -> tuple[Command, Nominal]:
        self.nominal = memory
        if np.isfinite(seen.gap).all():
            self.sizes.append(np.array([seen.obstacle_length, seen.obstacle_width]))
        return Command(np.zeros_like(seen.speed), np.ones_like(seen.speed)), memory


def listened(scenario: dict[str, Any]) -> Listens:
    system = system_of("wear", matrix=None, scenario=scenario)
    ads = Listens()
    drive_all(replace(system, ads=ads), original_of(system))
    return ads


CAR, ADULT = BODIES["car"], BODIES["adult"]


@pytest.mark.parametrize(
    ("scenario", "extent"),
    [
        (STANDING, (CAR.length, CAR.width)),
        (
            {"model": "crossing", "parameters": {"test": "CPFA"}},
            (ADULT.width, ADULT.length),
        ),
    ],
)
def test_an_ads_knows_how_long_the_obstacle_and_its_own_vehicle_are(
    scenario: dict[str, Any], extent: tuple[float, float]
) -> None:
    """Somebody who crosses is as long along the lane as he is wide."""
    size = {"vut_length": 4.7, "vut_width": 1.85}
    ads = listened({**scenario, "parameters": {**scenario["parameters"], **size}})
    assert (ads.nominal.length, ads.nominal.width) == (4.7, 1.85)
    assert_allclose(np.array(ads.sizes)[:, :, 0], [extent] * len(ads.sizes))


TELLS = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Tells(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.target = self.own = self.step_size = self.pedal = 0.0
        for name in ("target", "own", "step_size"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("pedal", causality=Fmi2Causality.output))

    def do_step(self, now, step):
        self.pedal = self.target / 100 + self.own / 1000 + self.step_size
        return True
"""


def test_an_fmu_may_be_given_the_same_numbers(in_tmp: Path) -> None:
    write("tells_sizes.py", TELLS)
    FmuBuilder.build_FMU(in_tmp / "tells_sizes.py", dest=in_tmp)
    write(
        "tells.toml",
        'extends = "native"\nname = "tells"\n[ads]\nkind = "fmu"\nmodel = "Tells.fmu"\n'
        'inputs = { obstacle_length = "target", nominal_length = "own", step = "step_size" }\n'
        'outputs = { brake = "pedal" }\n',
    )
    ads = system_of("tells.toml").ads
    memory = ads.start(1, KNOWN._replace(length=5.0), 0.1)
    now = seen(0.0, 1.0, np.ones(1))._replace(obstacle_length=np.full(1, 4.0))
    command, _ = ads.drive(now, memory)
    assert command.brake[0] == pytest.approx(0.04 + 0.005 + 0.1)
