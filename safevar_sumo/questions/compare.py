"""What changes from one system to another: another driving system, vehicle, weather or version?

The same settings are simulated in both systems, A and B: all solutions of results on either side that both domains
hold, and Sobol points of the common domain that satisfy the constraints of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Answer, Column, tabulate, with_interval
from safevar_sumo.questions.ask import Count, Criterion, question
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.evaluator import Evaluator, sobol_points
from safevar_sumo.questions.repair.price import benign_scenes, needless_braking
from safevar_sumo.questions.research_questions.statistics import ALPHA, compare_samples, fewest_runs, signed_rank_test
from safevar_sumo.questions.subject import study_in
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan, scan
from safevar_sumo.questions.words import counted_in_words, number_of
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.results import handles_of
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import assemble

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_FACTOR = 512
"""Largest number of settings that are drawn for each common one that satisfies the constraints."""
SAMPLE = "sample"
"""Source of the settings of the common sample."""
RUN_COLUMNS = ["source", "algorithm", "run"]
"""Columns that identify a run."""
SIDES = ("a", "b")
UNSAFE_IN = {"a": "only_a_unsafe", "b": "only_b_unsafe", "both": "both", "neither": "neither"}
"""In which systems a setting is unsafe, as the table says it, and the number that counts such settings."""
SETTING_COLUMNS = {
    "solution": Column("", "handle of the solution"),
    "unsafe_in": Column("", f"systems in which it is unsafe: {', '.join(UNSAFE_IN)}"),
    **{
        f"{side}_{name}": column
        for side in SIDES
        for name, column in (
            ("outcome", Column("", f"outcome in {side.upper()}")),
            ("degree", Column("m", f"safety degree in {side.upper()}; in -m/s on a collision", ".2f")),
        )
    },
}
LIMIT_COLUMNS = {
    "characteristic": Column("", "characteristic of the vehicle"),
    "unit": Column("", "its unit"),
    **with_interval("a", Column("", "value of A's original vehicle; the interval is safe alone in A", ".5g")),
    **with_interval("b", Column("", "value of B's original vehicle; the interval is safe alone in B", ".5g")),
}


@question
def compare(
    subject: Study | Case, evaluator: Evaluator, other: Study | Case, *, samples: Count = 2000, unsafe: Criterion = None
) -> Answer:
    """Compare two studies or results, A and B: what is unsafe in one of them only, limits, ratings.

    One criterion counts for both. The filter of small changes, whose thresholds are a search's, does not act.

    Parameters
    ----------
    samples
        Number of Sobol points of the common domain that are simulated beside the solutions.
    unsafe
        What is unsafe: a collision, a safety degree below X, or at most X points of a rating.
    """
    study = evaluator.study
    evaluators = evaluator, evaluator.for_study(_in_order_of(study, study_in(other)))
    stated = [one.parse_criterion(unsafe) for one in evaluators if unsafe is not None]
    names = list(evaluator.characteristics.names)
    frame, outside = _common_settings((subject, other), evaluators, samples)
    runs = [
        one.evaluate(frame[names].to_numpy(float), f"settings in {side.upper()}")
        for one, side in zip(evaluators, SIDES, strict=True)
    ]
    originals, both_rated = (
        [one.evaluate_original() for one in evaluators],
        all(is_rated(one.study) for one in evaluators),
    )
    criterion = stated[0] if stated else _default_criterion(both_rated, runs, originals)
    is_valid, is_left_out = runs[0].valid & runs[1].valid, runs[0].infeasible | runs[1].infeasible
    frame, (a, b) = frame[is_valid].reset_index(drop=True), [run.take(is_valid) for run in runs]
    settings = pd.concat([frame, table_of_pairs(frame["solution"], a, b, criterion).drop(columns="solution")], axis=1)
    metric = RATING_POINTS.name if both_rated else SAFETY_DEGREE
    p, a12, pairs = _test(frame.assign(a=a.column(metric), b=b.column(metric)))
    distinct, reason_b = settings.drop_duplicates(names), evaluators[1].no_verdict
    numbers: JsonObject = {
        **({"driven": False} if reason_b else {}),
        "unsafe": str(criterion),
        "settings": len(distinct),
        **counts_of(distinct),
        "p": p,
        "a12": a12,
        "outside": outside,
        "not_simulated": int(np.count_nonzero(~is_valid & ~is_left_out)),
        **_needless_braking(*(one.study for one in evaluators)),
        **_ends_of_originals(evaluators, originals, with_points=both_rated),
    }
    titles = tuple(one.study.name for one in evaluators)
    titles = titles if len(set(titles)) == 2 else ("A", "B")
    test = _test_in_words("rating" if both_rated else "safety degree", titles[1], p, a12, pairs)
    words = count_in_words(numbers, titles[0], titles[1], criterion), test
    verdict = " ".join([*words, *counted_in_words(study, int(np.count_nonzero(is_left_out)))])
    if reason_b not in ("", evaluator.no_verdict):
        verdict = f"{reason_b} {verdict}"
    columns = np.flatnonzero(evaluator.characteristics.of_vehicle).tolist()
    limits = [*_limits(*(scan(one, columns, criterion) for one in evaluators))]
    tables = {
        "limits": tabulate("Limits of each alone, all others as in the original", LIMIT_COLUMNS, limits),
        "settings": _settings_table(evaluator, settings),
    }
    draw = partial(draw_pairs, titles=titles)
    return Answer(question="compare", study=study, verdict=verdict, numbers=numbers, tables=tables, draw=draw)


def _ends_of_originals(
    evaluators: Sequence[Evaluator], originals: Sequence[Evaluations], *, with_points: bool
) -> JsonObject:
    """How both original vehicles end, with the gap where degrees are from centre to centre."""
    numbers: JsonObject = {}
    for side, one, original in zip(SIDES, evaluators, originals, strict=True):
        numbers |= {f"{side}_outcome": str(original.outcome[0]), f"{side}_degree": float(original.f_safe[0])}
        if contact := contact_degree(assemble(one.study)):
            numbers[f"{side}_gap"] = float(original.gaps(contact)[0])
        if with_points:
            numbers[f"{side}_points"] = float(original.column(RATING_POINTS.name)[0])
    return numbers


def _settings_table(evaluator: Evaluator, settings: pd.DataFrame) -> pd.DataFrame:
    """The table of settings, those first that are unsafe in one system only."""
    columns = {"source": Column("", "a or b, whose solution it is, or sample"), **SETTING_COLUMNS}
    columns |= {item.name: Column(item.unit, item.words, is_shown=False) for item in evaluator.characteristics}
    order = settings["unsafe_in"].map([*UNSAFE_IN].index).sort_values(kind="stable").index
    return tabulate("The same settings in both systems", columns, settings.loc[order, [*columns]])


def table_of_pairs(
    solutions: Sequence[str] | pd.Series[str], a: Evaluations, b: Evaluations, unsafe: Unsafe
) -> pd.DataFrame:
    """The frame with `SETTING_COLUMNS` of settings that were evaluated in two systems."""
    in_a, in_b = unsafe.of(a), unsafe.of(b)
    where = np.select([in_a & ~in_b, in_b & ~in_a, in_a & in_b], [*UNSAFE_IN][:-1], [*UNSAFE_IN][-1])
    values = (solutions, where, a.outcome, a.f_safe, b.outcome, b.f_safe)
    return pd.DataFrame(dict(zip(SETTING_COLUMNS, values, strict=True)))


def counts_of(settings: pd.DataFrame) -> dict[str, int]:
    """How many settings of a table are unsafe in A only, in B only, in both and in neither."""
    return {number: int((settings["unsafe_in"] == where).sum()) for where, number in UNSAFE_IN.items()}


def count_in_words(numbers: JsonObject, a: str, b: str, unsafe: Unsafe) -> str:
    """The counts as a sentence: what B avoids, and what it adds."""
    both, only_a, only_b, neither = (
        int(numbers[name]) for name in ("both", "only_a_unsafe", "only_b_unsafe", "neither")
    )
    return (
        f"{b} avoids {only_a} of {number_of(only_a + both, 'setting')} unsafe in {a}, and is unsafe in {only_b} of "
        f"{number_of(only_b + neither, 'setting')} safe in {a} ({unsafe.description})."
    )


def paired_test(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """The p-value of the signed-rank test of pairs, and the probability that A's value is greater (Vargha and Delaney's
    A12); NaN without pairs.
    """
    return signed_rank_test(a - b).p_value, compare_samples(a, b).effect_size


def draw_pairs(answer: Answer, titles: Sequence[str]) -> Figure:
    """The safety degree of every setting in B over that in A; on the line they agree."""
    from safevar_sumo.questions.figures import BLUE, FONT_SIZE, GREY, SKY_BLUE, VERMILION, escape_dollars, new_figure

    frame = answer.tables["settings"]
    figure, ((axis,),) = new_figure(f"Unsafe: {answer.numbers['unsafe']}", 1, 1, (4.6, 4.0))
    for where, colour in {"neither": GREY, "both": SKY_BLUE, "a": BLUE, "b": VERMILION}.items():
        rows = frame[frame["unsafe_in"] == where]
        axis.scatter(rows["a_degree"], rows["b_degree"], s=6, color=colour, label=where, rasterized=True)
    axis.axline((0, 0), slope=1, color="black", linewidth=0.6)
    labels = [escape_dollars(f"safety degree in {name} [m, below 0: -m/s]") for name in titles]
    axis.set(xlabel=labels[0], ylabel=labels[1])
    axis.legend(title="unsafe in", fontsize=FONT_SIZE - 1)
    return figure


def _test_in_words(quantity: str, b: str, p: float, a12: float, pairs: str) -> str:
    if np.isnan(p):
        return "There is no pair of results to test."
    change = f"{'lower' if a12 > 0.5 else 'higher'} in {b}" if p < ALPHA else "not significantly different"
    return f"The {quantity} is {change} (p = {p:.2g}, A12 = {a12:.2f}; {pairs})."


def _limits(in_a: Sequence[OneAtATimeScan], in_b: Sequence[OneAtATimeScan]) -> Iterator[list[Any]]:
    """A row of `LIMIT_COLUMNS` for each characteristic; no interval where the original is unsafe."""
    for both in zip(in_a, in_b, strict=True):
        item = both[0].characteristic
        values = [(one.characteristic.original, *(one.safe or (np.nan, np.nan))) for one in both]
        yield [item.name, item.unit, *chain(*values)]


def _needless_braking(a: Study, b: Study) -> dict[str, int]:
    """In how many of A's benign scenes the original vehicles of A and B brake, and the number of these scenes."""
    systems = [assemble(study, study.source) for study in (a, b)]
    # What a study searches in its scenario, these scenes do not have.
    systems = [replace(one, characteristics=one.characteristics.vehicle) for one in systems]
    scenes = benign_scenes(a, systems[0])
    brakes_in_a, brakes_in_b = (needless_braking(system, scenes) for system in systems)
    counts = {"a_needless_braking": sum(brakes_in_a), "b_needless_braking": sum(brakes_in_b)}
    return {**counts, "benign_scenes": len(brakes_in_a)}


def _in_order_of(a: Study, b: Study) -> Study:
    """Study B with its characteristics in A's order; refuses other characteristics and searched parameters, and other
    units.
    """
    units_a, units_b = ({(name, row.unit) for name, row in study.domains.items()} for study in (a, b))
    if units_a == units_b:
        characteristics = {name: b.domains[name] for name in a.vehicle.characteristics}
        return msgspec.structs.replace(
            b,
            vehicle=msgspec.structs.replace(b.vehicle, characteristics=characteristics),
            scenario=msgspec.structs.replace(b.scenario, search={name: b.domains[name] for name in a.scenario.search}),
        )
    a_alone, b_alone = (
        ", ".join(f"{name} [{unit}]" for name, unit in sorted(units)) or "none"
        for units in (units_a - units_b, units_b - units_a)
    )
    raise InputError(
        b.source,
        f"cannot be compared: characteristics of {a.name!r} alone: {a_alone}; of {b.name!r} alone: {b_alone}",
        "studies with the same characteristics and searched parameters in the same units",
    )


def _common_settings(
    subjects: Sequence[Study | Case], evaluators: Sequence[Evaluator], samples: int
) -> tuple[pd.DataFrame, int]:
    """The settings for both systems, with `source`, `solution` and, if there are runs, `algorithm` and `run`; and the
    number of solutions outside the common domain.
    """
    names = list(evaluators[0].characteristics.names)
    lower = np.max([one.characteristics.lower for one in evaluators], axis=0)
    upper = np.min([one.characteristics.upper for one in evaluators], axis=0)
    if (lower > upper).any():
        problem = f"{names[int(np.argmax(lower > upper))]}: the domains of the two studies do not overlap"
        raise InputError(evaluators[1].study.source, problem, "studies with a common domain of each characteristic")
    sample = _common_sample(evaluators, lower, upper, samples)
    frames = [pd.DataFrame(sample, columns=names).assign(source=SAMPLE, solution="")]
    for side, case in zip("ba", reversed(subjects), strict=True):
        if isinstance(case, Case):
            kept = [*names, *(name for name in RUN_COLUMNS if name in case.solutions and case.has_runs)]
            solutions = case.solutions[kept].assign(source=side, solution=list(map(str, handles_of(case.solutions))))
            frames.insert(0, solutions)
    frame = pd.concat(frames, ignore_index=True)
    is_inside = ((frame[names] >= lower) & (frame[names] <= upper)).all(axis=1)
    return frame[is_inside].reset_index(drop=True), int(np.count_nonzero(~is_inside))


def _common_sample(evaluators: Sequence[Evaluator], lower: FloatArray, upper: FloatArray, number: int) -> FloatArray:
    """`number` settings that cover the common domain evenly and satisfy the constraints of both studies; fewer if
    hardly any settings do.
    """
    factor = 1
    while True:
        settings = lower + sobol_points(number * factor, len(lower), 0) * (upper - lower)
        for evaluator in evaluators:
            settings = settings[evaluator.region.feasible(settings)]
        if len(settings) >= number or factor >= MAX_FACTOR:
            return settings[:number]
        factor *= 2


def _default_criterion(both_rated: bool, runs: list[Evaluations], originals: list[Evaluations]) -> Unsafe:
    """The default criterion for all vehicles of both systems; its limit depends on A's original, on its points only if
    both systems are rated.
    """
    original_a, original_b = originals
    if not both_rated:
        metrics = {name: values for name, values in original_a.metrics.items() if name != RATING_POINTS.name}
        original_a = replace(original_a, metrics=metrics)
    return Unsafe.default_among(Evaluations.concatenate([*runs, original_b]), original_a)


def _test(frame: pd.DataFrame) -> tuple[float, float, str]:
    """Test the columns `a` and `b` in pairs: the p-value, A12, and what the pairs are.

    A pair is the mean over the solutions of a run or, if there are fewer runs than the test needs, a setting of the
    sample.
    """
    frame = frame.dropna(subset=[*SIDES])
    pairs, unit = frame[frame["source"] == SAMPLE][[*SIDES]], "setting"
    if "run" in frame:
        means = frame.dropna(subset=["run"]).groupby(RUN_COLUMNS)[[*SIDES]].mean()
        if len(means) >= fewest_runs("RQ1"):
            pairs, unit = means, "run"
    p, a12 = paired_test(*pairs.to_numpy(dtype=float).T)
    return p, a12, number_of(len(pairs), unit)
