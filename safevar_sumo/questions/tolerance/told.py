"""What was found about limits, as it is told; and the verdict in words: the decision, what would do
instead, and the scope.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.cases import Counterexamples
from safevar_sumo.questions.counterexamples import (
    FURTHER_DIGITS,
    Failure,
    describe,
    limit_text,
)
from safevar_sumo.questions.models import Model, fit_names
from safevar_sumo.questions.phases import remark_on_phases
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Rows
from safevar_sumo.questions.tolerance.alone import Side
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.boxes import Attack
from safevar_sumo.questions.tolerance.search import FoundLimits
from safevar_sumo.questions.words import (
    bound_in_words,
    join_phrases,
    number_of,
    percentage,
    undecidable_in_words,
)
from safevar_sumo.records import Evaluations, FloatArray, finite_or_none
from safevar_sumo.study import Study, unit_text
from safevar_sumo.vehicles import Characteristic

DECIMALS = 3
"""Decimals of limits beyond those that are printed: further ones are rounding errors."""


class InRanges(NamedTuple):
    """The searches for counterexamples to limits in the ranges of a study, by the number of the
    parameter set.
    """

    task: Asked
    unsafe: Unsafe
    attacks: Mapping[int, Counterexamples]


@dataclass(frozen=True)
class Told:
    """What was found, and how it is told.

    Attributes
    ----------
    columns
        The columns of the characteristics that vary.
    has_scan
        Whether enough values were simulated to state limits alone.
    up_to, tests_left_out
        Where the study was cut, and the names of the tests above.
    """

    task: Asked
    limits: FoundLimits
    unsafe: Unsafe
    original: Evaluations
    columns: Sequence[int]
    is_rough: bool
    has_scan: bool
    at_tests: bool
    up_to: str | None
    tests_left_out: Sequence[str]

    @property
    def study(self) -> Study:
        """The study."""
        return self.own.evaluator.study

    @property
    def own(self) -> Model:
        """The first model with the study's own parameter set."""
        return self.task.oracle.own

    @cached_property
    def scope(self) -> str:
        """What the limits cover."""
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
        """The joint limits; none of few simulations if they leave a characteristic no room."""
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
        return [self.members[column].name for column in closed.tolist()]

    def box_of(self, sides: FloatArray) -> Box:
        """A box of vehicles as it is printed."""
        vehicle = self.task.oracle.vehicle
        boxes = self.limits.boxes
        ends = np.stack(boxes.ends(sides))
        for column, item in enumerate(self.members):
            for end in ends:
                end[column] = round(float(end[column]), item.digits + DECIMALS)
        is_specified = ~boxes.is_free & ~np.isnan(self.task.given)
        ends = np.where(is_specified, self.task.given, ends)
        lower, upper = np.clip(ends, vehicle.lower, vehicle.upper)
        return Box(self.own.evaluator.region, lower, upper)

    def failure(self, case: FloatArray, box: Box | None = None) -> Failure | None:
        """How a case fails, with the values that are printed; those within a box stay there."""
        if self.task.oracle.available < len(FURTHER_DIGITS):
            return None
        model, setting = self.task.oracle.setting(case)
        within = None if box is None else box.in_encounters_of(model.evaluator.region)
        return describe(model, {"": setting}, within).get("")

    @cached_property
    def failures(self) -> Mapping[int, Failure]:
        """How the vehicle fails just beyond a limit, by column: beyond the joint one, or alone."""
        beyond = self.limits.beyond
        if self.box is None:
            beyond = self.limits.alone.beyond
        failures = dict[int, Failure]()
        for side in sorted(beyond, key=lambda side: self._change(side, beyond[side])):
            column = side[1]
            if column in failures:
                continue
            failure = self.failure(beyond[side], self.box)
            if failure is not None:
                failures[column] = failure
        return failures

    def _change(self, side: Side, case: FloatArray) -> float:
        """How far a case beyond a side is from the original."""
        column = side[1]
        return abs(float(case[column] - self.task.original[column]))

    def alone(self, column: int) -> tuple[float, float] | tuple[None, None]:
        """What is safe alone, rounded inwards; nothing where it was not scanned."""
        if not (self.is_safe and self.has_scan):
            return None, None
        low = self._feasible(column, self.limits.alone.lower[column])
        high = self._feasible(column, self.limits.alone.upper[column])
        return self.members[column].rounded_inwards((low, high))

    def _feasible(self, column: int, end: float) -> float:
        """The last value on the way to a limit alone that satisfies the study's constraints."""
        region = self.own.evaluator.region
        start = region.characteristics.original_settings
        setting = start.copy()
        setting[0, column] = end
        if region.feasible(setting)[0]:
            return float(end)
        line = find_boundaries(start, setting, lambda rows: ~region.feasible(rows))
        return float(line.safe[0, column])

    def given(self, column: int) -> tuple[float | None, float | None]:
        """The specified limit."""
        low, high = self.task.given[:, column].tolist()
        return finite_or_none(low), finite_or_none(high)

    def outside(self, column: int) -> float:
        """How far a specified limit is beyond what is safe alone; 0 if it is not."""
        alone = self.limits.alone
        ends = float(alone.lower[column]), float(alone.upper[column])
        low, high = self.members[column].rounded_inwards(ends)
        given = self.task.given[:, column]
        return float(np.nanmax([low - given[0], given[1] - high, 0.0]))

    @cached_property
    def stated(self) -> list[int]:
        """The columns of the specified limits."""
        is_stated = ~np.isnan(self.task.given).all(axis=0)
        return list(np.flatnonzero(is_stated).tolist())

    @cached_property
    def broken(self) -> list[int]:
        """The columns of the specified limits that are not kept."""
        if self.limits.broken or not self.is_safe:
            return self.stated
        return [column for column in self.stated if self._is_broken(column)]

    def _is_broken(self, column: int) -> bool:
        """Whether a specified limit is beyond what is safe alone. A rough search has wide gaps
        between what is safe and what is not: there an unsafe vehicle must be within the limit.
        """
        if not self.is_rough:
            return self.outside(column) > 0
        lengths = np.abs(self.task.given[:, column] - self.task.original[column])
        beyond = self.limits.alone.beyond
        return any(
            self._change(side, case) <= lengths[side[0]]
            for side, case in beyond.items()
            if side[1] == column
        )

    def value_in(self, fit: int) -> float:
        """The worst that the search found in a parameter set: a clearance [m], or a metric."""
        return value_in(self.unsafe, fit, self.limits.attacks[fit].least)

    @property
    def attacked(self) -> int:
        """The number of simulations that searched the joint limits."""
        return sum(attack.simulated for attack in self.limits.attacks.values())

    @property
    def least(self) -> float | None:
        """The worst that the search found in any parameter set; None without an encounter."""
        return worst_of(self.unsafe, self.limits.attacks)

    @property
    def kept(self) -> bool | None:
        """Whether the specified limits hold, and the original is safe; None if it is not known."""
        if self.broken or not self.is_safe:
            return False
        return None if self.is_rough else True


def value_in(unsafe: Unsafe, fit: int, robustness: float) -> float:
    """The value of which some robustness is left in a parameter set: a clearance [m], or a metric;
    a distance to keep is demanded with the study's own alone.
    """
    criterion = unsafe if fit == 0 else replace(unsafe, keep=0.0)
    return criterion.value(robustness)


def worst_of(
    unsafe: Unsafe, attacks: Mapping[int, Attack | Counterexamples]
) -> float | None:
    """The worst value that searches in some parameter sets found; None without an encounter."""
    pairs = attacks.items()
    values = [value_in(unsafe, fit, attack.least) for fit, attack in pairs]
    finite = [value for value in values if np.isfinite(value)]
    return float(unsafe.worst(finite)) if finite else None


def refusal_in_words(facts: Told) -> str:
    """Why no limit can be kept."""
    breach = facts.unsafe.breach_in_words(facts.original)
    return f"the original vehicle itself {breach}: no limit can be kept"


def verdict_sentences(facts: Told, nearest: Rows, in_ranges: Rows) -> Iterator[str]:
    """The sentences of the verdict: the decision, what decides it, what would do instead, and the
    scope.
    """
    if not facts.is_safe:
        refusal = refusal_in_words(facts)
        yield f"{refusal[:1].upper()}{refusal[1:]}."
        demand = facts.unsafe.smaller_demand(facts.original)
        if demand:
            yield demand
        return
    if facts.broken:
        yield f"Do not release: {'; '.join(broken_in_words(facts))}."
    yield from _sets_in_words(facts)
    yield from _nearest_in_words(nearest)
    yield from _box_in_words(facts)
    yield from _vague_in_words(facts)
    for row in in_ranges:
        yield f"In the ranges of the study {row[2]}"
    yield from _alone_in_words(facts)
    if facts.unsafe.remark:
        yield facts.unsafe.remark
    if facts.tests_left_out:
        tests = join_phrases(facts.tests_left_out)
        yield f"Left out, because all their values are above {facts.up_to}: {tests}."
    if facts.at_tests:
        yield "Nothing was simulated between the values of the tests (--at-tests)."
    yield f"Scope: {facts.scope}."


def broken_in_words(facts: Told) -> list[str]:
    """What is wrong with the specified limits: of each that is not safe alone, else of all
    together.
    """
    outside = [column for column in facts.broken if facts.outside(column) > 0]
    if outside:
        return [_outside_in_words(facts, column) for column in outside]
    texts = list[str]()
    for column in facts.broken:
        item = facts.members[column]
        for end in facts.given(column):
            if end is not None:
                texts.append(f"{item.name} {limit_text(item, end)}")
    case = next(iter(facts.limits.broken.values()))
    failure = facts.failure(case, facts.box_of(facts.limits.specified))
    words = "the vehicle is unsafe" if failure is None else failure.words
    return [f"{join_phrases(texts)}: with all specified limits, {words}"]


def _outside_in_words(facts: Told, column: int) -> str:
    """What is wrong with a limit: `payload 500: the vehicle hits a pedestrian (outside by 8)`.

    At the specified value itself the vehicle may be safe; then what fails beyond the limit is said.
    """
    item = facts.members[column]
    low, high = facts.given(column)
    outside = limit_text(item, round(facts.outside(column), 9))
    for side, end in enumerate((low, high)):
        beyond = facts.limits.alone.beyond.get((side, column))
        if end is None or beyond is None:
            continue
        case = beyond.copy()
        case[column] = end
        vehicle = case[: len(facts.members)]
        point = Box(facts.own.evaluator.region, vehicle, vehicle)
        for failure in (facts.failure(case, point), facts.failure(beyond)):
            if failure is not None:
                value = limit_text(item, float(failure.setting[column]))
                return f"{item.name} {value}: {failure.words} (outside by {outside})"
    end = low if high is None else high
    assert end is not None
    return f"{item.name} {limit_text(item, end)}: the vehicle is unsafe (outside by {outside})"


def _sets_in_words(facts: Told) -> Iterator[str]:
    """In which parameter sets the specified limits do not hold."""
    broken = sorted(facts.limits.broken)
    number = len(facts.task.fits)
    if broken and number > 1:
        holding = f"{number - len(broken)} of {number}"
        yield (
            f"The specified limits hold in {holding} parameter sets of the vehicle, not in"
            f" {fit_names(broken)}."
        )


def _nearest_in_words(nearest: Rows) -> Iterator[str]:
    """Which values would hold in place of the specified limits."""
    values = [
        f"{name} {value:.10g}{unit_text(unit)}"
        for name, unit, _, value in nearest
        if value is not None
    ]
    if values:
        others = ", if the other specified limits stay" if len(nearest) > 1 else ""
        yield f"A limit that would hold instead: {' or '.join(values)}{others}."
    elif nearest:
        yield "No other value of a single specified limit would hold."


def _box_in_words(facts: Told) -> Iterator[str]:
    """The joint limits, and what was found within them."""
    broken = facts.limits.broken
    if facts.box is None:
        if 0 not in broken:
            yield from _no_box_in_words(facts)
        return
    where = ""
    number = len(facts.task.fits)
    holding = number - len(broken)
    if number > 1:
        where = f" in {holding} of {number} parameter sets of the vehicle model"
    decision = "All joint limits hold at the same time"
    if facts.stated:
        decision = "The joint limits below hold" if broken else "All limits hold"
    yield f"{decision}{where}: {tested_in_words(facts.unsafe, holding)}."
    for model in facts.task.left_out:
        # Its words name the test and the parameter set.
        described = describe(model, {"": model.characteristics.original})
        words = f"parameter set {model.fit} is unsafe"
        if described:
            words = described[""].words
        yield f"No limit holds in an encounter in which the original vehicle fails: {words}."
    is_single = number == 1 and not facts.task.left_out
    if is_single and facts.study.spread:
        yield (
            "The limits were computed with one parameter set of the vehicle model, not with the"
            " study's other sets."
        )
    if facts.without_room:
        names = join_phrases(facts.without_room)
        yield f"No room was found for {names}: they stay as in the original."


def _no_box_in_words(facts: Told) -> Iterator[str]:
    """That no joint limits were found."""
    if facts.stated and not facts.is_rough:
        yield "The specified limits hold with all other characteristics as in the original."
    if facts.without_room:
        yield (
            "The simulations found no joint limits of use, because no safe change of"
            f" {join_phrases(facts.without_room)} was found beside the others."
        )
        return
    boxes = number_of(facts.limits.failures.boxes, "operating range")
    if facts.limits.failures.boxes:
        yield (
            f"No joint limits were found ({facts.unsafe.description}): the search tested {boxes},"
            " and found an unsafe vehicle in each. That is no proof that there are none."
        )
    else:
        yield "The simulations did not suffice to search joint limits."


def tested_in_words(unsafe: Unsafe, fits: int) -> str:
    """What every vehicle within limits did that hold in some parameter sets: with others than the
    study's own, no distance is demanded.
    """
    if not unsafe.keep:
        sets = f" in any of {fits} parameter sets" if fits > 1 else ""
        return f"no vehicle that was tested within them is unsafe ({unsafe.description}){sets}"
    sets = ""
    if fits > 1:
        others = number_of(fits - 1, "other")
        sets = f" with the study's own parameter set, and none collides with {others}"
    clearance = f"at least {unsafe.keep:.3g} m of clearance"
    return f"every vehicle that was tested within them keeps {clearance}{sets}"


def _vague_in_words(facts: Told) -> Iterator[str]:
    """Which limits a workshop cannot decide."""
    box = facts.box
    if box is None:
        return
    ends = zip(facts.members, box.lower.tolist(), box.upper.tolist(), strict=True)
    vague = [item for item, low, high in ends if not item.is_decidable(low, high)]
    if vague:
        yield undecidable_in_words(vague)


def _alone_in_words(facts: Told) -> Iterator[str]:
    """Which characteristics can make the vehicle unsafe on their own, of those that were asked
    about.
    """
    columns = {column for _, column in facts.limits.alone.beyond}
    names = [
        facts.members[column].name for column in facts.columns if column in columns
    ]
    if len(names) > 1:
        yield f"{join_phrases(names)} can each make the vehicle unsafe on their own."
    elif names:
        yield f"{names[0]} can make the vehicle unsafe on its own."
    elif facts.has_scan:
        yield "No single characteristic makes the vehicle unsafe on its own."


def tested_sentences(facts: Told) -> Iterator[str]:
    """How joint limits were tested; nothing without such limits."""
    if facts.study.ranges and facts.is_safe:
        share = percentage(facts.own.evaluator.share_left_out)
        yield (
            f"{share} % of the encounters do not count, because the original vehicle keeps less"
            f" than {facts.study.scenario.margin or 0:g} m of clearance in them."
        )
    if facts.box is None:
        return
    search = f"{facts.attacked:,} simulations that search for a counterexample"
    least = facts.least
    worst = "of which none met an encounter that counts"
    if least is not None:
        worst = f"the worst {facts.unsafe.value_in_words(least)}"
    corners = "All corner cases; " if facts.task.effort.corners else ""
    yield f"{corners}{search} ({worst})."
    proof = facts.limits.proof
    if proof is not None:
        failed = ""
        if proof.not_simulated:
            failed = f" ({proof.not_simulated} could not be simulated)"
        bound = bound_in_words(proof.at_most).capitalize()
        yield f"None of {proof.samples:,} sampled vehicles is unsafe{failed}."
        yield f"{bound} of uniformly sampled vehicles within the limits are unsafe."
    if remark := remark_on_phases(facts.own.in_phases):
        yield remark
