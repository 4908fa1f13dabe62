"""Limits together that hold up to each of some values of a parameter: a box around that up to the value above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model, Models
from safevar_sumo.questions.tolerance.levels import Level, LevelSearch, nested_limit
from safevar_sumo.questions.tolerance.search import SEARCH_STAGE
from safevar_sumo.questions.tolerance.settlement import Settlement
from safevar_sumo.questions.tolerance.together import (
    LimitsTogether,
    has_room,
    open_search,
    result,
    start_of,
    without_box,
)
from safevar_sumo.questions.tolerance.trial import Trial, Trials
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit

MAX_TRIALS = 30
"""Largest number of trials of a box, each without the failures of the one before; if all fail, there is none."""
AT_ONCE = 8
"""Number of failures in each model, the worst first, from which limits move in at once."""
PARTS, ROUNDS = 8, 2
"""Each of `ROUNDS` rounds divides the interval from an unsafe to a safe value into `PARTS` parts."""
MAX_NESTINGS = 5
"""Largest number of times that boxes are cut to those up to the values below, and tried again."""


def levels_with_together(search: LevelSearch, known: FloatArray) -> list[Level]:
    """The limits up to each value, alone and together, before known failures of one characteristic, shape (K, n).

    A box is sought around that up to the value above, and holds nothing that failed there. Then each is cut to that up
    to the value below, and to what limits alone allow, which end before the failures that were met; a box that is cut
    is tried again.
    """
    levels = search.levels(known)
    boxes = list[_LevelBox]()
    for level in reversed(levels):
        models = search.models(None, level.value)
        if level.alone is not None and not level.failures and models is not None:
            boxes.insert(0, _LevelBox(search, level, models))
            boxes[0].find(boxes[1] if boxes[1:] else None)
    for is_last in [False] * MAX_NESTINGS + [True]:
        found = {each.value: each.limits() for each in boxes}
        levels = _with_alone(search, levels, found)
        if not _nest(boxes, levels, is_last):
            break
    return [level._replace(together=found.get(level.value)) for level in levels]


class _LevelBox:
    """The search for limits together up to a value.

    Attributes
    ----------
    trial
        What the box that was found passed; None without a box.
    """

    def __init__(self, search: LevelSearch, level: Level, models: Models) -> None:
        members = models.own.evaluator.characteristics
        everywhere = {item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario}
        alone = level.alone or []
        beyond = [pair[0] for each in alone for pair in each.beyond if pair is not None]
        columns = [*search.columns, *np.flatnonzero(~members.of_vehicle).tolist()]
        known = np.array(beyond).reshape(-1, len(members))
        self.levels = search
        self.value = level.value
        self.search, self.nothing = open_search(models, columns, {**search.limits, **everywhere}, known)
        self.start = start_of(self.search, columns, [each.scan for each in alone])
        self.trials = Trials(self.nothing.members, search.budget, search.evaluator)
        self.settlement = Settlement(self.search)
        self.is_broken = models.own.fit in self.nothing.broken
        self.attempts = 0
        self.trial: Trial | None = None

    def find(self, above: _LevelBox | None) -> None:
        """Seek a box around that up to the value above."""
        if self.is_broken:
            return
        inner = None
        if above is not None:
            self.share(above)
            inner = None if above.trial is None else self._here(above.trial.box)
        search = self.search
        self.settlement = Settlement(search, inner)
        with self.levels.evaluator.stage(SEARCH_STAGE):
            best = search.best(self.start, widen=False)
        sides = np.maximum(search.fixed if best is None else best, self.settlement.least)
        trial = self._passed(search.printed(sides), is_whole=False)
        if trial is not None:
            with self.levels.evaluator.stage(SEARCH_STAGE):
                wider = self.settlement.of(trial.box)
            trial = self._passed(wider, is_whole=True)
        if trial is None and inner is not None:
            trial = self._passed(inner, is_whole=True)
        self.trial = trial

    def _passed(self, box: Box, *, is_whole: bool) -> Trial | None:
        """The trial that a box passes, cut by what fails: quick, in the fits in which something failed so far, then
        whole, in all; None if too many fail, or no room is left.
        """
        for _ in range(MAX_TRIALS):
            box = self.settlement.cut(box)
            if not has_room(self.search, box):
                return None
            known = self.search.corner_settings(self.search.sides_of(box)[np.newaxis])[0]
            trial = self.trials.quick(box, self.attempts + 1, {model.fit for model in self.search.models}, known)
            if is_whole and not trial.failures:
                trial = self.trials.whole(box, self.attempts + 2)
            self.attempts += 2
            if not trial.failures:
                return trial
            box = self._without(trial)
        return None

    def _without(self, trial: Trial) -> Box:
        """The box of a trial without its failures, which the search takes with their models: for each of some, the
        worst first, that limit moves in which loses the least volume until the failure's encounter is safe.
        """
        settings = np.concatenate([failures.settings for failures in trial.failures])
        for failures in trial.failures:
            self.search.join(failures.model)
        self.know(settings)
        with self.levels.evaluator.stage(SEARCH_STAGE):
            self.search.learn(settings)
            box = trial.box
            for model, rows in trial.failures:
                rows = rows[:AT_ONCE]
                for row, ends in zip(rows, self._safe_sides(model, rows), strict=True):
                    if box.holds(row[np.newaxis])[0]:
                        box = self._moved_in(box, ends)
        return box

    def _safe_sides(self, model: Model, failures: FloatArray) -> FloatArray:
        """The longest sides with which each of K failures is safe if one of its characteristics alone moves in, shape
        (K, 2, n); NaN where that never is, or the characteristic may not move.
        """
        search = self.search
        extents = np.where(search.is_free, search.extents(failures), 0.0)
        ways = np.argwhere(extents > self.settlement.least)
        numbers, _, columns = ways.T
        unsafe = np.ones(len(ways))
        safe = np.zeros(len(ways))
        is_never = np.zeros(len(ways), dtype=bool)
        for _ in range(ROUNDS):
            shares = np.linspace(unsafe, safe, PARTS + 1)[1:]
            settings = np.tile(failures[numbers], (PARTS, 1, 1))
            changes = shares * (failures[numbers, columns] - search.original[columns])
            settings[:, np.arange(len(ways)), columns] = search.original[columns] + changes
            flat = settings.reshape(-1, failures.shape[1])
            are_safe = ~model.are_unsafe(flat, SEARCH_STAGE).reshape(PARTS, len(ways))
            first = np.argmax(are_safe, axis=0)
            steps = np.vstack([unsafe, shares])
            unsafe = steps[first, np.arange(len(ways))]
            safe = shares[first, np.arange(len(ways))]
            is_never |= ~are_safe.any(axis=0)
        sides = np.full_like(extents, np.nan)
        longest = np.maximum(safe * extents[tuple(ways.T)], self.settlement.least[tuple(ways.T[1:])])
        sides[tuple(ways.T)] = np.where(is_never, np.nan, longest)
        return sides

    def _moved_in(self, box: Box, ends: FloatArray) -> Box:
        """A box one limit of which has moved in to one of some sides, which loses the least volume; as it is if there
        is none.
        """
        sides = self.search.sides_of(box)
        choices = list[FloatArray]()
        for side, column in np.argwhere(~np.isnan(ends)).tolist():
            shorter = sides.copy()
            shorter[side, column] = min(ends[side, column], sides[side, column])
            choices.append(shorter)
        return self.search.printed(max(choices, key=self.search.log_volume)) if choices else box

    def share(self, above: _LevelBox) -> None:
        """Know what failed up to the value above in an encounter up to this one, and the fits in which it did."""
        if not self.levels.is_searched:
            return
        fits = {model.fit for model in above.search.models}
        for model in self.nothing.members:
            if model.fit in fits:
                self.search.join(model)
        self.know(self.levels.up_to(self.value, above.search.unsafe_settings))

    def know(self, failures: FloatArray) -> None:
        """Hold none of some failures, shape (K, n)."""
        known = np.concatenate([self.search.unsafe_settings, failures])
        self.search.unsafe_settings = np.unique(known, axis=0)

    def nest(self, below: _LevelBox | None, is_last: bool) -> bool:
        """Cut the box to that up to the value below and by what is known, and try it again, unless it is the last time;
        whether it was cut.
        """
        if self.trial is None:
            return False
        box = self.trial.box
        if below is not None and below.trial is not None:
            outer = self._here(below.trial.box)
            box = Box(box.region, np.maximum(box.lower, outer.lower), np.minimum(box.upper, outer.upper))
        box = self.settlement.cut(box)
        is_same = np.array_equal(box.lower, self.trial.box.lower) and np.array_equal(box.upper, self.trial.box.upper)
        if below is not None and below.trial is None:
            self.trial = None
        elif not is_same:
            self.trial = None if is_last else self._passed(box, is_whole=True)
        else:
            return False
        return True

    def _here(self, box: Box) -> Box:
        """The vehicles of a box up to another value, in the encounters up to this one."""
        members = self.search.characteristics
        lower = np.where(members.of_vehicle, box.lower, members.lower)
        upper = np.where(members.of_vehicle, box.upper, members.upper)
        return Box(self.search.region, lower, upper)

    def limits(self) -> LimitsTogether:
        """What was found."""
        if self.is_broken:
            return self.nothing
        if self.trial is None:
            return without_box(self.nothing, self.search, self.attempts)
        return result(self.nothing, self.settlement, self.trial, self.attempts)


def _nest(boxes: Sequence[_LevelBox], levels: Sequence[Level], is_last: bool) -> bool:
    """Cut each box to that up to the value below, before all that is known to fail; whether any was cut."""
    for slower, faster in reversed([*pairwise(boxes)]):
        slower.share(faster)
    is_cut = False
    below: _LevelBox | None = None
    for each in boxes:
        searches = [level.search for level in levels if level.value <= each.value and level.search is not None]
        for search in searches:
            each.know(search.failures)
        is_cut |= each.nest(below, is_last)
        below = each
    return is_cut


def _with_alone(search: LevelSearch, levels: Sequence[Level], found: Mapping[float, LimitsTogether]) -> list[Level]:
    """The levels with limits alone before the failures that searches for limits together met up to their values."""
    moved = list[Level]()
    for level in levels:
        alone = level.alone
        if level.search is not None:
            for value, each in found.items():
                if search.is_searched:
                    level.search.meet(each.searched, search.up_to(level.value, each.failures_alone))
                elif value <= level.value:
                    level.search.meet(each.searched, each.failures_alone)
            alone = level.search.limits()
            before = moved[-1].alone if moved else None
            if before is not None:
                alone = [nested_limit(limit, earlier) for limit, earlier in zip(alone, before, strict=True)]
        moved.append(level._replace(alone=alone))
    return moved
