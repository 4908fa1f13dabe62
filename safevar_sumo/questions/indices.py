"""Computes the influence of characteristics: shares of a measure's variance (Sobol indices)."""

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
"""The phase of progress in which the settings of the design are simulated."""
BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
LEAST_VEHICLES = 200
"""Least number of vehicles for indices. With fewer vehicles, the largest share of 20
characteristics without any effect is usually above 0.1.
"""
RESAMPLES = 200
"""Number of bootstrap samples for the intervals of indices."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, for indices of the unsafe outcome."""
OUTPUTS = {"degree": "the safety degree", "unsafe": "whether the vehicle is unsafe"}
"""The outputs whose variance is shared out, by the beginning of the names of their columns. The
measure of the criterion may replace the safety degree.
"""
MAX_DECIDING = 5
"""Largest number of characteristics on one screen."""
UNDEFINED = ("", "undefined here")
"""An empty key of SALib's results, and the meaning, for an index that does not exist."""
Indices = Mapping[str, FloatArray]
"""SALib's results by key: the index of each characteristic, shape (n,), or half of the width of its
confidence interval.
"""


IndexTable = tuple[AnswerTable, str]
"""The table of the indices, and the name of the measure whose variance is shared out."""


def _problem(number: int) -> JsonObject:
    """The problem as SALib wants it: the quantiles of `number` characteristics vary from 0 to 1.
    Their names are numbers, because SALib reserves some endings of names.
    """
    return {
        "num_vars": number,
        "names": list(map(str, range(number))),
        "bounds": [[0.0, 1.0]] * number,
    }


def _seed(evaluator: Evaluator) -> int:
    """The study's seed for SALib. It is never 0: with 0, SALib's numbers would differ each time."""
    return evaluator.seed % 2**32 or 1


def size_of_design(evaluator: Evaluator) -> int:
    """The number of settings of Saltelli's design."""
    return BASE_POINTS * (len(evaluator.characteristics) + 2)


def design_of(evaluator: Evaluator, model: VariationModel) -> Evaluations:
    """The evaluations of the settings of Saltelli's design, in which each characteristic varies
    alone, and together with all others.
    """
    from SALib.sample import sobol as design

    seed = evaluator.seed % 2**32
    problem = _problem(len(evaluator.characteristics))
    points = design.sample(problem, BASE_POINTS, calc_second_order=False, seed=seed)
    return evaluator.evaluate(model.settings(points), SENSITIVITY)


def sobol_indices(
    evaluator: Evaluator, evaluations: Evaluations, criterion: Unsafe, confidence: float
) -> IndexTable:
    """The table of the Sobol indices, first order and total, of independent characteristics; and
    the name of the measure whose variance is shared out.

    The indices come from Saltelli's design (`evaluations`). They are undefined if the output does
    not vary, or if too few settings are unsafe or safe. A base point counts only if all its
    settings have valid simulations.
    """
    from SALib.analyze import sobol as analysis

    names = evaluator.characteristics.names
    block = len(names) + 2
    is_complete = np.repeat(evaluations.valid.reshape(-1, block).all(axis=1), block)

    indices_of = partial(
        analysis.analyze,
        _problem(len(names)),
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
) -> IndexTable:
    """The table of the first-order indices from any sample of vehicles (`evaluations`); and the
    name of the measure whose variance is shared out.

    The index is the share of the variance that disappears if a characteristic is known. It includes
    the influence of other characteristics that depend on this one.
    """
    from SALib.analyze import delta as analysis

    varies = np.ptp(evaluations.settings, axis=0) > 0
    names = list(compress(evaluator.characteristics.names, varies))
    problem = _problem(len(names))
    options = {"num_resamples": RESAMPLES, "conf_level": confidence, "method": "sobol"}

    def indices_of(output: FloatArray) -> Indices:
        """SALib's first-order indices of an output, shape (M,)."""
        # SALib changes the warning filters and `formatwarning` of the whole process: undo this.
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
) -> IndexTable:
    """The table with a row for each characteristic, the one with the largest influence first; and
    the name of the measure. `kinds` maps the name of an index to SALib's key and the index's
    meaning.
    """
    # The measure is that of the criterion. If it is undefined for some vehicle, such as a vehicle
    # that collides, the safety degree replaces it.
    degree = evaluations.f_safe
    output_names = dict(OUTPUTS)
    measured = evaluations.column(criterion.measure)
    if criterion.measure != F_SAFE.name and np.isfinite(measured).all():
        degree = measured
        output_names["degree"] = criterion.measure

    is_unsafe = criterion.runs(evaluations).mean(axis=0)
    failures = is_unsafe.sum()
    indices = {}
    if len(degree) >= LEAST_VEHICLES and np.ptp(degree) > 0:
        indices["degree"] = indices_of(degree)
    if MIN_OUTCOMES <= failures <= len(degree) - MIN_OUTCOMES:
        indices["unsafe"] = indices_of(is_unsafe)

    columns: Columns = {
        "characteristic": "characteristic of the vehicle, or of its encounter"
    }
    values = {}
    undefined = np.full(len(names), np.nan)
    for output, of_what in output_names.items():
        of_output = indices.get(output, {})
        for index, (key, meaning) in kinds.items():
            name = f"{output}_{index}"
            value = np.asarray(of_output.get(key, undefined), float)
            half = np.asarray(of_output.get(f"{key}_conf", undefined), float)
            # An estimate may lie outside of 0 to 1, although a share cannot.
            values[name] = np.clip(value, 0, 1)
            values[f"{name}{LOW}"] = np.clip(value - half, 0, 1)
            values[f"{name}{HIGH}"] = np.clip(value + half, 0, 1)
            head = ""
            if output == "degree":
                head = f"{of_what.removeprefix('the ')}: {index}"
            column = Column(
                "-",
                f"share of the variance of {of_what}: {meaning}",
                ".2f",
                head=head,
                is_detail=not head,
            )
            columns |= with_interval(name, column)

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
