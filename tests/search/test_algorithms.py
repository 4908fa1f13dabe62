"""The contract of every algorithm."""

from __future__ import annotations

import random

import numpy as np
import pytest

from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.vehicles import CharacteristicSet
from tests.search.problems import POPULATION, SUN, begun, evaluated, searched, sphere


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
    searches = [begun(name, seed, 100) for seed in (5, 6)]
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


def test_a_setting_that_failed_never_gets_into_the_result(name: str) -> None:
    def failing(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        good = sphere(characteristics, settings)
        fails = settings[:, 0] < 5800
        outcome = np.where(fails, Outcome.SIMULATOR_ERROR.value, good.outcome).astype("U16")
        safety = np.where(fails, np.nan, good.f_safe)
        return Evaluations(settings=settings, outcome=outcome, collision_speed=good.collision_speed,
                           metrics={"safety_degree": safety}, f_diff=good.f_diff, f_num_diff=good.f_num_diff)

    found = searched(name, 1, 400, evaluate=failing)[0]
    assert len(found) > 0
    assert found.valid.all()


def test_nothing_is_found_where_everything_fails(name: str) -> None:
    def failing(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        lost = evaluated(characteristics, settings, np.full(len(settings), np.nan))
        return Evaluations(settings=settings, outcome=np.full(len(settings), Outcome.SIMULATOR_ERROR.value), metrics=lost.metrics,
                           collision_speed=lost.collision_speed, f_diff=lost.f_diff, f_num_diff=lost.f_num_diff)

    assert len(searched(name, 1, 100, evaluate=failing)[0]) == 0
