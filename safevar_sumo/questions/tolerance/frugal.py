"""Joint limits with few simulations: each characteristic alone, the corners of a box, and a search
for counterexamples in it with what is left. The answer is rough.
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
from safevar_sumo.questions.causes import settings_of_line
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.phases import AT_ONE_PHASE
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.limits import OF_BOX
from safevar_sumo.questions.tolerance.rows import LIMITS, LIMITS_TITLE, NOWHERE
from safevar_sumo.questions.words import change_texts, join_phrases, number_of
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Limit
from safevar_sumo.vehicles.characteristics import Characteristic

STAGE = "limits with few simulations"
PARTS = (4, 4)
"""Number of parts into which each round divides a line to a failure."""
CORNER_SHARE = 0.25
"""Share of the simulations that one round of corners takes at most."""
BATCH = 16
"""Number of vehicles that are tried at once in search of a counterexample."""


@dataclass
class _Search:
    """A box that shrinks where vehicles in it are unsafe.

    Attributes
    ----------
    low, high
        The ends of its sides, shape (n,).
    corners, tried
        Numbers of corners, and of other vehicles, that were safe in the box as it is now.
    broken
        A vehicle within the specified limits that is unsafe by what they allow alone, shape (n,);
        None as long as none is known.
    """

    model: Model
    columns: list[int]
    limits: Mapping[str, Limit]
    low: FloatArray = field(init=False)
    high: FloatArray = field(init=False)
    corners: int = 0
    tried: int = 0
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
        self.shrink(settings[self.are_unsafe(settings)])

    def needed(self, failure: FloatArray) -> FloatArray:
        """A failure, shape (n,), without the changes that it does not need, one after another."""
        original = self.model.characteristics.with_original_vehicle(failure[np.newaxis])
        least = failure.copy()
        for column in self.columns:
            tried = least.copy()
            tried[column] = original[0, column]
            if tried[column] != least[column] and self.are_unsafe(tried[np.newaxis])[0]:
                least = tried
        return least

    def cut(self, failures: FloatArray) -> None:
        """Move the sides that the first of some failures needs, shape (K, n)."""
        self.shrink(self.needed(failures[0])[np.newaxis])

    @property
    def cost(self) -> int:
        """Settings that a cut takes at most."""
        return len(self.columns) + settings_of_line(PARTS)

    def shrink(self, failures: FloatArray) -> None:
        """Move the sides that failures reach, shape (K, n), each to the last safe place on the line
        from the original vehicle in the same encounter.
        """
        members = self.model.characteristics
        starts = members.with_original_vehicle(failures)
        if not len(failures):
            return
        found = find_boundaries(starts, failures, self.are_unsafe, PARTS)
        changes = (failures != starts) & members.of_vehicle & ~self.is_fixed
        if (broken := failures[~changes.any(axis=1)]).size:
            self.broken = broken[0]
        for safe, start, is_changed in zip(found.safe, starts, changes, strict=True):
            for column in np.flatnonzero(is_changed):
                lower, upper = sorted((safe[column], start[column]))
                item = members.members[column]
                if safe[column] < start[column]:
                    end = item.rounded(lower, upwards=True)
                    self.low[column] = min(max(self.low[column], end), start[column])
                else:
                    end = item.rounded(upper, upwards=False)
                    self.high[column] = max(min(self.high[column], end), start[column])
        self.corners = self.tried = 0

    def test_corners(self, rng: Generator) -> None:
        """Test corners, all if they are few, until none of them is unsafe."""
        of_vehicle = self.model.characteristics.of_vehicle
        most = int(CORNER_SHARE * self.left)
        while most and self.left > most + self.cost:
            is_open = np.flatnonzero((self.low < self.high) & of_vehicle)
            size = len(is_open)
            numbers = np.arange(2**size) if 2**size <= most else rng.integers(2**size, size=most)
            points = rng.random((len(numbers), len(self.low)))
            points[:, is_open] = numbers[:, np.newaxis] >> np.arange(size) & 1
            settings = self.box.at(points)
            unsafe = settings[self.are_unsafe(settings)]
            if not len(unsafe):
                self.corners = len(settings)
                return
            self.cut(unsafe)

    def falsify(self, rng: Generator) -> bool:
        """Search for counterexamples with what is left; whether the last of them was cut off, and
        vehicles in the box were tried after it.
        """
        while self.left >= BATCH + self.cost:
            settings = self.box.with_ends(BATCH, rng)
            unsafe = settings[self.are_unsafe(settings)]
            if len(unsafe):
                self.cut(unsafe)
            else:
                self.tried += len(settings)
        return self.tried > 0


def answer_roughly(asked: Asked) -> Answer:
    """The answer with as many simulations as are allowed, in the study's own parameter set."""
    evaluator = asked.evaluator
    members = evaluator.characteristics
    search = _Search(Model(0, evaluator, asked.unsafe), asked.columns, asked.limits)
    seed = evaluator.seed
    search.limit_alone()
    alone = search.low.copy(), search.high.copy()
    search.test_corners(Stream.FIRST_CORNERS.generator(seed))
    is_tested = search.falsify(Stream.JOINT_LIMITS.generator(seed))

    # A row for each characteristic; limits alone only where there is one encounter, joint limits
    # only where vehicles were tried within them.
    has_encounters = len(members.scenario) > 0
    together = (search.low, search.high) if is_tested else None
    rows = []
    for column, item in enumerate(members):
        if column in asked.columns:
            ends = NOWHERE if together is None else tuple(float(one[column]) for one in together)
            limit = NOWHERE if has_encounters else tuple(float(one[column]) for one in alone)
            specified, kept = NOWHERE, None
            if item.name in asked.limits:
                specified = search.interval(item)
                kept = False if search.broken is not None else None
            known = (item.name, item.unit, item.original, *limit, *ends, *specified, kept)
            rows.append((*known, *[None] * (len(LIMITS) - len(known))))
    limits = tabulate(LIMITS_TITLE, LIMITS, rows)
    domains = [(members.lower[column], members.upper[column]) for column in asked.columns]
    limits.attrs["bars"] = bars_of(limits, domains)
    return Answer(
        question="tolerance",
        study=evaluator.study,
        verdict=_verdict(search, alone, is_tested),
        tested=(
            f"{number_of(search.corners, 'corner')} and {search.tried:,} vehicles in search of a"
            f" counterexample. {AT_ONE_PHASE}"
        ),
        failures=_failures(search),
        numbers={**_numbers(asked, search), "scope": scope_of(evaluator.study, between=False)},
        tables={"limits": limits},
        draw=draw_bars,
    )


def _verdict(search: _Search, alone: tuple[FloatArray, FloatArray], is_tested: bool) -> str:
    """What was found, and which characteristics can make the vehicle unsafe on their own."""
    members = search.model.characteristics
    words = "No vehicle that was tried within the joint limits is unsafe."
    if search.broken is not None:
        named = ", ".join(change_texts(members.vehicle, members.named(search.broken)))
        words = f"The specified limits do not hold: a vehicle within them is unsafe ({named})."
    elif not is_tested:
        words = "The simulations did not suffice to try vehicles within the joint limits."
    is_closer = (alone[0] > members.lower) | (alone[1] < members.upper)
    names = [item.name for item, fails in zip(members, is_closer, strict=True) if fails]
    names = [name for name in names if name in members.vehicle.names]
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
