"""Every ADS: vehicles are independent, pedals are in range, a scalar ADS has an instance per vehicle; warnings."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from safevar_sumo.ads import ADS, Ads, PerVehicleAds, ScalarAds
from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.plugins import UserCode
from safevar_sumo.plugins.contract import checked_class
from safevar_sumo.records import Command, FloatArray, Nominal, Observation, SimulationRuns
from safevar_sumo.scenarios import Along, CarToCar
from safevar_sumo.study import ModelTable, load_study, study_names
from safevar_sumo.sumo.system import assemble
from tests.scenarios.holding import CARLA, Hold, driven
from tests.scenarios.test_crossing import WORN

STEP = 0.05
STUDIES = {load_study(name).ads.model: load_study(name) for name in study_names()}
NATIVE = load_study("native")
SYSTEMS = {
    name: assemble(STUDIES.get(name, msgspec.structs.replace(NATIVE, ads=ModelTable(model=name)))) for name in ADS
}
TAKE_OVER = {"aeb", "autoware_aeb", "competent_driver", "full_braking", "fuzzy_safety", "r157", "rss"}
"""ADSs that keep the initial speed."""
KNOWN = assemble(load_study("sun")).nominal


@pytest.fixture(params=sorted(ADS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def observation(time: float, speed: FloatArray, gap: FloatArray, lateral: FloatArray) -> Observation:
    return Observation(time, speed, gap, speed, lateral, np.full_like(speed, 1.8), 1.0)


def approach(ads: Ads, nominal: Nominal, speed: FloatArray, gap: FloatArray) -> FloatArray:
    """Pedals over time, shape (T, 2, N), of vehicles whose speed stays constant whatever the pedals are."""
    memory, pedals = ads.start(len(speed), nominal, STEP), []
    for step in range(80):
        seen = observation(step * STEP, speed, gap - speed * step * STEP, np.zeros_like(speed))
        command, memory = ads.drive(seen, memory)
        pedals.append(np.stack(command))
    return np.stack(pedals)


@pytest.mark.slow
@settings(max_examples=8)
@given(speed=arrays(float, 6, elements=st.floats(0, 15)), gap=arrays(float, 6, elements=st.floats(0.5, 80)))
def test_pedals_stay_in_range_and_no_vehicle_knows_of_another(speed: FloatArray, gap: FloatArray) -> None:
    for system in SYSTEMS.values():
        nominal = system.nominal
        together = approach(system.ads, nominal, speed, gap)
        assert np.all((together >= 0) & (together <= 1))
        assert not np.any((together[:, 0] > 0) & (together[:, 1] > 0)), "no vehicle accelerates and brakes at once"
        assert approach(system.ads, nominal, speed[2:3], gap[2:3])[..., 0].tobytes() == together[..., 2].tobytes()


def test_a_standing_obstacle_close_ahead_makes_it_brake(name: str) -> None:
    system = SYSTEMS[name]
    pedals = approach(system.ads, system.nominal, np.array([5.0]), np.array([20.0]))
    assert pedals[:, 1, 0].max() > 0.1


def test_an_open_road_makes_it_drive(name: str) -> None:
    system = SYSTEMS[name]
    pedals = approach(system.ads, system.nominal, np.array([0.0]), np.array([1e3]))
    assert pedals[-1, 0, 0] > 0.1 or name in TAKE_OVER
    assert pedals[:, 1].max() == 0


class Timid(ScalarAds):
    """Brakes in front of everything, and counts its calls."""

    def __init__(self, distance: float = 10.0) -> None:
        self.distance, self.calls = distance, 0

    def drive(self, seen: Observation) -> tuple[float, float]:
        self.calls += 1
        return (0.0, 1.0) if seen.gap < self.distance else (0.1 * self.calls, 0.0)


def test_a_scalar_ads_drives_every_vehicle_with_an_instance_of_its_own() -> None:
    ads = PerVehicleAds(Timid, UserCode("it.toml", "ads"))
    memory = ads.start(3, KNOWN, STEP)
    gap = np.array([5.0, 50.0, 50.0])
    for expected in ([0.0, 0.1, 0.1], [0.0, 0.2, 0.2]):
        command, memory = ads.drive(observation(0.0, np.zeros(3), gap, np.zeros(3)), memory)
        assert command.throttle.tolist() == pytest.approx(expected)
        assert command.brake.tolist() == [1.0, 0.0, 0.0]
    assert memory[0].nominal.mass == KNOWN.mass
    assert not memory[0].nominal.speeds.flags.writeable
    assert memory[0].step == STEP


def worn(scenario: Any, latency: float, ads: Any) -> SimulationRuns:
    setting = WORN.characteristics.original.copy()
    setting[WORN.characteristics.names.index("sensorLatency")] = latency
    return driven(scenario, ads, setting[np.newaxis], WORN)


@pytest.mark.parametrize("latency", [0.05, 0.25, 0.4])
@pytest.mark.parametrize(
    "scenario", [CarToCar(test="CCRs", speed=60), Along(test="CPLA", speed=60), Along(test="CBLA", speed=70)]
)
def test_sensors_that_are_late_warn_as_much_later(scenario: Any, latency: float) -> None:
    """The first step in which the observed gap / closing speed is below 2.2 s: a true TTC of 2.2 s - latency, or one
    step less.
    """
    warned = worn(scenario, latency, Aeb(warning_time=2.2)).warning_ttc[0]
    assert 2.2 - latency - STEP <= warned + 1e-9
    assert warned < 2.2 - latency + 1e-9


class Near(ScalarAds):
    """Warns, and does no more, below a gap of 20 m."""

    def drive(self, seen: Any) -> tuple[float, float]:
        self.warns = seen.gap < 20
        return seen.throttle, seen.brake


class NearForMany(Hold):
    """The ADS `Near` over arrays of vehicles."""

    def drive(self, seen: Any, memory: Any) -> tuple[Command, Any]:
        self._near = np.asarray(seen.gap < 20)
        return super().drive(seen, memory)

    def warns(self, memory: Any) -> Any:
        return self._near


def test_an_ads_of_ones_own_warns() -> None:
    original = CARLA.characteristics.original
    for_many = checked_class(UserCode("it.toml", "ads", NearForMany), Ads)()
    for ads in (PerVehicleAds(Near, UserCode("it.toml", "ads")), for_many):
        run = driven(CarToCar(test="CCRs", speed=36), ads, np.stack([original, original]))
        assert run.warning_ttc == pytest.approx([2.0, 2.0], abs=STEP + 1e-6)
