"""The sentences of an answer about limits. `Told` derives facts from the limits that were found;
functions choose the templates of sentences, and fill them with these facts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import Side, find_boundaries
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.cases import Counterexamples
from safevar_sumo.questions.counterexamples import (
    FURTHER_DIGITS,
    Failure,
    describe,
    limit_text,
)
from safevar_sumo.questions.models import Model, fit_names
from safevar_sumo.questions.part import UpperEnd, scope_of
from safevar_sumo.questions.sentence import Sentence, answer, evidence, note
from safevar_sumo.questions.tables import Rows
from safevar_sumo.questions.tolerance import words
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.boxes import Attack
from safevar_sumo.questions.tolerance.search import FoundLimits
from safevar_sumo.questions.words import (
    VALID_FOR,
    join_phrases,
    number_of,
    undecidable_in_words,
)
from safevar_sumo.records import Evaluations, FloatArray, finite_or_none
from safevar_sumo.study import Study, unit_text
from safevar_sumo.vehicles import Characteristic

MOST_LIMITS = 3
"""Largest number of joint limits that a sentence names."""
DECIMALS = 3
"""Decimals of a joint limit beyond its printed decimals: further decimals are rounding errors."""


class InRanges(NamedTuple):
    """The searches (by the number of the parameter set) for counterexamples in a study's ranges."""

    task: Asked
    unsafe: Unsafe
    attacks: Mapping[int, Counterexamples]


@dataclass(frozen=True)
class Told:
    """The limits that were found, and the facts that sentences and tables state about them.

    Attributes
    ----------
    columns
        The columns of the characteristics whose limits the user asks for.
    original
        The evaluations of the original vehicle.
    has_scan
        Whether enough values were simulated to state limits alone.
    at_tests
        Whether limits cover only the listed test cases.
    upper_end, tests_left_out
        The value above which encounters were left out, such as a speed; None without such a value.
        The names of the tests that were left out completely.
    """

    task: Asked
    limits: FoundLimits
    unsafe: Unsafe
    original: Evaluations
    columns: Sequence[int]
    is_rough: bool
    has_scan: bool
    at_tests: bool
    upper_end: UpperEnd | None
    tests_left_out: Sequence[str]

    @property
    def study(self) -> Study:
        """The study of the first model."""
        return self.own.evaluator.study

    @property
    def own(self) -> Model:
        """The first model with the study's own parameter set."""
        return self.task.oracle.own

    @cached_property
    def scope(self) -> str:
        """The tests and encounters that the limits cover, in words."""
        return scope_of(self.study, between=not self.at_tests)

    @property
    def is_safe(self) -> bool:
        """Whether the original vehicle is safe."""
        return not self.unsafe.of(self.original)[0]

    @property
    def members(self) -> Sequence[Characteristic]:
        """The characteristics of the vehicle."""
        return self.task.oracle.vehicle.members

    @cached_property
    def box(self) -> Box | None:
        """The joint limits; None if no box was found. A box in which a characteristic cannot change
        does not count if only few simulations were done.
        """
        sides = self.limits.sides
        if sides is None or (self.without_room and not self.has_scan):
            return None
        return self.box_of(sides)

    @property
    def without_room(self) -> list[str]:
        """The characteristics that could not change at all in the box that was found."""
        sides = self.limits.sides
        if sides is None:
            return []
        is_free = self.limits.boxes.is_free.any(axis=0)
        closed = np.flatnonzero(is_free & (sides.sum(axis=0) == 0))
        return [self.members[column].short_name for column in closed.tolist()]

    def box_of(self, sides: FloatArray) -> Box:
        """The box of vehicles with these sides; its ends are rounded, except specified limits."""
        vehicle = self.task.oracle.vehicle
        boxes = self.limits.boxes
        ends = np.stack(boxes.ends(sides))
        for column, item in enumerate(self.members):
            for end in ends:
                end[column] = round(float(end[column]), item.digits + DECIMALS)
        is_specified = ~boxes.is_free & ~np.isnan(self.task.specification)
        ends = np.where(is_specified, self.task.specification, ends)
        lower, upper = np.clip(ends, vehicle.lower, vehicle.upper)
        return Box(self.own.evaluator.region, lower, upper)

    def failure(self, case: FloatArray, box: Box | None = None) -> Failure | None:
        """How a case fails, with values that are rounded for readers. With a `box`, the rounded
        values stay in the box. The result is None if no rounded values fail, or if there are too
        few simulations left to test them.
        """
        if self.task.oracle.available < len(FURTHER_DIGITS):
            return None
        model, setting = self.task.oracle.setting(case)
        if box is not None:
            box = box.in_encounters_of(model.evaluator.region)
        return describe(model, {"": setting}, box).get("")

    @cached_property
    def failures(self) -> Mapping[int, Failure]:
        """How the vehicle fails just beyond a limit, by column. The limit is the joint limit, or
        the limit alone if there are no joint limits.
        """
        breaches = self.limits.breaches
        if self.box is None:
            breaches = self.limits.alone.breaches
        failures = {}
        for (_, column), case in sorted(breaches.items(), key=self._change):
            if column in failures:
                continue
            failure = self.failure(case, self.box)
            if failure is not None:
                failures[column] = failure
        return failures

    def _change(self, breach: tuple[Side, FloatArray]) -> float:
        """How much a case beyond a side changes the side's characteristic, in its unit."""
        (_, column), case = breach
        return abs(float(case[column] - self.task.original[column]))

    def alone(self, column: int) -> tuple[float, float] | tuple[None, None]:
        """The limits of a characteristic alone, rounded inwards; None if they were not searched, or
        if the original vehicle is unsafe.
        """
        if not (self.is_safe and self.has_scan):
            return None, None
        low = self._feasible(column, self.limits.alone.lower[column])
        high = self._feasible(column, self.limits.alone.upper[column])
        return self.members[column].rounded_inwards((low, high))

    def _feasible(self, column: int, end: float) -> float:
        """The last value from the original to `end` that satisfies the study's constraints."""
        region = self.own.evaluator.region
        start = region.characteristics.original_settings
        setting = start.copy()
        setting[0, column] = end
        if region.feasible(setting)[0]:
            return float(end)
        line = find_boundaries(start, setting, lambda rows: ~region.feasible(rows))
        return float(line.safe[0, column])

    def specified(self, column: int) -> tuple[float | None, float | None]:
        """The lower and upper specified limit of a characteristic; None without such a limit."""
        low, high = self.task.specification[:, column].tolist()
        return finite_or_none(low), finite_or_none(high)

    def outside(self, column: int) -> float:
        """How far a specified limit is beyond what is safe alone; 0 if it is within that."""
        alone = self.limits.alone
        ends = float(alone.lower[column]), float(alone.upper[column])
        low, high = self.members[column].rounded_inwards(ends)
        specified_low, specified_high = self.task.specification[:, column]
        return float(np.nanmax([low - specified_low, specified_high - high, 0.0]))

    @cached_property
    def stated(self) -> list[int]:
        """The columns of the characteristics with specified limits."""
        is_stated = ~np.isnan(self.task.specification).all(axis=0)
        return list(np.flatnonzero(is_stated).tolist())

    @cached_property
    def broken(self) -> list[int]:
        """The columns whose specified limits do not hold. If the specified limits together are
        unsafe, or the original vehicle is unsafe, these are all columns with specified limits.
        """
        if self.limits.broken or not self.is_safe:
            return self.stated
        return list(filter(self._is_broken, self.stated))

    def _is_broken(self, column: int) -> bool:
        """Whether a specified limit is beyond the limit alone. A rough search leaves a wide gap
        between the last safe value and the first unsafe one: then the limit is broken only if an
        unsafe vehicle is within it.
        """
        if not self.is_rough:
            return self.outside(column) > 0
        lengths = np.abs(
            self.task.specification[:, column] - self.task.original[column]
        )
        return any(
            self._change(breach) <= lengths[breach[0][0]]
            for breach in self.limits.alone.breaches.items()
            if breach[0][1] == column
        )

    @property
    def attacked(self) -> int:
        """The number of simulations that searched for an unsafe vehicle within the joint limits."""
        return sum(attack.simulated for attack in self.limits.attacks.values())

    @property
    def least(self) -> float | None:
        """The worst value that the search of the joint limits found; None if no value is finite."""
        return worst_of(self.unsafe, self.limits.attacks)

    @property
    def kept(self) -> bool | None:
        """Whether the specified limits hold; None if only a rough search found no failure."""
        if self.broken or not self.is_safe:
            return False
        return None if self.is_rough else True


def value_in(unsafe: Unsafe, fit: int, robustness: float) -> float:
    """The clearance [m] or the value of a metric that belongs to a robustness in the parameter set
    number `fit`. Only set 0, the study's own, demands a clearance to keep.
    """
    criterion = unsafe if fit == 0 else replace(unsafe, keep=0.0)
    return criterion.value(robustness)


def worst_of(
    unsafe: Unsafe, attacks: Mapping[int, Attack | Counterexamples]
) -> float | None:
    """The worst value that searches found, by parameter set; None without a finite value."""
    pairs = attacks.items()
    values = [value_in(unsafe, fit, attack.least) for fit, attack in pairs]
    finite = list(filter(np.isfinite, values))
    return float(unsafe.worst(finite)) if finite else None


def refusal_in_words(facts: Told) -> str:
    """The reason for which no limit can be stated: the original vehicle's failure."""
    breach = facts.unsafe.breach_in_words(facts.original)
    return words.ORIGINAL_UNSAFE.format(breach=breach)


def verdict_sentences(
    facts: Told, nearest: Rows, in_ranges: Sequence[Sentence]
) -> Iterator[Sentence]:
    """The sentences of the verdict: the decision, its reason, other limits, and the scope."""
    if not facts.is_safe:
        yield words.REFUSAL(reason=refusal_in_words(facts))
        yield answer(facts.unsafe.smaller_demand(facts.original))
        return
    if facts.broken:
        yield from _broken(facts)
    yield from _nearest(facts, nearest)
    if facts.box is not None:
        yield from _joint(facts, facts.box)
    elif 0 not in facts.limits.broken:
        yield from _no_box(facts)
    yield from in_ranges
    yield from _alone(facts)
    yield note(facts.unsafe.remark)
    if facts.tests_left_out:
        tests = join_phrases(facts.tests_left_out)
        yield words.TESTS_LEFT_OUT(
            tests=tests,
            end=facts.upper_end,
        )
    if facts.at_tests:
        yield words.AT_TESTS
    yield VALID_FOR(scope=facts.scope)


def _broken(facts: Told) -> Iterator[Sentence]:
    """Say that specified limits do not hold. A sentence for each limit that is not safe alone, or
    else a sentence about all limits together. Then: in which parameter sets they fail.
    """
    yield words.DO_NOT_RELEASE
    outside = [column for column in facts.broken if facts.outside(column) > 0]
    for column in outside:
        yield _outside(facts, column)
    if not outside:
        yield _together(facts)
    fits = len(facts.task.fits)
    if facts.limits.broken and fits > 1:
        broken = sorted(facts.limits.broken)
        yield words.SPECIFIED_SETS(
            holding=fits - len(broken), fits=fits, broken=fit_names(broken)
        )


def _together(facts: Told) -> Sentence:
    """Say that all specified limits together do not hold."""
    values = []
    for column in facts.broken:
        item = facts.members[column]
        for end in facts.specified(column):
            if end is not None:
                values.append(f"{item.short_name} {limit_text(item, end)}")
    case = next(iter(facts.limits.broken.values()))
    failure = facts.failure(case, facts.box_of(facts.limits.specified))
    event = words.SOME_UNSAFE if failure is None else failure.words
    return words.TOGETHER(limits=join_phrases(values), event=event)


def _outside(facts: Told, column: int) -> Sentence:
    """Say that a specified limit is not safe alone. The sentence describes a failure at the
    specified value or, if the vehicle is safe there, at a larger change.
    """
    item = facts.members[column]
    value, event = _failure_outside(facts, column)
    outside = limit_text(item, round(facts.outside(column), 9))
    return words.OUTSIDE(
        name=item.short_name,
        value=limit_text(item, value),
        event=event,
        outside=outside,
    )


def _failure_outside(facts: Told, column: int) -> tuple[float, str]:
    """The value of a failure at a specified limit or beyond it, and the failure in words."""
    low, high = facts.specified(column)
    for side, end in enumerate((low, high)):
        unsafe = facts.limits.alone.breaches.get((side, column))
        if end is None or unsafe is None:
            continue
        case = unsafe.copy()
        case[column] = end
        vehicle = case[: len(facts.members)]
        point = Box(facts.own.evaluator.region, vehicle, vehicle)
        for failure in (facts.failure(case, point), facts.failure(unsafe)):
            if failure is not None:
                return float(failure.setting[column]), failure.words
    end = low if high is None else high
    assert end is not None
    return end, words.SOME_UNSAFE


def _nearest(facts: Told, nearest: Rows) -> Iterator[Sentence]:
    """Say which values would be safe in place of the specified limits."""
    names = {item.name: item.short_name for item in facts.members}
    limits = [
        f"{names[str(name)]} {value:.10g}{unit_text(unit)}"
        for name, unit, _, value in nearest
        if value is not None
    ]
    if limits:
        yield words.NEAREST(limits=join_phrases(limits, "or"))
    elif nearest:
        yield words.NONE_NEAREST


def _joint(facts: Told, box: Box) -> Iterator[Sentence]:
    """State the joint limits, and the result of the search within them."""
    if not facts.stated:
        yield from _limits(facts, box)
    elif facts.limits.broken:
        yield words.NOT_SPECIFIED
    else:
        yield words.SPECIFIED
    if facts.without_room:
        yield words.WITHOUT_ROOM(names=join_phrases(facts.without_room))
    fits = len(facts.task.fits)
    holding = fits - len(facts.limits.broken)
    if fits > 1:
        yield words.SETS(
            holding=holding,
            fits=fits,
        )
    yield _tested(facts.unsafe, holding)
    yield from _undecidable(facts, box)
    for model in facts.task.exclusions:
        # The failure's words name the test and the parameter set.
        described = describe(model, {"": model.characteristics.original})
        event = words.SOME_UNSAFE
        if described:
            event = described[""].words
        yield words.LEFT_OUT(
            fit=model.fit,
            event=event,
        )
    if fits == 1 and not facts.task.exclusions and facts.study.spread:
        yield words.ONE_SET


def _limits(facts: Told, box: Box) -> Iterator[Sentence]:
    """State the joint limits or, if they are many, their number: the table has the limits."""
    texts = [
        limit_in_words(facts, box, column)
        for column in facts.columns
        if box.lower[column] < box.upper[column]
    ]
    limits = list(filter(None, texts))
    if len(limits) > MOST_LIMITS:
        yield words.JOINT(number=len(limits))
    elif limits:
        yield words.KEEP(limits=join_phrases(limits))
    elif len(texts) == len(facts.columns):
        yield words.UNLIMITED


def limit_in_words(facts: Told, box: Box, column: int) -> str:
    """A joint limit, such as `payload at 500 kg or less`; "" if the whole domain is safe."""
    item = facts.members[column]
    low = float(box.lower[column])
    high = float(box.upper[column])
    return words.LIMITS[low != item.lower, high != item.upper].format(
        name=item.short_name, low=limit_text(item, low), high=limit_text(item, high)
    )


def _no_box(facts: Told) -> Iterator[Sentence]:
    """Say that no joint limits were found, and why."""
    if facts.stated and not facts.is_rough:
        yield words.SPECIFIED_ALONE
    boxes = facts.limits.failures.boxes
    if facts.without_room:
        yield words.NO_ROOM(names=join_phrases(facts.without_room))
    elif boxes:
        ranges = number_of(boxes, "set") + " of limits"
        yield words.NO_BOX(
            unsafe=facts.unsafe.description,
            boxes=ranges,
        )
    else:
        yield words.TOO_FEW


def _tested(unsafe: Unsafe, fits: int) -> Sentence:
    """Say what every tested vehicle within the limits did. `fits` is the number of parameter sets
    in which the limits hold. Only the study's own set demands a clearance to keep.
    """
    if not unsafe.keep:
        return words.SAFE(unsafe=unsafe.description)
    return words.CLEARANCE[fits > 1](
        keep=unsafe.keep, others=number_of(fits - 1, "other parameter set")
    )


def _undecidable(facts: Told, box: Box) -> Iterator[Sentence]:
    """Say which limits a workshop cannot check, because it measures less exactly than needed."""
    ends = zip(facts.members, box.lower.tolist(), box.upper.tolist(), strict=True)
    vague = [item for item, low, high in ends if not item.is_decidable(low, high)]
    if vague:
        yield evidence(undecidable_in_words(vague))


def _alone(facts: Told) -> Iterator[Sentence]:
    """Say which characteristics can make the vehicle unsafe alone, of those in `facts.columns`."""
    limited = {column for _, column in facts.limits.alone.breaches}
    names = [
        facts.members[column].short_name
        for column in facts.columns
        if column in limited
    ]
    if names:
        yield words.ALONE(names=join_phrases(names, "or"))
    elif facts.has_scan:
        yield words.NONE_ALONE
