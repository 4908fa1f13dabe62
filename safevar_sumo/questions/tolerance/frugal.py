"""Joint limits with few simulations: each characteristic alone, then a box that is cut where random
vehicles in it are unsafe, and tried with what is left. The answer is rough.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.random import Generator

from safevar_sumo.questions.answer import Answer, tabulate
from safevar_sumo.questions.bars import bars_of, draw_bars
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.phases import AT_ONE_PHASE
from safevar_sumo.questions.sampling import CONFIDENCE, Stream
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.limits import OF_BOX
from safevar_sumo.questions.tolerance.rows import LIMITS, LIMITS_TITLE, NOWHERE
from safevar_sumo.questions.words import bound_in_words, change_texts, join_phrases, number_of
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Limit
from safevar_sumo.vehicles.characteristics import Characteristic

STAGE = "limits with few simulations"
PARTS = (4, 4)
"""Number of parts into which each round divides a line to a failure."""
BATCH = 8
"""Number of vehicles that are tried at once in search of a counterexample."""
KEPT = 1 / 3
"""Share of the settings that has to be tried in the final box."""
FIRST_GAP, WIDENING = 1 / 50, 1.25
"""How far limits keep off failures first, as a share of the domain, and the factor by which each
further failure makes this larger.
"""
GREATEST_SHARE = 0.05
"""Greatest bound of the share of unsafe vehicles with which limits are stated."""


@dataclass
class _Search:
    """A box that is cut where vehicles in it are unsafe.

    Attributes
    ----------
    low, high
        The ends of its sides, shape (n,).
    tried
        Number of random vehicles that were safe in the box since it was cut last. Those before do
        not count: the box was chosen by what they did.
    names_alone
        The characteristics of which a value was found that is unsafe alone.
    broken
        A vehicle within the specified limits that is unsafe by what they allow alone, shape (n,);
        None as long as none is known.
    """

    model: Model
    columns: list[int]
    limits: Mapping[str, Limit]
    low: FloatArray = field(init=False)
    high: FloatArray = field(init=False)
    tried: int = 0
    names_alone: list[str] = field(default_factory=list)
    broken: FloatArray | None = None

    def __post_init__(self) -> None:
        members = self.model.characteristics
        self.is_fixed = np.isin(members.names, [*self.limits])
        varies = ~members.of_vehicle
        varies[self.columns] = True
        self.low = np.where(varies, members.lower, members.original)
        self.high = np.where(varies, members.upper, members.original)
        for column, item in enumerate(members):
            if item.name in self.limits:
                self.low[column], self.high[column] = self.interval(item)
        self._outer = self.low, self.high
        self._gap = FIRST_GAP
        self._failures = np.empty((0, len(members)))
        self._budget = self.left

    def interval(self, item: Characteristic) -> tuple[float, float]:
        """The values that a specified limit allows."""
        limit = self.limits[item.name]
        low = item.lower if limit.at_least is None else limit.at_least
        return low, item.upper if limit.at_most is None else limit.at_most

    @property
    def box(self) -> Box:
        return Box(self.model.evaluator.region, self.low, self.high)

    @property
    def left(self) -> int:
        """Settings that may still be simulated, none once a specified limit is broken."""
        return 0 if self.broken is not None else self.model.evaluator.left or 0

    @property
    def at_most(self) -> float:
        """The share of unsafe vehicles in the box is at most this (`CONFIDENCE`, one-sided)."""
        return float(1 - (1 - CONFIDENCE) ** (1 / self.tried)) if self.tried else 1.0

    @property
    def without_room(self) -> list[str]:
        """The characteristics that could not change at all in the box."""
        names = self.model.characteristics.names
        is_closed = (self.low == self.high) & ~self.is_fixed
        return [names[column] for column in self.columns if is_closed[column]]

    def are_unsafe(self, settings: FloatArray) -> BoolArray:
        return self.model.are_unsafe(settings, STAGE)

    def limit_alone(self) -> None:
        """Move each side to the last value that is safe if its characteristic alone changes."""
        members = self.model.characteristics
        ends = [
            members.setting({members.names[column]: value})
            for column in self.columns
            for value in (self.low[column], self.high[column])
            if value != members.original[column]
        ]
        settings = np.array(ends).reshape(-1, len(members))
        unsafe = settings[self.are_unsafe(settings)]
        fails = ((unsafe != members.original) & members.of_vehicle).any(axis=0)
        self.names_alone = np.array(members.names)[fails].tolist()
        if len(unsafe):
            starts = members.with_original_vehicle(unsafe)
            found = find_boundaries(starts, unsafe, self.are_unsafe, PARTS)
            for safe, failure in zip(found.safe, unsafe, strict=True):
                is_changed = (failure != members.original) & members.of_vehicle
                (column,) = np.flatnonzero(is_changed).tolist()
                if self.is_fixed[column]:
                    self.broken = failure
                    continue
                is_high = bool(failure[column] > members.original[column])
                self._move(column, safe[column], is_high=is_high)
        self._outer = self.low.copy(), self.high.copy()

    def find(self, rng: Generator) -> bool:
        """Cut the box until a third of all settings was tried in it; whether this was reached."""
        while self.left >= 2 * BATCH + len(self.columns):
            vehicles = self.box.with_ends(BATCH, rng)
            settings = vehicles if self.tried else np.concatenate([self._corners(), vehicles])
            is_unsafe = self.are_unsafe(settings)
            if is_unsafe.any():
                self._cut(settings[is_unsafe][0])
            else:
                self.tried += len(vehicles)
        return self.tried >= KEPT * self._budget and self.at_most <= GREATEST_SHARE

    def _cut(self, failure: FloatArray) -> None:
        """Cut off a failure, shape (n,), and keep farther off all that are known: too little was
        simulated around them.
        """
        needed = self._needed(failure)
        if not self._choices(needed).any():
            self.broken = needed
            return
        self._failures = np.vstack([self._failures, needed])
        self._gap *= WIDENING
        self.tried = 0

        # From the limits alone on, all that are known are cut off.
        self.low, self.high = (end.copy() for end in self._outer)
        while (inside := self._failures[self.box.holds(self._failures)]).size:
            self._cut_off(inside)

    def _corners(self) -> FloatArray:
        """The corners of the box towards the last failures that were cut off, in their encounters:
        where a box that is still too large is unsafe most likely, shape (K, n).
        """
        members = self.model.characteristics
        failures = self._failures[-BATCH:]
        ends = np.where(failures > members.original, self.high, self.low)
        is_moved = members.of_vehicle & (failures != members.original)
        corners = np.where(is_moved, ends, failures)
        return corners[self.box.region.feasible(corners)]

    def _needed(self, failure: FloatArray) -> FloatArray:
        """A failure, shape (n,), without the changes that it does not need, one after another."""
        original = self.model.characteristics.with_original_vehicle(failure[np.newaxis])
        least = failure.copy()
        for column in self.columns:
            tried = least.copy()
            tried[column] = original[0, column]
            if tried[column] != least[column] and self.are_unsafe(tried[np.newaxis])[0]:
                least = tried
        return least

    def _cut_off(self, failures: FloatArray) -> None:
        """Move the side that loses the least share of its length by it, for that of K failures,
        shape (K, n), for which this loss is the greatest.
        """
        # Where each side would end, and which share of its length would stay.
        members = self.model.characteristics
        gap = self._gap * (members.upper - members.lower)
        is_above = failures > members.original
        ends = np.where(
            is_above,
            np.maximum(failures - gap, members.original),
            np.minimum(failures + gap, members.original),
        )
        lengths = np.maximum(self.high - self.low, 1e-300)
        kept = np.where(is_above, ends - self.low, self.high - ends) / lengths
        kept = np.where(self._choices(failures), kept, -np.inf)

        # The failure whose best cut costs most is cut off first.
        row = int(np.argmin(kept.max(axis=1)))
        column = int(np.argmax(kept[row]))
        self._move(column, ends[row, column], is_high=bool(is_above[row, column]))

    def _choices(self, failures: FloatArray) -> BoolArray:
        """Where a side can cut failures off, shape (..., n)."""
        members = self.model.characteristics
        return np.asarray((failures != members.original) & members.of_vehicle & ~self.is_fixed)

    def _move(self, column: int, end: float, *, is_high: bool) -> None:
        """Move a side to an end, rounded towards the original."""
        item = self.model.characteristics.members[column]
        rounded = item.rounded(end, upwards=not is_high)
        if is_high:
            self.high[column] = max(rounded, item.original)
        else:
            self.low[column] = min(rounded, item.original)


def answer_roughly(asked: Asked) -> Answer:
    """The answer with as many simulations as are allowed, in the study's own parameter set."""
    evaluator = asked.evaluator
    members = evaluator.characteristics
    search = _Search(Model(0, evaluator, asked.unsafe), asked.columns, asked.limits)
    seed = evaluator.seed
    search.limit_alone()
    is_tested = search.find(Stream.JOINT_LIMITS.generator(seed))

    # A row for each characteristic; no limits alone, which need a scan, and joint limits only where
    # vehicles were tried within them, and all have room.
    together = (search.low, search.high) if is_tested and not search.without_room else None
    rows = []
    for column, item in enumerate(members):
        if column in asked.columns:
            ends = NOWHERE if together is None else tuple(float(one[column]) for one in together)
            specified, kept = NOWHERE, None
            if item.name in asked.limits:
                specified = search.interval(item)
                kept = False if search.broken is not None else None
            known = (item.name, item.unit, item.original, *NOWHERE, *ends, *specified, kept)
            rows.append((*known, *[None] * (len(LIMITS) - len(known))))
    limits = tabulate(LIMITS_TITLE, LIMITS, rows)
    domains = [(members.lower[column], members.upper[column]) for column in asked.columns]
    limits.attrs["bars"] = bars_of(limits, domains)
    bound = bound_in_words(search.at_most).capitalize()
    return Answer(
        question="tolerance",
        study=evaluator.study,
        verdict=_verdict(search, is_tested),
        tested=(
            f"{number_of(search.tried, 'random vehicle')} within the limits, with half of their"
            f" values at ends. {bound} of such vehicles are unsafe. {AT_ONE_PHASE}"
        ),
        failures=_failures(search),
        numbers={**_numbers(asked, search), "scope": scope_of(evaluator.study, between=False)},
        tables={"limits": limits},
        draw=draw_bars,
    )


def _verdict(search: _Search, is_tested: bool) -> str:
    """What was found, and which characteristics can make the vehicle unsafe on their own."""
    members = search.model.characteristics
    words = f"None of {search.tried:,} vehicles that were tried within the joint limits is unsafe."
    if search.without_room:
        words = (
            "The simulations found no joint limits of use, because no safe change of"
            f" {join_phrases(search.without_room)} was found beside the others."
        )
    if search.broken is not None:
        named = ", ".join(change_texts(members.vehicle, members.named(search.broken)))
        words = f"The specified limits do not hold: a vehicle within them is unsafe ({named})."
    elif not is_tested:
        words = "The simulations did not suffice to try enough vehicles within joint limits."
    names = search.names_alone
    return f"{words} {join_phrases(names)} can make it unsafe alone." if names else words


def _failures(search: _Search) -> tuple[str, ...]:
    """Why specified limits are not called kept."""
    if search.broken is not None:
        return tuple(f"limit of {name}" for name in search.limits)
    return ("few simulations call no limit kept",) if search.limits else ()


def _numbers(asked: Asked, search: _Search) -> JsonObject:
    numbers: dict[str, Any] = {"unsafe": str(asked.unsafe), "margin": asked.unsafe.keep}
    up_to = None if asked.up_to is None else float(asked.up_to.partition("=")[2])
    kept = None if search.broken is None else False
    numbers |= {"kept": kept, "rough": True, "up_to": up_to, "boxes": 0}
    return {**dict.fromkeys(OF_BOX), **numbers}
