"""What decides: variance-based sensitivity, first-order and total Sobol indices (Saltelli 2010, by SALib)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.answers.world import World
from safevar_sumo.records import FloatArray

BASE = 512
"""Base points of Saltelli's design; it has n + 2 times as many settings."""
FEWEST = 100
"""Unsafe and safe settings in the design that the sensitivity of being unsafe can be told from."""
RESAMPLES = 200
"""Bootstrap samples that the intervals come from."""


def sensitivities(bench: Bench, world: World, unsafe: Unsafe, confidence: float) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Sensitivity of the safety degree, and of being unsafe.

    Returns
    -------
    tuple of pandas.DataFrame
        One row per characteristic: `characteristic`, `first_order`, `total` [share of the variance], and the intervals'
        ends `first_order_lower`, `first_order_upper`, `total_lower`, `total_upper`; NaN where nothing varies, or too few
        settings are unsafe (or safe) to tell.
    """
    from SALib.sample import sobol  # takes a second to load

    seed, names = bench.study.search.seed % 2**32, bench.characteristics.names
    problem = {"num_vars": len(names), "names": list(names), "bounds": [[0.0, 1.0]] * len(names)}
    points = sobol.sample(problem, BASE, calc_second_order=False, seed=seed)
    evaluations = bench.evaluate(world.settings(np.asarray(points)), "what decides")
    degree = np.where(evaluations.valid, evaluations.f_safe, np.nan)
    is_unsafe = np.where(evaluations.valid, unsafe.of(evaluations).astype(float), np.nan)
    if min(np.count_nonzero(is_unsafe == outcome) for outcome in (0, 1)) < FEWEST:
        is_unsafe[:] = np.nan
    return _indices(problem, degree, confidence, seed), _indices(problem, is_unsafe, confidence, seed)


def _indices(problem: dict[str, Any], output: FloatArray, confidence: float, seed: int) -> pd.DataFrame:
    """Indices of an output over the design; a base point without a number at one of its settings is left out."""
    from SALib.analyze import sobol

    blocks = output.reshape(BASE, -1)
    whole = blocks[np.isfinite(blocks).all(axis=1)].ravel()
    names = problem["names"]
    if not whole.size or np.ptp(whole) == 0:
        found = {name: np.full(len(names), np.nan) for name in ("S1", "ST", "S1_conf", "ST_conf")}
    else:
        found = sobol.analyze(problem, whole, calc_second_order=False, num_resamples=RESAMPLES, conf_level=confidence, seed=seed)
    frame = pd.DataFrame({"characteristic": names, "first_order": found["S1"], "total": found["ST"]})
    for name, key in (("first_order", "S1"), ("total", "ST")):
        for end, sign in (("lower", -1), ("upper", 1)):
            frame[f"{name}_{end}"] = frame[name] + sign * found[f"{key}_conf"]
    return frame
