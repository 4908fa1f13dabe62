"""Which characteristics decide: shares of the variance (Sobol indices)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from itertools import combinations, combinations_with_replacement, compress
from unittest.mock import patch

import numpy as np
import pandas as pd
from numpy.random import default_rng
from scipy.stats import norm, zscore

from safevar_sumo.metrics import F_SAFE, Unsafe
from safevar_sumo.questions.answer import HIGH, LOW, Column, Columns, tabulate, with_interval
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, IntArray, JsonObject

SENSITIVITY = "sensitivity analysis"
"""Phase of progress."""
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
Indices = Mapping[str, FloatArray | float]
"""As SALib's results: by key, an index of each characteristic, shape (n,), or half of its
confidence interval; R2 is what a regression explains.
"""


def _problem(evaluator: Evaluator) -> JsonObject:
    """SALib's problem: each characteristic by its quantile."""
    names = list(evaluator.characteristics.names)
    return {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}


def design_of(evaluator: Evaluator, model: VariationModel) -> Evaluations:
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
