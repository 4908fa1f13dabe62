"""Warnings to the driver: their time, their lack of effect on the drive, and warnings of a user's own ADS."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import safevar_sumo as sv
from safevar_sumo.ads import GuardedAds, PerVehicleAds, ScalarAds
from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, SimulationRuns
from safevar_sumo.scenarios import Along, CarToCar
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import assemble
from tests.scenarios.holding import CARLA, Hold, driven
from tests.scenarios.test_crossing import WORN

STEP = 0.05


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


def test_a_warning_changes_nothing_and_who_brakes_has_warned() -> None:
    early, late = (driven(CarToCar(test="CCRs", speed=50), Aeb(warning_time=time)) for time in (6.0, 0.0))
    np.testing.assert_array_equal(early.trace.brake, late.trace.brake)
    brakes = int(np.argmax(late.trace.brake[:, 0] > 0))
    assert late.warning_ttc[0] == pytest.approx(late.trace.gap[brakes, 0] / late.trace.speed[brakes, 0])
    assert early.warning_ttc[0] == pytest.approx(5.0, abs=STEP), "as far as the scene goes"


def test_whoever_has_no_warnings_never_warns() -> None:
    assert np.isnan(driven(CarToCar(test="CCRs"), Hold()).warning_ttc).all()
    assert not np.isnan(driven(CarToCar(test="CCRs"), Aeb()).warning_ttc).any()


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
    guard, original = Guard("it.toml", "ads"), CARLA.characteristics.original
    for ads in (PerVehicleAds(Near, guard), GuardedAds(NearForMany(), guard)):
        run = driven(CarToCar(test="CCRs", speed=36), ads, np.stack([original, original]))
        assert run.warning_ttc == pytest.approx([2.0, 2.0], abs=STEP + 1e-6)


def test_one_simulation_has_the_warning_of_a_batch() -> None:
    scenario = {"model": "car_to_car", "parameters": {"test": "CCRs", "speed": 36.0}}
    study = sv.load_study("native", ads={"model": "aeb", "parameters": {}}, scenario=scenario)
    alone, system = sv.simulate(study), assemble(study)
    batch = simulate(system, system.characteristics.original[np.newaxis])
    assert alone.runs.warning_ttc.tolist() == batch.warning_ttc.tolist()
    assert not np.isnan(batch.warning_ttc).any()
