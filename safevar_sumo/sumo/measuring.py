"""What a study measures: the metrics, measures of change and objectives that it names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.metrics import (
    F_DIFF,
    F_NUM_DIFF,
    F_SAFE,
    METRICS,
    OBJECTIVES,
    OPTIONAL_METRICS,
    RATING_POINTS,
    STOPPING_DISTANCE,
    Measure,
    Scoring,
    checked_measure,
)
from safevar_sumo.plugins import Lookup
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.study import ORIGINAL_DEGREE, Study

RESULT_COLUMNS = (
    "algorithm",
    "run",
    "evaluation",
    "outcome",
    "handle",
    "collision",
    "collision_speed",
    "setting",
    F_SAFE.name,
    F_DIFF.name,
    F_NUM_DIFF.name,
    ORIGINAL_DEGREE,
)
"""Names of result columns, which no characteristic or measure may use."""
OBJECTIVES_KEY = "search.objectives"


class Measuring(NamedTuple):
    """The measures that are computed, of runs before those of settings, by column; and the scoring."""

    measures: Mapping[str, Measure]
    scoring: Scoring


def measuring_of(study: Study, lookup: Lookup, *, has_stops: bool) -> Measuring:
    """Look up the metrics and objectives that a study names; `has_stops`: one of its scenarios brakes fully.

    Raises
    ------
    InputError
        If a measure does not exist, is invalid, or has a name that is taken.
    """
    further = ((RATING_POINTS, is_rated(study)), (STOPPING_DISTANCE, has_stops))
    measures = {**METRICS, **{metric.name: metric for metric, is_meant in further if is_meant}}
    shipped = {**measures, **OPTIONAL_METRICS}
    own: dict[str, Measure] = {}
    taken = {*RESULT_COLUMNS, *shipped, *study.domains}

    def look_up(name: str, key: str, known: Mapping[str, Measure]) -> Measure:
        member = lookup.find({**known, **own}, name, key)
        measure: Measure = member.target
        if member.code is not None:
            measure = own[name] = checked_measure(member.code)
            if measure.name in taken:
                raise InputError("", f"{key} = {name!r}: the name {measure.name!r} is taken", "a unique name")
            own[measure.name] = measure
            taken.add(measure.name)
        if measure.function is not None:
            measures.setdefault(measure.name, measure)
        return measure

    for name in study.metrics.also:
        if name in METRICS:
            problem = f"metrics.also = {study.metrics.also}: every study has {name!r}"
            raise InputError("", problem, f"{one_of(OPTIONAL_METRICS)}, or package.module:Name")
        if look_up(name, "metrics.also", shipped).of == "settings":
            raise InputError("", f"metrics.also = {name!r} measures settings", "a measure of runs")
    objectives = [look_up(name, OBJECTIVES_KEY, {**shipped, **OBJECTIVES}).facts for name in study.search.objectives]
    names = [objective.name for objective in objectives]
    if len(set(names)) < len(names):
        problem = f"search.objectives: one of {', '.join(names)} is named twice"
        raise InputError("", problem, one_of([*shipped, *OBJECTIVES]))
    metrics = tuple(measure.facts for measure in measures.values() if measure.of == "runs")
    return Measuring(measures, Scoring(metrics=metrics, objectives=tuple(objectives)))
