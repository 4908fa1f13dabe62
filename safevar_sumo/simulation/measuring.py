"""What a study measures and minimises: names turned into records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.metrics import F_SAFE, METRICS, Metric, Objective, Scoring, foreign_metric
from safevar_sumo.plugins import Lookup, Member
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CHANGES, Change, foreign_change

TAKEN = ("algorithm", "run", "evaluation", "outcome", "handle", "collision", "collision_speed", "setting", "f_safe", "f_diff", "f_num_diff")
"""Columns of results that no characteristic and no metric may be called."""
OBJECTIVES = "search.objectives"


class Measuring(NamedTuple):
    """The metrics and further measures of change by their columns, the objectives, and what of it comes from outside."""

    metrics: Mapping[str, Metric]
    changes: Mapping[str, Change]
    scoring: Scoring
    members: tuple[Member, ...]


def measuring_of(study: Study, lookup: Lookup) -> Measuring:
    """Look up the metrics and objectives that a study names.

    Raises
    ------
    InputError
        If there is no such record, it is wrong, or its name is taken.
    """
    metrics, found = dict(METRICS), list[Member]()
    changes = {name: change for name, change in CHANGES.items() if name not in TAKEN}
    by_name: dict[str, Metric | Change] = {}

    def taken_in(name: str, key: str) -> Metric | Change:
        if name in by_name:
            return by_name[name]
        member = lookup.find({**METRICS, **CHANGES} if key == OBJECTIVES else METRICS, name, key)
        if member.guard is None:
            return member.what  # type: ignore[no-any-return]
        found.append(member)
        foreign = isinstance(member.what, Change) and key == OBJECTIVES
        record = foreign_change(member.what, member.guard) if foreign else foreign_metric(member.what, member.guard)
        if record.name in (*TAKEN, *metrics, *changes, *study.vehicle.characteristics):
            raise InputError(lookup.source, f"{key} = {name!r}: the name {record.name!r} is taken", "a name of its own")
        if isinstance(record, Change):
            changes[record.name] = record
        else:
            metrics[record.name] = record
        by_name[name] = by_name[record.name] = record
        return record

    for name in study.metrics.also:
        taken_in(name, "metrics.also")
    objectives = [F_SAFE if name == F_SAFE.name else _objective(taken_in(name, OBJECTIVES)) for name in study.search.objectives]
    _refuse_twice(objectives, lookup.source)
    scoring = Scoring(metrics=tuple(metric.facts for metric in metrics.values()), objectives=tuple(objectives))
    return Measuring(metrics, changes, scoring, tuple(found))


def _objective(record: Metric | Change) -> Objective:
    if isinstance(record, Metric):
        return Objective.of(record)
    return Objective(name=record.name, title=record.title, unit=record.unit)


def _refuse_twice(objectives: Iterable[Objective], source: str) -> None:
    names = [objective.name for objective in objectives]
    if len(set(names)) < len(names):
        raise InputError(source, f"search.objectives: one of {', '.join(names)} is named twice", one_of([*METRICS, *CHANGES]))
