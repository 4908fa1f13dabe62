"""Finds repairs by counterexamples: the smallest changes that survive them, attacks, and proof on fresh wear.

The first counterexamples are corners and Sobol points of the promise, without vehicles that no driving system survives.
The smallest changes that survive them (`smallest`) are attacked and proved (`attack`); what breaks one is a new
counterexample. Today's driving system is the change of no parameter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import describe_causes, find_minimal_causes
from safevar_sumo.analysis.repair import RepairOptions
from safevar_sumo.analysis.repair.answer import Repair, Repairs
from safevar_sumo.analysis.repair.attack import Proof, attack, prove
from safevar_sumo.analysis.repair.price import price_of
from safevar_sumo.analysis.repair.problem import Promise, RepairProblem, parameters_of
from safevar_sumo.analysis.repair.smallest import Search
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe, margin_of
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import assemble

SOBOL_VEHICLES = 256
"""Sobol points of the promise among the first counterexamples, and corners: the same points rounded."""
MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""
CAUSES_OF = 4
"""Number of failures of full braking whose causes are told."""


def find_repairs(source: Study | Case, options: RepairOptions, evaluator: Evaluator) -> Repairs:
    """Find the smallest changes of a driving system that survive the promise.

    Raises
    ------
    InputError
        If the study is rated, or the promise or a parameter cannot be used.
    """
    problem = _problem_of(evaluator, options)
    vehicles = _first_vehicles(problem, source)
    degrees = problem.degrees_with(problem.today, vehicles, "the driving system of today")
    order = np.argsort(degrees, kind="stable")
    vehicles, degrees = vehicles[order], degrees[order]
    # What no driving system survives needs another part, not a parameter; the rest is repaired.
    is_repairable = degrees >= problem.margin
    is_repairable[~is_repairable] = problem.repairable(vehicles[~is_repairable])
    kept = _find_survivors(problem, vehicles[is_repairable]) if is_repairable.any() else []
    repairs = []
    for change, proof in kept:
        values = problem.changed_values(change)
        if values:
            size = float(np.max(np.abs(change - problem.today)))
            repairs.append(Repair(values, size, price_of(problem.study, values), proof))
    return Repairs(
        study=problem.study,
        promise=problem.promise,
        unsafe=problem.unsafe,
        parameters=tuple(problem.parameters),
        repairs=tuple(repairs),
        worst_today=float(degrees[is_repairable][0] if is_repairable.any() else degrees[0]),
        proof_of_today=kept[0][1] if kept and not repairs else None,
        not_repairable=tuple(_describe_not_repairable(problem, vehicles[~is_repairable])),
        simulations=evaluator.simulated,
        no_verdict=evaluator.no_verdict,
    )


def _problem_of(evaluator: Evaluator, options: RepairOptions) -> RepairProblem:
    """The problem that options state."""
    study = evaluator.study
    if is_rated(study):
        text = f"{study.name!r} is rated, and its repair would take a whole test matrix for every vehicle and change"
        raise InputError(study.source, text, "the study without the rating, such as wear for euro_ncap_rating")
    promise = Promise.of(study, evaluator.region, options.promise)
    unsafe = Unsafe(keep=margin_of(study, options.margin), contact=contact_degree(assemble(study)))
    problem = RepairProblem(
        evaluator=evaluator, promise=promise, parameters=parameters_of(study, options.change), unsafe=unsafe
    )
    return replace(problem, arrays=problem.takes_arrays())


def _first_vehicles(problem: RepairProblem, source: Study | Case) -> FloatArray:
    """The new vehicle, corners and Sobol points of the promise, and failures of results in it; shape (L, n)."""
    promise, seed = problem.promise, problem.study.search.seed
    points = sobol_points(SOBOL_VEHICLES, len(promise.lower), seed)
    settings = [promise.region.characteristics.original[np.newaxis], promise.at(np.round(points)), promise.at(points)]
    if not isinstance(source, Study):
        failures = source.solutions[Unsafe(problem.margin).rows(source.solutions)]
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
            failures = attack(problem, change, search.settings, attacks)
            if not len(failures):
                proof, failures = prove(problem, change, attacks, failed_proofs)
                if len(failures):
                    failed_proofs += 1
                else:
                    proofs[change.tobytes()] = proof
            search.add(failures)
    return []


def _describe_not_repairable(problem: RepairProblem, failures: FloatArray) -> list[dict[str, float]]:
    """What no driving system can survive: the minimal causes of failures of full braking, shrunk to the limit."""
    if not len(failures):
        return []
    driver, unsafe = problem.best_driver, Unsafe(problem.margin)
    chosen = failures[np.linspace(0, len(failures) - 1, min(len(failures), CAUSES_OF)).astype(int)]
    causes = [cause for group in find_minimal_causes(driver, chosen, unsafe) for cause in group]
    limits = [cause.boundary for cause in describe_causes(driver, causes, unsafe)]
    return [limit for number, limit in enumerate(limits) if limit not in limits[:number]]
