"""Limits together that hold up to each of some values of a parameter: a box that grows towards lesser values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Models
from safevar_sumo.questions.tolerance.levels import Level, LevelSearch
from safevar_sumo.questions.tolerance.together import LimitsTogether, find_limits_together
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit


def levels_with_together(search: LevelSearch, known: FloatArray) -> list[Level]:
    """The limits up to each value, alone and together, before known failures of one characteristic, shape (K, n).

    The box up to a value grows from that up to the value above, and ends at that up to the value below. What its search
    meets moves limits alone, too.
    """
    levels = search.levels(known)
    found = list[LimitsTogether | None]()
    inner: Box | None = None
    for level in reversed(levels):
        models = search.models(None, level.value)
        if level.alone is None or level.failures or models is None:
            found.append(None)
            continue
        together = _find(search, level, models, inner)
        inner = together.box or inner
        found.append(together)
    found.reverse()
    met = [each.failures_alone for each in found if each is not None]
    if sum(map(len, met)):
        levels = search.levels(np.concatenate([known, *met]))
    return [level._replace(together=each) for level, each in zip(levels, _nested(found), strict=True)]


def _find(search: LevelSearch, level: Level, models: Models, inner: Box | None) -> LimitsTogether:
    """The limits together up to a value, around those up to the value above."""
    members = models.own.evaluator.characteristics
    region = models.own.evaluator.region
    if inner is not None:
        lower = np.where(members.of_vehicle, inner.lower, members.lower)
        upper = np.where(members.of_vehicle, inner.upper, members.upper)
        inner = Box(region, lower, upper)
    alone = level.alone or []
    beyond = [pair[0] for each in alone for pair in each.beyond if pair is not None]
    everywhere = {item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario}
    return find_limits_together(
        models,
        [*search.columns, *np.flatnonzero(~members.of_vehicle).tolist()],
        {**search.limits, **everywhere},
        [each.scan for each in alone],
        np.array(beyond).reshape(-1, len(members)),
        search.budget,
        inner,
    )


def _nested(found: Sequence[LimitsTogether | None]) -> list[LimitsTogether | None]:
    """Limits together, each cut to those up to the value below; without these there are none. The attack and the proof
    of a box that is cut are of a wider one: what is cut has none.
    """
    nested = list[LimitsTogether | None]()
    outer: Box | None = None
    for number, each in enumerate(found):
        box = None if each is None else each.box
        if each is not None and box is not None and number:
            common = None if outer is None else _common(box, outer)
            if common is None or (common.lower != box.lower).any() or (common.upper != box.upper).any():
                box = common
                each = each._replace(box=box, attack=None, proof=None)
        outer = box
        nested.append(each)
    return nested


def _common(box: Box, outer: Box) -> Box:
    """What two boxes of the vehicle have in common, in the encounters of the first."""
    of_vehicle = box.region.characteristics.of_vehicle
    lower = np.where(of_vehicle, np.maximum(box.lower, outer.lower), box.lower)
    upper = np.where(of_vehicle, np.minimum(box.upper, outer.upper), box.upper)
    return Box(box.region, lower, upper)
