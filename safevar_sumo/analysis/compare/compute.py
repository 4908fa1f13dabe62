"""Simulates the same settings in two systems: all solutions of both, and a sample of their common domain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import Case, UnanswerableError
from safevar_sumo.analysis.compare import CompareOptions
from safevar_sumo.analysis.compare.answer import Side, SystemComparison
from safevar_sumo.analysis.evaluator import Evaluator, sobol_points
from safevar_sumo.analysis.repair.price import benign_scenes, needless_braking
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
from safevar_sumo.sumo.system import assemble

MAX_FACTOR = 512
"""Largest number of settings that are drawn for each common one that satisfies the constraints."""
SAMPLE = "sample"
"""Source of the settings of the common sample."""
RUN_COLUMNS = ["source", "algorithm", "run"]
"""Columns that identify a run."""


def compare_systems(
    subject: Study | Case, options: CompareOptions, evaluator: Evaluator, *, other: Study | Case
) -> SystemComparison:
    """Compare two systems by one criterion, without the filter of small changes, whose thresholds are a search's.

    Raises
    ------
    InputError
        If the systems have other characteristics or no common domain, or `unsafe` cannot be used for both.
    SimulationError
        If an original vehicle cannot be simulated.
    """
    evaluators = evaluator, evaluator.for_study(study_in(other))
    studies = [of_side.study for of_side in evaluators]
    _require_same_characteristics(*studies)
    stated = [of_side.parse_criterion(options.unsafe) for of_side in evaluators if options.unsafe is not None]
    names = list(evaluator.characteristics.names)
    orders = [[names.index(name) for name in of_side.characteristics.names] for of_side in evaluators]
    lower, upper = _common_domain(evaluators, orders)
    sample = pd.DataFrame(_common_sample(evaluators, orders, lower, upper, options.samples), columns=names)
    cases = {side: case for side, case in (("a", subject), ("b", other)) if isinstance(case, Case)}
    solutions = [_solutions_of(side, case, names) for side, case in cases.items()]
    frame = pd.concat([*solutions, sample.assign(source=SAMPLE)], ignore_index=True)
    is_inside = ((frame[names] >= lower) & (frame[names] <= upper)).all(axis=1)
    outside, frame = int(np.count_nonzero(~is_inside)), frame[is_inside].reset_index(drop=True)
    values = frame[names].to_numpy(dtype=float)
    evaluations = [
        of_side.evaluate(values[:, order], f"settings in {side}")
        for of_side, order, side in zip(evaluators, orders, "AB", strict=True)
    ]
    originals = [of_side.evaluate_original() for of_side in evaluators]
    both_rated = all(map(is_rated, studies))
    unsafe = stated[0] if stated else _default_criterion(both_rated, evaluations, originals)
    is_valid = np.logical_and.reduce([runs.valid for runs in evaluations])
    tested = frame.copy()
    for side, runs in zip("ab", evaluations, strict=True):
        frame[f"outcome_{side}"] = runs.outcome
        frame[f"{SAFETY_DEGREE}_{side}"] = runs.f_safe
        frame[f"unsafe_{side}"] = unsafe.of(runs)
        tested[side] = runs.column(RATING_POINTS.name if both_rated else SAFETY_DEGREE)
    p, a12, unit, number = _test(tested[is_valid])
    side_a, side_b = (
        _side(of_side, original, unsafe, both_rated) for of_side, original in zip(evaluators, originals, strict=True)
    )
    remarks = (
        (outside, "solution", "outside the other system's domain left out"),
        (int(np.count_nonzero(~is_valid)), "setting", "left out, which one of the systems could not simulate"),
    )
    return SystemComparison(
        a=side_a,
        b=side_b,
        unsafe=unsafe,
        frame=frame[is_valid].reset_index(drop=True),
        p=p,
        a12=a12,
        test_unit=unit,
        test_size=number,
        weather=_weather_table(list(cases.values())),
        needless_braking=_needless_braking(*studies),
        remarks=tuple(f"{number_of(count, noun)} {remark}" for count, noun, remark in remarks if count),
    )


def _side(evaluator: Evaluator, original: Evaluations, unsafe: Unsafe, both_rated: bool) -> Side:
    return Side(
        study=evaluator.study,
        original=original,
        limits=scan(evaluator, range(len(evaluator.characteristics)), unsafe),
        points=float(original.column(RATING_POINTS.name)[0]) if both_rated else None,
        no_verdict=evaluator.no_verdict,
    )


def _needless_braking(a: Study, b: Study) -> tuple[int, int, int]:
    """In how many of A's benign scenes the original vehicles of A and B brake, and the number of these scenes."""
    systems = [assemble(study, study.source) for study in (a, b)]
    scenes = benign_scenes(a, systems[0])
    brakes_in_a, brakes_in_b = (needless_braking(system, scenes) for system in systems)
    return sum(brakes_in_a), sum(brakes_in_b), len(brakes_in_a)


def _common_domain(evaluators: tuple[Evaluator, Evaluator], orders: list[list[int]]) -> tuple[FloatArray, FloatArray]:
    """The ends of the domain that both systems have, in the order of A's characteristics; `orders` are their columns in
    each system's order.
    """
    sets = [(of_side.characteristics, np.argsort(order)) for of_side, order in zip(evaluators, orders, strict=True)]
    lower = np.max([characteristics.lower[order] for characteristics, order in sets], axis=0)
    upper = np.min([characteristics.upper[order] for characteristics, order in sets], axis=0)
    if (lower > upper).any():
        name = evaluators[0].characteristics.names[int(np.argmax(lower > upper))]
        raise InputError(
            evaluators[1].study.source,
            f"{name}: the domains of the two studies do not overlap",
            "studies with a common domain of each characteristic",
        )
    return lower, upper


def _require_same_characteristics(a: Study, b: Study) -> None:
    units_a, units_b = ([(name, row.unit) for name, row in study.vehicle.characteristics.items()] for study in (a, b))
    if set(units_a) == set(units_b):
        return
    a_alone, b_alone = (
        ", ".join(f"{name} [{unit}]" for name, unit in units if (name, unit) not in other_units) or "none"
        for units, other_units in ((units_a, units_b), (units_b, units_a))
    )
    raise InputError(
        b.source,
        f"cannot be compared: characteristics of {a.name!r} alone: {a_alone}; of {b.name!r} alone: {b_alone}",
        "studies with the same characteristics in the same units",
    )


def _solutions_of(source: str, case: Case, names: list[str]) -> pd.DataFrame:
    """Settings of the solutions with the columns `source`, `solution`, the handle, and, if there are runs, `algorithm`
    and `run`.
    """
    run_columns = [name for name in RUN_COLUMNS if name in case.solutions and case.has_runs]
    handles = list(map(str, handles_of(case.solutions)))
    return case.solutions[[*names, *run_columns]].assign(source=source, solution=handles)


def _common_sample(
    evaluators: tuple[Evaluator, Evaluator], orders: list[list[int]], lower: FloatArray, upper: FloatArray, number: int
) -> FloatArray:
    """`number` settings that cover the common domain evenly and satisfy the constraints of both studies; fewer if
    hardly any settings do.
    """
    factor = 1
    while True:
        settings = lower + sobol_points(number * factor, len(lower), 0) * (upper - lower)
        for evaluator, order in zip(evaluators, orders, strict=True):
            if evaluator.region:
                settings = settings[evaluator.region.feasible(settings[:, order])]
        if len(settings) >= number or factor >= MAX_FACTOR:
            return settings[:number]
        factor *= 2


def _default_criterion(both_rated: bool, evaluations: list[Evaluations], originals: list[Evaluations]) -> Unsafe:
    """The default criterion for all vehicles of both systems; its limit depends on A's original, on its points only if
    both systems are rated.
    """
    original_a, original_b = originals
    if not both_rated:
        metrics = {name: values for name, values in original_a.metrics.items() if name != RATING_POINTS.name}
        original_a = replace(original_a, metrics=metrics)
    return Unsafe.default_among(Evaluations.concatenate([*evaluations, original_b]), original_a)


def _test(frame: pd.DataFrame) -> tuple[float | None, float | None, str, int]:
    """Test the columns `a` and `b` in pairs: the p-value, A12, and the unit and number of the pairs.

    A pair is the mean over the solutions of a run or, if there are fewer runs than the test needs, a setting of the
    sample.
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


def _weather_table(cases: list[Case]) -> pd.DataFrame | None:
    """The table `weather` of the research questions, if both subjects are results that differ in the weather alone."""
    try:
        return compare_weathers(*cases) if len(cases) == 2 else None
    except UnanswerableError:
        return None
