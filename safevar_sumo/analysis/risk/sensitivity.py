"""Which characteristic decides: Sobol indices of the safety degree and of the unsafe outcome, over vehicles that vary."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.risk.variation import VariationModel
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray

BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, in the design for Sobol indices of unsafe outcomes."""
BOOTSTRAP_SAMPLES = 200
"""Number of bootstrap samples for the intervals."""


def compute_sensitivities(evaluator: Evaluator, model: VariationModel, unsafe: Unsafe,
                          confidence: float) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Sensitivity of the safety degree, and of the unsafe outcome.

    Returns
    -------
    tuple of pandas.DataFrame
        One row per characteristic: `characteristic`, `first_order`, `total` [share of the variance], and the intervals'
        ends `first_order_lower`, `first_order_upper`, `total_lower`, `total_upper`; NaN where nothing varies, or too few
        settings are unsafe (or safe).
    """
    from SALib.sample import sobol  # takes a second to load

    seed, names = evaluator.study.search.seed % 2**32, evaluator.characteristics.names
    problem = {"num_vars": len(names), "names": list(names), "bounds": [[0.0, 1.0]] * len(names)}
    points = sobol.sample(problem, BASE_POINTS, calc_second_order=False, seed=seed)
    evaluations = evaluator.evaluate(model.settings(np.asarray(points)), "sensitivity analysis")
    degree = np.where(evaluations.valid, evaluations.f_safe, np.nan)
    is_unsafe = np.where(evaluations.valid, unsafe.of(evaluations).astype(float), np.nan)
    if min(np.count_nonzero(is_unsafe == outcome) for outcome in (0, 1)) < MIN_OUTCOMES:
        is_unsafe[:] = np.nan
    return _sobol_indices(problem, degree, confidence, seed), _sobol_indices(problem, is_unsafe, confidence, seed)


def _sobol_indices(problem: dict[str, Any], output: FloatArray, confidence: float, seed: int) -> pd.DataFrame:
    """Sobol indices of an output over the design, without base points at which the output is undefined for any setting."""
    from SALib.analyze import sobol

    blocks = output.reshape(BASE_POINTS, -1)
    outputs = blocks[np.isfinite(blocks).all(axis=1)].ravel()
    names = problem["names"]
    if not outputs.size or np.ptp(outputs) == 0:
        indices = {name: np.full(len(names), np.nan) for name in ("S1", "ST", "S1_conf", "ST_conf")}
    else:
        indices = sobol.analyze(problem, outputs, calc_second_order=False, num_resamples=BOOTSTRAP_SAMPLES, conf_level=confidence,
                                seed=seed)
    frame = pd.DataFrame({"characteristic": names, "first_order": indices["S1"], "total": indices["ST"]})
    for name, key in (("first_order", "S1"), ("total", "ST")):
        for end, sign in (("lower", -1), ("upper", 1)):
            frame[f"{name}_{end}"] = frame[name] + sign * indices[f"{key}_conf"]
    return frame
