"""NSGA-II against fronts that are known, and the contract of every algorithm."""

from __future__ import annotations

import random

import moocore
import numpy as np
import pytest

from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

SUN = CharacteristicSet.of(load_study("sun").vehicle.characteristics)
POPULATION = 20


def evaluated(characteristics: CharacteristicSet, settings: np.ndarray, safety: np.ndarray) -> Evaluations:
    nothing = np.full(len(settings), np.nan)
    return Evaluations(
        settings=settings, outcome=np.full(len(settings), Outcome.STOPPED.value, dtype="U16"), collision_speed=nothing,
        metrics={"safety_degree": safety}, f_diff=characteristics.largest_change(settings),
        f_num_diff=characteristics.number_changed(settings))


def sphere(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
    """The safer, the nearer to the lower ends of the domains."""
    share = (settings - characteristics.lower) / (characteristics.upper - characteristics.lower)
    return evaluated(characteristics, settings, np.add.accumulate(share**2, axis=1)[:, -1])


def searched(name: str, seed: int, evaluations: int, characteristics: CharacteristicSet = SUN, evaluate=sphere):  # type: ignore[no-untyped-def]
    """Run an algorithm to its end; returns its result and all populations that it asked for."""
    search = ALGORITHMS[name](population=POPULATION).search(characteristics, evaluations, np.random.default_rng(seed))
    asked = [next(search)]
    while True:
        try:
            asked.append(search.send(evaluate(characteristics, asked[-1])))
        except StopIteration as end:
            return end.value, asked


@pytest.fixture(params=sorted(ALGORITHMS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("evaluations", [1, 7, POPULATION, 3 * POPULATION + 1, 500])
def test_the_budget_is_kept_to_the_evaluation(name: str, evaluations: int) -> None:
    assert sum(len(settings) for settings in searched(name, 1, evaluations)[1]) == evaluations


def test_what_is_asked_and_found_is_filtered_and_in_the_domains(name: str) -> None:
    found, asked = searched(name, 2, 400)
    for settings in (*asked, found.settings):
        assert np.all((settings >= SUN.lower) & (settings <= SUN.upper))
        assert np.array_equal(SUN.filter(settings), settings)


def test_a_run_is_the_same_for_the_same_seed_and_another_for_another(name: str) -> None:
    first, again, other = (searched(name, seed, 300)[0].settings for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_runs_that_alternate_do_not_disturb_each_other(name: str) -> None:
    alone = [searched(name, seed, 100)[0].settings for seed in (5, 6)]
    searches = [ALGORITHMS[name](population=POPULATION).search(SUN, 100, np.random.default_rng(seed)) for seed in (5, 6)]
    settings, results = [next(search) for search in searches], {}
    while len(results) < 2:
        for i, search in enumerate(searches):
            if i not in results:
                try:
                    settings[i] = search.send(sphere(SUN, settings[i]))
                except StopIteration as end:
                    results[i] = end.value.settings
                random.random()  # whoever else draws from the global generator does not matter
    assert all(np.array_equal(results[i], alone[i]) for i in (0, 1))


def test_the_global_generator_is_left_as_it_was(name: str) -> None:
    random.seed(9)
    state = random.getstate()
    searched(name, 1, 100)
    assert random.getstate() == state


def test_the_result_is_non_dominated(name: str) -> None:
    found = searched(name, 7, 600)[0]
    assert len(found) > 0
    assert moocore.is_nondominated(found.objectives, keep_weakly=True).all()


def test_a_longer_search_dominates_more(name: str) -> None:
    reference = np.array([12.0, 1.0, 12.0])

    def volume(evaluations: int) -> float:
        return float(np.median([moocore.hypervolume(searched(name, seed, evaluations)[0].objectives, ref=reference) for seed in range(5)]))

    assert volume(POPULATION) < volume(200) < volume(1500)


def test_nsga2_finds_the_known_front_of_one_variable() -> None:
    """Two conflicting objectives in one variable: everything between the original and the lower end is optimal."""
    single = CharacteristicSet((Characteristic(name="c", unit="-", original=5.0, lower=1.0, upper=9.0),))

    def linear(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        return evaluated(characteristics, settings, settings[:, 0].copy())

    found = searched("nsga2", 1, 1000, single, linear)[0]
    assert np.all(found.settings <= 5.0)
    assert found.settings.min() == pytest.approx(1.0, abs=1e-3)
    assert len(np.unique(found.settings)) > POPULATION / 2


def test_a_setting_that_failed_never_survives() -> None:
    def failing(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        good = sphere(characteristics, settings)
        fails = settings[:, 0] < 5800
        outcome = np.where(fails, Outcome.SIMULATOR_ERROR.value, good.outcome).astype("U16")
        safety = np.where(fails, np.nan, good.f_safe)
        return Evaluations(settings=settings, outcome=outcome, collision_speed=good.collision_speed,
                           metrics={"safety_degree": safety}, f_diff=good.f_diff, f_num_diff=good.f_num_diff)

    found = searched("nsga2", 1, 400, evaluate=failing)[0]
    assert len(found) > 0
    assert found.valid.all()


def test_nothing_is_found_where_everything_fails() -> None:
    def failing(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        lost = evaluated(characteristics, settings, np.full(len(settings), np.nan))
        return Evaluations(settings=settings, outcome=np.full(len(settings), Outcome.SIMULATOR_ERROR.value), metrics=lost.metrics,
                           collision_speed=lost.collision_speed, f_diff=lost.f_diff, f_num_diff=lost.f_num_diff)

    assert len(searched("nsga2", 1, 100, evaluate=failing)[0]) == 0
