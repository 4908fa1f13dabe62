"""The limits of each characteristic: what a workshop needs to know, in its unit and rounded to the
safe side.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import Failure, describe, limit_text
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.questions.tables import Column, Columns, Rows
from safevar_sumo.questions.tolerance.alone import AloneLimit
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.study import Limit
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

ALONE = "alone (only if all other parts are as new)"
"""Heading of the limits of one characteristic alone, which do not hold together."""
CHARACTERISTIC: Columns = {
    "characteristic": "characteristic of the vehicle",
    "unit": "unit of its values",
}
LIMITS_TITLE = "Limits, rounded to the safe side"
LIMITS: Columns = {
    **CHARACTERISTIC,
    "original": Column("", "value of the original vehicle", ".6g"),
    **{
        f"{name}_{end}": Column("", f"{end}est value {meaning}", ".10g", head=head)
        for name, meaning, head in (
            (
                "alone",
                "that is safe with all others as in the original, in every parameter set",
                ALONE,
            ),
            (
                "together",
                "that is safe with all others within theirs, in every parameter set",
                "limit, all together",
            ),
            ("specified", "that the user's limit allows", ""),
        )
        for end in ("low", "high")
    },
    "kept": (
        "whether every vehicle within the specified limits is safe in every parameter set; empty"
        " without a specified limit"
    ),
    "fails_first": Column("", "what fails first beyond the limit", head="just beyond it"),
    "fails_at": Column("", "the vehicle that fails, and its encounter", is_shown=False),
    "simulate": Column("", "the command that simulates it", is_detail=True),
    "sentence": Column(
        "",
        "sentence for a maintenance manual; all these limits hold at the same time",
        is_shown=False,
    ),
}
UNCERTAINTY: Columns = {
    **CHARACTERISTIC,
    **{
        f"{name}_{end}": Column("", f"{end}est value that is safe alone {meaning}", ".10g")
        for name, meaning in (
            ("own_fit", "at the points of the scan with the study's own parameter set"),
            (
                "alone",
                (
                    "in every parameter set, also between points, in all encounters that were met,"
                    " and in the search for counterexamples"
                ),
            ),
        )
        for end in ("low", "high")
    },
}
Ends = tuple[float | None, float | None]
NOWHERE: Ends = None, None


class LimitRows(NamedTuple):
    """The rows of the table of limits, and what is wrong with each of the user's limits that is not
    kept.

    Nothing is said of limits around an unsafe original.
    """

    rows: Rows
    broken: list[str]


def limit_rows(
    alone: Sequence[AloneLimit],
    together: LimitsTogether | None,
    limits: Mapping[str, Limit],
    models: Sequence[Model],
    scope: str,
    *,
    is_rough: bool,
) -> LimitRows:
    """The rows of the table of limits, whose sentences carry their scope.

    `together` is None around an unsafe original. None is called kept where
    the answer is rough.
    """
    beyond_alone = _failures_alone(alone)
    beyond = {} if together is None else _failures_beyond(together, models)
    rows = []
    broken = []
    for each in alone:
        item = each.characteristic
        name = item.name
        limit = limits.get(item.name)
        specified = NOWHERE if limit is None else (limit.at_least, limit.at_most)
        box = None if together is None else together.box
        members = models[0].characteristics
        column = members.names.index(name)
        ends = None if box is None else (float(box.lower[column]), float(box.upper[column]))
        failure = (beyond_alone if box is None else beyond).get(name)
        is_kept = None if limit is None else _is_kept(each, specified, together)
        if is_kept is False and each.safe is not None:
            broken.append(
                _broken_in_words(each, specified, together, beyond_alone.get(name), models)
            )
        rows.append(
            (
                *(name, item.unit, item.original),
                *(*(each.safe or NOWHERE), *(ends or NOWHERE), *specified),
                None if is_kept and is_rough else is_kept,
                None if failure is None else failure.words,
                None if failure is None else members.named(failure.setting),
                None if failure is None else failure.command,
                (
                    None
                    if together is None
                    else _sentence(item, box, members, beyond.get(name), scope)
                ),
            )
        )
    return LimitRows(rows, broken)


def uncertainty_rows(alone: Sequence[AloneLimit]) -> Rows:
    """A row of `UNCERTAINTY` for each characteristic whose limit alone is closer than in the
    scan.
    """
    return [
        (
            each.characteristic.name,
            each.characteristic.unit,
            *(each.of_own_fit or NOWHERE),
            *(each.safe or NOWHERE),
        )
        for each in alone
        if each.safe != each.of_own_fit
    ]


def _is_kept(alone: AloneLimit, specified: Ends, together: LimitsTogether | None) -> bool:
    """Whether a limit is safe alone, and with all specified limits in every parameter set."""
    return (
        alone.safe is not None
        and not _outside(alone, specified)[0]
        and not (together and together.broken)
    )


def _outside(alone: AloneLimit, specified: Ends) -> Interval:
    """How far the user's limit is outside what is safe alone [unit], 0 if it is inside, and the end
    that is.
    """
    assert alone.safe is not None
    ends = zip(specified, alone.safe, (-1, 1), strict=True)
    by = [(max(sign * (end - safe), 0.0), end) for end, safe, sign in ends if end is not None]
    return max(by, default=(0.0, alone.characteristic.original))


def _broken_in_words(
    alone: AloneLimit,
    specified: Ends,
    together: LimitsTogether | None,
    failure: Failure | None,
    models: Sequence[Model],
) -> str:
    """What is wrong with a limit: `brakeTorque 0.5: the car hits a pedestrian (outside by
    0.08)`.
    """
    item = alone.characteristic
    by, end = _outside(alone, specified)
    if by:
        members = models[0].characteristics
        # At the specified value itself the original encounter may be safe; then what fails beyond
        # the limit is said.
        for model in models:
            setting = members.setting({item.name: end})
            if found := describe(
                model, {item.name: setting}, Box(model.evaluator.region, setting, setting)
            ):
                failure = found[item.name]
                break
        words = "the car is unsafe" if failure is None else failure.words
        value = end if failure is None else failure.setting[members.names.index(item.name)]
        outside = limit_text(item, round(by, 9))
        return f"{item.name} {limit_text(item, value)}: {words} (outside by {outside})"
    assert together is not None
    model, setting = next(iter(together.broken.values()))
    found = describe(model, {item.name: setting}, together.specified)
    words = found[item.name].words if found else "the car is unsafe"
    specified_value = next(value for value in specified if value is not None)
    return f"{item.name} {limit_text(item, specified_value)}: with all specified limits, {words}"


def _failures_alone(alone: Iterable[AloneLimit]) -> dict[str, Failure]:
    """How each characteristic alone fails first, by its name."""
    failures = dict[str, Failure]()
    for each in alone:
        if each.nearest_failure is not None:
            setting, model = each.nearest_failure
            failures |= describe(model, {each.characteristic.name: setting})
    return failures


def _failures_beyond(together: LimitsTogether, models: Sequence[Model]) -> dict[str, Failure]:
    """How the car fails just beyond each limit of the box, by its name."""
    failures: dict[str, Failure] = {}
    names = models[0].characteristics.names
    waiting = {names[column]: setting for (_, column), setting in together.beyond.items()}
    for model in together.searched:
        if not waiting:
            break
        is_unsafe = model.are_unsafe(np.array([*waiting.values()]), "what fails first")
        of_model = {
            name: setting
            for (name, setting), fails in zip(waiting.items(), is_unsafe, strict=True)
            if fails
        }
        failures |= describe(model, of_model, together.box)
        waiting = {name: setting for name, setting in waiting.items() if name not in of_model}
    return failures


def _sentence(
    item: Characteristic,
    box: Box | None,
    members: CharacteristicSet,
    failure: Failure | None,
    scope: str,
) -> str:
    """A sentence for a maintenance manual: all of these may be obeyed together."""
    name = item.short_name[:1].upper() + item.short_name[1:]
    if box is None:
        return f"{name}: no joint limits were found."
    column = members.names.index(item.name)
    ends: Interval = float(box.lower[column]), float(box.upper[column])
    domain = (item.lower, item.upper)
    if ends[0] == ends[1]:
        return (
            f"{name}: {ends[0]:.10g}{item.suffix}, as in the original vehicle; no room was found"
            f" for it. Scope: {scope}."
        )
    keep = " and ".join(
        f"{word} {end:.10g}{item.suffix}"
        for word, end, last in zip(("at least", "at most"), ends, domain, strict=True)
        if end != last
    )
    if not keep:
        return (
            f"{name}: any value from {item.lower:.10g} to {item.upper:.10g}{item.suffix}. Scope:"
            f" {scope}."
        )
    beyond = ""
    if failure is not None:
        beyond = f" {_vehicle_in_words(item, box, members, failure)}, {failure.words}."
    return f"{name}: {keep}.{beyond} Scope: {scope}."


def _vehicle_in_words(
    item: Characteristic, box: Box, members: CharacteristicSet, failure: Failure
) -> str:
    """The vehicle that fails just beyond a limit: `At 0.81, with all others at their limits`, and
    which of the others are elsewhere.
    """
    named = list[str]()
    for other, value, low, high in zip(members, failure.setting, box.lower, box.upper, strict=True):
        # Others are at their limit, if they have one, and as in the original, if they have none.
        limits = [
            end for end, last in ((low, other.lower), (high, other.upper)) if end != last
        ] or [other.original]
        is_said = len(set(limits)) == 1 and np.isclose(value, limits[0])
        if other.name != item.name and not other.is_scenario and not is_said:
            named.append(f"{other.name} {limit_text(other, value)}")
    value = failure.setting[members.names.index(item.name)]
    others = "with all others at their limits"
    if named:
        others = f"with {join_phrases(named)} and all others at their limits"
    return f"At {limit_text(item, value)}, {others}"
