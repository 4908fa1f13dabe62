"""How likely is an unsafe vehicle when vehicles vary as a study specifies, and which characteristic
decides?

Plain Monte Carlo with the exact interval of Clopper and Pearson. What decides: Sobol indices, first
order and total (Saltelli's design); where characteristics are correlated or constrained, for which
Sobol's design does not exist, the first-order index from the drawn vehicles themselves (Plischke,
Borgonovo, Smith 2013, European Journal of Operational Research 226, 536-550).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from itertools import combinations, combinations_with_replacement, compress
from unittest.mock import patch

import numpy as np
import pandas as pd
from numpy.random import default_rng
from scipy.stats import norm, zscore

from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import F_SAFE, Unsafe
from safevar_sumo.questions.answer import (
    HIGH,
    LOW,
    Answer,
    Column,
    Columns,
    contents,
    tabulate,
    with_interval,
)
from safevar_sumo.questions.ask import question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.options import Count, Criterion, Fraction
from safevar_sumo.questions.over_sets import SharesOverSets, planned_over_sets
from safevar_sumo.questions.price import LEAST_SETTINGS
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.questions.words import join_phrases, number_of, percentage, with_scope
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, IntArray, JsonObject
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import Uniform

SAMPLING, SENSITIVITY = "sampling vehicles", "sensitivity analysis"
"""Phases of progress."""
BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
FEWEST = 3
"""Number of vehicles for each characteristic with which a sample says what decides; fewer say
nothing about it.
"""
LEAST_EXPLAINED = 0.5
"""Share of the variance that a regression has to explain to say what decides [-]."""
PENALTY = 1e-3
"""Penalty of a ridge regression for each vehicle [-]."""
REGRESSED = 4096
"""Number of vehicles over which the variance of a regression is known."""
RESAMPLES = 200
"""Number of bootstrap samples for the intervals of indices."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, for indices of the unsafe outcome."""
RARE = 1e-4
"""If no vehicle is unsafe, the verdict says how many would show a probability this small [-]."""
MAX_DECIDING = 5
"""Number of characteristics that one screen names."""
MAX_RIVALS = 3
"""Largest number of characteristics that the verdict names beside the one with the largest share.
"""
NO_PROBABILITY = (
    " This is no probability in traffic: the study does not say how vehicles vary (`[variation]`)."
)
OUTPUTS = {"degree": "the safety degree", "unsafe": "whether the vehicle is unsafe"}
"""What varies, by the beginning of the names of its columns; another measure may stand in place of
the safety degree.
"""
OF_WHAT, EXPLAINED = "of_what", "explained"
"""The attributes of the table that say what varies, as `OUTPUTS` does, and which share of its
variance a regression explains; None without a regression.
"""
UNDEFINED = ("", "undefined here")
"""SALib's key and the meaning of an index that does not exist."""
COLUMNS = [
    "characteristic",
    *(
        f"{output}_{index}{end}"
        for output in OUTPUTS
        for index in ("first", "total")
        for end in ("", LOW, HIGH)
    ),
]
Indices = Mapping[str, FloatArray | float]
"""As SALib's results: by key, an index of each characteristic, shape (n,), or half of its
confidence interval; R2 is what a regression explains.
"""


@question
@contents(
    *("unsafe", "samples", "failures", "probability", "interval", "confidence", "by_set"),
    lead="sensitivity",
    next="explain",
    sensitivity=COLUMNS,
)
def risk(
    subject: Subject,
    evaluator: Evaluator,
    *,
    samples: Count = 10_000,
    confidence: Fraction = 0.95,
    unsafe: Criterion = None,
) -> Answer:
    """Estimate how likely an unsafe vehicle is if vehicles vary as the study specifies, and which
    characteristics decide it.

    Parameters
    ----------
    samples
        Number of vehicles, sampled as [variation] says, without it uniformly over the domain.
    confidence
        Confidence of the intervals.
    unsafe
        What is unsafe: a collision, a safety degree below X, or at most X points of a rating.
    """
    # Vehicles as the study says that they vary.
    study = evaluator.study
    model = VariationModel(study)
    has_design = not (model.is_correlated or model.region or study.ranges)
    of_design = has_design * BASE_POINTS * (len(evaluator.characteristics) + 2)
    phases = planned_over_sets(study, SAMPLING, samples) | {SENSITIVITY: of_design}
    evaluator.begin(phases, least=LEAST_SETTINGS)
    criterion = evaluator.choose_criterion(unsafe, subject)
    samples = evaluator.at_most(samples)
    drawn = evaluator.evaluate(model.draw(samples, default_rng(study.search.seed)), SAMPLING)

    # How many are unsafe.
    simulated = drawn.take(np.flatnonzero(drawn.valid))
    failures = criterion.number(simulated)
    total = len(simulated)
    if not total:
        raise SimulationError(
            f"study {study.name!r}: none of {samples} vehicles could be simulated"
        )

    # With which probability, also in other parameter sets, and which characteristics decide.
    low, high = clopper_pearson(failures, total, confidence)
    over_sets = SharesOverSets.of(evaluator, criterion, drawn.settings)
    indices, of_whom = given_data_indices, simulated
    if evaluator.left is not None and not model.is_correlated:
        indices = regression_indices
    elif has_design:
        indices, of_whom = sobol_indices, _design(evaluator, model)
    table = indices(evaluator, of_whom, criterion, confidence)
    numbers = {"unsafe": str(criterion), "samples": total, "failures": failures}
    numbers |= {"probability": failures / total, "interval": [low, high], "confidence": confidence}
    numbers["by_set"] = over_sets.of_all(failures / total)

    # In words.
    verdict = (
        f"{_probability_in_words(study, criterion, failures, total)} ({100 * confidence:g} %"
        f" confidence interval {percentage(low)} to {percentage(high)} %)."
        f"{over_sets.in_words(failures / total)}"
        f"{NO_PROBABILITY if not study.variation else ''}"
    )
    left_out = int(drawn.infeasible.sum())
    if failed := samples - total - left_out:
        verdict += f" {failed:,} vehicles could not be simulated and are left out."
    least = FEWEST * len(evaluator.characteristics)
    if of_whom is simulated and total < least:
        verdict += f" What decides is unknown: that needs {least} vehicles."
    else:
        verdict += deciding_in_words(table, failures)
    verdict += "" if failures else _bound_in_words(high, total, confidence)
    table.attrs["lead_rows"] = range(min(MAX_DECIDING, len(table)))
    has_shares = table.drop(columns="characteristic").notna().any(axis=None)
    return Answer(
        question="risk",
        study=study,
        verdict=with_scope(study, left_out, verdict, criterion.remark),
        numbers=numbers,
        tables={"sensitivity": table},
        folded=() if has_shares else ("sensitivity",),
    )


def _bound_in_words(high: float, total: int, confidence: float) -> str:
    """What a sample without an unsafe vehicle says, and how many vehicles would say more. Clopper
    and Pearson's upper end of 0 of n is 1 - ((1 - confidence) / 2)^(1 / n).
    """
    words = f" No vehicle is unsafe, so the share is at most {percentage(high)} %."
    needed = math.ceil(math.log((1 - confidence) / 2) / math.log1p(-RARE))
    further = (
        f" To show at most {percentage(RARE)} %, {needed:,} vehicles are needed of which none is"
        " unsafe (--samples)."
    )
    return f"{words}{further if total < needed else ''}"


def deciding_in_words(table: pd.DataFrame, failures: float) -> str:
    """Which characteristic decides the table's measure, as the interval of its share of the
    variance is above those of all others, or which may.
    """
    if table.empty:
        return ""
    index = "total" if table["degree_total"].notna().any() else "first"

    # The largest share, of all orders if it is known.
    first = table.iloc[0]
    share, low, high = (first[f"degree_{index}{end}"] for end in ("", LOW, HIGH))
    in_words = table.attrs[OF_WHAT]
    words = f" No vehicle was found that changes {in_words['degree']}, so nothing decides it."
    explained = table.attrs.get(EXPLAINED)
    by = ""
    if explained is not None:
        by = (
            f" A regression with squares and products explains {100 * max(explained, 0):.0f} % of"
            " the variance (R^2, cross-validated)."
        )
        words = f"{by} As this is less than half, what decides is unknown."
    if np.isfinite(share):
        name = first["characteristic"]
        causes = (
            f"causes {100 * share:.0f} % of the variance of {in_words['degree']}"
            f" ({100 * low:.0f} to {100 * high:.0f} %)"
        )
        _, *rivals = table[table[f"degree_{index}{HIGH}"] >= low]["characteristic"]
        words = f" {name} decides most: it {causes}."
        if rivals:
            words = (
                f" What decides most is uncertain: {name} {causes}, and the interval of"
                f" {join_phrases(rivals[:MAX_RIVALS])} overlaps with that."
            )
        words += by

    # Without the outcome's own shares, what decides it is unknown.
    if failures and table[f"unsafe_{index}"].isna().all():
        words += (
            " What decides whether a vehicle is unsafe is unknown: that needs"
            f" {MIN_OUTCOMES} unsafe and as many safe vehicles."
        )
    return words


def _probability_in_words(study: Study, criterion: Unsafe, failures: float, total: int) -> str:
    """The share of unsafe vehicles, and how vehicles vary."""
    share = f"{percentage(failures / total)} %"
    if not study.variation:
        vehicles = (
            f"{number_of(total, 'vehicle')} that were sampled uniformly over the whole domain"
        )
        return f"Of {vehicles}, {criterion.number_in_words(failures)}: {share}"

    # Distributions other than the uniform one.
    variation = [
        f"{name} {distribution.__struct_config__.tag}"
        for name, distribution in study.variation.items()
        if distribution != Uniform()
    ]
    rest = ["the others uniform"] if len(variation) < len(study.domains) else []
    manner = join_phrases(variation + rest)
    vehicles = f"Of {number_of(total, 'vehicle')} that vary as the study says ({manner})"
    return f"{vehicles}, {criterion.number_in_words(failures)}. So the probability is about {share}"


def _problem(evaluator: Evaluator) -> JsonObject:
    """SALib's problem: each characteristic by its quantile."""
    names = list(evaluator.characteristics.names)
    return {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}


def _design(evaluator: Evaluator, model: VariationModel) -> Evaluations:
    """Saltelli's design, in which each characteristic varies alone and with all others."""
    from SALib.sample import sobol as design

    seed = evaluator.seed % 2**32
    points = design.sample(_problem(evaluator), BASE_POINTS, calc_second_order=False, seed=seed)
    return evaluator.evaluate(model.settings(points), SENSITIVITY)


def regression_indices(
    evaluator: Evaluator, evaluations: Evaluations, criterion: Unsafe, confidence: float
) -> pd.DataFrame:
    """The total share of the variance that each of the independent characteristics has in a ridge
    regression with squares and products, with bootstrap intervals; undefined where it explains less
    than `LEAST_EXPLAINED` of the variance of vehicles that were left out.
    """
    names = list(evaluator.characteristics.names)
    rng = default_rng(evaluator.seed)
    others = VariationModel(evaluator.study).draw(REGRESSED, rng)
    inputs = np.nan_to_num(zscore(np.vstack([evaluations.settings, others])))

    # Characteristics, and products of two or of one with itself; they vary as in other vehicles.
    columns = range(len(names))
    factors = [*combinations(columns, 1), *combinations_with_replacement(columns, 2)]
    terms = np.stack([inputs[:, factor].prod(axis=1) for factor in factors], axis=1)
    seen, covariance = terms[: len(evaluations)], np.cov(terms[len(evaluations) :].T)
    has = np.array(
        [*([column in factor for factor in factors] for column in columns), [True] * len(factors)]
    )

    def fit(output: FloatArray, is_used: BoolArray, rows: IntArray) -> tuple[float, FloatArray]:
        """The mean square of what each vehicle differs from the regression of all others (Allen
        1974, Technometrics 16, 125-127), and the shares of the characteristics.
        """
        x, y = seen[rows] * is_used, output[rows]
        x, y = x - x.mean(axis=0), y - y.mean()
        solve = np.linalg.solve(x.T @ x + PENALTY * len(y) * np.eye(len(factors)), x.T)
        left_out = (y - x @ solve @ y) / (1 - 1 / len(y) - np.sum(x.T * solve, axis=0))
        weights = has * (solve @ y)
        variances = np.sum(weights @ covariance * weights, axis=1)
        return float(np.mean(left_out**2)), variances[:-1] / (variances[-1] or 1.0)

    def indices_of(output: FloatArray) -> Indices:
        # With products if they help to predict left-out vehicles.
        rows = np.arange(len(output))
        kinds = [has.sum(axis=0) == 2, has[-1]]  # a single characteristic, and all
        error, _, best = min(
            (fit(output, kind, rows)[0], number, kind) for number, kind in enumerate(kinds)
        )
        explained = float(1 - error / np.var(output))
        if explained < LEAST_EXPLAINED:
            return {"R2": explained}
        samples = [rows, *rng.integers(0, len(rows), (RESAMPLES, len(rows)))]
        shares, *others = [explained * fit(output, best, sample)[1] for sample in samples]
        half = norm.ppf(0.5 + confidence / 2) * np.std(others, axis=0, ddof=1)
        return {"R2": explained, "ST": shares, "ST_conf": half}

    kinds = {"first": UNDEFINED, "total": ("ST", "total, in a quadratic regression")}
    table = _table(names, evaluations, criterion, indices_of, kinds)
    table.attrs["title"] = "What decides: shares of the variance (quadratic regression)"
    return table


def sobol_indices(
    evaluator: Evaluator, evaluations: Evaluations, criterion: Unsafe, confidence: float
) -> pd.DataFrame:
    """Sobol indices, first order and total, of independent characteristics, from Saltelli's design;
    undefined where nothing varies, or too few settings are unsafe or safe. Base points with a
    setting that could not be simulated do not count.
    """
    from SALib.analyze import sobol as analysis

    problem = _problem(evaluator)
    names = problem["names"]
    seed = evaluator.seed % 2**32
    block = len(names) + 2
    is_complete = np.repeat(evaluations.valid.reshape(-1, block).all(axis=1), block)

    indices_of = partial(
        analysis.analyze,
        problem,
        calc_second_order=False,
        num_resamples=RESAMPLES,
        conf_level=confidence,
        seed=seed,
    )
    kinds = {"first": ("S1", "first order"), "total": ("ST", "total, with all interactions")}
    return _table(names, evaluations.take(is_complete), criterion, indices_of, kinds)


def given_data_indices(
    evaluator: Evaluator, evaluations: Evaluations, criterion: Unsafe, confidence: float
) -> pd.DataFrame:
    """The first-order index of correlated or constrained characteristics, from the vehicles as they
    were drawn: the share of the variance that knowing a characteristic removes, with what is
    correlated with it.
    """
    from SALib.analyze import delta as analysis

    # Characteristics that vary in the sample.
    varies = np.ptp(evaluations.settings, axis=0) > 0
    names = [*compress(evaluator.characteristics.names, varies)]
    problem = {
        "num_vars": len(names),
        "names": [str(number) for number in range(len(names))],
    }  # SALib reserves endings
    options = {"num_resamples": RESAMPLES, "conf_level": confidence, "method": "sobol"}

    def indices_of(output: FloatArray) -> Indices:
        seed = evaluator.seed % 2**32
        with (
            warnings.catch_warnings(),
            patch.object(warnings, "formatwarning"),
        ):  # SALib sets both for the process
            indices: Indices = analysis.analyze(
                problem, evaluations.settings[:, varies], output, seed=seed, **options
            )
        return indices

    first = "S1", "first order, with everything that is correlated with it"
    return _table(names, evaluations, criterion, indices_of, {"first": first, "total": UNDEFINED})


def _table(
    names: list[str],
    evaluations: Evaluations,
    criterion: Unsafe,
    indices_of: Callable[[FloatArray], Indices],
    kinds: dict[str, tuple[str, str]],
) -> pd.DataFrame:
    """A row for each characteristic, the one that decides most of the measure first; `kinds` maps
    an index to SALib's key and its meaning. Readers see the name of a measure other than the safety
    degree above its column.
    """
    # The criterion's measure, or the safety degree where the measure is undefined for a vehicle,
    # such as one that collides.
    degree = evaluations.f_safe
    output_names = dict(OUTPUTS)
    own = evaluations.column(criterion.measure)
    if criterion.measure != F_SAFE.name and np.isfinite(own).all():
        degree = own
        output_names["degree"] = criterion.measure

    # Outputs that vary enough have indices.
    is_unsafe = criterion.runs(evaluations).mean(axis=0)
    failures = is_unsafe.sum()
    found = dict[str, Indices]()
    if len(degree) >= FEWEST * len(names) and np.ptp(degree) > 0:
        found["degree"] = indices_of(degree)
    if MIN_OUTCOMES <= failures <= len(degree) - MIN_OUTCOMES:
        found["unsafe"] = indices_of(is_unsafe)

    # An index of each output, with its interval.
    columns: Columns = {"characteristic": "characteristic of the vehicle, or of its encounter"}
    values = dict[str, FloatArray]()
    undefined = np.full(len(names), np.nan)
    for output, of_what in output_names.items():
        of_output = found.get(output, {})
        for index, (key, meaning) in kinds.items():
            name = f"{output}_{index}"
            value = np.asarray(of_output.get(key, undefined), dtype=float)
            half = np.asarray(of_output.get(f"{key}_conf", undefined), dtype=float)
            values |= {name: value, f"{name}{LOW}": value - half, f"{name}{HIGH}": value + half}
            head = f"{of_what.removeprefix('the ')}: {index}" if output == "degree" else ""
            meaning = f"share of the variance of {of_what}: {meaning}"
            column = Column("-", meaning, ".2f", head=head, is_detail=output == "unsafe")
            columns |= with_interval(name, column)

    # The characteristic that decides most comes first.
    frame = pd.DataFrame({"characteristic": names, **values})
    last = "degree_first" if kinds["total"] == UNDEFINED else "degree_total"
    frame = frame.sort_values(last, ascending=False, kind="stable", ignore_index=True)
    table = tabulate("What decides: shares of the variance (Sobol indices)", columns, frame)
    table.attrs |= {OF_WHAT: output_names, EXPLAINED: found.get("degree", {}).get("R2")}
    return table
