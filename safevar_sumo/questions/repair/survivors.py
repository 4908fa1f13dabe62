"""Finds the smallest changes that survive: no search finds a counterexample in any parameter set of
the vehicle model, and sampled vehicles prove a bound on the unsafe share. The steps follow each
other in rounds: find the smallest changes, search for counterexamples, prove.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import Proof, proof_size, prove
from safevar_sumo.questions.cases import SearchPlan, search_cases
from safevar_sumo.questions.evaluator import ENCOUNTERS
from safevar_sumo.questions.models import FitNumbers
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.smallest import Search
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.oracle import product_of
from safevar_sumo.records import FloatArray, IntArray

KNOWN = 256
"""Number of known cases with which a search begins, and largest number of unsafe cases that it
returns. With another parameter set a search begins with an eighth of these known cases.
"""
OWN_SEARCHES = 4
"""Number of searches with the study's own parameter set. Each other set has a single search with
half of the budget.
"""
MAX_SHARE_REPAIRED = 0.001
"""Upper bound of the unsafe share that newly sampled vehicles must prove, at the usual effort."""
FIRST = 1024
"""Number of the worst first cases with which the search for changes begins."""
MAX_ROUNDS = 30
"""Largest number of rounds; after them, no change counts as surviving."""
ATTACK_STAGE = "attack on the change"
PROOF_STAGE = "proof on fresh wear"


def usual_test(problem: RepairProblem, sets: int) -> float:
    """The usual number of settings that test a change in `sets` parameter sets."""
    points = len(problem.evaluator.system.points)
    encounters = 1 + ENCOUNTERS if problem.study.ranges else points
    searched = problem.budget * (OWN_SEARCHES + (sets - 1) / 2)
    proved = proof_size(1, unsafe_share(problem)) * encounters * min(sets, 2)
    return (searched + proved) / points


def unsafe_share(problem: RepairProblem) -> float:
    """The upper bound of the unsafe share that must be proved. More effort proves a lower bound."""
    return MAX_SHARE_REPAIRED / problem.evaluator.account.effort


def find_failures(
    problem: RepairProblem,
    fits: FitNumbers,
    change: FloatArray,
    cases: FloatArray,
    number: int,
) -> FloatArray:
    """Search the parameter sets `fits` for cases that a change does not keep safe. The result has
    the worst case first, and is empty if no search finds such a case.

    Parameters
    ----------
    cases
        Known cases, with which the searches begin.
    number
        The number of this call, which seeds its random numbers.
    """
    # The generator is no `Stream`: other random numbers would find other repairs.
    rng = np.random.default_rng((problem.study.search.seed, number))

    def judge(cases: FloatArray) -> FloatArray:
        """The robustness of cases with the change, shape (L,)."""
        return problem.counted_robustness(change, cases, ATTACK_STAGE)

    # Searches with other parameter sets have large generations: a few large ones cost less than
    # many small ones.
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
    fits: FitNumbers,
    change: FloatArray,
    number: int,
    attempt: int,
) -> tuple[Proof, FloatArray]:
    """Test a change with newly sampled promised vehicles in the listed encounters.

    First, vehicles drive with the study's own parameter set, which gives the proof. Then, if all of
    them are safe, as many further vehicles each drive with one of the other sets, at random. The
    second result are the unsafe cases: the change is proved only without them.

    Parameters
    ----------
    number
        The number of the search before, which seeds the random numbers.
    attempt
        The number of this proof, from 1 on: the more attempts, the stricter a proof must be.
    """
    rng = Stream.REPAIRED_BOUND.generator(problem.study.search.seed, number)
    unsafe = []

    def drive(vehicles: FloatArray, sets: IntArray) -> FloatArray:
        """The robustness of M vehicles, each with its parameter set, in the E listed encounters,
        shape (M, E). Unsafe cases are added to `unsafe`.
        """
        cases = product_of(vehicles, problem.encounters)
        cases = problem.with_sets(cases, np.repeat(sets, len(problem.encounters)))
        robustness = problem.counted_robustness(change, cases, PROOF_STAGE)
        unsafe.append(cases[robustness < 0][:KNOWN])
        return robustness.reshape(len(vehicles), -1)

    def judge(vehicles: FloatArray) -> FloatArray:
        """The robustness of M vehicles with the study's own parameter set, shape (M, E)."""
        return drive(vehicles, np.zeros(len(vehicles), dtype=np.intp))

    def draw(count: int) -> FloatArray:
        """Random promised vehicles, shape (count, n)."""
        return problem.promise.draw(count, rng)[:, : problem.size]

    proof = prove(draw, judge, unsafe_share(problem), attempt)
    if len(fits) > 1 and not len(unsafe[0]):
        vehicles = draw(proof.samples)
        drive(vehicles, rng.integers(1, len(fits), size=len(vehicles)))
    return proof, unsafe[-1]


class Survivors(NamedTuple):
    """The smallest changes that survive all searches and proofs.

    Attributes
    ----------
    changes
        Each change, shape (P,), with its proof; empty if no change survives.
    fits
        The number of parameter sets in which the changes hold.
    broken
        The numbers of the parameter sets in which a change does not hold.
    """

    changes: list[tuple[FloatArray, Proof]]
    fits: int
    broken: FitNumbers


def find_survivors(
    problem: RepairProblem, fits: FitNumbers, cases: FloatArray
) -> Survivors:
    """Find the smallest changes that survive in all parameter sets. If there are none, find those
    that survive in the study's own set, and the sets in which a search finds a counterexample to
    one of them. `cases` are the first counterexamples, the worst first.
    """
    changes = _survivors_in(problem, fits, cases)
    if changes or len(fits) == 1:
        return Survivors(changes, len(fits), ())
    changes = _survivors_in(problem, fits[:1], cases)

    def breaks_one(fit: int) -> bool:
        """Whether a search in a parameter set finds a counterexample to one of the changes."""
        return any(
            len(find_failures(problem, (fit,), change, cases, 0))
            for change, _ in changes
        )

    broken = tuple(filter(breaks_one, fits[1:]))
    return Survivors(changes, len(fits) - len(broken), broken)


def _survivors_in(
    problem: RepairProblem, fits: FitNumbers, cases: FloatArray
) -> list[tuple[FloatArray, Proof]]:
    """Find the smallest changes, search for counterexamples and prove in turns, until the smallest
    changes survive. The result is empty if no change survives.
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
                robustness = problem.counted_robustness(change, cases, ATTACK_STAGE)
                unsafe = cases[robustness < 0][:KNOWN]
            if not len(unsafe):
                # Only now is it likely that the round is the last one: expect its simulations.
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
