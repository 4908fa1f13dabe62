"""Attacks on changes of the parameters, near known failures and by the study's search (step 3), and proof on fresh wear
(step 5).
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.repair.problem import RepairProblem, degrees_of
from safevar_sumo.campaign.run import algorithm_of
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.search import Problem

ATTACKS = 3
"""Number of runs of the search, with different seeds, that must find nothing."""
RANDOM_ATTACKS = 1024
"""Number of random vehicles that attack first, with the counterexamples: they find failures far from the worst."""
GENERATIONS, PARENTS, CHILDREN, STEP = 8, 32, 512, 0.1
"""Of an attack near the worst vehicles: its generations; the worst vehicles, which are the parents of a generation;
simulations of its children; a characteristic's step, as a share of the way to a random value.
"""
MAX_NEW = 32
"""Failures at which an attack ends, and which become counterexamples."""
MAX_UNSAFE_SHARE = 0.001
"""Upper bound of the share of unsafe vehicles that fresh wear has to prove."""
PROOF_PARTS = 4
"""Parts of the fresh wear, after each of which a failure ends the proof."""


Key = tuple[int, int]
"""The number of a change, and of a run of attacks on it."""
Runs = dict[Key, Generator[FloatArray, Evaluations, object]]
"""Runs that yield vehicles and are sent their evaluations."""


class Proof(NamedTuple):
    """`unsafe` of `n` vehicles drawn after the parameters were chosen; at most `at_most` of all are, with
    `confidence`.
    """

    n: int
    unsafe: int
    at_most: float
    confidence: float = CONFIDENCE


def attack(
    problem: RepairProblem, changes: Sequence[FloatArray], known: FloatArray, points: Sequence[int], number: int
) -> list[FloatArray]:
    """Attack changes of the parameters at `points` of the matrix: the failures of each, worst first, shape (M, w).

    A failure is a vehicle within the promise that the change does not keep safe, and a driving system could. `known`
    are vehicles that broke other changes; `number` counts the attacks, for their random numbers.
    """
    shares, worn, search = np.array(changes), problem.promise.worn, problem.study.search
    size = max(CHILDREN // max(len(points), 1), PARENTS)
    rngs = [np.random.default_rng((search.seed, number, row)) for row in range(len(changes))]
    breeding: Runs = {(row, 0): _breed(problem, known, size, rng) for row, rng in enumerate(rngs)}
    bred = _carry_out(problem, shares, breeding, points)
    unbroken = [row for row, vehicles in enumerate(bred) if not len(vehicles)]
    originals = problem.evaluate(shares[unbroken], np.tile(worn.original, (len(unbroken), 1)), "attack", points)
    runs: Runs = {}
    for place, row in enumerate(unbroken):
        task = Problem(
            characteristics=worn,
            original=originals.take([place]),
            evaluations=search.evaluations,
            population=search.population,
        )
        for seed in range(ATTACKS):
            rng = np.random.default_rng((search.seed, number, place, seed))
            runs[row, seed] = algorithm_of(next(iter(search.labels)), problem.study).search(task, rng)
    searched = _carry_out(problem, shares, runs, points, MAX_NEW)
    shares_of_rows = np.linspace(0.0, 1.0, MAX_NEW) ** 2  # squared: more of the worst failures
    chosen = []
    for bred_failures, searched_failures in zip(bred, searched, strict=True):
        vehicles = bred_failures if len(bred_failures) else searched_failures
        rows = np.unique((shares_of_rows * max(len(vehicles) - 1, 0)).astype(int))
        chosen.append(vehicles[rows[: len(vehicles)]])
    return chosen


def _breed(
    problem: RepairProblem, known: FloatArray, number: int, rng: np.random.Generator
) -> Generator[FloatArray, Evaluations, None]:
    """Attack with known and random vehicles and their offspring, `number` children in each generation.

    A child has each characteristic of one of two parents. On average, one of its characteristics mutates: with equal
    probability to a random value, or a step towards one.
    """
    promise, size = problem.promise, len(problem.promise.worn)
    children = np.concatenate([known, promise.draw(RANDOM_ATTACKS, rng)])
    parents, worst = children[:0], np.zeros(0)
    for _ in range(GENERATIONS):
        evaluations = yield children
        feasible = evaluations.take(~evaluations.infeasible)
        worst, parents = np.append(worst, degrees_of(feasible)), np.concatenate([parents, feasible.settings])
        order = np.argsort(worst, kind="stable")[:PARENTS]
        worst, parents = worst[order], parents[order]
        pairs = parents[rng.integers(len(parents), size=(2, number))]
        children = np.where(rng.random((number, size)) < 0.5, *pairs)
        random = promise.vehicles_at(rng.random((number, size)))
        draw = rng.random((number, size)) * size  # below 1 for one characteristic on average
        children = np.select([draw < 0.5, draw < 1.0], [random, children + STEP * (random - children)], children)


def _carry_out(
    problem: RepairProblem, shares: FloatArray, runs: Runs, points: Sequence[int], enough: int | None = None
) -> list[FloatArray]:
    """The failures of each change that runs find, worst first; a change's runs end when they have found `enough`."""
    failures = [np.zeros((0, 1 + len(problem.promise.worn))) for _ in shares]  # safety degree and vehicle
    answers: dict[Key, Evaluations | None] = dict.fromkeys(runs)
    while answers:
        wanted = {}
        for key, answer in answers.items():
            change_number, _ = key
            if enough is None or len(failures[change_number]) < enough:
                with suppress(StopIteration):
                    wanted[key] = next(runs[key]) if answer is None else runs[key].send(answer)
        answers = dict(zip(wanted, _judge(problem, shares, wanted, failures, points), strict=True))
    return [rows[:, 1:] for rows in failures]


def _judge(
    problem: RepairProblem,
    shares: FloatArray,
    wanted: dict[Key, FloatArray],
    failures: list[FloatArray],
    points: Sequence[int],
) -> list[Evaluations]:
    """Evaluate the vehicles that runs want, and add the `failures` of each change that a driving system could avoid.

    A vehicle that no driving system could keep safe counts as infeasible.
    """
    if not wanted:
        return []
    promise, change_numbers = problem.promise, [change_number for change_number, _ in wanted]
    sizes = [len(vehicles) for vehicles in wanted.values()]
    settings = promise.region.repaired(promise.settings(np.concatenate(list(wanted.values()))), filtered=False)
    vehicles, change_of_row = settings[:, promise.columns], np.repeat(change_numbers, sizes)
    evaluations = problem.evaluate(shares[change_of_row], vehicles, "attack", points)
    degrees = degrees_of(evaluations)
    unsafe = np.flatnonzero(degrees < problem.margin)
    is_repairable = problem.repairable(vehicles[unsafe])
    evaluations.outcome[unsafe[~is_repairable]] = Outcome.INFEASIBLE.value
    failing = unsafe[is_repairable]
    for number in set(change_numbers):
        rows = failing[change_of_row[failing] == number]
        new_failures = np.column_stack([degrees[rows], vehicles[rows]])
        failures[number] = np.unique(np.concatenate([failures[number], new_failures]), axis=0)  # sorted: worst first
    ends = np.cumsum(sizes)
    return [evaluations.take(np.arange(end - size, end)) for size, end in zip(sizes, ends, strict=True)]


def prove(problem: RepairProblem, change: FloatArray, attempt: int) -> tuple[Proof | None, FloatArray]:
    """Draw fresh wear for a change: the proof and no vehicle if all are safe; otherwise None and the unsafe vehicles of
    the first part that has any.

    Attempt k may be wrong with probability alpha / 2^k, alpha = 1 - `CONFIDENCE`, so that later attempts draw more.
    """
    error = (1 - CONFIDENCE) / 2**attempt
    number = math.ceil(math.log(error) / math.log1p(-MAX_UNSAFE_SHARE))
    fresh = problem.promise.draw(number, np.random.default_rng((problem.study.search.seed, 7, attempt)))
    drawn = 0
    for part in np.array_split(fresh, PROOF_PARTS):
        (degrees,), _ = problem.degrees(change[np.newaxis], part, "proof on fresh wear")
        unsafe = part[degrees < problem.margin]
        is_repairable = problem.repairable(unsafe)
        if is_repairable.any():
            return None, unsafe[is_repairable]
        drawn += len(part) - len(unsafe)  # a vehicle that no driving system keeps safe proves nothing
    at_most = -math.expm1(math.log(error) / drawn) if drawn else 1.0
    return Proof(drawn, 0, at_most), fresh[:0]
