"""The measures of a study: the metrics, measures of change and objectives that the study names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from safevar_sumo.errors import InputError, check_name, one_of
from safevar_sumo.metrics import (
    F_DIFF,
    F_NUM_DIFF,
    F_SAFE,
    IMPACT_EXCESS,
    IMPACT_SPEED,
    METRICS,
    OBJECTIVES,
    OPTIONAL_METRICS,
    STOPPING_DISTANCE,
    UNSAFE_SHARE,
    Measure,
    Scoring,
    Unsafe,
    checked_measure,
)
from safevar_sumo.metrics.unsafe import COLLISION
from safevar_sumo.plugins import Lookup
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
CRITERION_KEY = "unsafe.criterion"


class Measuring(NamedTuple):
    """The measures that a study computes, by the name of their column, and the scoring: the facts
    of metrics and objectives.
    """

    measures: Mapping[str, Measure]
    scoring: Scoring


def measuring_of(study: Study, lookup: Lookup, *, has_stops: bool) -> Measuring:
    """Look up the metrics and objectives that a study names. With `has_stops`, a scenario of the
    study brakes fully, so that stopping distances are measured, too.

    Raises
    ------
    InputError
        If a measure does not exist, is invalid, or has a name that is taken.
    """
    computed = {**METRICS}
    if has_stops:
        computed[STOPPING_DISTANCE.name] = STOPPING_DISTANCE
    if study.scenario.repeats > 1:
        computed[UNSAFE_SHARE.name] = UNSAFE_SHARE
    metrics = {**computed, **OPTIONAL_METRICS}
    named = _Named(lookup, {*RESULT_COLUMNS, *metrics, *study.domains}, computed)

    for name in study.metrics.also:
        _add_metric(name, study, named, metrics)
    bound = own_criterion(study).bound
    if bound is not None:
        measures = OPTIONAL_METRICS | named.computed
        problem = f"{study.unsafe.criterion!r}: there is no metric {bound.measure!r}"
        check_name("", f"{CRITERION_KEY} = {problem}", bound.measure, measures)
        named.computed.setdefault(bound.measure, measures[bound.measure])

    objectives = _objectives(study, named, {**metrics, **OBJECTIVES})
    if IMPACT_EXCESS.name in named.computed:
        # Sentences about the impact excess state the impact speed, too.
        named.computed.setdefault(IMPACT_SPEED.name, IMPACT_SPEED)
    run_metrics = tuple(
        measure.facts for measure in named.computed.values() if measure.of == "runs"
    )
    return Measuring(
        named.computed, Scoring(metrics=run_metrics, objectives=tuple(objectives))
    )


def _add_metric(
    name: str, study: Study, named: _Named, metrics: Mapping[str, Measure]
) -> None:
    """Look up a metric that a study names in addition. A metric of every study, and a measure of
    settings, are refused.
    """
    if name in METRICS:
        raise InputError(
            "",
            f"metrics.also = {study.metrics.also}: every study has {name!r}",
            f"{one_of(OPTIONAL_METRICS)}, or package.module:Name",
        )
    if named.look_up(name, "metrics.also", metrics).of == "settings":
        raise InputError(
            "", f"metrics.also = {name!r} measures settings", "a measure of runs"
        )


def _objectives(
    study: Study, named: _Named, shipped: Mapping[str, Measure]
) -> list[Measure]:
    """Look up the objectives of a study. Two names of one objective are refused."""
    objectives = []
    texts = dict[str, list[str]]()
    for text in study.search.objectives:
        objective = named.look_up(text, OBJECTIVES_KEY, shipped).facts
        objectives.append(objective)
        texts.setdefault(objective.name, []).append(repr(text))
    for names in texts.values():
        if len(names) > 1:
            raise InputError(
                "",
                f"{OBJECTIVES_KEY}: {' and '.join(names)} are the same objective",
                "each objective once",
            )
    return objectives


def own_criterion(study: Study) -> Unsafe:
    """The criterion for unsafe that a study states. By default, a collision is unsafe.

    Raises
    ------
    InputError
        If the study's text is no criterion.
    """
    try:
        return Unsafe.parse(study.unsafe.criterion or COLLISION)
    except InputError as error:
        raise InputError(
            "", f"{CRITERION_KEY} = {error.problem}", error.legal
        ) from None


class _Named:
    """Looks up the measures that a study names, and collects them.

    Attributes
    ----------
    computed
        The measures that have to be computed, by the name of their column.
    """

    def __init__(
        self, lookup: Lookup, reserved_names: set[str], computed: dict[str, Measure]
    ) -> None:
        self.computed = computed
        self._lookup = lookup
        self._reserved_names = reserved_names
        self._own = dict[str, Measure]()

    def look_up(self, name: str, key: str, shipped: Mapping[str, Measure]) -> Measure:
        """The measure with this name. The name is that of a shipped measure, a user's class
        (package.module:Name), or that of a user's measure that was looked up before.
        """
        member = self._lookup.find({**shipped, **self._own}, name, key)
        measure: Measure = member.target
        if member.code is not None:
            measure = checked_measure(member.code)
            if measure.name in self._reserved_names:
                raise InputError(
                    "",
                    f"{key} = {name!r}: the name {measure.name!r} is taken",
                    "a unique name",
                )
            self._own |= {name: measure, measure.name: measure}
            self._reserved_names.add(measure.name)
        if measure.function is not None:
            self.computed.setdefault(measure.name, measure)
        return measure
