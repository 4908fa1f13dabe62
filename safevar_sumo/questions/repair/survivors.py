"""Search, attack and prove in turns: the smallest changes that survive everything, and in which
parameter sets of the vehicle model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safevar_sumo.questions.box import Proof, proof_size
from safevar_sumo.questions.cases import LEAST_SIMULATIONS
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.smallest import Search
from safevar_sumo.questions.repair.validation import (
    MAX_UNSAFE_SHARE,
    find_failures,
    prove_change,
)
from safevar_sumo.records import FloatArray

MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""
JOINING_VEHICLES = 64
"""Number of the worst known vehicles that a change must survive in a parameter set in which it
failed.
"""


class Survivors(NamedTuple):
    """The smallest changes that survive everything, each with its proof; none if no change does.

    They hold in `fits` parameter sets, and not in those with the numbers `broken`.
    """

    changes: list[tuple[FloatArray, Proof]]
    fits: int
    broken: tuple[int, ...]


def find_survivors(
    problems: Sequence[RepairProblem],
    between: Sequence[RepairProblem],
    vehicles: FloatArray,
) -> Survivors:
    """The smallest changes that survive in all parameter sets, also `between` the tests of a
    matrix; where none does, those of the study's own set, and the sets in which a falsification
    breaks one of them.
    """
    changes = _survivors_in(problems, between, vehicles)
    if changes or len(problems) == 1:
        return Survivors(changes, len(problems), ())

    def between_of(problem: RepairProblem) -> list[RepairProblem]:
        return [each for each in between if each.fit == problem.fit]

    changes = _survivors_in(problems[:1], between_of(problems[0]), vehicles)

    def breaks_one(problem: RepairProblem) -> bool:
        tests = between_of(problem)
        return any(
            find_failures([problem], tests, change, vehicles, 0)
            for change, _ in changes
        )

    broken = tuple(problem.fit for problem in problems[1:] if breaks_one(problem))
    return Survivors(changes, len(problems) - len(broken), broken)


def _survivors_in(
    problems: Sequence[RepairProblem],
    between: Sequence[RepairProblem],
    vehicles: FloatArray,
) -> list[tuple[FloatArray, Proof]]:
    """Search, attack and prove in turns until the smallest changes survive everything; none if no
    change does.
    """
    search = Search([*problems, *between], vehicles)
    proofs = dict[bytes, Proof]()
    attacks = 0
    failed_proofs = 0
    # What the attack and the proof of a change take if it survives, and the last search.
    own = problems[0]
    phases = own.evaluator.phases
    points = len(own.evaluator.system.points)
    attack = own.budget + 2 * LEAST_SIMULATIONS * len(between) / points
    proof = proof_size(0, MAX_UNSAFE_SHARE) * min(len(problems), 2)
    for each_round in range(1, MAX_ROUNDS + 1):
        changes = search.smallest_changes()
        unproved = [change for change in changes if change.tobytes() not in proofs]
        if not unproved:
            return [(change, proofs[change.tobytes()]) for change in changes]
        phases.begin_round(each_round, MAX_ROUNDS)
        for later, change in zip(reversed(range(len(unproved))), unproved, strict=True):
            attacks += 1
            left = later * (attack + proof) + len(changes) * len(search.settings)
            phases.expect(attack + proof + left)
            failures = find_failures(
                problems, between, change, search.settings, attacks
            )
            if not failures:
                phases.expect(proof + left)
                proved, failures = prove_change(
                    problems, change, attacks, failed_proofs + 1
                )
                if failures:
                    failed_proofs += 1
                else:
                    proofs[change.tobytes()] = proved
            for number, settings in failures.items():
                if number not in search.settings_of and number < len(problems):
                    search.add(number, _worst_with_fit(problems[number], vehicles))
                search.add(number, settings)
    return []


def _worst_with_fit(problem: RepairProblem, vehicles: FloatArray) -> FloatArray:
    """The worst of known vehicles, shape (L, n), that count with another parameter set."""
    worst = vehicles[:JOINING_VEHICLES]
    promised = worst[problem.holds(worst)]
    return promised[problem.repairable(promised)]
