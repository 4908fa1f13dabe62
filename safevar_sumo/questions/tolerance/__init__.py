"""How far may each characteristic go alone, and together with all others: in the largest safe box?

The filter of small changes is not applied, as the question is about the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pandas as pd

from safevar_sumo.errors import check_name
from safevar_sumo.metrics import RATING_POINTS, Unsafe, margin_of
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import Criterion, Margin, Range, question
from safevar_sumo.questions.evaluator import CONFIDENCE, Evaluator
from safevar_sumo.questions.model_spread import across
from safevar_sumo.questions.tables import Column, Columns, tabulate, with_interval
from safevar_sumo.questions.tolerance.boxes import MET_BY_CORNERS, random_settings
from safevar_sumo.questions.tolerance.joint import JointLimits, find_joint_limits
from safevar_sumo.questions.tolerance.rows import limit_rows
from safevar_sumo.questions.tolerance.scans import WHOLE_POINT_LOSS, OneAtATimeScan, scan
from safevar_sumo.questions.words import constraints_in_words, counted_in_words, join_phrases
from safevar_sumo.records import FloatArray
from safevar_sumo.study import SAFETY_DEGREE, Limit, Study, limits_of
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from safevar_sumo.questions.case import Case

CHARACTERISTIC: Columns = {"characteristic": "characteristic of the vehicle", "unit": "unit of its values"}
LIMITS: Columns = {
    **CHARACTERISTIC,
    "original": Column("", "value of the original vehicle", ".6g"),
    **{
        f"{name}_{end}": Column("", f"{end}est value {meaning}", ".10g")
        for name, meaning in (
            ("alone", "that is safe with all others as in the original"),
            ("together", "that is safe with all others within theirs"),
            ("specified", "that the user's limit allows"),
        )
        for end in ("low", "high")
    },
    "kept": "whether the car is safe within the specified limits, alone and together",
    "fails_first": Column("", "what fails first beyond the limit", is_shown=False),
    "sentence": "for a maintenance manual; all of these may be obeyed together",
}
INTERVALS: Columns = {
    **CHARACTERISTIC,
    "state": "safe, unsafe, not_simulated, or infeasible: a constraint is violated",
    "low": Column("", "first simulated value that is so, all others as in the original", ".6g"),
    "high": Column("", "last one", ".6g"),
    "degree_low": Column("m", "safety degree at the first value; in -m/s on a collision", ".2f"),
    "degree_high": Column("m", "safety degree at the last value; in -m/s on a collision", ".2f"),
}
FITS: Columns = {
    **CHARACTERISTIC,
    "end": "low or high end of what is safe alone",
    **with_interval("alone", Column("", "this end, not rounded; the interval holds it with all fits", ".4g")),
    "fits": Column("-", "number of fits with which the original is safe, so that there is an end"),
}
POINTS: Columns = {
    **CHARACTERISTIC,
    "any_lost": Column("", "value nearest to the original that loses points", ".5g"),
    "first_point_lost": Column("", "value nearest to the original that loses a whole point", ".5g"),
    "least_points": Column("-", "fewest points anywhere in the domain", ".2f"),
}


NUMBERS_OF_BOX = {"samples": "samples", "failures": "unsafe", "at_most": "at_most", "not_simulated": "failed"}
"""The fields of `JointLimits` by their names among the numbers."""


@question
def tolerance(
    subject: Study | Case,
    evaluator: Evaluator,
    *,
    limits: Annotated[tuple[str, ...], '"NAME >= X"'] = (),
    characteristics: Annotated[tuple[str, ...], "A,B"] = (),
    margin: Margin = None,
    unsafe: Criterion = None,
    fits: Annotated[int, Range(0, 1000)] = 12,
) -> Answer:
    """Find how far each characteristic may go: alone, and all together.

    The limits together hold none of the unsafe solutions of results. In a study that searches its scenario they hold in
    all encounters in which the original vehicle is safe, and end at contact unless a margin is stated.

    Parameters
    ----------
    limits
        A limit in the characteristic's unit, such as "treadDepth >= 3", beside those of [limits] in the study; may be
        repeated. All others get the largest box that is safe then; exit code 3 if a limit is not kept.
    characteristics
        Only these characteristics, separated by commas; all others keep their values. By default all.
    margin
        Distance to keep from a collision [m], between bumpers where the safety degree is from centre to centre; by
        default the model's error that the study states, else 0.3 m.
    unsafe
        What is unsafe: a collision, a safety degree below X, or at most X points of a rating.
    fits
        Number of vehicle models that fit the published data about as well (sets of [spread]) with which each
        characteristic is scanned again; 0 leaves this out.
    """
    study, system = evaluator.study, assemble(evaluator.study)
    members = evaluator.characteristics
    columns = _columns_of(members.vehicle.names, characteristics)
    everywhere = {item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario}
    all_columns = [*columns, *np.flatnonzero(~members.of_vehicle).tolist()]
    specified = _limits_of(study, limits, columns)
    original = evaluator.evaluate_original()
    criterion = evaluator.choose_criterion(unsafe, subject, original)
    # A collision that is asked for stands alone; and the original's margin is what wear may use up in an encounter.
    has_margin = margin is not None or (unsafe is None and not everywhere)
    if criterion == Unsafe() and has_margin:
        criterion = replace(criterion, keep=margin_of(study, margin))
    criterion = replace(criterion, contact=contact_degree(system))
    # A box of a rated study would take thousands of whole test matrices.
    is_sought = not is_rated(study)
    bounds = members.lower, members.upper
    if is_sought:  # drawing a setting raises the error if hardly any is feasible, before the long scans
        random_settings(evaluator, columns, *bounds, 1, np.random.default_rng(study.search.seed))
    scans, *others = across(
        evaluator, fits if is_sought else 0, lambda each: scan(each, columns, criterion, coarse=each is not evaluator)
    )
    box = None
    if is_sought and not criterion.of(original)[0]:
        known = [_unsafe_solutions(subject, all_columns, criterion), _unsafe_alone(evaluator, scans)]
        limits_of_box = {**specified, **everywhere}
        box = find_joint_limits(evaluator, all_columns, criterion, limits_of_box, scans, np.concatenate(known))
    rows, broken = limit_rows(evaluator, scans, box, specified, criterion)
    numbers = {
        "unsafe": str(criterion),
        "margin": criterion.keep,
        "kept": not broken,
        **{name: getattr(box, field, None) for name, field in NUMBERS_OF_BOX.items()},
    }
    tables = {
        "limits": tabulate("Limits, rounded to the safe side", LIMITS, rows),
        "intervals": tabulate("Each alone, all others as in the original", INTERVALS, _intervals(scans)),
    }
    if others:
        tables["fits"] = tabulate("Ends over the fits of published data", FITS, _ends_over_fits([scans, *others]))
    if is_rated(study):
        tables["points"] = tabulate("Points lost by each alone", POINTS, _lost_points(scans))
    return Answer(
        question="tolerance",
        study=study,
        verdict=" ".join(
            [
                *_verdict(scans, box, criterion, broken, bool(specified), bool(everywhere)),
                *counted_in_words(study),
                *constraints_in_words(study),
            ]
        ),
        numbers=numbers,
        tables=tables,
        failures=tuple(f"limit of {text}" for text in broken),
        draw=partial(_draw, scans=scans),
    )


def _columns_of(names: Sequence[str], characteristics: Sequence[str]) -> list[int]:
    chosen = [name.strip() for text in characteristics for name in text.split(",")]
    for name in chosen:
        check_name("characteristics", f"there is no characteristic {name!r}", name, names)
    return [column for column, name in enumerate(names) if not chosen or name in chosen]


def _limits_of(study: Study, texts: Sequence[str], columns: Sequence[int]) -> dict[str, Limit]:
    """The limits of the study and of the option for the characteristics that vary."""
    rows = study.vehicle.characteristics
    varied = [list(rows)[column] for column in columns]
    for name in limits_of(texts, rows):
        check_name("limits", f"{name} does not vary with these --characteristics", name, varied)
    return {name: limit for name, limit in limits_of(texts, rows, study.limits).items() if name in varied}


def _unsafe_alone(evaluator: Evaluator, scans: Sequence[OneAtATimeScan]) -> FloatArray:
    """The ends of the unsafe intervals as settings, shape (K, n), each in its worst encounter."""
    characteristics = evaluator.characteristics
    ends = [(one.characteristic.name, end) for one in scans for interval in one.of_state("unsafe") for end in interval]
    settings = [characteristics.setting({name: end}, name) for name, end in ends]
    ends_of_intervals = np.array(settings).reshape(-1, len(characteristics))
    return evaluator.evaluate_over_encounters(ends_of_intervals, "ends of what is unsafe alone").settings


def _unsafe_solutions(subject: Study | Case, columns: Sequence[int], unsafe: Unsafe) -> FloatArray:
    """The distinct unsafe solutions of results that change no other characteristics than `columns`, shape (K, n)."""
    if isinstance(subject, Study):
        return np.zeros((0, len(CharacteristicSet.of(subject))))
    names, original = list(subject.characteristics.names), subject.characteristics.original
    settings = subject.solutions[unsafe.rows(subject.solutions)][names].to_numpy(dtype=float)
    other_columns = np.setdiff1d(np.arange(len(names)), columns)
    return np.unique(settings[(settings == original)[:, other_columns].all(axis=1)], axis=0)


def _verdict(
    scans: Sequence[OneAtATimeScan],
    box: JointLimits | None,
    unsafe: Unsafe,
    broken: list[str],
    has_limits: bool,
    is_searched: bool,
) -> Iterator[str]:
    """The decision, how sure it is, and what is unsafe alone."""
    if any(one.safe is None for one in scans):
        yield f"The original vehicle itself is unsafe ({unsafe.description})."
        return
    if broken:
        yield f"Do not release: {'; '.join(broken)}."
    if box is not None and not box.kept and not has_limits:
        yield f"No safe box around the original was found ({unsafe.description})."
    elif box is not None:
        yield _box_in_words(box, unsafe, has_limits, f" in {MET_BY_CORNERS:,} encounters" if is_searched else "")
    if names := [one.characteristic.name for one in scans if one.of_state("unsafe")]:
        yield f"Unsafe alone, all others as in the original: {join_phrases(names)}."
    else:
        yield "No single characteristic makes it unsafe."


def _box_in_words(box: JointLimits, unsafe: Unsafe, has_limits: bool, met: str) -> str:
    """The result of the test of all limits together; `met` says in how many encounters the corners drive."""
    failed = f", and {box.failed} could not be simulated" if box.failed else ""
    bound = f"at most {100 * box.at_most:.2f} % are, with {100 * CONFIDENCE:.0f} % confidence"
    if not box.kept:
        drawn = f"{box.unsafe} of {box.samples:,} vehicles drawn" if box.unsafe else "vehicles that a search found"
        return f"Within the limits, all others as in the original, {drawn} are unsafe{failed}; {bound}."
    between = " between bumpers" if unsafe.contact else ""
    kept = f" with at least {unsafe.keep:.3g} m left{between}" if unsafe.keep else f" (unsafe: {unsafe.description})"
    decision = "Keeps all limits" if has_limits else "All may go to their limits together"
    tested = f"no corner{met} and none of {box.samples:,} vehicles drawn within is unsafe"
    return f"{decision}{kept}: {tested}{failed}; {bound}."


def _intervals(scans: Sequence[OneAtATimeScan]) -> pd.DataFrame:
    """The rows of the table of intervals."""
    frames = []
    for one in scans:
        degrees = {f"degree_{end}": one.intervals[end].map(one.degree) for end in ("low", "high")}
        frames.append(
            one.intervals.assign(characteristic=one.characteristic.name, unit=one.characteristic.unit, **degrees)
        )
    return pd.concat(frames, ignore_index=True)[[*INTERVALS]]


def _ends_over_fits(of_fits: Sequence[Sequence[OneAtATimeScan]]) -> list[tuple[Any, ...]]:
    """A row of `FITS` for each end of what is safe alone, except ends of the domain with all fits."""
    rows = []
    for own, *others in zip(*of_fits, strict=True):
        item, intervals = own.characteristic, [one.safe for one in (own, *others) if one.safe is not None]
        for column, last in enumerate((item.lower, item.upper)):
            values = [ends[column] for ends in intervals]
            if {*values} != {last}:
                value = np.nan if own.safe is None else own.safe[column]
                low, high = min(values, default=np.nan), max(values, default=np.nan)
                rows.append((item.name, item.unit, ("low", "high")[column], value, low, high, len(values)))
    return rows


def _lost_points(scans: Sequence[OneAtATimeScan]) -> list[tuple[Any, ...]]:
    """A row of `POINTS` for each characteristic."""
    return [
        (
            one.characteristic.name,
            one.characteristic.unit,
            one.first_loss(),
            one.first_loss(WHOLE_POINT_LOSS),
            one.profile[RATING_POINTS.name].min(),
        )
        for one in scans
    ]


def _draw(answer: Answer, scans: Sequence[OneAtATimeScan]) -> Figure:
    """The safety degree, or points, over each domain; limits are marked."""
    from safevar_sumo.questions.figures import DEGREE_LABEL, FONT_SIZE, new_panels

    column = RATING_POINTS.name if is_rated(answer.study) else SAFETY_DEGREE
    title = f"{answer.study.name}: one characteristic at a time (unsafe: {answer.numbers['unsafe']})"
    figure, axes = new_panels(title, len(scans), 4, (2.3, 1.75), min_width=4.6, title_height=1.1)
    for axis, one, row in zip(axes, scans, answer.tables["limits"].to_dict("records"), strict=True):
        if axis is not axes[0]:
            axis.sharey(axes[0])  # so that steep profiles stand out
        _draw_profile(axis, one, row, column)
    figure.supylabel(DEGREE_LABEL if column == SAFETY_DEGREE else RATING_POINTS.title, fontsize=FONT_SIZE)
    dashed = "; below a dashed line: collisions" if column == SAFETY_DEGREE else ""
    marks = "dot: the original vehicle; hatched: unsafe; light: limits of all together;\nline: specified"
    figure.supxlabel(f"{marks}{dashed}", fontsize=FONT_SIZE)
    return figure


def _draw_profile(axis: Axes, one: OneAtATimeScan, row: Mapping[Any, Any], column: str) -> None:
    from safevar_sumo.questions.figures import BLUE, FONT_SIZE, SKY_BLUE, VERMILION, as_formula, escape_dollars

    item, profile = one.characteristic, one.profile.set_index("value")[column]
    axis.plot(profile, color=BLUE, linewidth=1.2)
    for low, high in one.of_state("unsafe"):
        axis.axvspan(low, high, facecolor=VERMILION, alpha=0.35, hatch="////", edgecolor="white", linewidth=0)
    if not pd.isna(row["together_low"]):
        axis.axvspan(row["together_low"], row["together_high"], facecolor=SKY_BLUE, alpha=0.25, linewidth=0)
    for value in (row["specified_low"], row["specified_high"]):
        if not pd.isna(value):
            axis.axvline(value, color=VERMILION, linewidth=1.5)
    axis.plot(item.original, profile[item.original], marker="o", color="black", markersize=4)
    if column == SAFETY_DEGREE and profile.min() <= 0:
        axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlim(item.lower, item.upper)
    axis.set_title(escape_dollars(item.name), fontsize=FONT_SIZE)
    axis.set_xlabel(f"[{as_formula(item.unit)}]")
    axis.locator_params(axis="x", nbins=4)
