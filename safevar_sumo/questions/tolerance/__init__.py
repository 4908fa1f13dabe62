"""How far may each characteristic go alone, and together with all others: in the largest safe box?

The filter of small changes is not applied, as the question is about the vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError, about, check_name
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Criterion, Margin, Range, question
from safevar_sumo.questions.bars import bars_of
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Models, limit_criterion, models_of, with_points_between
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Column, Columns, tabulate
from safevar_sumo.questions.tolerance.alone import ALONE_STAGE, VALUES, AloneSearch
from safevar_sumo.questions.tolerance.by_parameter import Parameter
from safevar_sumo.questions.tolerance.left_out import Contacts, contacts_left_out
from safevar_sumo.questions.tolerance.levels import LevelSearch
from safevar_sumo.questions.tolerance.limits_by import answer_by, check_by
from safevar_sumo.questions.tolerance.refusal import nearest_limits
from safevar_sumo.questions.tolerance.rows import (
    CHARACTERISTIC,
    LIMITS,
    UNCERTAINTY,
    limit_rows,
    uncertainty_rows,
)
from safevar_sumo.questions.tolerance.scans import (
    SCAN_STAGE,
    SCAN_VALUES,
    WHOLE_POINT_LOSS,
    OneAtATimeScan,
    scan,
)
from safevar_sumo.questions.tolerance.search import SEARCH_STAGE
from safevar_sumo.questions.tolerance.together import LimitsTogether, find_limits_together
from safevar_sumo.questions.tolerance.trial import TRIAL_STAGE
from safevar_sumo.questions.tolerance.wider import WIDER, WIDER_STAGE, wider_rows
from safevar_sumo.questions.tolerance.words import NOT_FALSIFIED, USUAL_BUDGET, verdict_sentences
from safevar_sumo.questions.words import constraints_in_words, counted_in_words
from safevar_sumo.records import FloatArray
from safevar_sumo.study import SAFETY_DEGREE, Limit, Study, limits_of
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.vehicles.region import REJECTIONS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from safevar_sumo.questions.case import Case

LIMITS_TITLE = (
    "Limits, rounded to the safe side; a car beyond one has the others at theirs unless a sentence"
    " says which"
)
INTERVALS: Columns = {
    **CHARACTERISTIC,
    "state": "safe, unsafe, not_simulated, or infeasible: a constraint is violated",
    "low": Column(
        "",
        "first simulated value that is so, all others as in the original, with the study's own fit",
        ".6g",
    ),
    "high": Column("", "last one", ".6g"),
    "degree_low": Column("m", "safety degree at the first value; in -m/s on a collision", ".2f"),
    "degree_high": Column("m", "safety degree at the last value; in -m/s on a collision", ".2f"),
}
FITS: Columns = {
    "fit": Column("-", "number of the fit among the sets of [spread]; 0 is the study's own", "d"),
    "specified": (
        "whether the specified limits hold with it; left out: the original is unsafe or keeps too"
        " little"
    ),
    "corners": Column(
        "", "what the worst corner of the limits together keeps [m], or has of a metric", ".2f"
    ),
}
POINTS: Columns = {
    **CHARACTERISTIC,
    "any_lost": Column("", "value nearest to the original that loses points", ".5g"),
    "first_point_lost": Column("", "value nearest to the original that loses a whole point", ".5g"),
    "least_points": Column("-", "fewest points anywhere in the domain", ".2f"),
}
OF_BOX = (
    *("box", "samples", "failures", "at_most", "not_simulated"),
    *("fits", "fits_tried", "attacked", "least_attacked"),
)
"""Numbers about the limits together."""
MAX_REFUTED = 4
"""Largest number of searches for joint limits, each without what refuted the one before."""
NEAREST: Columns = {
    **CHARACTERISTIC,
    "limit": Column("", "the specified value", ".10g"),
    "nearest": Column(
        "", "the nearest value with which limits together exist, the others as specified", ".10g"
    ),
}


@question
@contents(
    *("unsafe", "margin", "kept", "rough", "scope", "boxes", "contacts_left_out", *OF_BOX),
    *("up_to", "original_keeps_up_to", "original_safe_up_to"),
    limits=(*LIMITS, "by_{by}", "scope"),
    intervals=INTERVALS,
    uncertainty=UNCERTAINTY,
    fits=FITS,
    points=POINTS,
    nearest=NEAREST,
    wider=WIDER,
)
def tolerance(
    subject: Study | Case,
    evaluator: Evaluator,
    *,
    limits: Annotated[tuple[str, ...], '"NAME >= X"'] = (),
    characteristics: Annotated[tuple[str, ...], "A,B"] = (),
    margin: Margin = None,
    unsafe: Criterion = None,
    fits: Annotated[int | None, Range(0, 1000)] = None,
    attack: Annotated[int, Range(0, 100_000_000)] = USUAL_BUDGET,
    by: Annotated[str | None, "NAME=V1,V2,..."] = None,
    together: bool = False,
) -> Answer:
    """Find how far each characteristic may go: alone, and all together.

    The limits hold in every fit of the vehicle, within a scope that is stated. The limits together
    hold none of the unsafe solutions of results. In a study that searches its scenario they hold in
    all encounters in which the original vehicle is safe.

    Parameters
    ----------
    limits
        A limit in the characteristic's unit, such as "treadDepth >= 3", beside those of [limits] in
        the study; may be repeated. All others get the largest box that is safe then; exit code 3 if
        a limit is not kept or the original itself is unsafe.
    characteristics
        Only these characteristics, separated by commas; all others keep their values. By default
        all.
    margin
        Distance to keep from a collision with the study's own fit [m], between bumpers; by default
        the model's error that the study states, else 0.3 m, and 0.1 m in a study that searches its
        scenario, whose originals keep more.
    unsafe
        What is unsafe: a collision, a safety degree below X, or at most X points of a rating.
    fits
        Number of vehicle models that fit the published data about as well (sets of [spread]) in
        which the limits hold, by default all; 0 for the study's own alone.
    attack
        Number of simulations that search for a counterexample to the limits together, over all
        fits, at least 1,000; 0 leaves this search out, and then no limit is called kept. With fewer
        than by default the answer is rough.
    by
        A searched parameter or an axis of the matrix, and values such as speed=20,30,40: the limits
        alone that hold up to each, and up to which value the specified limits hold.
    together
        Joint limits, which hold all at the same time; they are always sought without `by`, and
        never beside it.
    """
    study = evaluator.study
    members = evaluator.characteristics
    parameter = None if by is None else Parameter.parse(by, study)
    check_by(by, unsafe, together)
    evaluator.plan(
        SCAN_STAGE, ALONE_STAGE, SEARCH_STAGE, TRIAL_STAGE, *([WIDER_STAGE] if study.wider else [])
    )
    columns = _columns_of(members.vehicle.names, characteristics)
    specified = _limits_of(study, limits, columns)
    original = evaluator.evaluate_original()
    criterion = limit_criterion(evaluator, subject, unsafe, margin, original)
    if parameter is not None:
        solutions = _unsafe_solutions(subject, range(len(members)), criterion)
        is_alone = (
            np.count_nonzero((solutions != members.original) & members.of_vehicle, axis=1) == 1
        )
        search = LevelSearch(evaluator, parameter, criterion, columns, specified, fits, attack)
        return answer_by(search, solutions[is_alone])
    is_sought = not is_rated(
        study
    )  # a box of a rated study would take thousands of whole test matrices
    if is_sought:
        _check_drawable(evaluator)
    is_safe = not criterion.of(original)[0]
    # Around an unsafe original there is nothing to scan, but points that are lost.
    is_scanned = is_safe or is_rated(study)
    within = None if is_scanned else [(members.original[column],) * 2 for column in columns]
    with evaluator.stage(SCAN_STAGE, SCAN_VALUES * len(columns)):
        scans = scan(evaluator, columns, criterion, within, None if is_scanned else 1)
    models = (
        models_of(evaluator, criterion, fits)
        if is_sought and is_safe
        else Models.own_alone(evaluator, criterion)
    )
    judges = _denser(models, attack) if is_sought else models.members
    search_alone = AloneSearch(scans, columns, judges)
    with evaluator.stage(
        ALONE_STAGE, len(judges) * VALUES * len(columns) * (1 + len(evaluator.critical_encounters))
    ):
        search_alone.run(attack)
    found_together: LimitsTogether | None = None
    if is_sought and is_safe:
        all_columns = [*columns, *np.flatnonzero(~members.of_vehicle).tolist()]
        everywhere = {
            item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario
        }
        known = [
            _unsafe_solutions(subject, all_columns, criterion),
            _unsafe_alone(evaluator, criterion, scans),
        ]
        all_limits = {**specified, **everywhere}
        for _ in range(MAX_REFUTED):
            unsafe_settings = np.concatenate([*known, search_alone.failures])
            found_together = find_limits_together(
                models, all_columns, all_limits, scans, unsafe_settings, attack
            )
            search_alone.meet(found_together.searched, found_together.failures_alone)
            if not _is_refuted(found_together, search_alone.failures):
                break
            found_together = found_together._replace(box=None)
    alone = search_alone.limits()
    contacts = None
    if found_together is not None and attack and len(members.scenario):
        contacts = contacts_left_out(models.members, [found_together.box or found_together.promise])
    found = limit_rows(
        alone, found_together, specified, models.members, scope_of(study, between=attack > 0)
    )
    if not attack:
        found = found.without_kept()
    tables = {
        "limits": tabulate(LIMITS_TITLE, LIMITS, found.rows),
        "intervals": tabulate(
            "Each alone, all others as in the original", INTERVALS, _intervals(scans)
        ),
    }
    domains = [(one.characteristic.lower, one.characteristic.upper) for one in scans]
    tables["limits"].attrs["bars"] = bars_of(tables["limits"], domains)
    if moved := uncertainty_rows(alone):
        tables["uncertainty"] = tabulate(
            "Limits alone: with one fit and with all", UNCERTAINTY, moved
        )
    if found_together is not None and len(models.members) + len(models.left_out) > 1:
        tables["fits"] = tabulate(
            "The limits in each fit of the vehicle", FITS, _fit_rows(models, found_together)
        )
    if is_rated(study):
        tables["points"] = tabulate("Points lost by each alone", POINTS, _lost_points(scans))
    nearest = (
        nearest_limits(models, specified) if found.broken and found_together is not None else []
    )
    if nearest:
        tables["nearest"] = tabulate("Limits that would do", NEAREST, nearest)
    wider = (
        wider_rows(evaluator, specified, found_together, unsafe, margin, fits, attack)
        if is_safe
        else []
    )
    if wider:
        tables["wider"] = tabulate("The same limits in a wider scope", WIDER, wider)
    refusal = (
        ""
        if is_safe
        else f"the original itself {criterion.breach_in_words(original)}: no limit can be kept"
    )
    failures = (refusal,) if refusal else tuple(f"limit of {text}" for text in found.broken)
    is_kept = None if not failures and not attack else not failures
    sentences = verdict_sentences(
        models,
        alone,
        found_together,
        specified,
        found.broken,
        attack,
        nearest,
        wider,
        refusal,
        contacts,
    )
    return Answer(
        question="tolerance",
        study=study,
        verdict=" ".join([*sentences, *counted_in_words(study), *constraints_in_words(study)]),
        numbers=_numbers(study, criterion, models, found_together, is_kept, attack, contacts),
        tables=tables,
        failures=(NOT_FALSIFIED,) if is_kept is None and specified else failures,
        draw=partial(_draw, scans=scans),
    )


def _numbers(
    study: Study,
    criterion: Unsafe,
    models: Models,
    together: LimitsTogether | None,
    is_kept: bool | None,
    attack: int,
    contacts: Contacts | None,
) -> dict[str, Any]:
    """The numbers of the answer; without limits together those about them are undefined."""
    numbers: dict[str, Any] = {
        "unsafe": str(criterion),
        "margin": criterion.keep,
        "kept": is_kept,
        "rough": attack < USUAL_BUDGET,
        "scope": scope_of(study, between=attack > 0),
        "contacts_left_out": None if contacts is None else contacts.number,
    }
    if together is None:
        return {**numbers, **dict.fromkeys(OF_BOX), "boxes": 0}
    return {**numbers, **together.numbers, "fits_tried": len(models.members)}


def _check_drawable(evaluator: Evaluator) -> None:
    """Refuse a study of which hardly any setting is feasible, before the long scans."""
    members = evaluator.characteristics
    region = evaluator.region
    if not len(
        Box(region, members.lower, members.upper).draw(
            1, np.random.default_rng(evaluator.study.search.seed)
        )
    ):
        problem = (
            f"fewer than 1 in {REJECTIONS} random settings satisfy the constraints, which leaves no"
            " box to test: "
        )
        legal = "characteristics that the constraints do not tie to each other"
        raise InputError(evaluator.study.source, f"{problem}{region}", legal)


def _denser(models: Models, attack: int) -> list[Any]:
    """The models with further points between those of the study's matrix, if there is an attack."""
    if not attack:
        return [*models.members]
    own = models.own
    return [with_points_between(model, own.unsafe, 0)[0] for model in models.members]


def _is_refuted(together: LimitsTogether, failures: FloatArray) -> bool:
    """Whether limits together hold a setting that a limit alone had to move before."""
    return together.box is not None and bool(together.box.holds(failures).any())


def _columns_of(names: Sequence[str], characteristics: Sequence[str]) -> list[int]:
    chosen = [name.strip() for text in characteristics for name in text.split(",")]
    for name in chosen:
        check_name("characteristics", f"there is no characteristic {name!r}", name, names)
    return [column for column, name in enumerate(names) if not chosen or name in chosen]


def _limits_of(study: Study, texts: Sequence[str], columns: Sequence[int]) -> dict[str, Limit]:
    """The limits of the study and of the option for the characteristics that vary."""
    rows = study.vehicle.characteristics
    varied = [list(rows)[column] for column in columns]
    with about("limits"):
        for name in limits_of(texts, rows):
            check_name("", f"{name} does not vary with these --characteristics", name, varied)
        return {
            name: limit
            for name, limit in limits_of(texts, rows, study.limits).items()
            if name in varied
        }


def _unsafe_alone(
    evaluator: Evaluator, unsafe: Unsafe, scans: Sequence[OneAtATimeScan]
) -> FloatArray:
    """The ends of the unsafe intervals as settings, shape (K, n), each in its worst encounter."""
    characteristics = evaluator.characteristics
    ends = [
        (one.characteristic.name, end)
        for one in scans
        for interval in one.of_state("unsafe")
        for end in interval
    ]
    settings = [characteristics.setting({name: end}) for name, end in ends]
    ends_of_intervals = np.array(settings).reshape(-1, len(characteristics))
    return evaluator.evaluate_over_encounters(
        ends_of_intervals, unsafe, "ends of what is unsafe alone"
    ).settings


def _unsafe_solutions(subject: Study | Case, columns: Sequence[int], unsafe: Unsafe) -> FloatArray:
    """The distinct unsafe solutions of results that change no other characteristics than `columns`,
    shape (K, n).
    """
    if isinstance(subject, Study):
        return np.zeros((0, len(CharacteristicSet.of(subject))))
    names = list(subject.characteristics.names)
    original = subject.characteristics.original
    settings = subject.solutions[unsafe.rows(subject.solutions)][names].to_numpy(dtype=float)
    other_columns = np.setdiff1d(np.arange(len(names)), columns)
    return np.unique(settings[(settings == original)[:, other_columns].all(axis=1)], axis=0)


def _intervals(scans: Sequence[OneAtATimeScan]) -> pd.DataFrame:
    """The rows of the table of intervals."""
    frames = []
    for one in scans:
        degrees = {f"degree_{end}": one.intervals[end].map(one.degree) for end in ("low", "high")}
        frames.append(
            one.intervals.assign(
                characteristic=one.characteristic.name, unit=one.characteristic.unit, **degrees
            )
        )
    return pd.concat(frames, ignore_index=True)[[*INTERVALS]]


def _fit_rows(models: Models, together: LimitsTogether) -> list[tuple[Any, ...]]:
    """A row of `FITS` for each fit."""
    states = {fit: "kept" for fit in models.fits} | dict.fromkeys(together.broken, "not kept")
    states |= dict.fromkeys(models.left_out, "left out")
    return [
        (fit, state, together.corners.get(fit, np.nan)) for fit, state in sorted(states.items())
    ]


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
    title = (
        f"{answer.study.name}: one characteristic at a time (unsafe: {answer.numbers['unsafe']})"
    )
    figure, axes = new_panels(title, len(scans), 4, (2.3, 1.75), min_width=4.6, title_height=1.1)
    for axis, one, row in zip(axes, scans, answer.tables["limits"].to_dict("records"), strict=True):
        if axis is not axes[0]:
            axis.sharey(axes[0])  # so that steep profiles stand out
        _draw_profile(axis, one, row, column)
    figure.supylabel(
        DEGREE_LABEL if column == SAFETY_DEGREE else RATING_POINTS.title, fontsize=FONT_SIZE
    )
    dashed = "; below a dashed line: collisions" if column == SAFETY_DEGREE else ""
    ranges = "light: limits of all together;\nbar below: limits alone"
    marks = f"dot: the original vehicle; hatched: unsafe; {ranges}; line: specified"
    figure.supxlabel(f"{marks}{dashed}", fontsize=FONT_SIZE)
    return figure


def _draw_profile(axis: Axes, one: OneAtATimeScan, row: Mapping[Any, Any], column: str) -> None:
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        SKY_BLUE,
        VERMILION,
        as_formula,
        escape_dollars,
    )

    item = one.characteristic
    profile = one.profile.set_index("value")[column]
    axis.plot(profile, color=BLUE, linewidth=1.2)
    for low, high in one.of_state("unsafe"):
        axis.axvspan(
            low, high, facecolor=VERMILION, alpha=0.35, hatch="////", edgecolor="white", linewidth=0
        )
    if not pd.isna(row["together_low"]):
        axis.axvspan(
            row["together_low"], row["together_high"], facecolor=SKY_BLUE, alpha=0.25, linewidth=0
        )
    ends_alone = (row["alone_low"], row["alone_high"])
    axis.plot(
        ends_alone,
        (0.03, 0.03),
        transform=axis.get_xaxis_transform(),
        color=BLUE,
        linewidth=4,
        alpha=0.5,
    )
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
