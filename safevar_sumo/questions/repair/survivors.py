"""Search, attack and prove in turns: the smallest changes that survive the search for
counterexamples in all parameter sets of the vehicle model, and a bound on new wear.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import Proof, proof_size, prove
from safevar_sumo.questions.cases import SearchPlan, search_cases
from safevar_sumo.questions.evaluator import ENCOUNTERS
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.smallest import Search
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.oracle import product_of
from safevar_sumo.records import FloatArray, IntArray

KNOWN = 256
"""Number of known cases with which a search begins, and of unsafe ones that it hands over; with
each other parameter set an eighth."""
OWN_SEARCHES = 4
"""Number of searches with the study's own parameter set; each other one has one of half the
size."""
MAX_UNSAFE_SHARE = 0.001
"""Upper bound of the share of unsafe vehicles that fresh wear has to prove."""
FIRST = 1024
"""Number of the worst cases that are the first counterexamples."""
MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""
ATTACK_STAGE = "attack on the change"
PROOF_STAGE = "proof on fresh wear"


def usual_test(problem: RepairProblem, sets: int) -> float:
    """How many settings test a change that holds in so many parameter sets."""
    points = len(problem.evaluator.system.points)
    encounters = 1 + ENCOUNTERS if problem.study.ranges else points
    searched = problem.budget * (OWN_SEARCHES + (sets - 1) / 2)
    proved = proof_size(1, unsafe_share(problem)) * encounters * min(sets, 2)
    return (searched + proved) / points


def unsafe_share(problem: RepairProblem) -> float:
    """The upper bound to prove, by how much is searched."""
    return MAX_UNSAFE_SHARE / problem.evaluator.account.effort


def find_failures(
    problem: RepairProblem,
    fits: tuple[int, ...],
    change: FloatArray,
    cases: FloatArray,
    number: int,
) -> FloatArray:
    """Search some parameter sets for cases that a change does not keep safe, from known `cases` on,
    the worst first; none if it keeps all safe. `number` counts the attacks, for their random
    numbers.
    """
    # These numbers are of no `Stream`: repairs depend on them.
    rng = np.random.default_rng((problem.study.search.seed, number))

    def judge(cases: FloatArray) -> FloatArray:
        return problem.robustness(change, cases, ATTACK_STAGE)

    # Few large generations of the other sets cost less than many small ones.
    plan_of_study = SearchPlan(problem.budget)
    generation = 2 * plan_of_study.generation
    plan_of_set = SearchPlan(problem.budget // 2, generation=generation)
    for fit in [*fits, *fits[:1] * (OWN_SEARCHES - 1)]:
        starts = problem.with_sets(cases[: KNOWN // 8 if fit else KNOWN], fit)
        plan = plan_of_set if fit else plan_of_study
        results = search_cases(judge, problem.space(fit), starts, plan, rng)
        if len(results.unsafe):
            return results.unsafe[:KNOWN]
    return cases[:0]


def prove_change(
    problem: RepairProblem,
    fits: tuple[int, ...],
    change: FloatArray,
    number: int,
    attempt: int,
) -> tuple[Proof, FloatArray]:
    """Draw fresh wear for a change: its proof with the study's own set in the listed encounters,
    and the unsafe cases; only without them the change is proved.

    As many vehicles again each drive with one of the other sets, at random. `number` counts the
    searches, for the random numbers, and `attempt` the proofs, from 1 on.
    """
    rng = Stream.REPAIRED_BOUND.generator(problem.study.search.seed, number)
    unsafe = list[FloatArray]()

    def drive(vehicles: FloatArray, sets: IntArray) -> FloatArray:
        """What vehicles, each with a parameter set, leave in the listed encounters."""
        cases = product_of(vehicles, problem.encounters)
        cases = problem.with_sets(cases, np.repeat(sets, len(problem.encounters)))
        robustness = problem.robustness(change, cases, PROOF_STAGE)
        unsafe.append(cases[robustness < 0][:KNOWN])
        return robustness.reshape(len(vehicles), -1)

    def judge(vehicles: FloatArray) -> FloatArray:
        """What vehicles leave with the study's own parameter set."""
        return drive(vehicles, np.zeros(len(vehicles), dtype=np.intp))

    def draw(count: int) -> FloatArray:
        """Promised vehicles."""
        return problem.promise.draw(count, rng)[:, : problem.size]

    proof = prove(draw, judge, unsafe_share(problem), attempt)
    if len(fits) > 1 and not len(unsafe[0]):
        vehicles = draw(proof.samples)
        drive(vehicles, rng.integers(1, len(fits), size=len(vehicles)))
    return proof, unsafe[-1]


class Survivors(NamedTuple):
    """The smallest changes that survive everything, each with its proof; none if no change does.

    They hold in `fits` parameter sets, and not in those with the numbers `broken`.
    """

    changes: list[tuple[FloatArray, Proof]]
    fits: int
    broken: tuple[int, ...]


def find_survivors(
    problem: RepairProblem, fits: tuple[int, ...], cases: FloatArray
) -> Survivors:
    """The smallest changes that survive in all parameter sets, from known cases on; where none
    does, those of the study's own set, and the sets in which a search breaks one of them.
    """
    changes = _survivors_in(problem, fits, cases)
    if changes or len(fits) == 1:
        return Survivors(changes, len(fits), ())
    changes = _survivors_in(problem, fits[:1], cases)

    def breaks_one(fit: int) -> bool:
        return any(
            len(find_failures(problem, (fit,), change, cases, 0))
            for change, _ in changes
        )

    broken = tuple(fit for fit in fits[1:] if breaks_one(fit))
    return Survivors(changes, len(fits) - len(broken), broken)


def _survivors_in(
    problem: RepairProblem, fits: tuple[int, ...], cases: FloatArray
) -> list[tuple[FloatArray, Proof]]:
    """Search, attack and prove in turns until the smallest changes survive everything; none if no
    change does.
    """
    phases = problem.evaluator.phases
    search = Search(problem, cases[:FIRST])
    proofs = dict[bytes, Proof]()
    attacks = 0
    failed_proofs = 0
    for each_round in range(1, MAX_ROUNDS + 1):
        changes = search.smallest_changes()
        unproved = [change for change in changes if change.tobytes() not in proofs]
        if not unproved:
            return [(change, proofs[change.tobytes()]) for change in changes]
        phases.begin_round(each_round, MAX_ROUNDS)
        for row, change in enumerate(unproved):
            attacks += 1
            unsafe = find_failures(problem, fits, change, search.cases, attacks)
            if not len(unsafe):
                robustness = problem.robustness(change, cases, ATTACK_STAGE)
                unsafe = cases[robustness < 0][:KNOWN]
            if not len(unsafe):
                # Earlier nobody knows how many rounds follow.
                phases.expect((len(unproved) - row) * usual_test(problem, len(fits)))
                proof, unsafe = prove_change(
                    problem, fits, change, attacks, failed_proofs + 1
                )
                if len(unsafe):
                    failed_proofs += 1
                else:
                    proofs[change.tobytes()] = proof
            if len(unsafe):
                search.add(unsafe)
    return []
