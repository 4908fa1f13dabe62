"""What a study measures: the metrics, measures of change and objectives that it names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.metrics import (
    METRIC_OF_OBJECTIVE,
    METRICS,
    OPTIONAL_METRICS,
    RATING_POINTS,
    STOPPING_DISTANCE,
    Metric,
    Objective,
    Scoring,
    checked_metric,
)
from safevar_sumo.plugins import Lookup
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.study import ORIGINAL_DEGREE, Study
from safevar_sumo.vehicles import CHANGES, Change, checked_change

RESULT_COLUMNS = (
    "algorithm",
    "run",
    "evaluation",
    "outcome",
    "handle",
    "collision",
    "collision_speed",
    "setting",
    "f_safe",
    "f_diff",
    "f_num_diff",
    ORIGINAL_DEGREE,
)
"""Names of result columns, which no characteristic or metric may use."""
OBJECTIVES_KEY = "search.objectives"


class Measuring(NamedTuple):
    """Metrics and additional measures of change by column, and the objectives."""

    metrics: Mapping[str, Metric]
    changes: Mapping[str, Change]
    scoring: Scoring


def measuring_of(study: Study, lookup: Lookup, *, has_stops: bool) -> Measuring:
    """Look up the metrics and objectives that a study names; `has_stops`: one of its scenarios brakes fully.

    Raises
    ------
    InputError
        If a metric or measure of change does not exist, is invalid, or has a name that is taken.
    """
    further = [
        metric for metric, is_meant in ((RATING_POINTS, is_rated(study)), (STOPPING_DISTANCE, has_stops)) if is_meant
    ]
    metrics = {**METRICS, **{metric.name: metric for metric in further}}
    shipped: Mapping[str, Metric] = {**metrics, **OPTIONAL_METRICS}
    changes, user_records = dict[str, Change](), dict[str, Metric | Change]()

    def look_up(known: Mapping[str, Metric | Change], name: str, key: str) -> Metric | Change:
        if name in user_records:
            return user_records[name]
        member = lookup.find(known, name, key)
        record: Metric | Change = member.target
        if member.code is not None:
            is_change = isinstance(record, Change) and key == OBJECTIVES_KEY
            record = (checked_change if is_change else checked_metric)(member.code)
            if record.name in (*RESULT_COLUMNS, *metrics, *OPTIONAL_METRICS, *changes, *study.domains):
                raise InputError(lookup.source, f"{key} = {name!r}: the name {record.name!r} is taken", "a unique name")
            user_records[name] = user_records[record.name] = record
            if isinstance(record, Change):
                changes[record.name] = record
        if isinstance(record, Metric):
            metrics.setdefault(record.name, record)
        return record

    for name in study.metrics.also:
        if name in METRICS:
            problem = f"metrics.also = {study.metrics.also}: every study has {name!r}"
            raise InputError(lookup.source, problem, f"{one_of(OPTIONAL_METRICS)}, or package.module:Name")
        look_up(shipped, name, "metrics.also")
    objectives = []
    for name in study.search.objectives:
        record = look_up({**shipped, **CHANGES, **METRIC_OF_OBJECTIVE}, name, OBJECTIVES_KEY)
        if isinstance(record, Metric):
            objectives.append(Objective.of(record))
        else:
            objectives.append(Objective(name=record.name, title=record.title, unit=record.unit))
    names = [objective.name for objective in objectives]
    if len(set(names)) < len(names):
        problem = f"search.objectives: one of {', '.join(names)} is named twice"
        raise InputError(lookup.source, problem, one_of([*METRICS, *OPTIONAL_METRICS, *CHANGES]))
    scoring = Scoring(metrics=tuple(metric.facts for metric in metrics.values()), objectives=tuple(objectives))
    return Measuring(metrics, changes, scoring)
