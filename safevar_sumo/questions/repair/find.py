"""The search of `repair`: from a problem to everything that its answer tells. After this nothing is
simulated.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.questions.between import remark_on_phases
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.cause_limits import find_cause_limits
from safevar_sumo.questions.causes import find_minimal_causes
from safevar_sumo.questions.drives import Drives
from safevar_sumo.questions.repair.found import Found, Repair
from safevar_sumo.questions.repair.price import price_of
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.survivors import Survivors, find_survivors
from safevar_sumo.questions.sampling import sobol_points
from safevar_sumo.records import BoolArray, NamedValues
from safevar_sumo.study import Study

ROUNDS_STAGE = "smallest change that survives"
"""The stage of progress in which changes are searched and tested."""
SOBOL_VEHICLES = 256
"""Number of Sobol points of the promise among the first counterexamples, and number of corners: the
corners are the same points, rounded.
"""
CAUSES_OF = 4
"""Number of failures of full braking whose causes the answer states."""


def search(problem: RepairProblem, subject: Subject) -> Found:
    """Search the smallest changes that keep all promised vehicles safe, and what they cost."""
    evaluator = problem.evaluator
    sets = problem.sets
    drives, is_repairable = _worst_first(problem, _first_drives(problem, subject))
    survivors = Survivors([], len(sets), ())
    if is_repairable.any():
        with evaluator.phases.stage(ROUNDS_STAGE):
            survivors = find_survivors(problem, sets, drives[is_repairable])
    worst_repairable = drives[int(np.argmax(is_repairable)) :][:1]
    worst_today = problem.outcome_today(worst_repairable)
    not_repairable = _not_repairable(problem, drives[~is_repairable])

    # If today's parameters survive, they are the only change: no repair is necessary.
    proof_today = None
    repairs = []
    for change, proof in survivors.changes:
        values = problem.changed_values(change)
        if not values:
            proof_today = proof
            continue
        size = float(np.max(np.abs(change - problem.today)))
        price = price_of(problem.study, values, problem.new_vehicle_settings)
        repairs.append(Repair(values, size, proof, price))
    simulations = sum(world.model.evaluator.simulated for world in problem.bench.worlds)
    holds = bool(survivors.changes)
    return Found(
        study=problem.study,
        unsafe=problem.unsafe,
        promise=problem.promise,
        parameters=problem.parameters,
        repairs=sorted(repairs, key=lambda repair: repair.cost),
        proof_today=proof_today,
        worst_today=float(worst_today.column(problem.unsafe.measure)[0]),
        not_repairable=not_repairable,
        sets=len(sets),
        sets_holding=survivors.holding if holds else 0,
        broken_sets=survivors.broken,
        simulations=simulations,
        is_rough=evaluator.budget.effort < 1,
        phases=remark_on_phases(problem.bench.own.in_phases) if holds else "",
    )


def _first_drives(problem: RepairProblem, subject: Subject) -> Drives:
    """The first drives, which may be counterexamples. They are the new vehicle, corners and Sobol
    points of the promise, and promised failures of results, each in all listed encounters that
    count. The failures are also taken in their own encounters.
    """
    promise = problem.promise
    members = promise.region.characteristics
    number = problem.evaluator.budget.by_effort(SOBOL_VEHICLES)
    points = sobol_points(number, len(promise.lower), problem.study.search.seed)
    failures = members.original_settings[:0]
    if not isinstance(subject, Study):
        rows = subject.solutions[problem.unsafe.rows(subject.solutions)]
        failures = rows[list(members.names)].to_numpy(dtype=float)
        failures = failures[promise.holds(failures)]
    points = np.vstack([np.round(points), points])
    settings = np.vstack([members.original, promise.at(points)])
    settings = np.vstack([settings[promise.holds(settings)], failures])
    vehicles = np.unique(settings[:, : problem.size], axis=0)
    listed = Drives.product(vehicles, problem.encounters)
    own = problem.drives_of(failures)
    own = own[problem.is_promised(own.encounters)]
    drives = Drives.concatenate([listed, own])
    if not len(drives):
        keep = problem.unsafe.keep
        demand = f"keeps {keep:g} m" if keep else "is safe"
        study = problem.study
        raise InputError(
            study.source,
            f"{study.name!r}: the new vehicle {demand} in none of the tested encounters",
            "a smaller --margin, or narrower ranges of the axes",
        )
    return drives


def _worst_first(problem: RepairProblem, drives: Drives) -> tuple[Drives, BoolArray]:
    """The drives in another order: the one that is least safe today comes first. The second result
    says which of them a driving system can keep safe. All other vehicles need a repaired part, not
    a changed parameter.
    """
    today = problem.outcomes(problem.today, drives, "the driving system of today")
    today = today[today.worst_first()]
    ordered = today.drives
    is_unsafe = today.is_not_safe
    is_repairable = ~is_unsafe
    is_repairable[is_unsafe] = problem.repairable(ordered[is_unsafe])
    return ordered, is_repairable


def _not_repairable(problem: RepairProblem, drives: Drives) -> list[NamedValues]:
    """The wear that no driving system can keep safe, as minimal causes of failures of full braking.
    A cause has, for each of its characteristics, the value from which on even full braking at once
    fails.
    """
    driver = problem.best_driver(problem.bench.own)
    if not len(drives) or driver is None:
        return []
    unsafe = problem.unsafe
    evenly_spaced = np.linspace(0, len(drives) - 1, min(len(drives), CAUSES_OF))
    number = len(problem.promise.lower)
    failures = []
    for drive in drives[evenly_spaced.astype(int)]:
        _, setting = problem.bench.setting(drive)
        failures.append(setting[:number])
    causes = []
    for of_failure in find_minimal_causes(driver, np.array(failures), unsafe):
        causes += of_failure
    all_limits = find_cause_limits(driver, causes, unsafe)
    members = {member.name: member for member in problem.promise.region.characteristics}
    parts: dict[tuple[str, ...], NamedValues] = {}
    for limits, cause in zip(all_limits, causes, strict=True):
        # The same characteristics may be a cause in many encounters: only the first cause counts.
        # Without an encounter, only the first of the causes counts that have the same text.
        kind = tuple(limits.boundary)
        if not cause.encounter:
            kind += tuple(
                members[name].text(value) for name, value in limits.boundary.items()
            )
        parts.setdefault(kind, limits.boundary | cause.encounter)
    return list(parts.values())
