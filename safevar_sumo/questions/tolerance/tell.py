"""Makes the answer of `tolerance` from the limits that were found: numbers, tables and verdict."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.bars import bars_of, draw_bars
from safevar_sumo.questions.between import remark_on_phases
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import Failure, describe, limit_text
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import scope_of
from safevar_sumo.questions.sentence import Sentence, Verdict, condition, note
from safevar_sumo.questions.tables import (
    AnswerTable,
    Rows,
    shipped_columns,
    tabulate,
)
from safevar_sumo.questions.tolerance import words
from safevar_sumo.questions.tolerance.oracle import Oracle
from safevar_sumo.questions.tolerance.told import (
    InRanges,
    Told,
    limit_in_words,
    refusal_in_words,
    value_in,
    verdict_sentences,
    worst_of,
)
from safevar_sumo.questions.words import (
    bound_in_words,
    constraints_in_words,
    counted_in_words,
    join_phrases,
    percentage,
)
from safevar_sumo.records import FloatArray, JsonObject, finite_or_none
from safevar_sumo.scenarios import SPEED_DIMENSION

NUMBERS = (
    "unsafe",
    "margin",
    "kept",
    "rough",
    "scope",
    "up_to",
    "box",
    "boxes",
    "samples",
    "failures",
    "at_most",
    "not_simulated",
    "fits",
    "fits_tried",
    "attacked",
    "least_attacked",
)
LIMITS_TITLE = "Limits, rounded to the safe side"
LIMITS, FITS, NEAREST, IN_RANGES = shipped_columns("tolerance").values()


def answer_limits(
    facts: Told, nearest: FloatArray | None, ranges: InRanges | None
) -> Answer:
    """The answer of `tolerance`.

    Parameters
    ----------
    nearest
        The safe values nearest to the specified limits, shape (2, n), NaN without such a value;
        None if they were not searched.
    ranges
        The searches in the ranges of the study; None if there were no such searches.
    """
    tables = {"limits": _limits_table(facts)}
    sets = len(facts.task.fits) + len(facts.task.exclusions)
    if facts.is_safe and sets > 1:
        title = "The limits in each parameter set of the vehicle model"
        tables["fits"] = tabulate(title, FITS, _fit_rows(facts))
    nearest_rows = _nearest_rows(facts, nearest)
    if nearest_rows:
        tables["nearest"] = tabulate("Limits that would do", NEAREST, nearest_rows)
    in_ranges = []
    if ranges is not None:
        sentence, row = _told_in_ranges(facts, ranges)
        in_ranges = [sentence]
        title = "The same limits in the ranges of the study"
        tables["ranges"] = tabulate(title, IN_RANGES, [row])
    texts = counted_in_words(facts.study) + constraints_in_words(facts.study)
    return Answer(
        question="tolerance",
        study=facts.study,
        verdict=Verdict(verdict_sentences(facts, nearest_rows, in_ranges)),
        tested=Verdict([*_tested(facts), *map(note, texts)]),
        numbers=_numbers(facts),
        tables=tables,
        failures=_failures(facts),
        draw=draw_bars,
    )


def _tested(facts: Told) -> Iterator[Sentence]:
    """Say how the joint limits were tested. Without joint limits, say only how many encounters do
    not count.
    """
    if facts.study.ranges and facts.is_safe:
        yield words.NOT_COUNTED(
            share=percentage(facts.own.evaluator.share_left_out),
            margin=facts.study.scenario.margin or 0,
        )
    if facts.box is None:
        return
    search = words.EMPTY_SEARCH
    keeps = ""
    if facts.least is not None:
        search = words.SEARCH
        keeps = facts.unsafe.value_in_words(facts.least)
    yield search(
        number=facts.attacked,
        keeps=keeps,
    )
    limit = facts.task.effort.corners
    corners = 2 ** np.count_nonzero(facts.box.lower < facts.box.upper)
    if corners <= limit:
        yield words.CORNERS
    elif limit > 1:
        yield words.SOME_CORNERS(number=limit)
    proof = facts.limits.proof
    if proof is not None:
        yield words.PROOF(
            samples=proof.samples,
            bound=bound_in_words(proof.at_most),
        )
        if proof.not_simulated:
            yield words.NOT_SIMULATED(not_simulated=proof.not_simulated)
    yield condition(remark_on_phases(facts.own.in_phases))


def _numbers(facts: Told) -> JsonObject:
    """The numbers of the answer, by the names in `NUMBERS`. Numbers about joint limits are None if
    there are no joint limits.
    """
    numbers: JsonObject = dict.fromkeys(NUMBERS)
    numbers |= {
        "unsafe": str(facts.unsafe),
        "margin": facts.unsafe.keep,
        "kept": facts.kept,
        "rough": facts.is_rough,
        "scope": facts.scope,
        "boxes": int(facts.box is not None),
    }
    if facts.upper_end is not None:
        numbers["up_to"] = facts.upper_end.value
    if not facts.is_safe:
        return numbers
    fits = len(facts.task.fits)
    numbers |= {
        "box": facts.box is not None,
        "fits": fits - len(facts.limits.broken),
        "fits_tried": fits,
    }
    if facts.box is not None:
        numbers |= {"attacked": facts.attacked, "least_attacked": facts.least}
    if facts.limits.proof is not None:
        numbers |= facts.limits.proof._asdict()
    return numbers


def _failures(facts: Told) -> tuple[str, ...]:
    """The reasons for which a gate (a command that must succeed before a release) fails; () if it
    passes. A rough answer confirms no specified limit.
    """
    if not facts.is_safe:
        return (refusal_in_words(facts),)
    if facts.broken:
        return tuple(
            words.BROKEN.format(name=facts.members[column].short_name)
            for column in facts.broken
        )
    return (words.ROUGH,) if facts.is_rough and facts.stated else ()


def _limits_table(facts: Told) -> AnswerTable:
    """The table of the limits, with a row for each characteristic that varies. One screen shows
    only the characteristics with a joint limit.
    """
    rows = [_limits_row(facts, column) for column in facts.columns]
    # If there are joint limits, one screen shows them without the limits alone.
    end = LIMITS["alone_low"]._replace(is_detail=facts.box is not None)
    columns = {**LIMITS, "alone_low": end}
    frame = pd.DataFrame(rows, columns=list(columns))
    texts = frame["fails_first"].dropna()
    events = {text: text.removeprefix("the vehicle ") for text in texts}
    members = [facts.members[column] for column in facts.columns]
    domains = [(item.lower, item.upper) for item in members]
    joint = frame[["together_low", "together_high"]].to_numpy(float)
    is_open = (joint == np.array(domains)).all(axis=1)
    return tabulate(
        LIMITS_TITLE,
        columns,
        frame,
        words=events,
        # If no characteristic has a joint limit, the list is empty: one screen shows all rows.
        lead_rows=np.flatnonzero(~is_open).tolist(),
        bars=bars_of(frame, domains),
    )


def _limits_row(facts: Told, column: int) -> JsonObject:
    """The row of the table `LIMITS` for the characteristic in a column of settings."""
    item = facts.members[column]
    row: JsonObject = {
        **dict.fromkeys(LIMITS),
        "characteristic": item.name,
        "unit": item.unit,
        "original": item.original,
    }
    row["alone_low"], row["alone_high"] = facts.alone(column)
    row["specified_low"], row["specified_high"] = facts.specified(column)
    if facts.box is not None:
        row["together_low"] = float(facts.box.lower[column])
        row["together_high"] = float(facts.box.upper[column])
    if facts.specified(column) != (None, None):
        is_kept = column not in facts.broken
        row["kept"] = None if is_kept and facts.is_rough else is_kept
    failure = facts.failures.get(column)
    if failure is not None:
        row["fails_first"] = failure.words
        row["fails_at"] = _values_of(facts.own, failure)
        row["simulate"] = failure.command
    if facts.is_safe:
        row["sentence"] = _sentence(facts, column)
    return row


def _values_of(model: Model, failure: Failure) -> JsonObject:
    """The values of a failing vehicle by name. If encounters are ranges, the values of the
    encounter are added.
    """
    names = model.characteristics.names
    return dict(zip(names, failure.setting.tolist(), strict=False))


def _sentence(facts: Told, column: int) -> str:
    """The limit of a characteristic in a sentence for a maintenance manual. All these sentences
    together state the joint limits.
    """
    item = facts.members[column]
    box = facts.box
    name = item.short_name[:1].upper() + item.short_name[1:]
    if box is None:
        return words.MANUAL_NONE.format(name=name)
    original = limit_text(item, item.original)
    limit = limit_in_words(facts, box, column)
    failure = facts.failures.get(column)
    template = words.MANUAL
    values = event = ""
    if box.lower[column] == box.upper[column]:
        template = words.MANUAL_ORIGINAL
    elif not limit:
        template = words.MANUAL_ANY
    elif failure is not None:
        template = words.MANUAL_FAILURE
        values = _values_in_words(
            facts,
            box,
            column,
            failure,
        )
        event = failure.words
    return template.format(
        name=name,
        original=original,
        lower=f"{item.lower:.10g}",
        upper=limit_text(item, item.upper),
        limit=limit,
        values=values,
        event=event,
        scope=facts.scope,
    )


def _values_in_words(facts: Told, box: Box, column: int, failure: Failure) -> str:
    """The values of a vehicle that fails just beyond a joint limit, such as `tread depth at 1.5 mm
    and payload at 300 kg`. The value beyond the limit stands first. A value is left out if a reader
    can guess it: it is at the joint limit of its characteristic.
    """
    texts = list[str]()
    for number, item in enumerate(facts.members):
        value = float(failure.setting[number])
        text = f"{item.short_name} at {limit_text(item, value)}"
        # A reader expects a value at its only joint limit or, without a joint limit, the original
        # value.
        ends = {float(box.lower[number]), float(box.upper[number])}
        limits = ends - {item.lower, item.upper} or {item.original}
        is_said = len(limits) == 1 and np.isclose(value, list(limits))[0]
        if number == column:
            texts.insert(0, text)
        elif not is_said:
            texts.append(text)
    return join_phrases(texts)


def _fit_rows(facts: Told) -> Rows:
    """The rows of the table `FITS`: whether the limits hold in each parameter set, and the worst
    value that was found in it; NaN if it was not searched.
    """
    broken = facts.limits.broken
    states = dict.fromkeys(facts.task.fits, "kept")
    states |= dict.fromkeys(broken, "not kept")
    states |= {model.fit: "left out" for model in facts.task.exclusions}
    values = dict.fromkeys(states, np.nan)
    if facts.box is not None:
        for fit, attack in facts.limits.attacks.items():
            values[fit] = value_in(facts.unsafe, fit, attack.least)
    return [(fit, states[fit], values[fit]) for fit in sorted(states)]


def _nearest_rows(facts: Told, nearest: FloatArray | None) -> Rows:
    """The rows of the table `NEAREST`: for each end of a specified limit, the nearest safe value;
    None if there is no safe value.
    """
    rows = list[tuple[object, ...]]()
    if nearest is None:
        return rows
    for column in facts.stated:
        item = facts.members[column]
        for side, limit in enumerate(facts.specified(column)):
            value = finite_or_none(nearest[side, column])
            if limit is not None:
                rows.append((item.name, item.unit, limit, value))
    return rows


def _told_in_ranges(
    facts: Told, ranges: InRanges
) -> tuple[Sentence, tuple[object, ...]]:
    """A sentence and the row of the table `IN_RANGES`, which say whether the limits hold in the
    ranges of the study. If several vehicles fail, both name the failure at the lowest speed.
    """
    attacks = ranges.attacks.values()
    number = sum(attack.simulated for attack in attacks)
    unsafe = np.concatenate([attack.unsafe for attack in attacks])
    worst = worst_of(ranges.unsafe, ranges.attacks)
    model = ranges.task.oracle.own
    vehicle: tuple[object, ...] = (None, None)
    if len(unsafe):
        failure = _slowest_failure(facts, ranges.task.oracle, unsafe)
        event = words.SOME_UNSAFE
        if failure is not None:
            event = failure.words
            vehicle = _values_of(model, failure), failure.command
        sentence = words.RANGES_FAIL(event=event)
    elif worst is None:
        sentence = words.RANGES_UNKNOWN(number=number)
    else:
        keeps = ranges.unsafe.value_in_words(worst)
        sentence = words.RANGES_HOLD(number=number, keeps=keeps)
    scope = scope_of(model.evaluator.study)
    return sentence, (scope, not len(unsafe), sentence.text, *vehicle)


def _slowest_failure(facts: Told, oracle: Oracle, unsafe: FloatArray) -> Failure | None:
    """The failure of the unsafe case at the lowest speed. If no axis is a speed, the first axis
    decides instead.
    """
    members = oracle.own.characteristics
    axes = members.scenario.names
    axis = SPEED_DIMENSION if SPEED_DIMENSION in axes else axes[0]
    column = members.names.index(axis)
    settings = map(oracle.setting, unsafe)
    model, setting = min(settings, key=lambda pair: float(pair[1][column]))
    limits = facts.box or facts.box_of(facts.limits.specified)
    box = limits.in_encounters_of(model.evaluator.region)
    return describe(model, {"": setting}, box).get("")
