"""Worlds that live on give the results of fresh ones to the last bit, and end where they could not."""

from __future__ import annotations

import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import Command, Nominal, Observation, SimulationRuns
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study, study_names
from safevar_sumo.sumo.batch import drive
from safevar_sumo.sumo.engine import Engine, open_world
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.network import copied_network
from safevar_sumo.sumo.staging import staged
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.traffic import repeatable_traffic

SYSTEMS = {name: assemble(load_study(name)) for name in study_names() if load_study(name).matrix is None}
SYSTEMS["nearer than SUMO would put it"] = replace(SYSTEMS["sun"], scenario=CarToCar(test="CCRs", speed=60, headway=0.5))


class _FullThrottle:
    """Drives into whatever is there."""

    def start(self, n: int, nominal: Nominal, step: float) -> None:
        return None

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        return Command(np.ones_like(seen.speed), np.zeros_like(seen.speed)), memory


class _Failing(_FullThrottle):
    """Breaks down on the way."""

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        if seen.time > 1:
            raise SimulationError("the engine is on fire")
        return super().drive(seen, memory)


@pytest.fixture(autouse=True)
def loadings(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every network that libsumo loads, by file."""
    loaded: list[str] = []
    start = libsumo.start

    def counting(command: list[str], *arguments: Any) -> Any:
        loaded.append(command[command.index("-n") + 1])
        return start(command, *arguments)

    monkeypatch.setattr(libsumo, "start", counting)
    return loaded


def fresh(system: System, population: np.ndarray) -> SimulationRuns:
    n = len(population)
    with open_world(copied_network(staged(system.scenario), n), n) as world:
        return drive(system, population, world)


def bits(drives: SimulationRuns) -> dict[str, bytes]:
    """Everything that is told of simulations."""
    trace = drives.trace
    told = {"outcome": drives.outcome.tobytes(), "collision speed": drives.collision_speed.tobytes()}
    for field in fields(trace):
        values = getattr(trace, field.name)
        if isinstance(values, np.ndarray):
            told[field.name] = (np.where(trace.active, values, 0) if values.ndim == 2 else values).tobytes()
    return told


def drawn(system: System, n: int, seed: int) -> np.ndarray:
    characteristics = system.characteristics
    rng = np.random.default_rng(seed)
    return characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (n, len(characteristics))))


def changed_network(folder: Path, network: str, **changes: tuple[str, str]) -> str:
    """A copy of a shipped network with some text of its files replaced; keyword: the file's first word."""
    mine = folder / network
    shutil.copytree(NETWORKS / network, mine)
    for word, (old, new) in changes.items():
        (file,) = (one for one in mine.glob(f"*{word}*") if "net.xml" not in one.name)
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new))
    return str(mine)


@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(batches=st.lists(st.tuples(st.sampled_from(sorted(SYSTEMS)), st.integers(1, 12), st.booleans()), min_size=2, max_size=5),
       seed=st.integers(0, 2**32 - 1))
def test_whatever_was_driven_before_leaves_no_trace(batches: list[tuple[str, int, bool]], seed: int) -> None:
    """Studies, sizes and drivers in any order; half of the batches end in collisions."""
    asked = [(replace(SYSTEMS[name], ads=_FullThrottle()) if crashes else SYSTEMS[name], drawn(SYSTEMS[name], n, seed + i))
             for i, (name, n, crashes) in enumerate(batches)]
    for engine in (Engine.LIBSUMO, Engine.RECORDED):
        for here, (system, population) in zip([simulate(*one, engine) for one in asked], asked, strict=True):
            assert bits(here) == bits(fresh(system, population))


def test_the_network_is_loaded_once_for_batches_that_fit(loadings: list[str]) -> None:
    system = SYSTEMS["rain"]
    with pytest.raises(SimulationError):
        simulate(replace(system, ads=_Failing()), drawn(system, 2, 1), Engine.LIBSUMO)
    loadings.clear()
    for n in (7, 3, 10, 1):
        simulate(system, drawn(system, n, n), Engine.LIBSUMO)
    assert len(loadings) == 1
    simulate(system, drawn(system, 11, 1), Engine.LIBSUMO)
    assert len(loadings) == 2


UNREPEATABLE: dict[str, dict[str, tuple[str, str]]] = {
    "a flow": {"traffic": ("</routes>", '<flow id="f" type="parked" from="road" to="road" begin="0" end="9" number="2"/></routes>')},
    "a trip": {"traffic": ("</routes>", '<trip id="t" type="parked" from="road" to="road" depart="0"/></routes>')},
    "a late departure": {"traffic": ('depart="0"', 'depart="2"')},
    "a stop until a time": {"traffic": ('duration="100000"', 'until="5"')},
    "a random place": {"traffic": ('departPos="20"', 'departPos="random"')},
    "random speeds": {"traffic": ('speedDev="0"', 'speedDev="0.1"')},
    "random driving": {"traffic": ('sigma="0"', 'sigma="0.5"')},
    "no word of sigma": {"traffic": (' sigma="0"', "")},
    "a device that reroutes": {"scenario": ("<processing>", '<processing><device.rerouting.probability value="1"/>')},
}


@pytest.mark.parametrize("what", sorted(UNREPEATABLE))
def test_what_cannot_be_put_back_is_not(tmp_path: Path, what: str) -> None:
    assert repeatable_traffic(changed_network(tmp_path, "lead_vehicle_stopped", **UNREPEATABLE[what])) is None


@pytest.mark.parametrize("network", sorted({path.name for path in NETWORKS.iterdir() if path.is_dir()}))
def test_the_shipped_networks_are_repeatable(network: str) -> None:
    assert repeatable_traffic(network)
