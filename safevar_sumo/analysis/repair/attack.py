"""Attacks on sets of parameters with the search that broke today's, and proof on fresh wear (steps 3 and 5)."""

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
"""Random vehicles that attack where the search has found nothing: they find failures far from the worst."""
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


def attack(problem: Problem, sets: Sequence[FloatArray], points: Sequence[int], number: int) -> list[FloatArray]:
    """For each set of parameters the vehicles within the promise that it does not keep safe at some points, and a
    driving system could, worst first, shape (M, w). `number` counts the attacks.
    """
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
    rng = np.random.default_rng((search.seed, number))
    random = problem.promise.draw(RANDOM_ATTACKS, rng)
    failures = []
    for one, rows in zip(shares, found, strict=True):
        vehicles = rows[:, 1:]
        if not len(rows):
            degrees, vehicles, _ = problem.failing(one, random, "attack by random wear", points)
            vehicles = vehicles[np.argsort(degrees, kind="stable")]
        failures.append(vehicles[np.linspace(0, len(vehicles) - 1, min(len(vehicles), MAX_NEW)).astype(int)])
    return failures


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
