"""Which smallest change of the driving system survives the wear that the user promises, and what does it cost?

The first counterexamples are corners and Sobol points of the promise, without vehicles that no driving system survives.
The smallest changes that survive them (`smallest`) are attacked and proved (`attack`); what breaks one is a new
counterexample. Today's driving system is the change of no parameter.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe, margin_of
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import Margin, question
from safevar_sumo.questions.evaluator import Evaluator, sobol_points
from safevar_sumo.questions.explain.causes import find_limits, find_minimal_causes
from safevar_sumo.questions.repair.answer import answer_of, check_file, write_repair
from safevar_sumo.questions.repair.attack import Proof, find_failures, prove
from safevar_sumo.questions.repair.problem import Promise, RepairProblem, parameters_of
from safevar_sumo.questions.repair.smallest import Search
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import assemble

if TYPE_CHECKING:
    from safevar_sumo.questions.case import Case

SOBOL_VEHICLES = 256
"""Sobol points of the promise among the first counterexamples, and corners: the same points rounded."""
MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""
CAUSES_OF = 4
"""Number of failures of full braking whose causes are told."""


@question
def repair(
    subject: Study | Case,
    evaluator: Evaluator,
    *,
    promise: Annotated[tuple[str, ...], '"NAME >= X"'] = (),
    margin: Margin = None,
    change: Annotated[tuple[str, ...], "PARAMETER"] = (),
    out: Annotated[str | None, "FILE.toml"] = None,
) -> Answer:
    """Find the smallest change of the driving system that survives promised wear, and its price.

    Failures of results within the promise are survived, too.

    Parameters
    ----------
    promise
        Wear that is promised, such as "treadDepth >= 3"; may be repeated. Characteristics that no promise names stay as
        in the original; "all" promises the whole domain. By default the study's [repair.promise], else its [limits].
    margin
        Distance to keep from a collision [m], between bumpers where the safety degree is from centre to centre; by
        default the model's error that the study states, else 0.3 m.
    change
        Parameter of the driving system that may change; may be repeated. By default those under [repair], else those
        that come with a shipped driving system.
    out
        Study file to write with the first repair; it extends the study.
    """
    study = evaluator.study
    if is_rated(study):
        text = f"{study.name!r} is rated, and its repair would take a whole test matrix for every vehicle and change"
        raise InputError(study.source, text, "the study without the rating, such as wear for euro_ncap_rating")
    if out is not None:
        check_file(Path(out), study)
    problem = RepairProblem(
        evaluator=evaluator,
        promise=Promise.of(study, evaluator.region, promise),
        parameters=parameters_of(study, change),
        unsafe=Unsafe(keep=margin_of(study, margin), contact=contact_degree(assemble(study))),
    )
    vehicles = _first_vehicles(problem, subject)
    degrees = problem.degrees_with(problem.today, vehicles, "the driving system of today")
    order = np.argsort(degrees, kind="stable")
    vehicles, degrees = vehicles[order], degrees[order]
    # What no driving system survives needs another part, not a parameter; the rest is repaired.
    is_repairable = degrees >= problem.margin
    is_repairable[~is_repairable] = problem.repairable(vehicles[~is_repairable])
    survivors = _find_survivors(problem, vehicles[is_repairable]) if is_repairable.any() else []
    worst = float(degrees[is_repairable][0] if is_repairable.any() else degrees[0])
    answer = answer_of(problem, survivors, worst, _not_repairable(problem, vehicles[~is_repairable]))
    if out is not None and answer.numbers["repairs"]:
        write_repair(Path(out), answer)
    return answer


def _first_vehicles(problem: RepairProblem, subject: Study | Case) -> FloatArray:
    """The new vehicle, corners and Sobol points of the promise, and failures of results in it; shape (L, n)."""
    promise, seed = problem.promise, problem.study.search.seed
    points = sobol_points(SOBOL_VEHICLES, len(promise.lower), seed)
    settings = [promise.region.characteristics.original[np.newaxis], promise.at(np.round(points)), promise.at(points)]
    if not isinstance(subject, Study):
        failures = subject.solutions[Unsafe(problem.margin).rows(subject.solutions)]
        settings.append(failures[list(promise.region.characteristics.names)].to_numpy(dtype=float))
    rows = np.unique(np.concatenate(settings), axis=0)
    return rows[promise.holds(rows)]


def _find_survivors(problem: RepairProblem, vehicles: FloatArray) -> list[tuple[FloatArray, Proof]]:
    """Search, attack and prove in turns until the smallest changes survive everything; none if no change does."""
    search, proofs, attacks, failed_proofs = Search(problem, vehicles), dict[bytes, Proof](), 0, 0
    for _ in range(MAX_ROUNDS):
        changes = search.smallest_changes()
        unproved = [change for change in changes if change.tobytes() not in proofs]
        if not unproved:
            return [(change, proofs[change.tobytes()]) for change in changes]
        for change in unproved:
            attacks += 1
            failures = find_failures(problem, change, search.settings, attacks)
            if not len(failures):
                proof, failures = prove(problem, change, attacks, failed_proofs)
                if len(failures):
                    failed_proofs += 1
                else:
                    proofs[change.tobytes()] = proof
            search.add(failures)
    return []


def _not_repairable(problem: RepairProblem, failures: FloatArray) -> list[dict[str, float]]:
    """What no driving system can survive: the minimal causes of failures of full braking, shrunk to the limit; for each
    characteristic of a cause the value from which on even full braking at once fails.
    """
    if not len(failures):
        return []
    driver, unsafe = problem.best_driver, Unsafe(problem.margin)
    chosen = failures[np.linspace(0, len(failures) - 1, min(len(failures), CAUSES_OF)).astype(int)]
    causes = [cause for group in find_minimal_causes(driver, chosen, unsafe) for cause in group]
    limits = [one.boundary for one in find_limits(driver, causes, unsafe)]
    return [limit for number, limit in enumerate(limits) if limit not in limits[:number]]
