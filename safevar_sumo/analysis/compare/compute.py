"""Simulates the same settings in two systems: all solutions of both, and a sample of their common domain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import Case, UnanswerableError
from safevar_sumo.analysis.compare import CompareOptions
from safevar_sumo.analysis.compare.answer import Side, SystemComparison
from safevar_sumo.analysis.evaluator import MAX_REJECTIONS, Evaluator, sobol_points
from safevar_sumo.analysis.rating.compute import rate
from safevar_sumo.analysis.research_questions.changes import compare_weathers
from safevar_sumo.analysis.research_questions.statistics import FEWEST_RUNS, compare_samples, signed_rank_test
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.analysis.tolerance.scans import scan
from safevar_sumo.analysis.words import number_of
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import handles_of
from safevar_sumo.study import SAFETY_DEGREE, Study

SAMPLE = "sample"
RUN_COLUMNS = ["source", "algorithm", "run"]


def compare_systems(
    subject: Study | Case, options: CompareOptions, evaluator: Evaluator, *, other: Study | Case
) -> SystemComparison:
    """Compare two systems by one criterion. The filter of small changes is not applied: its thresholds are a search's.

    Raises
    ------
    InputError
        If the systems have other characteristics or no common domain, or `unsafe` cannot be used for both.
    SimulationError
        If an original vehicle cannot be simulated.
    """
    subjects, evaluators = (subject, other), (evaluator, evaluator.for_study(study_in(other)))
    _require_same_characteristics(*(one.study for one in evaluators))
    stated = [one.parse_criterion(options.unsafe) for one in evaluators if options.unsafe is not None]
    names = list(evaluator.characteristics.names)
    orders = [[names.index(name) for name in one.characteristics.names] for one in evaluators]
    lower, upper = _common_domain(evaluators, orders)
    sample = pd.DataFrame(_common_sample(evaluators, orders, lower, upper, options.samples), columns=names)
    solutions = [
        _solutions_of(side, one, names) for side, one in zip("ab", subjects, strict=True) if isinstance(one, Case)
    ]
    frame = pd.concat([*solutions, sample.assign(source=SAMPLE)], ignore_index=True)
    inside = ((frame[names] >= lower) & (frame[names] <= upper)).all(axis=1)
    outside, frame = int(np.count_nonzero(~inside)), frame[inside].reset_index(drop=True)
    values = frame[names].to_numpy(dtype=float)
    evaluations = [
        one.evaluate(values[:, order], f"settings in {side}")
        for one, order, side in zip(evaluators, orders, "AB", strict=True)
    ]
    originals = [one.evaluate_original() for one in evaluators]
    unsafe = stated[0] if stated else _default_criterion(evaluators, evaluations, originals)
    both_rated = all(is_rated(one.study) for one in evaluators)
    is_valid = np.logical_and.reduce([one.valid for one in evaluations])
    for side, one in zip("ab", evaluations, strict=True):
        frame[f"outcome_{side}"] = one.outcome
        frame[f"{SAFETY_DEGREE}_{side}"] = one.f_safe
        frame[f"unsafe_{side}"] = unsafe.of(one)
    quantities = [one.column(RATING_POINTS.name if both_rated else SAFETY_DEGREE) for one in evaluations]
    p, a12, unit, number = _test(frame.assign(**dict(zip("ab", quantities, strict=True)))[is_valid])
    sides = [_side(one, original, unsafe, both_rated) for one, original in zip(evaluators, originals, strict=True)]
    remarks = {
        "solution": (outside, "outside the other system's domain left out"),
        "setting": (int(np.count_nonzero(~is_valid)), "left out, which one of the systems could not simulate"),
    }
    return SystemComparison(
        a=sides[0],
        b=sides[1],
        unsafe=unsafe,
        frame=frame[is_valid].reset_index(drop=True),
        p=p,
        a12=a12,
        test_unit=unit,
        test_size=number,
        weather=_weather_table(subjects),
        remarks=tuple(f"{number_of(count, noun)} {rest}" for noun, (count, rest) in remarks.items() if count),
    )


def _side(evaluator: Evaluator, original: Evaluations, unsafe: Unsafe, is_rated: bool) -> Side:
    return Side(
        study=evaluator.study,
        original=original,
        limits=scan(evaluator, range(len(evaluator.characteristics)), unsafe),
        points=rate(evaluator, {}).original.points if is_rated else None,
        no_verdict=evaluator.no_verdict,
    )


def _common_domain(evaluators: tuple[Evaluator, Evaluator], orders: list[list[int]]) -> tuple[FloatArray, FloatArray]:
    """The ends of the domain that both systems have, in the order of the first one's characteristics."""
    sets = [(one.characteristics, np.argsort(order)) for one, order in zip(evaluators, orders, strict=True)]
    lower = np.max([one.lower[order] for one, order in sets], axis=0)
    upper = np.min([one.upper[order] for one, order in sets], axis=0)
    if (lower > upper).any():
        name = evaluators[0].characteristics.names[int(np.argmax(lower > upper))]
        raise InputError(
            evaluators[1].study.source,
            f"{name}: the domains of the two studies do not overlap",
            "studies with a common domain of each characteristic",
        )
    return lower, upper


def _require_same_characteristics(a: Study, b: Study) -> None:
    units = [{name: row.unit for name, row in study.vehicle.characteristics.items()} for study in (a, b)]
    if units[0] == units[1]:
        return
    ours, theirs = (
        ", ".join(f"{name} [{unit}]" for name, unit in one.items() if another.get(name) != unit) or "none"
        for one, another in (units, units[::-1])
    )
    raise InputError(
        b.source,
        f"cannot be compared: characteristics of {a.name!r} alone: {ours}; of {b.name!r} alone: {theirs}",
        "studies with the same characteristics in the same units",
    )


def _solutions_of(source: str, case: Case, names: list[str]) -> pd.DataFrame:
    """Settings of the solutions with the columns of `RUN_COLUMNS`, if there are runs, and `solution`, the handle."""
    frame = case.solutions
    kept = frame[[*names, *(name for name in RUN_COLUMNS if name in frame and case.has_runs)]]
    return kept.assign(source=source, solution=list(map(str, handles_of(frame))))


def _common_sample(
    evaluators: tuple[Evaluator, Evaluator], orders: list[list[int]], lower: FloatArray, upper: FloatArray, number: int
) -> FloatArray:
    """`number` settings that cover the common domain evenly and satisfy the constraints of both studies; fewer where
    hardly any do.
    """
    factor = 1
    while True:
        settings = lower + sobol_points(number * factor, len(lower), 0) * (upper - lower)
        for evaluator, order in zip(evaluators, orders, strict=True):
            if evaluator.region:
                settings = settings[evaluator.region.feasible(settings[:, order])]
        if len(settings) >= number or factor >= MAX_REJECTIONS:
            return settings[:number]
        factor *= 2


def _default_criterion(
    evaluators: tuple[Evaluator, Evaluator], evaluations: list[Evaluations], originals: list[Evaluations]
) -> Unsafe:
    """The default of all vehicles of both systems, with the limit of the first original."""
    original = originals[0]
    if not all(is_rated(one.study) for one in evaluators):
        metrics = {name: values for name, values in original.metrics.items() if name != RATING_POINTS.name}
        original = replace(original, metrics=metrics)
    return Unsafe.default_among(Evaluations.concatenate([*evaluations, originals[1]]), original)


def _test(frame: pd.DataFrame) -> tuple[float | None, float | None, str, int]:
    """The paired test and A12 of the columns `a` and `b`, with the paired unit and its number: each run's mean over its
    solutions, or each setting of the sample if there are fewer runs than the test needs.
    """
    frame = frame.dropna(subset=["a", "b"])
    pairs, unit = frame[frame["source"] == SAMPLE][["a", "b"]], "setting"
    if "run" in frame:
        means = frame.dropna(subset=["run"]).groupby(RUN_COLUMNS)[["a", "b"]].mean()
        if len(means) >= FEWEST_RUNS["RQ1"]:
            pairs, unit = means, "run"
    a, b = pairs.to_numpy(dtype=float).T
    p, a12 = signed_rank_test(a - b, 0.0).p_value, compare_samples(a, b).effect_size
    return finite_or_none(p), finite_or_none(a12), unit, len(pairs)


def _weather_table(subjects: tuple[Study | Case, Study | Case]) -> pd.DataFrame | None:
    """The table `weather` of the research questions, if the systems differ in the weather alone."""
    cases = [one for one in subjects if isinstance(one, Case)]
    try:
        return compare_weathers(*cases) if len(cases) == 2 else None
    except UnanswerableError:
        return None
