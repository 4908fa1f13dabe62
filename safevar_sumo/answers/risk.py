"""How likely is an unsafe outcome when vehicles vary as a study says, and which characteristic decides?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.answers.bench import Progress, open_bench, silent
from safevar_sumo.answers.causes import number
from safevar_sumo.answers.sensitivity import sensitivities
from safevar_sumo.answers.unsafe import Unsafe, usual_in
from safevar_sumo.answers.world import World
from safevar_sumo.computing import Pool
from safevar_sumo.errors import SimulationError
from safevar_sumo.options import RiskOptions
from safevar_sumo.study import Study

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
        Frames of `safevar_sumo.answers.sensitivity`, of the safety degree and of being unsafe; None where
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


def risk(study: Study, *, samples: int = RiskOptions.samples, confidence: float = RiskOptions.confidence, width: float | None = None,
         unsafe: str | None = None, pool: Pool | None = None, jobs: int | None = None, progress: Progress = silent) -> Risk:
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
    means, world = Unsafe.given(unsafe), World(study)
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
