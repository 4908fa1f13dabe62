"""Estimates how likely an unsafe outcome is for vehicles that vary as a study specifies, and which characteristic
decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.risk import ENOUGH_FAILURES, PILOT_VEHICLES, RARE_BELOW, RiskOptions
from safevar_sumo.analysis.risk.answer import Estimate, Risk
from safevar_sumo.analysis.risk.rare import RareMethodError, Response, estimate_rare, is_plateau, load_openturns
from safevar_sumo.analysis.risk.shapley import compute_shapley_effects
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import Distribution, Fixed, Lognormal, Normal, Triangular, Uniform
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from safevar_sumo.vehicles.region import REJECTIONS

VEHICLES_PER_CHECK = 1000
"""Number of vehicles drawn between two checks of the interval's width."""
MAX_VEHICLES_PER_CALL = 50_000
"""Maximum number of vehicles evaluated in one call if no `width` is requested; bounds the memory of a process."""


BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, in the design for Sobol indices of unsafe outcomes."""
BOOTSTRAP_SAMPLES = 200
"""Number of bootstrap samples for the intervals."""
QuantileFunction = Callable[[FloatArray], FloatArray]
"""Turns probabilities into values in the characteristic's unit."""


def estimate_risk(source: Study | Case, options: RiskOptions, evaluator: Evaluator) -> Risk:
    """Estimate the probability of an unsafe outcome. The filter of small changes is not applied, as no search changes
    vehicles.

    Raises
    ------
    InputError
        If a distribution of the study is impossible or `unsafe` cannot be used.
    SimulationError
        If no vehicle can be simulated.
    """
    model = VariationModel(evaluator.study)
    unsafe = evaluator.choose_criterion(options.unsafe, source)
    simulated_before = evaluator.simulated
    estimate = vars(_draw_vehicles(evaluator, model, unsafe, options))
    are_independent = not (model.is_correlated or evaluator.region)
    compute = compute_sensitivities if are_independent else compute_shapley_effects
    of_degree, of_unsafe = (
        (None, None) if options.requires_rare_method else compute(evaluator, model, unsafe, options.confidence)
    )
    samples, simulations = estimate["simulations"] - estimate["errors"], simulated_before + estimate.pop("simulations")
    return Risk(
        study=evaluator.study,
        unsafe=unsafe,
        confidence=options.confidence,
        no_verdict=evaluator.no_verdict,
        samples=samples,
        simulations=simulations,
        sensitivity=of_degree if are_independent else None,
        sensitivity_of_unsafe=of_unsafe if are_independent else None,
        shapley=None if are_independent else of_degree,
        shapley_of_unsafe=None if are_independent else of_unsafe,
        **estimate,
    )


def _draw_vehicles(evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, options: RiskOptions) -> Estimate:
    """Draw vehicles by plain Monte Carlo; if few of the first `PILOT_VEHICLES` are unsafe, switch to a method for rare
    failures.
    """
    study, remark = evaluator.study, ""
    rng, requested, counts = np.random.default_rng(study.search.seed), options.samples, np.zeros(3, dtype=int)

    def simulate(settings: FloatArray) -> Evaluations:
        """Simulate vehicles, and count all, those that could be simulated and the unsafe ones."""
        evaluations = evaluator.evaluate(settings, "sampling vehicles")
        counts[:] += len(settings), np.count_nonzero(evaluations.valid), np.count_nonzero(unsafe.of(evaluations))
        return evaluations

    if options.requires_rare_method:
        load_openturns()  # raises if the module is missing
        requested = max(requested, PILOT_VEHICLES)
        remark = "the study has constraints, which only plain Monte Carlo supports" if evaluator.region else ""
    if _needs_pilot(options, study) and not evaluator.region:
        probabilities = rng.random((PILOT_VEHICLES, len(evaluator.characteristics)))
        response = Response(evaluator, model.settings_of_normal, unsafe)
        responses = response.record(scipy.stats.norm.ppf(probabilities), simulate(model.settings(probabilities)))
        estimate = _try_rare_method(response, responses, options, requested, study.search.seed)
        if isinstance(estimate, Estimate):
            return estimate
        remark = estimate
    while True:
        drawn, valid, failures = counts.tolist()
        interval = clopper_pearson(failures, valid, options.confidence) if valid else (0.0, 1.0)
        if drawn >= requested or (options.width is not None and interval[1] - interval[0] <= options.width):
            break
        number = min(MAX_VEHICLES_PER_CALL if options.width is None else VEHICLES_PER_CHECK, requested - drawn)
        simulate(_draw_feasible_vehicles(evaluator, model, number, rng))
    if not valid:
        raise SimulationError(f"study {study.name!r}: none of {drawn} vehicles could be simulated")
    share = failures / valid
    return Estimate(
        probability=share,
        coefficient_of_variation=math.sqrt((1 - share) / failures) if failures else math.nan,
        interval=interval,
        failures=failures,
        errors=drawn - valid,
        simulations=drawn,
        method="monte_carlo",
        remark=remark,
    )


def _needs_pilot(options: RiskOptions, study: Study) -> bool:
    """Whether a method for rare failures may follow; unless required, not for a share of the domain, which `rules`
    counts likewise.
    """
    may_be_rare = options.method == "auto" and bool(study.variation) and options.width is None
    return options.requires_rare_method or (may_be_rare and options.samples >= 2 * PILOT_VEHICLES)


def _try_rare_method(
    response: Response, responses: FloatArray, options: RiskOptions, requested: int, seed: int
) -> Estimate | str:
    """The estimate by a method for rare failures; why plain Monte Carlo has to continue if there is none."""
    valid, failures = response.simulations - response.errors, response.failure_count
    expected_failures = failures * requested / PILOT_VEHICLES
    if not valid or failures >= RARE_BELOW * valid:
        frequent = f"at least {100 * RARE_BELOW:g} % of {valid} vehicles are unsafe"
        pilot = frequent if valid else f"none of the first {PILOT_VEHICLES} vehicles could be simulated"
        return f"{pilot}: plain Monte Carlo is used" if options.requires_rare_method else ""
    if not options.requires_rare_method and expected_failures >= ENOUGH_FAILURES:
        return ""
    if is_plateau(responses):
        return (
            "the response is a plateau: most vehicles nearest to failure have the same safety degree, so that methods "
            "for rare failures cannot approach failures; plain Monte Carlo is used"
        )
    if not options.requires_rare_method and find_spec("openturns") is None:
        return (
            f"fewer than {100 * RARE_BELOW:g} % of the first vehicles are unsafe; for a method that needs fewer "
            "vehicles for rare failures, in the checkout: pip install '.[rare]'"
        )
    method = "cross_entropy" if options.method == "cross_entropy" else "subset_simulation"
    try:
        return estimate_rare(response, method, options.confidence, seed)
    except RareMethodError as error:
        return f"{error}; plain Monte Carlo is used"


def _draw_feasible_vehicles(
    evaluator: Evaluator, model: VariationModel, number: int, rng: np.random.Generator
) -> FloatArray:
    """Random vehicles that satisfy the constraints, shape (number, n)."""
    settings = evaluator.region.draw_feasible(
        lambda count: model.settings(rng.random((count, len(evaluator.characteristics)))), number
    )
    if len(settings) < number:
        raise InputError(
            evaluator.study.source,
            f"fewer than 1 in {REJECTIONS} random vehicles satisfy the constraints: {evaluator.region}",
            "a [variation] and [[constraints]] that agree",
        )
    return settings


class VariationModel:
    """The random variation of a study's characteristics, by its `[variation]` and `[[correlations]]`.

    Raises
    ------
    InputError
        If the correlations contradict each other.
    """

    def __init__(self, study: Study) -> None:
        self._characteristics = CharacteristicSet.of(study)
        self._quantiles = [
            _quantile_function(characteristic, study.variation.get(characteristic.name, Uniform()))
            for characteristic in self._characteristics
        ]
        self.is_correlated, matrix = bool(study.correlations), np.eye(len(self._characteristics))
        for correlation in study.correlations:
            first, second = map(self._characteristics.names.index, correlation.between)
            matrix[first, second] = matrix[second, first] = correlation.value
        self.correlation = matrix
        self.varying = np.array([not isinstance(study.variation.get(one.name), Fixed) for one in self._characteristics])
        try:
            self._factor = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            pairs = ", ".join(f"{' and '.join(one.between)} {one.value:g}" for one in study.correlations)
            problem = f"correlations contradict each other: {pairs}"
            raise InputError(study.source, problem, "a positive definite matrix") from None

    def settings(self, probabilities: FloatArray) -> FloatArray:
        """Settings at N independent points of the unit cube, shape (N, n); the settings are correlated as the study
        specifies.
        """
        if self.is_correlated:
            return self.settings_of_normal(scipy.stats.norm.ppf(probabilities))
        return self._settings_at(probabilities)

    def settings_of_normal(self, points: FloatArray) -> FloatArray:
        """Settings at N points of standard normal space, shape (N, n), correlated as the study specifies."""
        return self.settings_of_correlated(points @ self._factor.T if self.is_correlated else points)

    def settings_of_correlated(self, points: FloatArray) -> FloatArray:
        """Settings at N points of normal space, shape (N, n), that have the study's correlations already."""
        return self._settings_at(scipy.stats.norm.cdf(points))

    def _settings_at(self, probabilities: FloatArray) -> FloatArray:
        columns = [quantile(column) for quantile, column in zip(self._quantiles, probabilities.T, strict=True)]
        return np.clip(np.stack(columns, axis=1), self._characteristics.lower, self._characteristics.upper)


def _quantile_function(characteristic: Characteristic, distribution: Distribution) -> QuantileFunction:
    low, high, stated = characteristic.lower, characteristic.upper, msgspec.structs.asdict(distribution)
    defaults = {"lower": low, "upper": high}
    values = {
        name: defaults.get(name, characteristic.original) if value is None else value for name, value in stated.items()
    }
    match distribution:
        case Fixed():
            return lambda p: np.full_like(p, values["value"])
        case Uniform():
            return lambda p: values["lower"] + p * (values["upper"] - values["lower"])
        case Triangular():
            lower, width = values["lower"], values["upper"] - values["lower"]
            triangle = scipy.stats.triang((values["mode"] - lower) / width, loc=lower, scale=width)
            return lambda p: triangle.ppf(p)
        case Normal():
            normal = _truncated_normal(low, high, values["mean"], values["deviation"])
            return lambda p: normal.ppf(p)
        case Lognormal():
            logarithm = _truncated_normal(np.log(low), np.log(high), np.log(values["median"]), values["sigma"])
            return lambda p: np.exp(logarithm.ppf(p))


def _truncated_normal(low: float, high: float, mean: float, deviation: float) -> Any:
    return scipy.stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, loc=mean, scale=deviation)


def compute_sensitivities(
    evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, confidence: float
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Sensitivity of the safety degree, and of the unsafe outcome.

    Returns
    -------
    tuple of pandas.DataFrame
        One row per characteristic: `characteristic`, `first_order`, `total` [share of the variance], and the intervals'
        ends `first_order_lower`, `first_order_upper`, `total_lower`, `total_upper`; NaN where nothing varies, or too
        few settings are unsafe (or safe).
    """
    from SALib.sample import sobol  # takes a second to load

    seed, names = evaluator.study.search.seed % 2**32, evaluator.characteristics.names
    problem = {"num_vars": len(names), "names": list(names), "bounds": [[0.0, 1.0]] * len(names)}
    points = sobol.sample(problem, BASE_POINTS, calc_second_order=False, seed=seed)
    evaluations = evaluator.evaluate(model.settings(points), "sensitivity analysis")
    degree = np.where(evaluations.valid, evaluations.f_safe, np.nan)
    is_unsafe = np.where(evaluations.valid, unsafe.of(evaluations).astype(float), np.nan)
    if min(np.count_nonzero(is_unsafe == outcome) for outcome in (0, 1)) < MIN_OUTCOMES:
        is_unsafe[:] = np.nan
    return _sobol_indices(problem, degree, confidence, seed), _sobol_indices(problem, is_unsafe, confidence, seed)


def _sobol_indices(problem: JsonObject, output: FloatArray, confidence: float, seed: int) -> pd.DataFrame:
    """Sobol indices of an output over the design, without base points at which the output is undefined for any
    setting.
    """
    from SALib.analyze import sobol

    blocks = output.reshape(BASE_POINTS, -1)
    outputs = blocks[np.isfinite(blocks).all(axis=1)].ravel()
    names = problem["names"]
    if not outputs.size or np.ptp(outputs) == 0:
        indices = {name: np.full(len(names), np.nan) for name in ("S1", "ST", "S1_conf", "ST_conf")}
    else:
        indices = sobol.analyze(
            problem, outputs, calc_second_order=False, num_resamples=BOOTSTRAP_SAMPLES, conf_level=confidence, seed=seed
        )
    frame = pd.DataFrame({"characteristic": names, "first_order": indices["S1"], "total": indices["ST"]})
    for name, key in (("first_order", "S1"), ("total", "ST")):
        for end, sign in (("lower", -1), ("upper", 1)):
            frame[f"{name}_{end}"] = frame[name] + sign * indices[f"{key}_conf"]
    return frame
