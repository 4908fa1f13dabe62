"""The limits of each characteristic: what a workshop needs to know, in its unit and rounded to the safe side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.questions.tables import Column, Columns
from safevar_sumo.questions.tolerance.alone import AloneLimit
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.records import KMH_PER_MS, FloatArray, JsonObject
from safevar_sumo.scenarios import FROM_CENTRES, Scenario
from safevar_sumo.study import Limit
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

CHARACTERISTIC: Columns = {"characteristic": "characteristic of the vehicle", "unit": "unit of its values"}
LIMITS: Columns = {
    **CHARACTERISTIC,
    "original": Column("", "value of the original vehicle", ".6g"),
    **{
        f"{name}_{end}": Column("", f"{end}est value {meaning}", ".10g")
        for name, meaning in (
            ("alone", "that is safe with all others as in the original, with every fit"),
            ("together", "that is safe with all others within theirs, with every fit"),
            ("specified", "that the user's limit allows"),
        )
        for end in ("low", "high")
    },
    "kept": "whether the car is safe within the specified limits with every fit; empty without one",
    "fails_first": Column("", "what fails first beyond the limit", is_shown=False),
    "fails_at": Column("", "the vehicle that fails, and its encounter", is_shown=False),
    "sentence": "for a maintenance manual; all of these may be obeyed together",
}
UNCERTAINTY: Columns = {
    **CHARACTERISTIC,
    **{
        f"{name}_{end}": Column("", f"{end}est value that is safe alone {meaning}", ".10g")
        for name, meaning in (
            ("own_fit", "at the points of the scan with the study's own fit"),
            ("alone", "with every fit, also between points, in all encounters that were met, and under the attack"),
        )
        for end in ("low", "high")
    },
}
Ends = tuple[float | None, float | None]
NOWHERE: Ends = None, None


class Failure(NamedTuple):
    """An unsafe setting, how it fails, in words, and the parameters of the point of the matrix where it does."""

    setting: FloatArray
    words: str
    point: JsonObject


class LimitRows(NamedTuple):
    """The rows of the table of limits, and what is wrong with each of the user's limits that is not kept.

    Nothing is said of limits around an unsafe original.
    """

    rows: list[tuple[Any, ...]]
    broken: list[str]


def limit_rows(
    alone: Sequence[AloneLimit], together: LimitsTogether | None, limits: Mapping[str, Limit], models: Sequence[Model]
) -> LimitRows:
    """The rows of the table of limits.

    `together` is None in a rated study, and around an unsafe original.
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
        column = models[0].evaluator.characteristics.names.index(name)
        ends = None if box is None else (float(box.lower[column]), float(box.upper[column]))
        failure = beyond.get(name) or beyond_alone.get(name)
        is_kept = None if limit is None else _is_kept(each, specified, together)
        if is_kept is False and each.safe is not None:
            broken.append(_broken_in_words(each, specified, together, beyond_alone.get(name), models))
        members = models[0].evaluator.characteristics
        rows.append(
            (
                *(name, item.unit, item.original),
                *(*(each.safe or NOWHERE), *(ends or NOWHERE), *specified),
                is_kept,
                None if failure is None else failure.words,
                None if failure is None else dict(zip(members.names, failure.setting.tolist(), strict=True)),
                None if together is None else _sentence(item, box, members, beyond.get(name)),
            )
        )
    return LimitRows(rows, broken)


def uncertainty_rows(alone: Sequence[AloneLimit]) -> list[tuple[Any, ...]]:
    """A row of `UNCERTAINTY` for each characteristic whose limit alone is closer than in the scan."""
    return [
        (each.characteristic.name, each.characteristic.unit, *(each.of_own_fit or NOWHERE), *(each.safe or NOWHERE))
        for each in alone
        if each.safe != each.of_own_fit
    ]


def _is_kept(alone: AloneLimit, specified: Ends, together: LimitsTogether | None) -> bool:
    """Whether a limit is safe alone, and with all specified limits in every fit."""
    return alone.safe is not None and not _outside(alone, specified)[0] and not (together and together.broken)


def _outside(alone: AloneLimit, specified: Ends) -> tuple[float, float]:
    """How far the user's limit is outside what is safe alone [unit], 0 if it is inside, and the end that is."""
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
    """What is wrong with a limit: `brakeTorque 0.5: the car hits a pedestrian (outside by 0.08)`."""
    item = alone.characteristic
    by, end = _outside(alone, specified)
    name = f"{item.name} {next(value for value in specified if value is not None):.10g}{item.suffix}"
    if by:
        members = models[0].evaluator.characteristics
        setting = members.setting({item.name: end})
        for model in models:
            if model.are_unsafe(setting[np.newaxis], "what fails first")[0]:
                failure = describe(model, {item.name: setting})[item.name]
                break
        words = "the car is unsafe" if failure is None else failure.words
        value = end if failure is None else failure.setting[members.names.index(item.name)]
        shown = f"{value:.10g}{item.suffix}" if value == end else _text_beyond(item, value)
        return f"{item.name} {shown}: {words} (outside by {by:.10g}{item.suffix})"
    assert together is not None
    fits = {model.fit: model for model in models}
    fit, setting = next(iter(together.broken.items()))
    return f"{name}: with all specified limits, {describe(fits[fit], {'': setting})[''].words}"


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
    names = models[0].evaluator.characteristics.names
    waiting = {names[column]: setting for (_, column), setting in together.beyond.items()}
    for model in together.searched:
        if not waiting:
            break
        is_unsafe = model.are_unsafe(np.array([*waiting.values()]), "what fails first")
        of_model = {name: setting for (name, setting), fails in zip(waiting.items(), is_unsafe, strict=True) if fails}
        failures |= describe(model, of_model)
        waiting = {name: setting for name, setting in waiting.items() if name not in of_model}
    return failures


def describe(model: Model, settings: Mapping[str, FloatArray]) -> dict[str, Failure]:
    """How unsafe settings of a model fail at their worst points, by the same names."""
    if not settings:
        return {}
    points = assemble(model.evaluator.study).points
    members = model.evaluator.characteristics
    points = tuple(points[number] for number in model.points) or points
    runs = model.evaluate(np.array(list(settings.values())), "what fails first")
    worst = np.zeros(len(runs), dtype=int) if runs.worst_points is None else runs.worst_points
    fit = f" (fit {model.fit} of the vehicle)" if model.fit else ""
    failures = {}
    rows = zip(settings.items(), worst.tolist(), runs.collided, runs.f_safe, strict=True)
    for (name, setting), point, collided, degree in rows:
        values = dict(zip(members.scenario.names, setting[~members.of_vehicle].tolist(), strict=True))
        scenario = encounter(points[point], values).scenario
        words = _failure_in_words(scenario, model.unsafe, bool(collided), degree) + fit
        failures[name] = Failure(setting, words, dict(points[point].parameters))
    return failures


def _failure_in_words(scenario: Scenario, unsafe: Unsafe, collided: bool, degree: float) -> str:
    """A failure at a safety degree, such as `the car hits a pedestrian with 12 km/h in the test at 40 km/h`."""
    if unsafe.is_of_points:  # points are of the whole matrix
        return f"the car {unsafe.in_words}"
    test = "" if scenario.test_speed is None else f" in the test at {KMH_PER_MS * scenario.test_speed:.3g} km/h"
    if unsafe.bound is not None and not collided:
        return f"the car {unsafe.in_words}{test}"
    if collided:
        impact_speed = -KMH_PER_MS * degree  # nearly 0 at the limit itself: then it says nothing
        impact = "" if impact_speed < 1 else f" with {impact_speed:.2g} km/h"
        return f"the car hits {scenario.obstacle()}{impact}{test}"
    measured = FROM_CENTRES if unsafe.contact and unsafe.below else ""
    return f"the car keeps less than {unsafe.below or unsafe.keep:.3g} m{measured} from {scenario.obstacle()}{test}"


def _sentence(item: Characteristic, box: Any, members: CharacteristicSet, failure: Failure | None) -> str:
    """A sentence for a maintenance manual: all of these may be obeyed together."""
    name = item.short_name[:1].upper() + item.short_name[1:]
    if box is None:
        return f"{name}: no limits together were found."
    column = members.names.index(item.name)
    ends: Interval = float(box.lower[column]), float(box.upper[column])
    domain = (item.lower, item.upper)
    if ends[0] == ends[1]:
        return f"{name}: keep {ends[0]:.10g}{item.suffix}, as in the original: no room was found for it."
    keep = " and ".join(
        f"{word} {end:.10g}{item.suffix}"
        for word, end, last in zip(("at least", "at most"), ends, domain, strict=True)
        if end != last
    )
    if not keep:
        return f"{name}: anything from {item.lower:.10g} to {item.upper:.10g}{item.suffix}."
    beyond = "" if failure is None else f"; {_vehicle_in_words(item, box, members, failure)}, {failure.words}"
    return f"{name}: keep {keep}{beyond}."


def _vehicle_in_words(item: Characteristic, box: Any, members: CharacteristicSet, failure: Failure) -> str:
    """The vehicle that fails just beyond a limit: `at 0.81`, with what the table's title does not say of the others."""
    others = [number for number, member in enumerate(members) if not member.is_scenario and member.name != item.name]
    values = failure.setting[others]
    is_corner = bool((np.isclose(values, box.lower[others]) | np.isclose(values, box.upper[others])).all())
    value = failure.setting[members.names.index(item.name)]
    named = [
        f"{members.members[number].name} {_limit_text(members.members[number], failure.setting[number])}"
        for number in others
        if failure.setting[number] != members.original[number]
    ]
    rest = "" if is_corner else ", ".join(named)
    return f"at {_text_beyond(item, value)}{f', with {rest}' if rest else ''}"


def _limit_text(item: Characteristic, value: float) -> str:
    """A value with the digits of a limit: limits are rounded once, and written without further zeros, as in tables."""
    return f"{round(value, item.digits):.10g}{item.suffix}"


def _text_beyond(item: Characteristic, value: float) -> str:
    """A value beyond a limit with the digits of the limit, which it does not become by rounding."""
    return _limit_text(item, item.rounded(value, upwards=value > item.original))
