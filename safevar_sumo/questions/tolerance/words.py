"""The verdict on limits in words: the decision, what would do instead, and the scope."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import describe, limit_text
from safevar_sumo.questions.models import fit_names
from safevar_sumo.questions.phases import remark_on_phases
from safevar_sumo.questions.tables import Rows
from safevar_sumo.questions.tolerance.told import Told
from safevar_sumo.questions.words import (
    bound_in_words,
    join_phrases,
    number_of,
    share_in_words,
    undecidable_in_words,
)
from safevar_sumo.study import unit_text


def refusal_in_words(told: Told) -> str:
    """Why no limit can be kept."""
    breach = told.unsafe.breach_in_words(told.original)
    return f"the original vehicle itself {breach}: no limit can be kept"


def verdict_sentences(told: Told, nearest: Rows, in_ranges: Rows) -> Iterator[str]:
    """The sentences of the verdict: the decision, what decides it, what would do instead, and the
    scope.
    """
    if not told.is_safe:
        refusal = refusal_in_words(told)
        yield f"{refusal[:1].upper()}{refusal[1:]}."
        demand = told.unsafe.smaller_demand(told.original)
        if demand:
            yield demand
        return
    if told.broken:
        yield f"Do not release: {'; '.join(broken_in_words(told))}."
    yield from _sets_in_words(told)
    yield from _nearest_in_words(nearest)
    yield from _box_in_words(told)
    yield from _vague_in_words(told)
    for row in in_ranges:
        yield f"In the ranges of the study {row[2]}"
    yield from _alone_in_words(told)
    if told.unsafe.remark:
        yield told.unsafe.remark
    if told.tests_left_out:
        tests = join_phrases(told.tests_left_out)
        yield f"Left out, because all their values are above {told.up_to}: {tests}."
    if told.at_tests:
        yield "Nothing was simulated between the values of the tests (--at-tests)."
    yield f"Scope: {told.scope}."


def broken_in_words(told: Told) -> list[str]:
    """What is wrong with the specified limits: of each that is not safe alone, else of all
    together.
    """
    outside = [column for column in told.broken if told.outside(column) > 0]
    if outside:
        return [_outside_in_words(told, column) for column in outside]
    items = [told.members[column] for column in told.broken]
    texts = [
        f"{item.name} {limit_text(item, end)}"
        for item, column in zip(items, told.broken, strict=True)
        for end in told.given(column)
        if end is not None
    ]
    case = next(iter(told.limits.broken.values()))
    failure = told.failure(case, told.box_of(told.limits.specified))
    words = "the car is unsafe" if failure is None else failure.words
    return [f"{join_phrases(texts)}: with all specified limits, {words}"]


def _outside_in_words(told: Told, column: int) -> str:
    """What is wrong with a limit: `brakeTorque 0.5: the car hits a pedestrian (outside by 0.08)`.

    At the specified value itself the vehicle may be safe; then what fails beyond the limit is said.
    """
    item = told.members[column]
    low, high = told.given(column)
    outside = limit_text(item, round(told.outside(column), 9))
    for side, end in enumerate((low, high)):
        beyond = told.limits.alone.beyond.get((side, column))
        if end is None or beyond is None:
            continue
        at_end = beyond.copy()
        at_end[column] = end
        vehicle = at_end[: len(told.members)]
        point = Box(told.own.evaluator.region, vehicle, vehicle)
        for failure in (told.failure(at_end, point), told.failure(beyond)):
            if failure is not None:
                value = limit_text(item, float(failure.setting[column]))
                return f"{item.name} {value}: {failure.words} (outside by {outside})"
    end = low if high is None else high
    assert end is not None
    return (
        f"{item.name} {limit_text(item, end)}: the car is unsafe (outside by {outside})"
    )


def _sets_in_words(told: Told) -> Iterator[str]:
    """In which parameter sets the specified limits do not hold."""
    broken = sorted(told.limits.broken)
    tried = len(told.asked.fits)
    if broken and tried > 1:
        kept = f"{tried - len(broken)} of {tried}"
        yield (
            f"The specified limits hold in {kept} parameter sets of the vehicle, not in"
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


def _box_in_words(told: Told) -> Iterator[str]:
    """The joint limits, and what was found within them."""
    found = told.limits
    is_stated = not np.isnan(told.asked.given).all()
    if told.box is None:
        if 0 not in found.broken:
            yield from _no_box_in_words(told)
        return
    where = ""
    tried = len(told.asked.fits)
    held = tried - len(found.broken)
    if tried > 1:
        where = f" in {held} of {tried} parameter sets of the vehicle model"
    decision = "All joint limits hold at the same time"
    if is_stated:
        decision = "The joint limits below hold" if found.broken else "All limits hold"
    yield f"{decision}{where}: {tested_in_words(told.unsafe, held)}."
    for model in told.asked.left_out:
        # Its words name the test and the parameter set.
        described = describe(model, {"": model.characteristics.original})
        words = (
            described[""].words if described else f"parameter set {model.fit} is unsafe"
        )
        yield f"With the original vehicle itself {words}: there no limit is claimed."
    if (
        tried == 1
        and not told.asked.left_out
        and told.study.spread
        and not told.is_rough
    ):
        yield (
            "The limits were computed with one parameter set of the vehicle model; the study's"
            " other sets were not tried."
        )
    if told.without_room:
        names = join_phrases(told.without_room)
        yield f"No room was found for {names}: they stay as in the original."


def _no_box_in_words(told: Told) -> Iterator[str]:
    """That no joint limits were found."""
    if not np.isnan(told.asked.given).all() and not told.is_rough:
        yield "The specified limits hold with all other characteristics as in the original."
    if told.without_room:
        yield (
            "The simulations found no joint limits of use, because no safe change of"
            f" {join_phrases(told.without_room)} was found beside the others."
        )
        return
    boxes = number_of(told.limits.known.boxes, "operating range")
    if told.limits.known.boxes:
        yield (
            f"No joint limits were found ({told.unsafe.description}): the search tested {boxes},"
            " and found an unsafe vehicle in each. That is no proof that there are none."
        )
    else:
        yield "The simulations did not suffice to search joint limits."


def tested_in_words(unsafe: Unsafe, fits: int) -> str:
    """What every vehicle within limits did that hold in some parameter sets: with others than the
    study's own, no distance is demanded.
    """
    every = "every vehicle that was tested within them"
    if not unsafe.keep:
        sets = f" in any of {fits} parameter sets" if fits > 1 else ""
        return f"no vehicle that was tested within them is unsafe ({unsafe.description}){sets}"
    others = ""
    if fits > 1:
        others = (
            " with the study's own parameter set, and none collides with"
            f" {number_of(fits - 1, 'other')}"
        )
    return f"{every} keeps at least {unsafe.keep:.3g} m of clearance{others}"


def _vague_in_words(told: Told) -> Iterator[str]:
    """Which limits a workshop cannot decide."""
    box = told.box
    if box is None:
        return
    vague = [
        item
        for column, item in enumerate(told.members)
        if not item.is_decidable(float(box.lower[column]), float(box.upper[column]))
    ]
    if vague:
        yield undecidable_in_words(vague)


def _alone_in_words(told: Told) -> Iterator[str]:
    """Which characteristics can make the vehicle unsafe on their own, of those that were asked
    about.
    """
    limited = {column for _, column in told.limits.alone.beyond}
    names = [told.members[column].name for column in told.columns if column in limited]
    if len(names) > 1:
        yield f"{join_phrases(names)} can each make the vehicle unsafe on their own."
    elif names:
        yield f"{names[0]} can make the vehicle unsafe on its own."
    elif told.has_scan:
        yield "No single characteristic makes the vehicle unsafe on its own."


def tested_sentences(told: Told) -> Iterator[str]:
    """How joint limits were tested; nothing without such limits."""
    found, evaluator = told.limits, told.own.evaluator
    if told.study.ranges and told.is_safe:
        share = share_in_words(evaluator.share_left_out)
        yield (
            f"Of the encounters over the domain {share} do not count, because the original vehicle"
            f" itself keeps less than {told.study.scenario.margin or 0:g} m in them."
        )
    if told.box is None:
        return
    attacked = sum(attack.simulated for attack in found.attacks.values())
    searched = f"{attacked:,} simulations that search for a counterexample"
    least = told.least
    worst = "of which none met an encounter that counts"
    if least is not None:
        worst = f"the worst {told.unsafe.value_in_words(least)}"
    corners = "All corner cases; " if told.asked.effort.corners else ""
    yield f"{corners}{searched} ({worst})."
    proof = found.proof
    if proof is not None:
        failed = (
            f", {proof.not_simulated} could not be simulated"
            if proof.not_simulated
            else ""
        )
        bound = bound_in_words(proof.at_most).capitalize()
        yield f"{proof.samples:,} random vehicles, none unsafe{failed}."
        yield f"{bound} of uniformly sampled vehicles within the limits are unsafe."
    if remark := remark_on_phases(told.own.in_phases):
        yield remark
