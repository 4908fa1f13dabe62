"""How likely is an unsafe outcome when vehicles vary as a study says, and which characteristic decides?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.criterion import Unsafe, usual_in
from safevar_sumo.analysis.evaluator import Bench, Progress, open_bench, silent
from safevar_sumo.analysis.explain.causes import number
from safevar_sumo.analysis.risk.options import RiskOptions
from safevar_sumo.analysis.risk.variation_model import VariationModel
from safevar_sumo.errors import SimulationError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.workers.evaluation import Pool

CHUNK = 1000
"""Samples after which the interval is looked at."""


@dataclass(frozen=True, kw_only=True)
class Risk:
    """Probability of an unsafe outcome, with Clopper and Pearson's interval, and what decides.

    Attributes
    ----------
    samples, failures
        Vehicles that were drawn, and how many of them were unsafe; those that could not be simulated are `errors`.
    sensitivity, sensitivity_of_unsafe
        Frames of `safevar_sumo.analysis.risk.compute`, of the safety degree and of being unsafe; None where
        characteristics are correlated, for which they are not defined.
    """

    study: Study
    unsafe: Unsafe
    samples: int
    failures: int
    errors: int
    confidence: float
    sensitivity: pd.DataFrame | None
    sensitivity_of_unsafe: pd.DataFrame | None

    @property
    def probability(self) -> float:
        return self.failures / self.samples

    @property
    def of_domain(self) -> bool:
        """Whether it is a share of the domain, no probability in the field: the study does not say how vehicles vary."""
        return not self.study.variation

    @property
    def interval(self) -> tuple[float, float]:
        return interval_of(self.failures, self.samples, self.confidence)

    def record(self) -> dict[str, Any]:
        """As `risk --json` prints it."""
        rows = [] if self.sensitivity is None else self.sensitivity.to_dict("records")
        return {
            "study": self.study.name, "unsafe": str(self.unsafe), "samples": self.samples, "failures": self.failures,
            "probability": self.probability, "interval": list(self.interval), "confidence": self.confidence,
            "sensitivity": [{
                "characteristic": row["characteristic"], "first_order": number(row["first_order"]), "total": number(row["total"]),
                **{f"{name}_interval": [number(row[f"{name}_lower"]), number(row[f"{name}_upper"])] for name in ("first_order", "total")}}
                for row in rows]}

    def __repr__(self) -> str:
        low, high = self.interval
        return f"<Risk of {self.study.name}, unsafe {self.unsafe}: {self.probability:.4g} ({low:.4g} to {high:.4g})>"


def interval_of(count: int, number: int, confidence: float) -> tuple[float, float]:
    """Clopper and Pearson's exact interval of a share."""
    found = scipy.stats.binomtest(count, number).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


def estimate_risk(study: Study, *, samples: int = RiskOptions.samples, confidence: float = RiskOptions.confidence,
                  width: float | None = None, unsafe: str | None = None, pool: Pool | None = None, jobs: int | None = None,
                  progress: Progress = silent) -> Risk:
    """Estimate the probability of an unsafe outcome. Nothing is filtered: this is about vehicles, not about a search.

    Parameters
    ----------
    samples
        Vehicles to draw at the most.
    confidence
        Of the intervals.
    width
        Stop as soon as the interval of the probability is no wider.
    unsafe
        As in `tolerance`.
    pool, jobs, progress
        As in `tolerance`.

    Raises
    ------
    InputError
        If a distribution of the study is impossible, or as in `tolerance`.
    """
    RiskOptions(samples=samples, confidence=confidence, width=width, unsafe=unsafe)
    means, world = Unsafe.given(unsafe), VariationModel(study)
    rng = np.random.default_rng(study.search.seed)
    count = failures = errors = 0
    with open_bench(study, pool, jobs, progress) as bench:
        means = means or usual_in(bench, bench.original())
        chunk = CHUNK if width is not None else samples
        while count + errors < samples:
            drawn = rng.random((min(chunk, samples - count - errors), len(bench.characteristics)))
            evaluations = bench.evaluate(world.settings(drawn), "vehicles as they vary")
            valid = int(np.count_nonzero(evaluations.valid))
            count, errors = count + valid, errors + len(drawn) - valid
            failures += int(np.count_nonzero(means.of(evaluations)))
            low, high = interval_of(failures, count, confidence) if count else (0.0, 1.0)
            if width is not None and high - low <= width:
                break
        if not count:
            raise SimulationError(f"study {study.name!r}: not one of {errors} vehicles could be simulated")
        decides = (None, None) if world.correlated else sensitivities(bench, world, means, confidence)
    return Risk(study=study, unsafe=means, samples=count, failures=failures, errors=errors, confidence=confidence, sensitivity=decides[0],
                sensitivity_of_unsafe=decides[1])


BASE = 512
"""Base points of Saltelli's design; it has n + 2 times as many settings."""
FEWEST = 100
"""Unsafe and safe settings in the design that the sensitivity of being unsafe can be told from."""
RESAMPLES = 200
"""Bootstrap samples that the intervals come from."""


def sensitivities(bench: Bench, world: VariationModel, unsafe: Unsafe, confidence: float) -> tuple[pd.DataFrame, pd.DataFrame]:
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
