"""Estimates how likely an unsafe outcome is for vehicles that vary as a study specifies, and which characteristic decides."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson, open_evaluator
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.risk import ENOUGH_FAILURES, PILOT_VEHICLES, RARE_BELOW, RiskOptions
from safevar_sumo.analysis.risk.rare import Estimate, RareMethodError, Response, estimate_rare, is_plateau, load_openturns
from safevar_sumo.analysis.risk.sensitivity import compute_sensitivities
from safevar_sumo.analysis.risk.variation import VariationModel
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.records import FloatArray, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.vehicles.region import REJECTIONS
from safevar_sumo.workers.evaluation import Pool

FLEET_VEHICLES = 1000
"""Number of vehicles of the fleet in examples."""
VEHICLES_PER_CHECK = 1000
"""Number of vehicles drawn between two checks of the interval's width."""
MAX_VEHICLES_PER_CALL = 50_000
"""Maximum number of vehicles evaluated in one call if no `width` is requested; bounds the memory of a process."""


@dataclass(frozen=True, kw_only=True)
class Risk:
    """Probability of an unsafe outcome with its interval (for plain Monte Carlo by Clopper and Pearson), and Sobol indices.

    Attributes
    ----------
    samples, failures
        Number of simulated vehicles, and of unsafe vehicles among them; `errors` is the number of vehicles that could not be simulated.
    method
        "monte_carlo", "subset_simulation" or "cross_entropy".
    simulations
        Number of simulations for the estimate, without the simulations for the sensitivities.
    coefficient_of_variation
        Standard error divided by the probability; NaN if no vehicle was unsafe.
    design_point
        Values of the most probable failure by characteristic, if a method for rare failures was used.
    remark
        Failures that the estimate may have missed, or the reason for its method; may be empty.
    sensitivity, sensitivity_of_unsafe
        The two frames of `compute_sensitivities`; None if characteristics are correlated or bound by constraints, because Sobol
        indices are then undefined.
    """

    study: Study
    unsafe: Unsafe
    samples: int
    failures: int
    errors: int
    confidence: float
    sensitivity: pd.DataFrame | None
    sensitivity_of_unsafe: pd.DataFrame | None
    probability: float
    interval: tuple[float, float]
    method: str
    simulations: int
    coefficient_of_variation: float
    design_point: dict[str, float] | None
    remark: str
    no_verdict: str = ""

    @property
    def is_share_of_domain(self) -> bool:
        """Whether the probability is a share of the domain, because the study does not say how vehicles vary."""
        return not self.study.variation

    def of_fleet(self, vehicles: int) -> float:
        """Probability that at least one of N = `vehicles` vehicles is unsafe if they vary independently of each other, 1 - (1 - p)^N."""
        return float(-np.expm1(vehicles * np.log1p(-self.probability))) if self.probability < 1 else 1.0

    def of_fleet_in_words(self, vehicles: int) -> str:
        """The probability `of_fleet`, which is never called certain."""
        probability = self.of_fleet(vehicles)
        return "above 0.99" if probability > 0.99 else f"{probability:.2g}"

    def to_dict(self) -> dict[str, Any]:
        """The JSON of `risk`."""
        rows = [] if self.sensitivity is None else self.sensitivity.to_dict("records")
        return {
            "study": self.study.name, **driven_entry(self.no_verdict), "unsafe": str(self.unsafe),
            "samples": self.samples, "failures": self.failures,
            "probability": self.probability, "interval": list(self.interval), "confidence": self.confidence,
            "sensitivity": [{
                "characteristic": row["characteristic"],
                **{name: finite_or_none(row[name]) for name in ("first_order", "total")},
                **{f"{name}_interval": [finite_or_none(row[f"{name}_{end}"]) for end in ("lower", "upper")]
                   for name in ("first_order", "total")}} for row in rows],
            "method": self.method, "simulations": self.simulations,
            "coefficient_of_variation": finite_or_none(self.coefficient_of_variation),
            "design_point": self.design_point, "remark": self.remark}

    def to_frame(self) -> pd.DataFrame:
        """Sensitivity of the safety degree and of the unsafe outcome, one row per output and characteristic; empty if correlated.

        Columns: `output` (safety_degree or unsafe), and the columns of `compute_sensitivities`.
        """
        frames = {SAFETY_DEGREE: self.sensitivity, "unsafe": self.sensitivity_of_unsafe}
        tables = [frame.assign(output=name) for name, frame in frames.items() if frame is not None]
        columns = ["output", "characteristic", *(f"{index}{end}" for index in ("first_order", "total") for end in ("", "_lower", "_upper"))]
        return pd.concat(tables, ignore_index=True)[columns] if tables else pd.DataFrame(columns=columns)

    def __repr__(self) -> str:
        low, high = self.interval
        return f"<Risk of {self.study.name}, unsafe {self.unsafe}: {self.probability:.4g} ({low:.4g} to {high:.4g})>"


def estimate_risk(source: Study | Case, options: RiskOptions, *, pool: Pool | None = None, jobs: int | None = None,
                  progress: Progress = show_no_progress) -> Risk:
    """Estimate the probability of an unsafe outcome. The filter of small changes is not applied, as no search changes vehicles.

    Raises
    ------
    InputError
        If a distribution of the study is impossible or `unsafe` cannot be used, or the study cannot be assembled.
    SimulationError
        If no vehicle can be simulated.
    """
    study = study_in(source)
    model = VariationModel(study)
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        unsafe = evaluator.choose_criterion(options.unsafe, source)
        simulated_before = evaluator.simulated
        response = Response(evaluator, model.settings_of_normal, unsafe)
        counts_or_estimate = _draw_vehicles(evaluator, model, unsafe, options, response)
        if isinstance(counts_or_estimate, Estimate):
            estimate, method = counts_or_estimate, _rare_method(options)
        else:
            estimate, method = counts_or_estimate.estimate(options.confidence), "monte_carlo"
        lacks_indices = model.is_correlated or bool(evaluator.region) or options.requires_rare_method
        sensitivity, sensitivity_of_unsafe = (
            (None, None) if lacks_indices else compute_sensitivities(evaluator, model, unsafe, options.confidence))
        no_verdict = evaluator.no_verdict
    design_setting = None if estimate.design_point is None else model.settings_of_normal(estimate.design_point[np.newaxis])[0]
    return Risk(
        study=study, unsafe=unsafe, samples=estimate.simulations - estimate.errors, failures=estimate.failures, errors=estimate.errors,
        confidence=options.confidence, sensitivity=sensitivity, sensitivity_of_unsafe=sensitivity_of_unsafe,
        probability=estimate.probability, interval=estimate.interval, method=method, simulations=simulated_before + estimate.simulations,
        coefficient_of_variation=estimate.coefficient_of_variation, remark=estimate.remark, no_verdict=no_verdict,
        design_point=None if design_setting is None else dict(zip(evaluator.characteristics.names, design_setting.tolist(), strict=True)))


@dataclass(kw_only=True)
class _VehicleCounts:
    """Numbers of vehicles that plain Monte Carlo simulated, of failures among them, and of vehicles that could not be simulated."""

    vehicles: int = 0
    failures: int = 0
    errors: int = 0
    remark: str = ""

    def estimate(self, confidence: float) -> Estimate:
        share = self.failures / self.vehicles
        coefficient = float(np.sqrt((1 - share) / self.failures)) if self.failures else float("nan")
        return Estimate(probability=share, coefficient_of_variation=coefficient, failures=self.failures, errors=self.errors,
                        interval=clopper_pearson(self.failures, self.vehicles, confidence), simulations=self.vehicles + self.errors,
                        design_point=None, remark=self.remark)


def _rare_method(options: RiskOptions) -> str:
    return options.method if options.method == "cross_entropy" else "subset_simulation"


def _draw_vehicles(evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, options: RiskOptions,
                   response: Response) -> Estimate | _VehicleCounts:
    """Draw vehicles by plain Monte Carlo; if few of the first `PILOT_VEHICLES` are unsafe, switch to a method for rare failures."""
    counts, rng = _VehicleCounts(), np.random.default_rng(evaluator.study.search.seed)
    is_pilot = _needs_pilot(options, evaluator.study) and not evaluator.region
    if options.requires_rare_method and evaluator.region:
        counts.remark = "the study has constraints, which only plain Monte Carlo supports"
    if options.requires_rare_method:
        load_openturns()  # raises if the module is missing
    requested = max(options.samples, PILOT_VEHICLES) if options.requires_rare_method else options.samples
    while counts.vehicles + counts.errors < requested:
        largest_number = PILOT_VEHICLES if is_pilot else VEHICLES_PER_CHECK if options.width is not None else MAX_VEHICLES_PER_CALL
        offset = counts.vehicles + counts.errors
        number = min(largest_number, requested - offset)
        probabilities = rng.random((number, len(evaluator.characteristics))) if is_pilot else None
        settings = _draw_feasible_vehicles(evaluator, model, number, rng) if probabilities is None else model.settings(probabilities)
        evaluations = evaluator.evaluate(settings, "sampling vehicles", done_before=offset, total=requested)
        valid_vehicles = int(np.count_nonzero(evaluations.valid))
        counts.vehicles, counts.errors = counts.vehicles + valid_vehicles, counts.errors + number - valid_vehicles
        counts.failures += int(np.count_nonzero(unsafe.of(evaluations)))
        if probabilities is not None:
            is_pilot = False
            responses = response.record(scipy.stats.norm.ppf(probabilities), evaluations)
            is_frequent = not options.requires_rare_method and counts.failures * (requested / number) >= ENOUGH_FAILURES
            if valid_vehicles and counts.failures < RARE_BELOW * valid_vehicles and not is_frequent:
                estimate = _try_rare_method(response, responses, options, counts, evaluator.study.search.seed)
                if estimate is not None:
                    return estimate
            elif options.requires_rare_method:
                pilot = f"at least {100 * RARE_BELOW:g} % of {valid_vehicles} vehicles are unsafe" if valid_vehicles else (
                    f"none of the first {number} vehicles could be simulated")
                counts.remark = f"{pilot}: plain Monte Carlo is used"
        low, high = clopper_pearson(counts.failures, counts.vehicles, options.confidence) if counts.vehicles else (0.0, 1.0)
        if options.width is not None and high - low <= options.width:
            break
    if not counts.vehicles:
        raise SimulationError(f"study {evaluator.study.name!r}: none of {counts.errors} vehicles could be simulated")
    return counts


def _needs_pilot(options: RiskOptions, study: Study) -> bool:
    """Whether a method for rare failures may follow; unless required, not for a share of the domain, which `rules` counts likewise."""
    may_be_rare = options.method == "auto" and bool(study.variation) and options.width is None
    return options.requires_rare_method or (may_be_rare and options.samples >= 2 * PILOT_VEHICLES)


def _try_rare_method(response: Response, responses: FloatArray, options: RiskOptions, counts: _VehicleCounts, seed: int) -> Estimate | None:
    """The estimate by a method for rare failures; None if plain Monte Carlo has to continue, with the reason in `counts.remark`."""
    if is_plateau(responses):
        counts.remark = ("the response is a plateau: most vehicles nearest to failure have the same safety degree, so that methods for "
                        "rare failures cannot approach failures; plain Monte Carlo is used")
        return None
    if not options.requires_rare_method and find_spec("openturns") is None:
        counts.remark = (f"fewer than {100 * RARE_BELOW:g} % of the first vehicles are unsafe; for a method that needs fewer vehicles "
                          "for rare failures, in the checkout: pip install '.[rare]'")
        return None
    try:
        return estimate_rare(response, _rare_method(options), options.confidence, seed)
    except RareMethodError as error:
        counts.remark = f"{error}; plain Monte Carlo is used"
        return None


def _draw_feasible_vehicles(evaluator: Evaluator, model: VariationModel, number: int, rng: np.random.Generator) -> FloatArray:
    """Random vehicles that satisfy the constraints, shape (number, n)."""
    settings = evaluator.region.draw_feasible(lambda count: model.settings(rng.random((count, len(evaluator.characteristics)))), number)
    if len(settings) < number:
        raise InputError(evaluator.study.source, f"fewer than 1 in {REJECTIONS} random vehicles satisfy the constraints: "
                         f"{evaluator.region}", "a [variation] and [[constraints]] that agree")
    return settings
