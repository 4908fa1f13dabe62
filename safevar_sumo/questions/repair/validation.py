"""The falsification of a change in all parameter sets of the vehicle, and its bound on new wear."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from safevar_sumo.questions.between import PLACES
from safevar_sumo.questions.box import Judgement, Proof, prove
from safevar_sumo.questions.cases import LEAST_SIMULATIONS
from safevar_sumo.questions.falsify import falsify
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.phases import at_worst_phases
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.records import FloatArray

KNOWN = 256
"""Number of the worst known settings with which a falsification begins; with each other
parameter set an eighth."""
KNOWN_BETWEEN = 64
"""Number of the worst known vehicles with which an attack between the tests begins."""
MAX_UNSAFE_SHARE = 0.001
"""Upper bound of the share of unsafe vehicles that fresh wear has to prove."""
ATTACK_STAGE, PROOF_STAGE = "attack on the change", "proof on fresh wear"
Failures = dict[int, FloatArray]
"""Failures by the number of the problem, of one parameter set, in which they are, shape (M, n)."""


def find_failures(
    problems: Sequence[RepairProblem],
    between: Sequence[RepairProblem],
    change: FloatArray,
    known: FloatArray,
    number: int,
) -> Failures:
    """Attack a change in all fits: promised settings that it does not keep safe, and a driving
    system could; then `between` the tests of a matrix and at other phases, whose problems are
    numbered after the others. `number` counts the attacks, for their random numbers.
    """
    own = problems[0]
    # These numbers are of no `Stream`: repairs depend on them.
    rng = np.random.default_rng((own.study.search.seed, number))
    judges = [
        partial(problem.robustness, change, stage=ATTACK_STAGE) for problem in problems
    ]
    starts = [
        known[: KNOWN if row == 0 else KNOWN // 8] for row in range(len(problems))
    ]
    failures = falsify(own.promise, judges, starts, own.budget, rng).failures
    for row, problem in enumerate(between, len(problems)):
        if failures:
            break
        judge = partial(problem.robustness, change, stage=ATTACK_STAGE)
        # The worst known vehicles and corners at their worst phases.
        if problem.has_phases:
            corners = own.promise.corners(own.study.search.seed, number)[:KNOWN]
            model = Model(problem.fit, problem.evaluator, problem.unsafe)
            rows, left = at_worst_phases(
                model, judge, np.concatenate([known[:KNOWN], corners])
            )
            failures = {row: rows[left < 0]} if (left < 0).any() else {}
            continue
        # The worst known vehicles, each at some random places on the axes.
        vehicles = np.repeat(known[:KNOWN_BETWEEN], PLACES, axis=0)
        start = problem.promise.at(
            rng.random((len(vehicles), len(problem.promise.lower)))
        )
        start[:, : vehicles.shape[1]] = vehicles
        budget = own.evaluator.scaled(LEAST_SIMULATIONS)
        found = falsify(problem.promise, [judge], [start], budget, rng)
        if found.failures:
            failures = {row: found.failures[0]}
    return {row: np.unique(settings, axis=0) for row, settings in failures.items()}


def prove_change(
    problems: Sequence[RepairProblem], change: FloatArray, number: int, attempt: int
) -> tuple[Proof, Failures]:
    """Draw fresh wear for a change: its proof with the study's own set, and the unsafe settings;
    only without them the change is proved.

    As many settings again each meet one of the other sets, at random. `number` counts the searches,
    for the random numbers, and `attempt` the proofs, from 1 on.
    """
    own = problems[0]
    seed = problems[0].study.search.seed

    def judge(settings: FloatArray) -> Judgement:
        robustness = own.robustness(change, settings, PROOF_STAGE)
        return Judgement(
            robustness < 0,
            np.zeros(len(robustness), dtype=bool),
            np.isfinite(robustness),
        )

    rng = Stream.REPAIRED_BOUND.generator(seed, number)
    share = MAX_UNSAFE_SHARE / own.evaluator.account.effort
    proof, unsafe = prove(lambda count: own.draw(count, rng), judge, share, attempt)
    failures = {0: unsafe} if len(unsafe) else {}
    if failures or len(problems) == 1:
        return proof, failures
    settings = own.draw(proof.samples, rng)
    fits = rng.integers(1, len(problems), size=len(settings))
    for row in range(1, len(problems)):
        of_fit = settings[fits == row]
        is_unsafe = problems[row].robustness(change, of_fit, PROOF_STAGE) < 0
        if is_unsafe.any():
            failures[row] = of_fit[is_unsafe]
    return proof, failures
