"""The kernel: a setting's result depends on that setting alone, and ends in a typed outcome."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safevar_sumo.records import Evaluations, Outcome, Trace
from safevar_sumo.study import load_study
from safevar_sumo.sumo.batch import _Verdict
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


def judged(*samples: tuple[float, bool, float | None]) -> tuple[str, list[bool], float]:
    """Outcome, which samples are active, and the collision's speed of one vehicle: (speed, encounter over, speed of a collision)."""
    verdict, active = _Verdict(1), []
    for i, (speed, over, crash) in enumerate(samples):
        collisions = {} if crash is None else {0: crash}
        told = verdict.judge(np.array([speed]), np.array([over]), collisions, last=i == len(samples) - 1)
        active.append(bool(told[0]))
    assert not verdict.open.any()
    return str(verdict.outcome()[0]), active, float(verdict.collision_speed[0])


@pytest.mark.parametrize(("samples", "outcome"), [
    (((0, False, None), (2, False, None), (2, False, None)), Outcome.TIMEOUT),
    (((0, False, None), (0, False, None), (0, False, None)), Outcome.NEVER_MOVED),
    (((0, False, None), (0, False, None), (0, True, None)), Outcome.NEVER_MOVED),
    (((0, False, None), (2, False, None), (0, False, None)), Outcome.STOPPED),
    (((0, False, None), (2, False, None), (2, True, None), (2, False, None)), Outcome.PASSED),
    (((0, False, None), (2, False, None), (2, False, 1.5), (0, False, None)), Outcome.COLLISION),
    (((0, False, None), (0, False, 0.0), (0, False, None)), Outcome.COLLISION)])
def test_an_ending_has_its_outcome(samples: tuple[tuple[float, bool, float | None], ...], outcome: Outcome) -> None:
    assert judged(*samples)[0] == outcome


def test_who_stands_from_the_start_has_not_stopped_yet() -> None:
    assert judged((0, False, None), (0, False, None), (3, False, None), (3, False, None))[0] == Outcome.TIMEOUT


def test_the_sample_of_a_collision_counts_and_none_after_it() -> None:
    _, active, speed = judged((3, False, None), (3, False, 2.5), (1, False, 0.5), (0, False, None))
    assert active == [True, True, False, False]
    assert speed == 2.5, "the first report is the collision's"


def test_no_sample_counts_once_the_encounter_is_over_but_a_collision_in_that_moment() -> None:
    assert judged((3, False, None), (3, True, None), (3, False, None))[1] == [True, False, False]
    assert judged((3, False, None), (3, True, 3.0), (3, False, None))[1:] == ([True, True, False], 3.0)


def test_the_last_sample_counts() -> None:
    assert judged((3, False, None), (3, False, None))[1] == [True, True]
    assert judged((3, False, None), (0, False, None))[0] == Outcome.STOPPED
