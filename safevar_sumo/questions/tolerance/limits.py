"""The limits of a study: of each characteristic alone, and joint limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.bars import bars_of, draw_bars
from safevar_sumo.questions.between import moving_tests
from safevar_sumo.questions.box import MAX_CORNERS, Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import budget_of
from safevar_sumo.questions.model_spread import other_sets
from safevar_sumo.questions.models import Model, Models, models_of
from safevar_sumo.questions.reach import nearest_limits
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Column, Columns, Frames, Rows, tabulate
from safevar_sumo.questions.tolerance.alone import VALUES, AloneLimit, AloneSearch
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.in_ranges import (
    IN_RANGES,
    RANGES_STAGE,
    SLOWNESS,
    rows_in_ranges,
    usual_settings,
)
from safevar_sumo.questions.tolerance.rows import (
    CHARACTERISTIC,
    LIMITS,
    LIMITS_TITLE,
    UNCERTAINTY,
    limit_rows,
    uncertainty_rows,
)
from safevar_sumo.questions.tolerance.scans import SCAN_STAGE, SCAN_VALUES, OneAtATimeScan, scan
from safevar_sumo.questions.tolerance.together import JointSearch, LimitsTogether, budget_of_set
from safevar_sumo.questions.tolerance.words import tested_sentences, verdict_sentences
from safevar_sumo.questions.words import constraints_in_words, counted_in_words
from safevar_sumo.records import FloatArray, JsonObject, NamedValues
from safevar_sumo.study import Limit
from safevar_sumo.vehicles.region import REJECTIONS

OWN_SET_STAGE = "joint limits with the study's own parameter set"
OTHER_SETS_STAGE = "limits in each further parameter set"
"""Phases of progress; the first has a round for each box, the second one for each set."""
INTERVALS: Columns = {
    **CHARACTERISTIC,
    "state": "safe, unsafe, not_simulated, or infeasible: a constraint is violated",
    "low": Column(
        "",
        "first simulated value that is so, all others as in the original, with the study's own set",
        ".6g",
    ),
    "high": Column("", "last one", ".6g"),
    "degree_low": Column("m", "safety degree at the first value; in -m/s on a collision", ".2f"),
    "degree_high": Column("m", "safety degree at the last value; in -m/s on a collision", ".2f"),
}
FITS: Columns = {
    "fit": Column("-", "number of the parameter set in [spread]; 0 is the study's own", "d"),
    "specified": (
        "whether the specified limits hold in it; left out: the original is unsafe or keeps too"
        " little"
    ),
    "corners": Column(
        "", "clearance of the worst corner of the joint limits [m], or its value of a metric", ".2f"
    ),
}
OF_BOX = (
    *("box", "samples", "failures", "at_most", "not_simulated"),
    *("fits", "fits_tried", "attacked", "attacked_at_worst_points", "attacked_between"),
    "least_attacked",
)
"""Numbers about joint limits."""
USUAL_BOXES = 80
"""Usual number of boxes of the study's own parameter set: each takes the simulations of a
falsification, at the worst points of a matrix alone.
"""
MAX_REFUTED = 4
"""Largest number of searches for joint limits, each without what refuted the one before."""
NEAREST: Columns = {
    **CHARACTERISTIC,
    "limit": Column("", "the specified value", ".10g"),
    "nearest": Column(
        "", "the nearest value with which joint limits exist, the others as specified", ".10g"
    ),
}


class FoundLimits(NamedTuple):
    """The limits of a study.

    Attributes
    ----------
    scans
        Each characteristic alone, with the study's own parameter set.
    models
        The models in which the limits hold.
    alone
        The limits of each characteristic alone.
    together
        The joint limits; None around an unsafe original.
    """

    scans: list[OneAtATimeScan]
    models: Models
    alone: list[AloneLimit]
    together: LimitsTogether | None

    @property
    def is_safe(self) -> bool:
        """Whether the original vehicle is safe."""
        return all(one.safe is not None for one in self.scans)


def phases_of(evaluator: Evaluator, columns: int, fits: int | None) -> NamedValues:
    """The phases of progress, each with the number of settings that it usually simulates."""
    study = evaluator.study
    points = len(evaluator.system.points)
    phases = {SCAN_STAGE: float(SCAN_VALUES * columns)}
    sets = len(other_sets(study, fits))
    budget = budget_of(evaluator)
    own = USUAL_BOXES * budget / points
    of_set = VALUES * columns + 2 * budget_of_set(evaluator, budget) + min(2**columns, MAX_CORNERS)
    phases |= {OWN_SET_STAGE: own, OTHER_SETS_STAGE: sets * of_set}
    if there := usual_settings(evaluator, budget, 1 + sets):
        phases[RANGES_STAGE] = SLOWNESS * there
    return phases


def find_nested_limits(asked: Asked) -> FoundLimits:
    """Search the limits that a question asks for: those up to a value within those up to each
    smaller one at which the original vehicle is safe.
    """
    outer = None
    for evaluator in asked.smaller:
        original = evaluator.evaluate(
            evaluator.characteristics.original_settings, "original vehicle"
        )
        if original.valid[0] and not asked.unsafe.of(original)[0]:
            outer = find_limits(asked._replace(evaluator=evaluator, original=original), outer)
    return find_limits(asked, outer)


def find_limits(asked: Asked, outer: FoundLimits | None = None) -> FoundLimits:
    """Search limits within outer ones."""
    evaluator = asked.evaluator
    members = evaluator.characteristics
    _check_drawable(evaluator)
    # Around an unsafe original there is nothing to scan.
    is_safe = not asked.unsafe.of(asked.original)[0]
    within = None if is_safe else [(members.original[column],) * 2 for column in asked.columns]
    scans = scan(evaluator, asked.columns, asked.unsafe, within, None if is_safe else 1)
    models = Models((Model(0, evaluator, asked.unsafe),), ())
    if is_safe:
        models = models_of(evaluator, asked.unsafe, asked.fits)
    search_alone = AloneSearch(scans, asked.columns, models.own)
    together = None
    if is_safe:
        outer_box = None if outer is None else outer.together
        together = _find_together(asked, scans, models, search_alone, outer_box)
    else:
        search_alone.add(models.own)
    alone = search_alone.limits()
    if outer is not None:
        alone = [each.within(wide) for each, wide in zip(alone, outer.alone, strict=True)]
    return FoundLimits(scans, models, alone, together)


def _find_together(
    asked: Asked,
    scans: Sequence[OneAtATimeScan],
    models: Models,
    search_alone: AloneSearch,
    outer: LimitsTogether | None,
) -> LimitsTogether:
    """The joint limits within outer ones. They hold nothing that the search of limits alone met,
    and the other way round: limits alone end before failures that the search of joint limits met.

    One parameter set after another moves both in, so that they do not depend on those that follow.
    """
    members = asked.evaluator.characteristics
    columns = [*asked.columns, *np.flatnonzero(~members.of_vehicle).tolist()]
    everywhere = {
        item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario
    }
    tests = {
        model.fit: [] if asked.at_tests else moving_tests(model, asked.unsafe)
        for model in models.members
    }
    joint = JointSearch(models, tests, columns, {**asked.limits, **everywhere}, asked.budget, outer)
    known = np.concatenate([asked.unsafe_solutions, _unsafe_alone(asked, scans)])
    phases = asked.evaluator.phases
    for number, model in enumerate(models.members):
        with phases.stage(OTHER_SETS_STAGE if number else OWN_SET_STAGE):
            if number:
                phases.begin_round(number, len(models.members) - 1, is_known=True)
            search_alone.add(model, tests[model.fit])
            search_alone.attack(model, asked.budget)
            # No joint box holds a failure of one characteristic alone, and what the joint search
            # met of these moves limits alone.
            for _ in range(MAX_REFUTED):
                if model.fit == 0:
                    joint.find(scans, np.concatenate([known, search_alone.failures]))
                else:
                    joint.cut(model, search_alone.failures)
                search_alone.meet(joint.met, joint.found.failures_alone)
                box = joint.found.box
                if box is None or not box.holds(search_alone.failures).any():
                    break
            else:
                joint.give_up()
    return joint.found


def answer_limits(asked: Asked) -> Answer:
    """The answer with limits alone and joint limits."""
    study = asked.evaluator.study
    found = find_nested_limits(asked)
    models = found.models
    together = found.together
    scope = scope_of(study, between=not asked.at_tests)
    rows = limit_rows(
        found.alone, together, asked.limits, models.members, scope, is_rough=asked.is_quick
    )
    nearest = []
    if rows.broken and together is not None:
        nearest = nearest_limits(models, asked.limits)
    in_ranges = [] if asked.is_quick or not found.is_safe else rows_in_ranges(asked, together)
    refusal = demand = ""
    if not found.is_safe:
        breach = asked.unsafe.breach_in_words(asked.original)
        refusal = f"the original vehicle itself {breach}: no limit can be kept"
        demand = f"{refusal}. {asked.unsafe.smaller_demand(asked.original)}".strip()
    failures = (refusal,) if refusal else tuple(f"limit of {text}" for text in rows.broken)
    is_kept = None if not failures and asked.is_quick else not failures
    if is_kept is None and asked.limits:
        failures = ("with --quick, no limit is called kept: ask without it",)
    sentences = verdict_sentences(
        models, found.alone, together, asked, rows.broken, nearest, in_ranges, demand
    )
    tested = tested_sentences(models, together)
    return Answer(
        question="tolerance",
        study=study,
        verdict=" ".join(sentences),
        tested=" ".join([*tested, *counted_in_words(study), *constraints_in_words(study)]),
        numbers={
            "unsafe": str(asked.unsafe),
            "margin": asked.unsafe.keep,
            "kept": is_kept,
            "rough": asked.is_quick,
            "scope": scope,
            "up_to": None if asked.up_to is None else float(asked.up_to.partition("=")[2]),
            **_numbers(found),
        },
        tables=_tables(found, rows.rows, nearest, in_ranges),
        failures=failures,
        draw=draw_bars,
    )


def _numbers(found: FoundLimits) -> JsonObject:
    """The numbers about joint limits; without such limits they are undefined."""
    if found.together is None:
        return {**dict.fromkeys(OF_BOX), "boxes": 0}
    return {**found.together.numbers, "fits_tried": len(found.models.members)}


def _tables(found: FoundLimits, rows: Rows, nearest: Rows, in_ranges: Rows) -> Frames:
    """The tables of an answer, the limits first; those without rows are left out."""
    scans = found.scans
    # Joint limits lead, without those of the whole domain; else those of each alone.
    is_joint = found.together is not None and found.together.box is not None
    end = LIMITS["alone_low"]
    assert isinstance(end, Column)
    columns = {**LIMITS, "alone_low": end._replace(is_detail=is_joint)}
    found_beyond = [row[[*LIMITS].index("fails_first")] for row in rows]
    words = {text: text.removeprefix("the car ") for text in found_beyond if text}
    limits = tabulate(LIMITS_TITLE, columns, rows, words=words)
    domains = np.array([(one.characteristic.lower, one.characteristic.upper) for one in scans])
    is_open = (limits[["together_low", "together_high"]].to_numpy(float) == domains).all(axis=1)
    if not is_open.all():
        limits.attrs["lead_rows"] = np.flatnonzero(~is_open).tolist()
    limits.attrs["bars"] = bars_of(limits, domains.tolist())
    intervals = tabulate(
        "Safe values of each characteristic if it alone changes", INTERVALS, _intervals(scans)
    )
    tables = {"limits": limits, "intervals": intervals}
    if moved := uncertainty_rows(found.alone):
        tables["uncertainty"] = tabulate(
            "Limits alone: with one parameter set and with all", UNCERTAINTY, moved
        )
    tried = len(found.models.members) + len(found.models.left_out)
    if found.together is not None and tried > 1:
        fits = _fit_rows(found.models, found.together)
        tables["fits"] = tabulate(
            "The limits in each parameter set of the vehicle model", FITS, fits
        )
    if nearest:
        tables["nearest"] = tabulate("Limits that would do", NEAREST, nearest)
    if in_ranges:
        tables["ranges"] = tabulate(
            "The same limits in the ranges of the study", IN_RANGES, in_ranges
        )
    return tables


def _check_drawable(evaluator: Evaluator) -> None:
    """Refuse a study of which hardly any setting is feasible, before the long scans."""
    members = evaluator.characteristics
    region = evaluator.region
    if not len(
        Box(region, members.lower, members.upper).draw(1, np.random.default_rng(evaluator.seed))
    ):
        problem = (
            f"fewer than 1 in {REJECTIONS} random settings satisfy the constraints, which leaves no"
            " box to test: "
        )
        legal = "characteristics that the constraints do not tie to each other"
        raise InputError(evaluator.study.source, f"{problem}{region}", legal)


def _unsafe_alone(asked: Asked, scans: Sequence[OneAtATimeScan]) -> FloatArray:
    """The ends of the unsafe intervals as settings, shape (K, n), each in its worst encounter."""
    characteristics = asked.evaluator.characteristics
    ends = [
        (one.characteristic.name, end)
        for one in scans
        for interval in one.of_state("unsafe")
        for end in interval
    ]
    settings = [characteristics.setting({name: end}) for name, end in ends]
    ends_of_intervals = np.array(settings).reshape(-1, len(characteristics))
    return asked.evaluator.evaluate_over_encounters(
        ends_of_intervals, asked.unsafe, "ends of what is unsafe alone"
    ).settings


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


def _fit_rows(models: Models, together: LimitsTogether) -> Rows:
    """A row of `FITS` for each parameter set."""
    states = {fit: "kept" for fit in models.fits} | dict.fromkeys(together.broken, "not kept")
    states |= {model.fit: "left out" for model in models.left_out}
    corners = {
        model.fit: model.unsafe.value(together.validations[model.fit].corners)
        for model in together.members
        if model.fit in together.validations
    }
    return [(fit, state, corners.get(fit, np.nan)) for fit, state in sorted(states.items())]
