"""The contract of every algorithm, on problems with a known solution."""

from __future__ import annotations

import dataclasses
import pickle
from itertools import zip_longest
from typing import Any

import moocore
import msgspec
import numpy as np
import pytest
from deap import tools
from hypothesis import given, strategies as st
from numpy.random import default_rng

from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.plugins import read_only
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.search.baselines import Ranges
from safevar_sumo.search.genetic import (
    Individual,
    fitness_class,
    run_tournament,
    select_survivors,
)
from safevar_sumo.search.pymoo import PYMOO_ALGORITHMS
from safevar_sumo.search.surrogate import _learn
from safevar_sumo.study import ORIGINAL_DEGREE
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from tests.support.in_process import SLOW
from tests.support.made_up import SUN
from tests.support.searches import (
    POPULATION,
    TWO,
    begun,
    built,
    evaluated,
    problem,
    sphere,
)

OURS = [
    pytest.param(name, marks=SLOW if name == "surrogate" else ()) for name in ALGORITHMS
]
"""Our algorithms; fitting models takes seconds."""


def failing(characteristics: CharacteristicSet, settings: FloatArray) -> Evaluations:
    """The sphere, where a part of the domain cannot be simulated."""
    good = sphere(characteristics, settings)
    fails = settings[:, 0] < 5600
    outcome = np.where(fails, Outcome.SIMULATOR_ERROR.value, good.outcome).astype("U16")
    metrics = {"safety_degree": np.where(fails, np.nan, good.f_safe)}
    return dataclasses.replace(good, outcome=outcome, metrics=metrics)


def searched(
    name: str, seed: int, evaluations: int, **changes: Any
) -> tuple[Evaluations, list[FloatArray]]:
    """Run an algorithm to its end; returns its result and all populations that it requested."""
    *asked, result = begun(ALGORITHMS[name](), seed, evaluations, **changes)
    return result, asked


@pytest.mark.parametrize(
    "name", [*OURS, "pymoo:NSGA3", "pymoo:CMAES", "pymoo:DE", "pymoo:NelderMead"]
)
@pytest.mark.parametrize("evaluations", [1, 7, POPULATION, 3 * POPULATION + 1, 500])
def test_the_budget_is_kept_to_the_evaluation(name: str, evaluations: int) -> None:
    *asked, result = begun(built(name), 1, evaluations)
    assert sum(map(len, asked)) == evaluations
    assert len(result)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=SLOW if "pymoo" in name or name == "surrogate" else ())
        for name in (*ALGORITHMS, *PYMOO_ALGORITHMS)
    ],
)
def test_every_algorithm_keeps_the_contract_and_runs_in_turn_are_runs_alone(
    name: str,
) -> None:
    """Two runs that take turns, while others draw from numpy's global state."""
    alone = [list(begun(built(name), seed, 130, failing)) for seed in (1, 2)]
    np.random.seed(5)
    in_turn = []
    for pair in zip_longest(
        *(begun(built(name), seed, 130, failing) for seed in (1, 2))
    ):
        in_turn.append(pair)
        state = np.random.random()
    np.random.seed(5)
    assert state == np.random.random(len(in_turn))[-1], "the caller's random state"
    for steps, (*asked, result) in zip(zip(*in_turn, strict=True), alone, strict=True):
        *asked_in_turn, result_in_turn = (step for step in steps if step is not None)
        assert all(map(np.array_equal, asked_in_turn, asked))
        assert np.array_equal(result_in_turn.settings, result.settings)
        every = np.concatenate(asked)
        assert 0 < len(every) <= 130
        assert np.all((every >= SUN.lower) & (every <= SUN.upper))
        assert np.array_equal(SUN.filter(every), every)
        assert len(result)
        assert set(map(bytes, every)).issuperset(map(bytes, result.settings))
        assert result.valid.all()
    assert not np.array_equal(*in_turn[0]) or name == "pymoo:DIRECT", "another seed"


@pytest.mark.parametrize("name", ["nsga2", "rs"])
def test_the_result_is_non_dominated(name: str) -> None:
    solutions = searched(name, 7, 600)[0]
    assert len(solutions)
    objectives = np.stack(
        [solutions.f_safe, solutions.f_diff, solutions.f_num_diff], axis=1
    )
    assert moocore.is_nondominated(objectives, keep_weakly=True).all()


def test_a_generation_is_fifty_and_changes_between_one_and_all() -> None:
    _, asked = searched("safe_fuzzer", 1, 500)
    assert [len(settings) for settings in asked] == [50] * 10
    changed = np.concatenate([SUN.number_changed(settings) for settings in asked])
    assert set(changed) == set(range(1, 13)), (
        "k is uniform in 1..n before the first update"
    )
    assert np.bincount(changed.astype(int))[1:].min() > 500 / 12 / 2


def test_safe_fuzzer_ends_after_five_generations_without_improvement() -> None:
    single = CharacteristicSet(
        (Characteristic(name="c", unit="-", original=5.0, lower=4.0, upper=6.0),)
    )

    def constant(
        characteristics: CharacteristicSet, settings: FloatArray
    ) -> Evaluations:
        return evaluated(
            characteristics, np.full_like(settings, 6.0), np.ones(len(settings))
        )

    _, asked = searched(
        "safe_fuzzer", 4, 5000, characteristics=single, evaluate=constant
    )
    assert sum(len(settings) for settings in asked) == 500 + 5 * 50


def test_a_score_is_relative_to_its_generation_and_the_fifty_best_are_the_result() -> (
    None
):
    solutions, asked = searched("safe_fuzzer", 6, 5000)
    scores = []
    for generation in (sphere(SUN, settings) for settings in asked):
        sd_norm = (generation.f_safe - generation.f_safe.min()) / np.ptp(
            generation.f_safe
        )
        scores.append(
            (6 * sd_norm + generation.f_diff + (generation.f_num_diff - 1) / 11) / 8
        )
    best = np.argsort(np.concatenate(scores), kind="stable")[:50]
    assert np.array_equal(solutions.settings, np.concatenate(asked)[best])
    lowest = np.minimum.accumulate([score.min() for score in scores])
    last_improvement = np.flatnonzero(np.diff(lowest) < 0)[-1] + 1
    assert len(asked) == max(last_improvement + 1, 500 // 50) + 5 < 5000 // 50, (
        "the best score is five generations old"
    )


@SLOW
def test_the_surrogate_finds_more_than_nsga2_with_four_times_as_many_simulations() -> (
    None
):
    few, many = (
        PUBLISHED_SCORING.values(searched(name, 1, count)[0])
        for name, count in (("surrogate", 100), ("nsga2", 400))
    )
    volume = moocore.Hypervolume(ref=[12.0, 1.0, 12.0])
    assert volume(few) > volume(many)


def test_the_surrogate_uses_its_budget_where_no_original_vehicle_is_safe() -> None:
    def never_safe(
        characteristics: CharacteristicSet, settings: FloatArray
    ) -> Evaluations:
        found = sphere(characteristics, settings)
        degrees = np.full(len(settings), -1.0)
        return dataclasses.replace(
            found, metrics={**found.metrics, ORIGINAL_DEGREE: degrees}
        )

    scoring = msgspec.structs.replace(PUBLISHED_SCORING, safe_original=0.0)
    _, asked = searched("surrogate", 1, 45, evaluate=never_safe, scoring=scoring)
    assert len(np.unique(np.concatenate(asked), axis=0)) == 45


def individuals(*objectives: tuple[float, float, float]) -> list[Individual]:
    population = []
    for values in objectives:
        one = Individual(list(values))
        one.fitness = fitness_class(3)(values)
        population.append(one)
    return population


@given(st.lists(st.tuples(*[st.integers(-2, 2)] * 3), max_size=40), st.integers(1, 40))
def test_survivors_are_those_of_deap(
    objectives: list[tuple[float, float, float]], number: int
) -> None:
    """Identical survivors in identical order, with ties of all kinds."""
    ours = individuals(*objectives)
    deaps = individuals(*objectives)
    fronts = tools.sortLogNondominated(deaps, number) if deaps else []
    expected = []
    for front in fronts:
        tools.emo.assignCrowdingDist(front)
        expected += sorted(
            front, key=lambda one: one.fitness.crowding_dist, reverse=True
        )
    places = [
        next(i for i, one in enumerate(ours) if one is survivor)
        for survivor in select_survivors(ours, number)
    ]
    assert places == [
        next(i for i, one in enumerate(deaps) if one is survivor)
        for survivor in expected[:number]
    ]


def test_feasible_individuals_survive_before_infeasible_ones_which_the_violation_orders() -> (
    None
):
    worst_feasible, best, slightly, badly = individuals(
        (9, 9, 9), (0, 1, 0), (-9, 0, 0), (-99, 0, 0)
    )
    slightly.violation = 0.1
    badly.violation = 5.0
    assert select_survivors([badly, slightly, worst_feasible, best], 4) == [
        best,
        worst_feasible,
        slightly,
        badly,
    ]
    assert select_survivors([badly, slightly], 1) == [slightly]
    assert 0 < slightly.standing[0] < badly.standing[0], "no solution of a run"


def test_a_tournament_is_won_by_rank_then_by_crowding_distance() -> None:
    better, worse = individuals((0, 0, 0), (1, 1, 1))
    for one, rank, room in ((better, 0, 0.1), (worse, 1, 9.0)):
        one.standing = rank, -room
    assert all(run_tournament([better, worse]) is better for _ in range(20))
    worse.standing = 0, -9.0
    assert all(run_tournament([better, worse]) is worse for _ in range(20))


def window(settings: list[list[float]], safety: list[float]) -> Evaluations:
    return evaluated(TWO, np.array(settings), np.array(safety))


def test_models_predict_beyond_what_is_known_and_changes_are_computed() -> None:
    known = default_rng(0).uniform(55, 80, (50, 2))
    predict = _learn(evaluated(TWO, known, -known[:, 0] - known[:, 1]), problem(), 0)
    predicted = predict(np.array([[100.0, 50.0]]))
    assert predicted.f_safe[0] == pytest.approx(-150, abs=1)
    assert predicted.f_diff[0] == predicted.f_num_diff[0] == 1


def test_ranges_narrow_to_means_of_the_unsafe_alone_and_never_across_the_original() -> (
    None
):
    ranges = Ranges(problem())
    ranges.narrow(window([[60, 50], [80, 40], [90, 10], [0, 0]], [4.0, 4.9, 5.0, 6.0]))
    assert ranges.upper.tolist() == [70, 100]
    assert ranges.lower.tolist() == [0, 40]


@pytest.mark.parametrize(
    ("settings", "most"),
    [([[60, 50], [60, 40]], 2), ([[60, 50], [60, 50], [60, 40]], 1), ([[60, 50]], 1)],
)
def test_the_number_of_changes_is_rounded_half_up(
    settings: list[list[float]], most: int
) -> None:
    ranges = Ranges(problem())
    ranges.narrow(window(settings, [1.0] * len(settings)))
    assert ranges.max_changes == most, "a mean of 1.5 makes 2, of 4/3 makes 1"


@pytest.mark.parametrize(
    "options", [{"tournament_size": 3}, {"mutation_probability": 1.0}]
)
def test_options_change_what_a_search_asks_for(options: dict[str, object]) -> None:
    asked, usual = (list(begun(built("nsga2", **one), 1, 200)) for one in (options, {}))
    assert not np.array_equal(asked[-2], usual[-2])


def test_what_user_code_was_sent_and_returns_can_go_to_another_process() -> None:
    sent = read_only(
        dataclasses.replace(sphere(SUN, np.ones((2, len(SUN)))), reasons={b"1": "?"})
    )
    returned = pickle.loads(pickle.dumps(sent.take([1])))
    assert (len(returned), returned.reasons) == (1, {b"1": "?"})
