"""Who survives, who is kept, what narrows: examples small enough to be worked by hand."""

from __future__ import annotations

import moocore
import numpy as np
import pytest
from deap import tools
from hypothesis import given
from hypothesis import strategies as st

from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.search import Problem
from safevar_sumo.search.nsga2 import _fitness, _Individual, _survivors, _tournament
from safevar_sumo.search.safe_fuzzer import _improves, _Ranges, _scores
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from tests.search.problems import POPULATION, SUN, evaluated, searched, sphere

TWO = CharacteristicSet((Characteristic(name="a", unit="-", original=50.0, lower=0.0, upper=100.0),
                         Characteristic(name="b", unit="-", original=50.0, lower=0.0, upper=100.0)))


def individuals(*objectives: tuple[float, float, float]) -> list[_Individual]:
    made = []
    for values in objectives:
        one = _Individual(list(values))
        one.fitness = _fitness(3)(values)
        made.append(one)
    return made


def test_survivors_are_the_better_ranks_and_of_the_last_rank_those_with_most_room() -> None:
    """Room is the distance between both neighbours, each objective over its spread, here 4; the ends have infinitely much."""
    front = individuals((0, 4, 1), (1, 3, 1), (1.5, 2.5, 1), (3, 1, 1), (4, 0, 1))
    behind = individuals((5, 5, 1), (6, 6, 1))
    kept = _survivors([*behind, *front], 4)
    # (1, 3) has (1.5 - 0) / 4 + (4 - 2.5) / 4 = 0.75, (1.5, 2.5) has 1, (3, 1) has 1.25.
    assert {tuple(one.fitness.values[:2]) for one in kept} == {(0, 4), (4, 0), (3, 1), (1.5, 2.5)}
    assert {one.standing[0] for one in kept} == {0}
    everybody = _survivors([*behind, *front], 7)
    assert [one.standing[0] for one in everybody] == [0] * 5 + [1, 2]


@given(st.lists(st.tuples(*[st.integers(-2, 2)] * 3), max_size=40), st.integers(1, 40))
def test_survivors_are_those_of_deap(objectives: list[tuple[float, float, float]], number: int) -> None:
    """The very same ones, in the same order: with ties of all kinds."""
    ours, deaps = individuals(*objectives), individuals(*objectives)
    fronts = tools.sortLogNondominated(deaps, number) if deaps else []
    expected = []
    for front in fronts:
        tools.emo.assignCrowdingDist(front)
        expected += sorted(front, key=lambda one: one.fitness.crowding_dist, reverse=True)
    found = [next(i for i, one in enumerate(ours) if one is survivor) for survivor in _survivors(ours, number)]
    assert found == [next(i for i, one in enumerate(deaps) if one is survivor) for survivor in expected[:number]]


def test_a_tournament_is_won_by_rank_then_by_room() -> None:
    better, worse = individuals((0, 0, 0), (1, 1, 1))
    for one, rank, room in ((better, 0, 0.1), (worse, 1, 9.0)):
        one.standing = rank, -room
    assert all(_tournament([better, worse]) is better for _ in range(20))
    worse.standing = 0, -9.0
    assert all(_tournament([better, worse]) is worse for _ in range(20))


@pytest.mark.parametrize("seed", range(5))
def test_nsga2_returns_of_its_population_what_nothing_dominates(seed: int) -> None:
    """After the first population alone most of it is dominated."""
    found, asked = searched("nsga2", seed, POPULATION)
    everything = sphere(SUN, asked[0])
    optimal = everything.take(moocore.is_nondominated(everything.objectives, keep_weakly=True))
    assert len(optimal) < POPULATION
    assert sorted(map(tuple, found.objectives.tolist())) == sorted(map(tuple, optimal.objectives.tolist()))


def test_random_search_keeps_all_of_equal_worth() -> None:
    def equal(characteristics: CharacteristicSet, settings: np.ndarray) -> Evaluations:
        one = np.ones(len(settings))
        return Evaluations(settings=settings, outcome=np.full(len(settings), Outcome.STOPPED.value, dtype="U16"),
                           collision_speed=one * np.nan, metrics={"safety_degree": one}, f_diff=one, f_num_diff=one)

    assert len(searched("rs", 1, 45, evaluate=equal)[0]) == 45


def problem() -> Problem:
    return Problem(characteristics=TWO, original=evaluated(TWO, TWO.original[np.newaxis], np.array([5.0])), evaluations=1000)


def window(settings: list[list[float]], safety: list[float]) -> Evaluations:
    return evaluated(TWO, np.array(settings), np.array(safety))


def test_ranges_narrow_to_means_of_the_unsafe_alone_and_never_across_the_original() -> None:
    ranges = _Ranges(problem())
    ranges.narrow(window([[60, 50], [80, 40], [90, 10], [0, 0]], [4.0, 4.9, 5.0, 6.0]))
    assert ranges.upper.tolist() == [70, 100]
    assert ranges.lower.tolist() == [0, 40]


@pytest.mark.parametrize(("settings", "most"), [([[60, 50], [60, 40]], 2), ([[60, 50], [60, 50], [60, 40]], 1), ([[60, 50]], 1)])
def test_the_number_of_changes_is_rounded_half_up(settings: list[list[float]], most: int) -> None:
    ranges = _Ranges(problem())
    ranges.narrow(window(settings, [1.0] * len(settings)))
    assert ranges.most_changed == most, "a mean of 1.5 makes 2, of 4/3 makes 1"


def test_a_window_without_anything_unsafe_narrows_nothing() -> None:
    ranges = _Ranges(problem())
    ranges.narrow(window([[60, 40]], [5.0]))
    assert ranges.upper.tolist() == [100, 100]
    assert ranges.most_changed == 2


def test_a_score_weighs_safety_six_times_and_the_others_once() -> None:
    """SD 1, 2, 3 by min-max 0, 0.5, 1; numbers 1, 2, 2 of 2 give 0, 1, 1; changes 0.2, 0.4, 1."""
    told = _scores(window([[60, 50], [70, 60], [100, 0]], [1.0, 2.0, 3.0]))
    assert told == pytest.approx([0.2 / 8, (3 + 0.4 + 1) / 8, (6 + 1 + 1) / 8])


def test_a_generation_improves_if_its_best_beats_the_worst_of_the_fifty_best() -> None:
    earlier = window([[60, 50]] * 60, [float(i) for i in range(60)])
    assert _improves(window([[60, 50]], [48.5]), earlier)
    assert not _improves(window([[60, 50]], [49.0]), earlier)
    assert not _improves(window([[60, 50]], [55.0]), earlier)
