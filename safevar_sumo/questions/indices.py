"""Which characteristics decide: shares of the variance (Sobol indices)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import compress
from unittest.mock import patch

import numpy as np
import pandas as pd

from safevar_sumo.metrics import F_SAFE, Unsafe
from safevar_sumo.questions.answer import (
    HIGH,
    LOW,
    AnswerTable,
    Column,
    Columns,
    tabulate,
    with_interval,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.records import Evaluations, FloatArray, JsonObject

SENSITIVITY = "sensitivity analysis"
"""Phase of progress."""
BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
LEAST_VEHICLES = 200
"""Number of vehicles from which on shares say what decides: of fewer, the largest share of 20
characteristics without any effect is usually above 0.1.
"""
RESAMPLES = 200
"""Number of bootstrap samples for the intervals of indices."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, for indices of the unsafe outcome."""
OUTPUTS = {"degree": "the safety degree", "unsafe": "whether the vehicle is unsafe"}
"""What varies, by the beginning of the names of its columns; another measure may stand in place of
the safety degree.
"""
MAX_DECIDING = 5
"""Number of characteristics that one screen names."""
UNDEFINED = ("", "undefined here")
"""SALib's key and the meaning of an index that does not exist."""
Indices = Mapping[str, FloatArray]
"""As SALib's results: by key, an index of each characteristic, shape (n,), or half of its
confidence interval.
"""


def _problem(names: Sequence[str]) -> JsonObject:
    """SALib's problem: each characteristic by its quantile. SALib reserves endings of names, so
    that it gets numbers.
    """
    return {
        "num_vars": len(names),
        "names": list(map(str, range(len(names)))),
        "bounds": [[0.0, 1.0]] * len(names),
    }


def _seed(evaluator: Evaluator) -> int:
    """The study's seed for SALib, to which 0 means that numbers differ each time."""
    return evaluator.seed % 2**32 or 1


def size_of_design(evaluator: Evaluator) -> int:
    """The number of settings of Saltelli's design."""
    return BASE_POINTS * (len(evaluator.characteristics) + 2)


def design_of(evaluator: Evaluator, model: VariationModel) -> Evaluations:
    """Saltelli's design, in which each characteristic varies alone and with all others."""
    from SALib.sample import sobol as design

    seed = evaluator.seed % 2**32
    problem = _problem(evaluator.characteristics.names)
    points = design.sample(problem, BASE_POINTS, calc_second_order=False, seed=seed)
    return evaluator.evaluate(model.settings(points), SENSITIVITY)


def sobol_indices(
    evaluator: Evaluator, evaluations: Evaluations, criterion: Unsafe, confidence: float
) -> tuple[AnswerTable, str]:
    """Sobol indices, first order and total, of independent characteristics, from Saltelli's design;
    undefined where nothing varies, or too few settings are unsafe or safe. Base points with a
    setting that could not be simulated do not count. And the name of the measure that varies.
    """
    from SALib.analyze import sobol as analysis

    names = evaluator.characteristics.names
    block = len(names) + 2
    is_complete = np.repeat(evaluations.valid.reshape(-1, block).all(axis=1), block)

    indices_of = partial(
        analysis.analyze,
        _problem(names),
        calc_second_order=False,
        num_resamples=RESAMPLES,
        conf_level=confidence,
        seed=_seed(evaluator),
    )
    kinds = {
        "first": ("S1", "first order"),
        "total": ("ST", "total, with all interactions"),
    }
    return _table(names, evaluations.take(is_complete), criterion, indices_of, kinds)


def given_data_indices(
    evaluator: Evaluator, evaluations: Evaluations, criterion: Unsafe, confidence: float
) -> tuple[AnswerTable, str]:
    """The first-order index from any sample of vehicles: the share of the variance that knowing a
    characteristic removes, with what depends on it. And the name of the measure that varies.
    """
    from SALib.analyze import delta as analysis

    # Characteristics that vary in the sample.
    varies = np.ptp(evaluations.settings, axis=0) > 0
    names = list(compress(evaluator.characteristics.names, varies))
    problem = _problem(names)
    options = {"num_resamples": RESAMPLES, "conf_level": confidence, "method": "sobol"}

    def indices_of(output: FloatArray) -> Indices:
        # SALib sets both for the process.
        with warnings.catch_warnings(), patch.object(warnings, "formatwarning"):
            settings = evaluations.settings[:, varies]
            seed = _seed(evaluator)
            indices: Indices = analysis.analyze(
                problem, settings, output, seed=seed, **options
            )
        return indices

    kinds = {
        "first": ("S1", "first order, with everything that depends on it"),
        "total": UNDEFINED,
    }
    return _table(names, evaluations, criterion, indices_of, kinds)


def _table(
    names: Sequence[str],
    evaluations: Evaluations,
    criterion: Unsafe,
    indices_of: Callable[[FloatArray], Indices],
    kinds: dict[str, tuple[str, str]],
) -> tuple[AnswerTable, str]:
    """A row for each characteristic, the one that decides most of the measure first; `kinds` maps
    an index to SALib's key and its meaning. Readers see the name of a measure other than the safety
    degree above its column.
    """
    # The criterion's measure, or the safety degree where the measure is undefined for a vehicle,
    # such as one that collides.
    degree = evaluations.f_safe
    output_names = dict(OUTPUTS)
    measured = evaluations.column(criterion.measure)
    if criterion.measure != F_SAFE.name and np.isfinite(measured).all():
        degree = measured
        output_names["degree"] = criterion.measure

    # Outputs that vary enough have indices.
    is_unsafe = criterion.runs(evaluations).mean(axis=0)
    failures = is_unsafe.sum()
    indices = {}
    if len(degree) >= LEAST_VEHICLES and np.ptp(degree) > 0:
        indices["degree"] = indices_of(degree)
    if MIN_OUTCOMES <= failures <= len(degree) - MIN_OUTCOMES:
        indices["unsafe"] = indices_of(is_unsafe)

    # An index of each output, with its interval.
    columns: Columns = {
        "characteristic": "characteristic of the vehicle, or of its encounter"
    }
    values = dict[str, FloatArray]()
    undefined = np.full(len(names), np.nan)
    for output, of_what in output_names.items():
        of_output = indices.get(output, {})
        for index, (key, meaning) in kinds.items():
            name = f"{output}_{index}"
            value = np.asarray(of_output.get(key, undefined), float)
            half = np.asarray(of_output.get(f"{key}_conf", undefined), float)
            # An estimate may lie beyond what a share can be.
            values[name] = np.clip(value, 0, 1)
            values[f"{name}{LOW}"] = np.clip(value - half, 0, 1)
            values[f"{name}{HIGH}"] = np.clip(value + half, 0, 1)
            column = Column(
                "-", f"share of the variance of {of_what}: {meaning}", ".2f"
            )
            if output == "degree":
                column = column._replace(
                    head=f"{of_what.removeprefix('the ')}: {index}"
                )
            else:
                column = column._replace(is_detail=True)
            columns |= with_interval(name, column)

    # The characteristic that decides most comes first.
    frame = pd.DataFrame({"characteristic": names, **values})
    largest = "degree_first" if kinds["total"] == UNDEFINED else "degree_total"
    frame = frame.sort_values(
        largest, ascending=False, kind="stable", ignore_index=True
    )
    title = "What decides: shares of the variance (Sobol indices)"
    table = tabulate(
        title, columns, frame, lead_rows=range(min(MAX_DECIDING, len(names)))
    )
    return table, output_names["degree"]
