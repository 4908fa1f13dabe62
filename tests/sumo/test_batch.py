"""The kernel: a setting's result depends on that setting alone, and ends in a typed outcome."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safevar_sumo.records import Evaluations, Outcome, Trace
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate, simulate
from safevar_sumo.sumo.system import System, assemble


def drawn(system: System, n: int, seed: int) -> np.ndarray:
    characteristics = system.characteristics
    rng = np.random.default_rng(seed)
    return characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (n, len(characteristics))))


def same_bits(one: Evaluations, other: Evaluations) -> bool:
    numbers = [(one.collision_speed, other.collision_speed), *((one.metrics[name], other.metrics[name]) for name in one.metrics)]
    return bool(np.array_equal(one.outcome, other.outcome)) and all(a.tobytes() == b.tobytes() for a, b in numbers)


@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 23), data=st.data())
def test_a_result_depends_neither_on_the_batch_nor_on_its_size(study: str, seed: int, n: int, data: st.DataObject) -> None:
    system = assemble(load_study(study))
    population = drawn(system, n, seed)
    together = evaluate(system, population)
    some = data.draw(st.lists(st.integers(0, n - 1), min_size=1, max_size=n, unique=True))
    assert same_bits(together.take(some), evaluate(system, population[some]))
    assert same_bits(together.take([0]), evaluate(system, population[:1]))


def test_a_whole_trace_does_not_depend_on_the_batch() -> None:
    system = assemble(load_study("rain"))
    population = drawn(system, 17, 5)
    together, alone = simulate(system, population).trace, simulate(system, population[3:4]).trace
    length = min(len(alone.time), len(together.time))
    shown = alone.active[:length, 0]
    assert np.array_equal(together.active[:length, 3], shown)
    for field in fields(Trace):
        values = getattr(alone, field.name)
        if isinstance(values, np.ndarray) and values.ndim == 2:
            assert values[:length][shown, 0].tobytes() == getattr(together, field.name)[:length][shown, 3].tobytes(), field.name


def test_the_original_vehicle_does_not_collide(any_system: System) -> None:
    original = evaluate(any_system, any_system.characteristics.original[np.newaxis])
    assert original.outcome[0] in (Outcome.STOPPED, Outcome.PASSED)
    assert original.f_safe[0] > 0
    assert original.f_diff[0] == original.f_num_diff[0] == 0


def test_every_end_of_every_domain_moves_and_ends_in_a_typed_outcome(any_system: System) -> None:
    characteristics = any_system.characteristics
    n = len(characteristics)
    ends = np.repeat(characteristics.original[np.newaxis], 2 * n, axis=0)
    ends[np.arange(n), np.arange(n)] = characteristics.lower
    ends[np.arange(n, 2 * n), np.arange(n)] = characteristics.upper
    run = simulate(any_system, ends)
    assert set(run.outcome) <= {Outcome.STOPPED, Outcome.PASSED, Outcome.COLLISION, Outcome.TIMEOUT}
    assert np.all(run.trace.speed.max(axis=0) > 1.0)


def test_sumo_moves_the_vehicle_as_the_plant_says(any_system: System) -> None:
    """SUMO's position is the integral of the speeds that were set: mean of both speeds of a step, as the ballistic method has it."""
    trace = simulate(any_system, drawn(any_system, 3, 11)).trace
    travelled = np.add.accumulate((trace.speed[1:] + trace.speed[:-1]) / 2 * trace.step, axis=0)
    until = trace.active[1:]
    assert np.allclose((trace.position[1:] - trace.position[0])[until], travelled[until], atol=1e-6)


def test_the_sumo_type_is_that_of_the_setting() -> None:
    import libsumo

    from safevar_sumo.sumo.engine import open_world
    from safevar_sumo.sumo.network import copied_network

    for name in ("sun", "lgsvl", "native"):
        system = assemble(load_study(name))
        population = drawn(system, 4, 3)
        values = dict(zip(system.characteristics.names, np.ascontiguousarray(population.T), strict=True))
        types = system.vehicle.sumo_type(system.vehicle.prepare(values, 1.0, 0.05))
        with open_world(copied_network(system.scenario.network, 4), 4) as world:
            world.set_types(types)
            world.depart()
            for copy, vehicle in enumerate(world.ids("vut")):
                told = [libsumo.vehicle.getMass(vehicle), libsumo.vehicle.getAccel(vehicle), libsumo.vehicle.getDecel(vehicle),
                        libsumo.vehicle.getMaxSpeed(vehicle), libsumo.vehicle.getTau(vehicle)]
                assert told == pytest.approx([values[copy] for values in types])
        assert np.all(np.array(types) > 0)
        assert types.mass.tolist() == values["mass"].tolist()
