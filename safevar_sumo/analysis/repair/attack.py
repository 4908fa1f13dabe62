"""Attacks on sets of parameters, near known failures and by the search that broke today's (step 3), and proof on fresh
wear (step 5).
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.repair.problem import Problem, degrees_of
from safevar_sumo.campaign.run import algorithm_of
from safevar_sumo.records import Evaluations, FloatArray, Outcome
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


Runs = dict[tuple[int, int], Generator[FloatArray, Evaluations, object]]
"""Runs that ask for evaluations of vehicles, by the number of their set of parameters and their own."""


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
    shares, worn, search = np.array(sets), problem.promise.worn, problem.study.search
    size = max(CHILDREN // max(len(points), 1), PARENTS)
    rngs = [np.random.default_rng((search.seed, number, row)) for row in range(len(sets))]
    near: Runs = {(row, 0): _breed(problem, known, size, rng) for row, rng in enumerate(rngs)}
    failures = _carry_out(problem, shares, near, points)
    rest = [row for row, vehicles in enumerate(failures) if not len(vehicles)]
    originals = problem.evaluate(shares[rest], np.tile(worn.original, (len(rest), 1)), "attack", points)
    runs: Runs = {}
    for place, row in enumerate(rest):
        task = SearchProblem(
            characteristics=worn,
            original=originals.take([place]),
            evaluations=search.evaluations,
            population=search.population,
        )
        for seed in range(ATTACKS):
            rng = np.random.default_rng((search.seed, number, place, seed))
            runs[row, seed] = algorithm_of(next(iter(search.labels)), problem.study).search(task, rng)
    found = _carry_out(problem, shares, runs, points, MAX_NEW)
    failures = [one if len(one) else other for one, other in zip(failures, found, strict=True)]
    ways = np.linspace(0.0, 1.0, MAX_NEW) ** 2  # more of the worst
    rows = [np.unique((ways * max(len(vehicles) - 1, 0)).astype(int))[: len(vehicles)] for vehicles in failures]
    return [vehicles[chosen] for vehicles, chosen in zip(failures, rows, strict=True)]


def _breed(
    problem: Problem, known: FloatArray, number: int, rng: np.random.Generator
) -> Generator[FloatArray, Evaluations, None]:
    """Attack with known and random vehicles and their offspring.

    A child has each characteristic of one of two parents; one in expectation is anew, or a step away.
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
        fresh = promise.at(rng.random((number, size)))
        draw = rng.random((number, size)) * size
        children = np.select([draw < 0.5, draw < 1.0], [fresh, children + STEP * (fresh - children)], children)


def _carry_out(
    problem: Problem, shares: FloatArray, runs: Runs, points: Sequence[int], enough: int | None = None
) -> list[FloatArray]:
    """The failures of each set that runs find, worst first; a set's runs end when they have found `enough`."""
    found = [np.zeros((0, 1 + len(problem.promise.worn))) for _ in shares]  # safety degree and vehicle
    answers: dict[tuple[int, int], Evaluations | None] = dict.fromkeys(runs)
    while answers:
        wanted = dict[tuple[int, int], FloatArray]()
        for key, answer in answers.items():
            if enough is None or len(found[key[0]]) < enough:
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
    """Evaluate the vehicles that runs want, and note their failures that a driving system could avoid; a vehicle that
    none could keep safe is no feasible attack.
    """
    if not wanted:
        return []
    promise, owners = problem.promise, [owner for owner, _ in wanted]
    sizes = [len(vehicles) for vehicles in wanted.values()]
    settings = promise.region.repaired(promise.settings(np.concatenate(list(wanted.values()))), filtered=False)
    vehicles, owner_of = settings[:, promise.columns], np.repeat(owners, sizes)
    evaluations = problem.evaluate(shares[owner_of], vehicles, "attack", points)
    degrees = degrees_of(evaluations)
    failing = np.flatnonzero(degrees < problem.margin)
    is_able = problem.repairable(vehicles[failing])
    evaluations.outcome[failing[~is_able]] = Outcome.INFEASIBLE.value
    failing = failing[is_able]
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
        degrees, _ = problem.degrees(one[np.newaxis], part, "proof on fresh wear")
        unsafe = part[degrees[0] < problem.margin]
        is_able = problem.repairable(unsafe)
        if is_able.any():
            return None, unsafe[is_able]
        drawn += len(part) - len(unsafe)  # what no driving system keeps safe proves nothing
    return Proof(drawn, 0, -math.expm1(math.log(error) / drawn) if drawn else 1.0), fresh[:0]
