"""Attacks on sets of parameters, near known failures and by the search that broke today's (step 3), and proof on fresh
wear (step 5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.repair.problem import Problem, degrees_of
from safevar_sumo.campaign.run import algorithm_of
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search import Problem as SearchProblem

ATTACKS = 3
"""Runs of the search, each with a seed of its own, that must find nothing."""
RANDOM_ATTACKS = 1024
"""Random vehicles that attack first, with the counterexamples: they find failures far from the worst."""
GENERATIONS, PARENTS, CHILDREN, STEP = 8, 32, 512, 0.1
"""Generations of an attack near the worst vehicles, which become parents; simulations of children in each; step of a
characteristic, as a share of the way to a random value.
"""
MAX_NEW = 32
"""Failures at which an attack ends, and which become counterexamples."""
MAX_UNSAFE_SHARE = 0.001
"""Upper bound of the share of unsafe vehicles that fresh wear has to prove."""
PROOF_PARTS = 4
"""Parts of the fresh wear, after each of which a failure ends the proof."""


class Proof(NamedTuple):
    """`unsafe` of `n` vehicles drawn after the parameters were chosen; at most `at_most` of all are, with
    `confidence`.
    """

    n: int
    unsafe: int
    at_most: float
    confidence: float = CONFIDENCE


def attack(
    problem: Problem, sets: Sequence[FloatArray], known: FloatArray, points: Sequence[int], number: int
) -> list[FloatArray]:
    """For each set of parameters the vehicles within the promise that it does not keep safe at some points, and a
    driving system could, worst first, shape (M, w). `known` are vehicles that broke other sets; `number` counts the
    attacks.
    """
    failures = [
        _failures_near(problem, one, known, points, np.random.default_rng((problem.study.search.seed, number, row)))
        for row, one in enumerate(sets)
    ]
    rest = [row for row, vehicles in enumerate(failures) if not len(vehicles)]
    for row, vehicles in zip(rest, _search_failures(problem, [sets[row] for row in rest], points, number), strict=True):
        failures[row] = vehicles
    shares = np.linspace(0.0, 1.0, MAX_NEW) ** 2  # more of the worst
    rows = [np.unique((shares * max(len(vehicles) - 1, 0)).astype(int))[: len(vehicles)] for vehicles in failures]
    return [vehicles[chosen] for vehicles, chosen in zip(failures, rows, strict=True)]


def _failures_near(
    problem: Problem, one: FloatArray, known: FloatArray, points: Sequence[int], rng: np.random.Generator
) -> FloatArray:
    """The failures of a set among known and random vehicles and their offspring, worst first.

    A child has each characteristic of one of two parents; one in expectation is anew, or a step away.
    """
    promise, stage, size = problem.promise, "attack near the worst", len(problem.promise.worn)
    number = max(CHILDREN // max(len(points), 1), PARENTS)
    children = np.concatenate([known, promise.draw(RANDOM_ATTACKS, rng)])
    parents, worst, failures = children[:0], np.zeros(0), np.zeros((0, 1 + size))
    for _ in range(GENERATIONS):
        degrees = problem.degrees(one[np.newaxis], children, stage, points)[0][0]
        is_unsafe = degrees < problem.margin
        is_unsafe[is_unsafe] = problem.repairable(children[is_unsafe])
        failures = np.concatenate([failures, np.column_stack([degrees, children])[is_unsafe]])
        is_rival = is_unsafe | (degrees >= problem.margin)
        worst, parents = np.append(worst, degrees[is_rival]), np.concatenate([parents, children[is_rival]])
        order = np.argsort(worst, kind="stable")[:PARENTS]
        worst, parents = worst[order], parents[order]
        pairs = parents[rng.integers(len(parents), size=(2, number))]
        children = np.where(rng.random((number, size)) < 0.5, *pairs)
        fresh = promise.at(rng.random((number, size)))
        draw = rng.random((number, size)) * size
        children = np.select([draw < 0.5, draw < 1.0], [fresh, children + STEP * (fresh - children)], children)
        children = promise.region.repaired(promise.settings(children), filtered=False)[:, promise.columns]
    return np.unique(failures, axis=0)[:, 1:]


def _search_failures(
    problem: Problem, sets: Sequence[FloatArray], points: Sequence[int], number: int
) -> list[FloatArray]:
    """The failures of each set that runs of the search find, worst first."""
    if not sets:
        return []
    shares, worn, search = np.array(sets), problem.promise.worn, problem.study.search
    label = next(iter(search.labels))
    originals = problem.evaluate(shares, np.tile(worn.original, (len(shares), 1)), "attack", points)
    runs = {}
    for owner in range(len(shares)):
        task = SearchProblem(
            characteristics=worn,
            original=originals.take([owner]),
            evaluations=search.evaluations,
            population=search.population,
        )
        for seed in range(ATTACKS):
            rng = np.random.default_rng((search.seed, number, owner, seed))
            runs[owner, seed] = algorithm_of(label, problem.study).search(task, rng)
    found = [np.zeros((0, 1 + len(worn))) for _ in sets]  # safety degree and vehicle
    answers: dict[tuple[int, int], Evaluations | None] = dict.fromkeys(runs)
    while answers:
        wanted = dict[tuple[int, int], FloatArray]()
        for key, answer in answers.items():
            if len(found[key[0]]) < MAX_NEW:
                with suppress(StopIteration):
                    wanted[key] = next(runs[key]) if answer is None else runs[key].send(answer)
        answers = dict(zip(wanted, _judge(problem, shares, wanted, found, points), strict=True))
    return [rows[:, 1:] for rows in found]


def _judge(
    problem: Problem,
    shares: FloatArray,
    wanted: dict[tuple[int, int], FloatArray],
    found: list[FloatArray],
    points: Sequence[int],
) -> list[Evaluations]:
    """Evaluate the vehicles that searches want, and note their failures that a driving system could avoid."""
    if not wanted:
        return []
    promise, owners = problem.promise, [owner for owner, _ in wanted]
    sizes = [len(vehicles) for vehicles in wanted.values()]
    settings = promise.region.repaired(promise.settings(np.concatenate(list(wanted.values()))), filtered=False)
    vehicles, owner_of = settings[:, promise.columns], np.repeat(owners, sizes)
    evaluations = problem.evaluate(shares[owner_of], vehicles, "attack", points)
    degrees = degrees_of(evaluations)
    failing = np.flatnonzero(degrees < problem.margin)
    failing = failing[problem.repairable(vehicles[failing])]
    for owner in set(owners):
        own = failing[owner_of[failing] == owner]
        found[owner] = np.unique(np.concatenate([found[owner], np.column_stack([degrees[own], vehicles[own]])]), axis=0)
    return [evaluations.take(rows) for rows in np.split(np.arange(len(vehicles)), np.cumsum(sizes)[:-1])]


def prove(problem: Problem, one: FloatArray, attempt: int) -> tuple[Proof | None, FloatArray]:
    """Draw fresh wear for a set of parameters: the proof, if no vehicle is unsafe, and the first unsafe vehicles.

    Attempt k may be wrong with probability alpha / 2^k of alpha = 1 - `CONFIDENCE`, so that later attempts draw more.
    """
    error = (1 - CONFIDENCE) / 2**attempt
    number = math.ceil(math.log(error) / math.log1p(-MAX_UNSAFE_SHARE))
    fresh = problem.promise.draw(number, np.random.default_rng((problem.study.search.seed, 7, attempt)))
    drawn = 0
    for part in np.array_split(fresh, PROOF_PARTS):
        _, unsafe, lost = problem.failing(one, part, "proof on fresh wear")
        if len(unsafe):
            return None, unsafe
        drawn += len(part) - lost
    return Proof(drawn, 0, -math.expm1(math.log(error) / drawn) if drawn else 1.0), fresh[:0]
