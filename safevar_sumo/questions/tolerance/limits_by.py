"""The answer with limits up to each of some values of a parameter: its table, its words, and its
picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.counterexamples import Failure, describe
from safevar_sumo.questions.falsify import USUAL_BUDGET, enough
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.reach import Reach
from safevar_sumo.questions.tables import Column, Columns, Wide, tabulate
from safevar_sumo.questions.tolerance.alone import AloneLimit, budget_alone
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.by_parameter import Parameter
from safevar_sumo.questions.tolerance.left_out import Contacts
from safevar_sumo.questions.tolerance.levels import Level, LevelSearch
from safevar_sumo.questions.tolerance.rows import ALONE, LIMITS, NOWHERE
from safevar_sumo.questions.tolerance.words import (
    contacts_in_words,
    one_set_in_words,
    rough_in_words,
    tested_in_words,
    why_not_kept,
)
from safevar_sumo.questions.words import constraints_in_words, counted_in_words, join_phrases
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.study import Limit, unit_text
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BETWEEN_STAGE = "specified limits between two values"
"""A phase of progress."""
UNSAFE_ORIGINAL = "the original vehicle itself is unsafe, or safe in no encounter"


def answer_by(asked: Asked, by: Parameter) -> Answer:
    """The answer with limits of each characteristic alone that hold up to each value of a
    parameter.
    """
    search = LevelSearch(asked, by)
    study = search.evaluator.study
    members = search.evaluator.characteristics
    # Limits alone end before failures of one characteristic that results hold.
    known = asked.unsafe_solutions
    is_changed = (known != members.original) & members.of_vehicle
    levels = search.levels(known[np.count_nonzero(is_changed, axis=1) == 1])
    with search.evaluator.stage(BETWEEN_STAGE):
        reach = search.reach(levels)
    contacts = search.contacts(levels)
    scopes = [by.scope(study, level.value, between=search.budget > 0) for level in levels]
    is_kept = _is_kept(search, levels, reach)
    values = ["alone", *(["kept"] if search.limits else [])]
    frame = tabulate(
        _title(by),
        columns_by(by),
        _rows(search, levels, scopes),
        wide=Wide(
            ["characteristic", "unit", "original"],
            f"by_{by.name}",
            values,
            f"to {{:g}}{unit_text(by.unit)}",
        ),
    )
    sentences = [*_sentences(search, levels, frame, reach, contacts), f"Scope: {scopes[-1]}."]
    tested = " ".join(_tested_sentences(search))
    return Answer(
        question="tolerance",
        study=study,
        verdict=" ".join(sentences),
        tested=tested,
        numbers={
            "unsafe": str(search.unsafe),
            "margin": search.unsafe.keep,
            "kept": is_kept,
            "rough": search.budget < USUAL_BUDGET,
            "scope": scopes[-1],
            **_numbers(levels, reach, search.unsafe),
            "up_to": reach.value,
            "original_keeps_up_to": search.original.keeps_up_to,
            "original_safe_up_to": search.original.safe_up_to,
            "contacts_left_out": None if contacts is None else contacts.number,
        },
        tables={"limits": frame},
        failures=_failed(search, reach, is_kept),
        draw=lambda answer: _draw(answer, search),
    )


def _is_kept(search: LevelSearch, levels: Sequence[Level], reach: Reach) -> bool | None:
    """Whether the specified limits hold up to the greatest value; without any, whether the original
    does. None where that was not tested.
    """
    if levels[0].alone is None:
        return False
    if search.limits and any(level.alone is None or level.failures for level in levels):
        return False
    if not search.budget:
        return None
    return not search.limits or reach.value == search.by.values[-1]


def _failed(search: LevelSearch, reach: Reach, is_kept: bool | None) -> tuple[str, ...]:
    """What makes the command end with exit code 3."""
    if is_kept:
        return ()
    if is_kept is None:
        return (why_not_kept(search.asked),) if search.limits else ()
    return (
        (
            f"the limits hold up to {_text(search.by, reach.value)}, not"
            f" {search.by.text(search.by.values[-1])}"
        ),
    )


def _numbers(levels: Sequence[Level], reach: Reach, unsafe: Unsafe) -> JsonObject:
    """Numbers about the limits up to the greatest value, and about the attack on the specified
    limits up to the value that they reach.
    """
    last = levels[-1]
    found = reach.falsification
    least = (
        None
        if found is None or not len(found.robustness)
        else unsafe.value(float(found.robustness[0]))
    )
    attacked = {"attacked": None if found is None else found.simulated, "least_attacked": least}
    members, left_out = last.models
    return {
        "fits": len(members),
        "fits_tried": len(members) + len(left_out),
        **attacked,
        "boxes": 0,
    }


def columns_by(by: Parameter) -> Columns:
    """The columns of the table, with that of the parameter behind the original."""
    own = {f"by_{by.name}": Column(by.unit, "value up to which the limits hold", ".6g")}
    names = [*LIMITS]
    place = names.index("original") + 1
    first = names[:place]
    rest = names[place:]
    texts = {
        "sentence": Column("", "for a maintenance manual", is_shown=False),
        "scope": Column("", "what the limits up to this value cover", is_shown=False),
    }
    return {
        **{name: LIMITS[name] for name in first},
        **own,
        **{name: LIMITS[name] for name in rest},
        **texts,
    }


def _title(by: Parameter) -> str:
    return f"Limits up to each {by.name.replace('_', ' ')}, {ALONE}, rounded to the safe side"


def _text(by: Parameter, value: float | None) -> str:
    return "none of these values" if value is None else by.text(value)


def _rows(
    search: LevelSearch, levels: Sequence[Level], scopes: Sequence[str]
) -> list[tuple[Any, ...]]:
    """A row for each characteristic and value."""
    failures = _failures(levels)
    members = search.evaluator.characteristics
    rows = list[tuple[Any, ...]]()
    for number, column in enumerate(search.columns):
        item = members.members[column]
        limit = search.limits.get(item.name)
        specified = NOWHERE if limit is None else (limit.at_least, limit.at_most)
        for level, scope in zip(levels, scopes, strict=True):
            alone = None if level.alone is None else level.alone[number]
            failure = failures.get((level.value, number))
            kept = None if limit is None else not level.failures and _holds(alone, limit)
            kept = None if kept and not search.budget else kept
            rows.append(
                (
                    *(item.name, item.unit, item.original, level.value),
                    *(NOWHERE if alone is None or alone.safe is None else alone.safe),
                    *(*NOWHERE, *specified, kept),
                    (
                        UNSAFE_ORIGINAL
                        if alone is None
                        else None
                        if failure is None
                        else failure.words
                    ),
                    None if failure is None else _setting(members, failure),
                    (
                        f"Up to {search.by.text(level.value)}{_of_counted(search, level.value)}, "
                        f"{_keep(item, alone)}. Scope: {scope}."
                    ),
                    scope,
                )
            )
    return rows


def _of_counted(search: LevelSearch, value: float) -> str:
    """Which encounters a claim up to a value is about, where the original does not keep its margin
    in all of them.
    """
    end = search.original.keeps_up_to
    if not search.is_searched or (end is not None and value <= end):
        return ""
    return (
        ", of the encounters in which the original keeps"
        f" {search.evaluator.study.scenario.margin:g} m"
    )


def _setting(members: CharacteristicSet, failure: Failure) -> JsonObject:
    """The vehicle that fails, and its encounter: searched values, or those of a point of the
    matrix.
    """
    return {**dict(zip(members.names, failure.setting.tolist(), strict=True)), **failure.point}


def _holds(alone: AloneLimit | None, limit: Limit) -> bool:
    """Whether a specified limit is safe alone."""
    if alone is None or alone.safe is None:
        return False
    low, high = alone.safe
    return (limit.at_least is None or limit.at_least >= low) and (
        limit.at_most is None or limit.at_most <= high
    )


def _keep(item: Characteristic, alone: AloneLimit | None) -> str:
    """What a limit demands: `with all others as in the original: brake torque at least 0.7`."""
    ends = None if alone is None else alone.safe
    if ends is None:
        return "no limit holds"
    low, high = ends
    name = item.short_name[:1].lower() + item.short_name[1:]
    if low == high:
        return f"no room for {name}: {low:.10g}{item.suffix}, as in the original"
    sides = (("at least", low, item.lower), ("at most", high, item.upper))
    keep = " and ".join(
        f"{word} {end:.10g}{item.suffix}" for word, end, last in sides if end != last
    )
    return f"with all others as in the original: {name} {keep or 'anywhere in its domain'}"


def _failures(levels: Sequence[Level]) -> dict[tuple[float, int], Failure]:
    """How each characteristic alone fails first, by value and number; failures of one model are
    driven together.
    """
    models = dict[int, Model]()
    settings = dict[int, dict[str, FloatArray]]()
    places = dict[tuple[float, int], tuple[int, str]]()
    for level in levels:
        for number, limit in enumerate(level.alone or ()):
            nearest = limit.nearest_failure
            if nearest is not None:
                setting, model = nearest
                place = id(model.evaluator), setting.tobytes().hex()
                models[place[0]] = model
                settings.setdefault(place[0], {})[place[1]] = setting
                places[level.value, number] = place
    found = {number: describe(model, settings[number]) for number, model in models.items()}
    return {
        key: found[model][name] for key, (model, name) in places.items() if name in found[model]
    }


def _sentences(
    search: LevelSearch,
    levels: Sequence[Level],
    frame: pd.DataFrame,
    reach: Reach,
    contacts: Contacts | None,
) -> Iterator[str]:
    """The sentences of the verdict, the allowed value first, then the original's own limit and what
    does not count.
    """
    by = search.by
    unsafe = search.unsafe
    points = search.evaluator.system.points
    names = dict.fromkeys(point.weather.name.replace("_", " ") for point in points)
    where = f"{rough_in_words(search.budget)}In {' or '.join(names)} weather"
    if search.limits and search.budget:
        what = join_phrases(_limit_texts(search))
        yield f"{where} with {what}, all others as in the original: up to {_text(by, reach.value)}."
    elif search.limits:
        yield (
            f"{where}, up to which value the specified limits hold was not tested:"
            f" {why_not_kept(search.asked)}."
        )
    else:
        yield (
            f"{where}, if all others stay as in the original: {'; '.join(_allowed(search, frame))}."
        )
    yield _original_in_words(search)
    if contacts is not None:
        yield from contacts_in_words(search.evaluator, contacts)
    values = f"{join_phrases(f'{value:g}' for value in by.values)}{unit_text(by.unit)}"
    members, left_out = levels[-1].models
    tried = len(members) + len(left_out)
    fits = f" in {len(members)} of {tried} parameter sets of the vehicle model" if tried > 1 else ""
    counted = _of_counted(search, by.values[-1])
    of_counted = f"{counted}," if counted else ""
    hold = "hold" if search.budget else "were only scanned"
    yield (
        f"The limits up to {values}{of_counted} {hold}{fits}:"
        f" {tested_in_words(unsafe, len(members))}."
    )
    yield from one_set_in_words(members, left_out)
    unsafe_from = next((level.value for level in levels if level.alone is None), None)
    if unsafe_from is not None:
        yield f"Up to {by.text(unsafe_from)} no limit holds: {UNSAFE_ORIGINAL}."


def _original_in_words(search: LevelSearch) -> str:
    """Up to which value the original vehicle itself keeps its margin, and touches nobody."""
    by = search.by
    study = search.evaluator.study
    keeps, safe = search.original
    margin = study.scenario.margin if search.is_searched else search.unsafe.keep
    if keeps == by.values[-1]:
        return f"The original vehicle keeps {margin:g} m of clearance up to {by.text(keeps)}."
    touches = "" if safe == keeps else f" and touches nobody up to {_text(by, safe)}"
    kept = f"{margin:g} m of clearance only up to {_text(by, keeps)}"
    return f"The original vehicle itself keeps {kept}{touches}."


def _tested_sentences(search: LevelSearch) -> Iterator[str]:
    """How the limits were tested, and what does not count."""
    texts = ["scans of each characteristic"]
    if search.budget and search.evaluator.study.scenario.search:
        count = f"{budget_alone(search.budget):,}"
        texts.append(f"{count} simulations for each limit that search for a counterexample")
    elif search.budget:
        texts.append("points between those of the study")
    if search.budget and search.limits:
        count = f"{enough(search.budget):,}"
        texts.append(f"{count} such simulations for the specified limits")
    text = join_phrases(texts)
    yield f"{text[:1].upper()}{text[1:]}."
    study = search.evaluator.study
    yield from counted_in_words(study)
    yield from constraints_in_words(study)


def _limit_texts(search: LevelSearch) -> Iterator[str]:
    """Specified limits in words: `treadDepth at least 3 mm`."""
    members = {item.name: item for item in search.evaluator.characteristics}
    for name, limit in search.limits.items():
        for word, end in (("at least", limit.at_least), ("at most", limit.at_most)):
            if end is not None:
                yield f"{name} {word} {end:.10g}{members[name].suffix}"


def _allowed(search: LevelSearch, frame: pd.DataFrame) -> Iterator[str]:
    """For each characteristic, up to which value it may go to the far end of its domain."""
    by = search.by
    for column in search.columns:
        item = search.evaluator.characteristics.members[column]
        rows = frame[frame["characteristic"] == item.name]
        is_low = item.original - item.lower >= item.upper - item.original
        is_whole = rows["alone_low"] <= item.lower if is_low else rows["alone_high"] >= item.upper
        whole = rows.loc[is_whole, f"by_{by.name}"].max()
        text = f"{item.name} {item.lower if is_low else item.upper:.10g}{item.suffix}"
        yield (
            f"{text} is unsafe already up to {by.text(by.values[0])}"
            if np.isnan(whole)
            else f"{text} is safe up to {by.text(whole)}"
        )


def _draw(answer: Answer, search: LevelSearch) -> Figure:
    """The limits across, the parameter upward, a panel for each characteristic."""
    from safevar_sumo.questions.figures import FONT_SIZE, as_formula, new_panels

    frame = answer.tables["limits"]
    by = search.by
    title = f"{answer.study.name}: limits alone up to each {by.name.replace('_', ' ')}"
    figure, axes = new_panels(
        title, len(search.columns), 4, (2.3, 1.75), min_width=4.6, title_height=1.1
    )
    for axis, column in zip(axes, search.columns, strict=True):
        item = search.evaluator.characteristics.members[column]
        if axis is not axes[0]:
            axis.sharey(axes[0])
        _draw_limits(axis, frame[frame["characteristic"] == item.name], by)
        axis.set_xlim(item.lower, item.upper)
        axis.set_title(item.name.replace("$", r"\$"), fontsize=FONT_SIZE)
        axis.set_xlabel(f"[{as_formula(item.unit)}]")
        axis.locator_params(axis="x", nbins=4)
    unit = f" [{as_formula(by.unit)}]" if by.unit else ""
    figure.supylabel(f"up to {by.name.replace('_', ' ')}{unit}", fontsize=FONT_SIZE)
    marks = "blue: limits alone; dotted: the original vehicle; line: specified"
    figure.supxlabel(marks, fontsize=FONT_SIZE)
    return figure


def _draw_limits(axis: Axes, rows: pd.DataFrame, by: Parameter) -> None:
    """The limits of one characteristic, a step for each value: what holds up to it holds from the
    value below on.
    """
    from safevar_sumo.questions.figures import BLUE, SKY_BLUE, VERMILION

    values = np.concatenate([[by.lowest], rows[f"by_{by.name}"].to_numpy(float)])
    low, high = (
        np.append(ends[:1], ends) for ends in rows[["alone_low", "alone_high"]].to_numpy(float).T
    )
    axis.fill_betweenx(values, low, high, step="pre", color=SKY_BLUE, alpha=0.6)
    for ends in (low, high):
        axis.step(ends, values, where="post", color=BLUE, linewidth=1.2)
    axis.axvline(rows["original"].iloc[0], color="black", linestyle=":", linewidth=1)
    for name in ("specified_low", "specified_high"):
        if not pd.isna(rows[name].iloc[0]):
            axis.axvline(rows[name].iloc[0], color=VERMILION, linewidth=1.5)
    axis.set_ylim(values[0], values[-1])


def check_by(by: str | None, unsafe: str | None, *, is_quick: bool = False) -> None:
    """Refuse options that do not go together with limits up to values of a parameter.

    Raises
    ------
    InputError
        If another criterion than the margin or a rough answer are asked for beside `by`.
    """
    if by is not None and is_quick:
        problem = f"a rough answer has no value of --by {by} up to which limits hold"
        raise InputError("quick", problem, "--quick without --by, or --by without --quick")
    if by is not None and unsafe is not None:
        legal = "limits that keep the margin (--margin), or the question without --by"
        raise InputError("by", f"{by!r} beside --unsafe {unsafe!r}", legal)
