"""What is told about limits: a row for each characteristic, and the verdict."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.bars import bars_of, draw_bars
from safevar_sumo.questions.counterexamples import Failure, describe, limit_text
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Column, Columns, Rows, tabulate
from safevar_sumo.questions.tolerance.told import InRanges, Told
from safevar_sumo.questions.tolerance.words import (
    broken_in_words,
    refusal_in_words,
    tested_sentences,
    verdict_sentences,
)
from safevar_sumo.questions.words import (
    constraints_in_words,
    counted_in_words,
    join_phrases,
)
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.scenarios import SPEED_DIMENSION
from safevar_sumo.vehicles import Characteristic

NUMBERS = (
    *("unsafe", "margin", "kept", "rough", "scope", "up_to", "box", "boxes"),
    *("samples", "failures", "at_most", "not_simulated", "fits", "fits_tried"),
    *("attacked", "least_attacked"),
)
MEANINGS = {
    "alone": (
        "that is safe with all others as in the original, in every parameter set",
        "alone (only if all other parts are as new)",
    ),
    "together": (
        "that is safe with all others within theirs, in every parameter set",
        "limit, all together",
    ),
    "specified": ("that the user's limit allows", ""),
}
CHARACTERISTIC: Columns = {
    "characteristic": "characteristic of the vehicle",
    "unit": "unit of its values",
}
LIMITS: Columns = {
    **CHARACTERISTIC,
    "original": Column("", "value of the original vehicle", ".6g"),
    **{
        f"{name}_{end}": Column("", f"{end}est value {meaning}", ".10g", head=head)
        for name, (meaning, head) in MEANINGS.items()
        for end in ("low", "high")
    },
    "kept": (
        "whether every vehicle within the specified limits is safe in every parameter set; empty"
        " without a specified limit"
    ),
    "fails_first": Column(
        "", "what fails first beyond the limit", head="just beyond it"
    ),
    "fails_at": Column("", "the vehicle that fails, and its encounter", is_shown=False),
    "simulate": Column("", "the command that simulates it", is_detail=True),
    "sentence": Column(
        "",
        "sentence for a maintenance manual; all these limits hold at the same time",
        is_shown=False,
    ),
}
LIMITS_TITLE = "Limits, rounded to the safe side"
FITS: Columns = {
    "fit": Column(
        "-", "number of the parameter set in [spread]; 0 is the study's own", "d"
    ),
    "specified": (
        "whether the specified limits hold in it; left out: the original is unsafe or keeps too"
        " little"
    ),
    "least": Column(
        "",
        "smallest clearance that the search found [m], or the worst value of a metric",
        ".2f",
    ),
}
NEAREST: Columns = {
    **CHARACTERISTIC,
    "limit": Column("", "the specified value", ".10g"),
    "nearest": Column(
        "",
        "the nearest value with which joint limits exist, the others as specified",
        ".10g",
    ),
}
IN_RANGES: Columns = {
    "scope": "what they cover",
    "kept": "whether the limits above hold there in every parameter set",
    "verdict": "what a search for counterexamples found there",
    "fails_at": Column(
        "", "the vehicle that fails first, and its encounter", is_shown=False
    ),
    "simulate": Column("", "the command that simulates it", is_detail=True),
}
ROUGH = (
    "a rough answer calls no limit kept: ask without --quick, or for more simulations"
)


def answer_limits(
    told: Told, nearest: FloatArray | None, ranges: InRanges | None
) -> Answer:
    """The answer with limits alone and joint limits."""
    tables = {"limits": _limits_table(told)}
    tried = len(told.asked.fits) + len(told.asked.left_out)
    if told.is_safe and tried > 1:
        title = "The limits in each parameter set of the vehicle model"
        tables["fits"] = tabulate(title, FITS, _fit_rows(told))
    near = _nearest_rows(told, nearest)
    if near:
        tables["nearest"] = tabulate("Limits that would do", NEAREST, near)
    in_ranges = [] if ranges is None else [_row_in_ranges(told, ranges)]
    if in_ranges:
        title = "The same limits in the ranges of the study"
        tables["ranges"] = tabulate(title, IN_RANGES, in_ranges)
    sentences = verdict_sentences(told, near, in_ranges)
    counted = counted_in_words(told.study), constraints_in_words(told.study)
    return Answer(
        question="tolerance",
        study=told.study,
        verdict=" ".join(sentences),
        tested=" ".join([*tested_sentences(told), *counted[0], *counted[1]]),
        numbers=_numbers(told),
        tables=tables,
        failures=_failures(told),
        draw=draw_bars,
    )


def _numbers(told: Told) -> JsonObject:
    """The numbers of an answer; those about joint limits are undefined without such limits."""
    found, proof = told.limits, told.limits.proof
    numbers: JsonObject = dict.fromkeys(NUMBERS)
    numbers |= {
        "unsafe": str(told.unsafe),
        "margin": told.unsafe.keep,
        "kept": told.kept,
    }
    numbers |= {
        "rough": told.is_rough,
        "scope": told.scope,
        "boxes": int(told.box is not None),
    }
    if told.up_to is not None:
        numbers["up_to"] = float(told.up_to.partition("=")[2])
    if not told.is_safe:
        return numbers
    tried = len(told.asked.fits)
    numbers |= {
        "box": told.box is not None,
        "fits": tried - len(found.broken),
        "fits_tried": tried,
    }
    if told.box is not None:
        attacked = sum(attack.simulated for attack in found.attacks.values())
        numbers |= {"attacked": attacked, "least_attacked": told.least}
    if proof is not None:
        numbers |= {"samples": proof.samples, "failures": proof.failures}
        numbers |= {"at_most": proof.at_most, "not_simulated": proof.not_simulated}
    return numbers


def _failures(told: Told) -> tuple[str, ...]:
    """Why a gate must not pass."""
    if not told.is_safe:
        return (refusal_in_words(told),)
    if told.broken:
        return tuple(f"limit of {text}" for text in broken_in_words(told))
    is_stated = not np.isnan(told.asked.given).all()
    return (ROUGH,) if told.is_rough and is_stated else ()


def _limits_table(told: Told) -> pd.DataFrame:
    """The row of each characteristic that varies; the screen shows those that are limited."""
    rows = [_limits_row(told, column) for column in told.columns]
    # Joint limits lead, without those of each alone.
    end = LIMITS["alone_low"]
    assert isinstance(end, Column)
    shown = {**LIMITS, "alone_low": end._replace(is_detail=told.box is not None)}
    texts = [text for row in rows if (text := row["fails_first"])]
    words = {text: text.removeprefix("the car ") for text in texts}
    table = tabulate(
        LIMITS_TITLE, shown, [[*row.values()] for row in rows], words=words
    )
    members = [told.members[column] for column in told.columns]
    domains = [(item.lower, item.upper) for item in members]
    joint = table[["together_low", "together_high"]].to_numpy(float)
    is_open = (joint == np.array(domains)).all(axis=1)
    if not is_open.all():
        table.attrs["lead_rows"] = np.flatnonzero(~is_open).tolist()
    table.attrs["bars"] = bars_of(table, domains)
    return table


def _limits_row(told: Told, column: int) -> JsonObject:
    """A row of `LIMITS`."""
    item = told.members[column]
    row: JsonObject = {
        **dict.fromkeys(LIMITS),
        "characteristic": item.name,
        "unit": item.unit,
    }
    row["original"] = item.original
    row["alone_low"], row["alone_high"] = told.alone(column)
    row["specified_low"], row["specified_high"] = told.given(column)
    if told.box is not None:
        row["together_low"] = float(told.box.lower[column])
        row["together_high"] = float(told.box.upper[column])
    if told.given(column) != (None, None):
        is_kept = column not in told.broken
        row["kept"] = None if is_kept and told.is_rough else is_kept
    failure = told.failures.get(column)
    if failure is not None:
        row["fails_first"] = failure.words
        row["fails_at"] = _values_of(told, failure)
        row["simulate"] = failure.command
    if told.is_safe:
        row["sentence"] = _sentence(told, column)
    return row


def _values_of(told: Told, failure: Failure) -> JsonObject:
    """The vehicle that fails, with its encounter where encounters are ranges."""
    names = told.own.characteristics.names
    return dict(zip(names, failure.setting.tolist(), strict=False))


def _sentence(told: Told, column: int) -> str:
    """A sentence for a maintenance manual: all of these may be obeyed together."""
    item, box = told.members[column], told.box
    name = item.short_name[:1].upper() + item.short_name[1:]
    if box is None:
        return f"{name}: no joint limits were found."
    ends = float(box.lower[column]), float(box.upper[column])
    if ends[0] == ends[1]:
        value = limit_text_of(item, ends[0])
        return (
            f"{name}: {value}, as in the original vehicle; no room was found for it. Scope:"
            f" {told.scope}."
        )
    domain = item.lower, item.upper
    demands = [
        f"{word} {limit_text_of(item, end)}"
        for word, end, last in zip(("at least", "at most"), ends, domain, strict=True)
        if end != last
    ]
    if not demands:
        span = f"from {item.lower:.10g} to {limit_text_of(item, item.upper)}"
        return f"{name}: any value {span}. Scope: {told.scope}."
    beyond = ""
    failure = told.failures.get(column)
    if failure is not None:
        beyond = f" {_vehicle_in_words(told, column, failure)}, {failure.words}."
    return f"{name}: {' and '.join(demands)}.{beyond} Scope: {told.scope}."


def limit_text_of(item: Characteristic, value: float) -> str:
    """A limit in a sentence."""
    return f"{value:.10g}{item.suffix}"


def _vehicle_in_words(told: Told, column: int, failure: Failure) -> str:
    """The vehicle that fails just beyond a limit: `At 0.81, with all others at their limits`, and
    which of the others are elsewhere.
    """
    box = told.box
    assert box is not None
    elsewhere = list[str]()
    for other, item in enumerate(told.members):
        value = float(failure.setting[other])
        # Others are at their limit, if they have one, and as in the original, if they have none.
        ends = ((box.lower[other], item.lower), (box.upper[other], item.upper))
        limits = {float(end) for end, last in ends if end != last} or {item.original}
        is_said = len(limits) == 1 and np.isclose(value, [*limits])[0]
        if other != column and not is_said:
            elsewhere.append(f"{item.name} {limit_text(item, value)}")
    others = "with all others at their limits"
    if elsewhere:
        others = f"with {join_phrases(elsewhere)} and all others at their limits"
    value = float(failure.setting[column])
    return f"At {limit_text(told.members[column], value)}, {others}"


def _fit_rows(told: Told) -> Rows:
    """A row of `FITS` for each parameter set."""
    attacks, broken = told.limits.attacks, told.limits.broken
    states = {fit: "not kept" if fit in broken else "kept" for fit in told.asked.fits}
    states |= {model.fit: "left out" for model in told.asked.left_out}
    least = {fit: told.value_in(fit) for fit in attacks} if told.box is not None else {}
    return [
        (fit, state, least.get(fit, np.nan)) for fit, state in sorted(states.items())
    ]


def _nearest_rows(told: Told, nearest: FloatArray | None) -> Rows:
    """A row of `NEAREST` for each end of a specified limit."""
    if nearest is None:
        return []
    rows = []
    for column in told.columns:
        item = told.members[column]
        for given, value in zip(
            told.given(column), nearest[:, column].tolist(), strict=True
        ):
            if given is not None:
                found = None if np.isnan(value) else value
                rows.append((item.name, item.unit, given, found))
    return rows


def _row_in_ranges(told: Told, ranges: InRanges) -> tuple[object, ...]:
    """The row of `IN_RANGES`; of several failures that at the lowest speed."""
    own = ranges.asked.oracle.own
    scope = scope_of(own.evaluator.study)
    simulated = sum(attack.simulated for attack in ranges.attacks)
    least = min(attack.least for attack in ranges.attacks)
    unsafe = [case for attack in ranges.attacks for case in attack.unsafe]
    if not np.isfinite(least):
        verdict = f"none of {simulated:,} simulations met an encounter that counts."
        return (scope, True, verdict, None, None)
    if not unsafe:
        keeps = ranges.unsafe.value_in_words(ranges.unsafe.value(least))
        searched = f"{simulated:,} simulations that search for a counterexample"
        return (
            scope,
            True,
            f"the limits hold: the worst of {searched} {keeps}.",
            None,
            None,
        )
    axes = own.characteristics.scenario.names
    axis = own.characteristics.names.index(
        SPEED_DIMENSION if SPEED_DIMENSION in axes else axes[0]
    )
    settings = [ranges.asked.oracle.setting(case) for case in unsafe]
    model, setting = min(settings, key=lambda pair: float(pair[1][axis]))
    limits = told.box or told.box_of(told.limits.specified)
    within = limits.in_encounters_of(model.evaluator.region)
    failure = describe(model, {"": setting}, within).get("")
    if failure is None:
        return (
            scope,
            False,
            "they do not hold: a car within them is unsafe.",
            None,
            None,
        )
    values = dict(
        zip(own.characteristics.names, failure.setting.tolist(), strict=False)
    )
    return (
        scope,
        False,
        f"they do not hold: {failure.words}.",
        values,
        failure.command,
    )
