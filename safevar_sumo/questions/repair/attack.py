"""Attacks on a change of the parameters, and its proof on fresh wear."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.evaluator import proof_size
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.records import FloatArray

RANDOM = 1024
"""Number of random settings that attack first, with the counterexamples: they find failures far from the worst."""
GENERATIONS, PARENTS, CHILDREN, STEP = 8, 32, 512, 0.1
"""Generations of an attack; the worst settings, which are the parents of a generation; its children; a characteristic's
step, as a share of the way to a random value.
"""
MAX_UNSAFE_SHARE = 0.001
"""Upper bound of the share of unsafe vehicles that fresh wear has to prove."""


class Proof(NamedTuple):
    """`proof_failures` of `proof_samples` vehicles drawn after the parameters were chosen; at most the share `at_most`
    of all are unsafe, with `CONFIDENCE`.
    """

    proof_samples: int
    proof_failures: int
    at_most: float


def find_failures(problem: RepairProblem, change: FloatArray, known: FloatArray, number: int) -> FloatArray:
    """Attack a change with known and random settings and their offspring: its worst failures, shape (M, n).

    A failure is a promised setting that the change does not keep safe, and a driving system could. `number` counts the
    attacks, for their random numbers. A child has each characteristic of one of two parents. On average, one of its
    characteristics mutates: with equal probability to a random value, or a step towards one.
    """
    promise, rng = problem.promise, np.random.default_rng((problem.study.search.seed, number))
    children = np.concatenate([known, problem.draw(RANDOM, rng)])
    parents, degrees = children[:0], np.zeros(0)
    for _ in range(GENERATIONS):
        new_degrees = problem.degrees_with(change, children, "attack")
        is_repairable = new_degrees >= problem.margin
        is_repairable[~is_repairable] = problem.repairable(children[~is_repairable])
        parents = np.concatenate([parents, children[is_repairable]])
        degrees = np.append(degrees, new_degrees[is_repairable])
        worst = np.argsort(degrees, kind="stable")[:PARENTS]
        parents, degrees = parents[worst], degrees[worst]
        pairs, shape = parents[rng.integers(len(parents), size=(2, CHILDREN))], (CHILDREN, len(promise.lower))
        children = np.where(rng.random(shape) < 0.5, *pairs)
        random = promise.at(rng.random(shape))
        draw = rng.random(shape) * np.count_nonzero(promise.lower < promise.upper)
        children = np.select([draw < 0.5, draw < 1.0], [random, children + STEP * (random - children)], children)
        children = children[problem.holds(children)]
    return np.unique(parents[degrees < problem.margin], axis=0)


def prove(problem: RepairProblem, change: FloatArray, number: int, attempt: int) -> tuple[Proof, FloatArray]:
    """Draw fresh wear for a change: its proof, and the unsafe settings; only without them the change is proved.

    After k attempts that failed this one may be wrong with probability alpha / 2^k, alpha = 1 - `CONFIDENCE`, so that
    it draws more. `number` counts the attacks, for the random numbers.
    """
    error, draws = proof_size(attempt, MAX_UNSAFE_SHARE)
    fresh = problem.draw(draws, np.random.default_rng((problem.study.search.seed, 7, number)))
    unsafe = fresh[problem.degrees_with(change, fresh, "proof on fresh wear") < problem.margin]
    is_repairable = problem.repairable(unsafe)
    samples = len(fresh) - int(np.count_nonzero(~is_repairable))  # what no driving system keeps safe proves nothing
    at_most = -math.expm1(math.log(error) / samples) if samples else 1.0
    return Proof(samples, int(np.count_nonzero(is_repairable)), at_most), unsafe[is_repairable]
