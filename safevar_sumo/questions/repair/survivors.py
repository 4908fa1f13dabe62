"""Search, attack and prove in turns: the smallest changes that survive everything, and in which
parameter sets of the vehicle model.
"""

from __future__ import annotations

from typing import NamedTuple

from safevar_sumo.questions.box import Proof
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.smallest import Search
from safevar_sumo.questions.repair.validation import (
    ATTACK_STAGE,
    KNOWN,
    find_failures,
    prove_change,
    usual_test,
)
from safevar_sumo.records import FloatArray

FIRST = 1024
"""Number of the worst cases that are the first counterexamples."""
MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""


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
