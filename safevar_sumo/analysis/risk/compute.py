"""Estimates how likely an unsafe outcome is for vehicles that vary as a study specifies."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.risk import ENOUGH_FAILURES, PILOT_VEHICLES, RARE_BELOW, RiskOptions
from safevar_sumo.analysis.risk.answer import SOBOL, Estimate, Risk, effect_columns
from safevar_sumo.analysis.risk.rare import RareMethodError, Response, estimate_rare, is_plateau, load_openturns
from safevar_sumo.analysis.risk.variation import VariationModel, compute_effects
from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study

VEHICLES_PER_CHECK = 1000
"""Number of vehicles drawn between two checks of the interval's width."""
MAX_VEHICLES_PER_CALL = 50_000
"""Maximum number of vehicles evaluated in one call if no `width` is requested; bounds the memory of a process."""


def estimate_risk(source: Study | Case, options: RiskOptions, evaluator: Evaluator) -> Risk:
    """Estimate the probability of an unsafe outcome.

    The filter of small changes is not applied, as no search changes vehicles.

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
    estimate = _draw_vehicles(evaluator, model, unsafe, options)
    effects = pd.DataFrame(columns=effect_columns(SOBOL))
    if not options.requires_rare_method:
        effects = compute_effects(evaluator, model, unsafe, options.confidence)
    return Risk(
        study=evaluator.study,
        unsafe=unsafe,
        confidence=options.confidence,
        no_verdict=evaluator.no_verdict,
        simulations=simulated_before + estimate.samples + estimate.errors,
        effects=effects,
        **vars(estimate),
    )


def _draw_vehicles(evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, options: RiskOptions) -> Estimate:
    """Draw vehicles by plain Monte Carlo; if few of the first `PILOT_VEHICLES` are unsafe, switch to a method for rare
    failures.
    """
    study, remark = evaluator.study, ""
    rng, requested, counts = np.random.default_rng(study.search.seed), options.samples, np.zeros(3, dtype=int)

    def simulate(settings: FloatArray) -> Evaluations:
        """Simulate vehicles, and add their numbers to `counts`: all, those that could be simulated, the unsafe ones."""
        evaluations = evaluator.evaluate(settings, "sampling vehicles")
        counts[:] += len(settings), np.count_nonzero(evaluations.valid), np.count_nonzero(unsafe.of(evaluations))
        return evaluations

    if options.requires_rare_method:
        load_openturns()  # raises if the module is missing
        requested = max(requested, PILOT_VEHICLES)
        remark = "the study has constraints, which only plain Monte Carlo supports" if evaluator.region else ""
    # Without [variation] the answer is the unsafe share of the domain: plain Monte Carlo as in `rules`, unless the user
    # requires a method for rare failures.
    may_be_rare = options.method == "auto" and bool(study.variation) and options.width is None
    needs_pilot = options.requires_rare_method or (may_be_rare and options.samples >= 2 * PILOT_VEHICLES)
    if needs_pilot and not evaluator.region:
        probabilities = rng.random((PILOT_VEHICLES, len(evaluator.characteristics)))
        response = Response(evaluator, model.settings_of_normal, unsafe)
        pilot_responses = response.record(scipy.stats.norm.ppf(probabilities), simulate(model.settings(probabilities)))
        estimate_or_remark = _try_rare_method(response, pilot_responses, options, requested)
        if isinstance(estimate_or_remark, Estimate):
            return estimate_or_remark
        remark = estimate_or_remark
    while True:
        drawn, valid, failures = counts.tolist()
        interval = clopper_pearson(failures, valid, options.confidence) if valid else (0.0, 1.0)
        if drawn >= requested or (options.width is not None and interval[1] - interval[0] <= options.width):
            break
        number = min(MAX_VEHICLES_PER_CALL if options.width is None else VEHICLES_PER_CHECK, requested - drawn)
        simulate(model.draw(number, rng, study.source))
    if not valid:
        raise SimulationError(f"study {study.name!r}: none of {drawn} vehicles could be simulated")
    share = failures / valid
    return Estimate(
        probability=share,
        coefficient_of_variation=math.sqrt((1 - share) / failures) if failures else math.nan,
        interval=interval,
        samples=valid,
        failures=failures,
        errors=drawn - valid,
        method="monte_carlo",
        remark=remark,
    )


def _try_rare_method(
    response: Response, pilot_responses: FloatArray, options: RiskOptions, requested: int
) -> Estimate | str:
    """The estimate by a method for rare failures; without one, a remark why plain Monte Carlo has to continue, which
    may be empty.

    `pilot_responses` are those of the pilot's vehicles, which `response` has recorded.
    """
    required, percent = options.requires_rare_method, f"{100 * RARE_BELOW:g} %"
    if not response.samples or response.failures >= RARE_BELOW * response.samples:
        pilot = f"none of the first {PILOT_VEHICLES} vehicles could be simulated"
        if response.samples:
            pilot = f"at least {percent} of {response.samples} vehicles are unsafe"
        return f"{pilot}: plain Monte Carlo is used" if required else ""
    if not required and response.failures * requested / PILOT_VEHICLES >= ENOUGH_FAILURES:
        return ""
    if is_plateau(pilot_responses):
        return (
            "the response is a plateau: most vehicles nearest to failure have the same safety degree, so that methods "
            "for rare failures cannot approach failures; plain Monte Carlo is used"
        )
    if not required and find_spec("openturns") is None:
        return (
            f"fewer than {percent} of the first vehicles are unsafe; for a method that needs fewer vehicles for rare "
            "failures, in the checkout: pip install '.[rare]'"
        )
    method = "cross_entropy" if options.method == "cross_entropy" else "subset_simulation"
    try:
        return estimate_rare(response, method, options.confidence)
    except RareMethodError as error:
        return f"{error}; plain Monte Carlo is used"
