"""Estimates how likely an unsafe outcome is for vehicles that vary as a study specifies, and which characteristic
decides.
"""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson, open_evaluator
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.risk import ENOUGH_FAILURES, PILOT_VEHICLES, RARE_BELOW, RiskOptions
from safevar_sumo.analysis.risk.answer import Estimate, Risk
from safevar_sumo.analysis.risk.rare import RareMethodError, Response, estimate_rare, is_plateau, load_openturns
from safevar_sumo.analysis.risk.variation import VariationModel, compute_sensitivities
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.terminal import Progress, show_no_progress
from safevar_sumo.vehicles.region import REJECTIONS

VEHICLES_PER_CHECK = 1000
"""Number of vehicles drawn between two checks of the interval's width."""
MAX_VEHICLES_PER_CALL = 50_000
"""Maximum number of vehicles evaluated in one call if no `width` is requested; bounds the memory of a process."""


def estimate_risk(
    source: Study | Case,
    options: RiskOptions,
    *,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Risk:
    """Estimate the probability of an unsafe outcome. The filter of small changes is not applied, as no search changes
    vehicles.

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
        estimate = vars(_draw_vehicles(evaluator, model, unsafe, options))
        has_indices = not (model.is_correlated or evaluator.region or options.requires_rare_method)
        sensitivity, sensitivity_of_unsafe = (
            compute_sensitivities(evaluator, model, unsafe, options.confidence) if has_indices else (None, None)
        )
        no_verdict = evaluator.no_verdict
    samples, simulations = estimate["simulations"] - estimate["errors"], simulated_before + estimate.pop("simulations")
    return Risk(
        study=study,
        unsafe=unsafe,
        confidence=options.confidence,
        sensitivity=sensitivity,
        no_verdict=no_verdict,
        sensitivity_of_unsafe=sensitivity_of_unsafe,
        samples=samples,
        simulations=simulations,
        **estimate,
    )


def _draw_vehicles(evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, options: RiskOptions) -> Estimate:
    """Draw vehicles by plain Monte Carlo; if few of the first `PILOT_VEHICLES` are unsafe, switch to a method for rare
    failures.
    """
    rng, vehicles, failures, errors, remark = np.random.default_rng(evaluator.study.search.seed), 0, 0, 0, ""
    is_pilot, requested = _needs_pilot(options, evaluator.study) and not evaluator.region, options.samples
    if options.requires_rare_method:
        load_openturns()  # raises if the module is missing
        requested = max(requested, PILOT_VEHICLES)
        remark = "the study has constraints, which only plain Monte Carlo supports" if evaluator.region else ""
    interval = 0.0, 1.0
    while vehicles + errors < requested and not (
        options.width is not None and interval[1] - interval[0] <= options.width
    ):
        largest_number = (
            PILOT_VEHICLES if is_pilot else (MAX_VEHICLES_PER_CALL if options.width is None else VEHICLES_PER_CHECK)
        )
        number = min(largest_number, requested - vehicles - errors)
        probabilities = rng.random((number, len(evaluator.characteristics))) if is_pilot else None
        settings = (
            _draw_feasible_vehicles(evaluator, model, number, rng)
            if probabilities is None
            else model.settings(probabilities)
        )
        evaluations = evaluator.evaluate(settings, "sampling vehicles", done_before=vehicles + errors, total=requested)
        valid = int(np.count_nonzero(evaluations.valid))
        vehicles, errors = vehicles + valid, errors + number - valid
        failures += int(np.count_nonzero(unsafe.of(evaluations)))
        if probabilities is not None:
            is_pilot = False
            response = Response(evaluator, model.settings_of_normal, unsafe)
            responses = response.record(scipy.stats.norm.ppf(probabilities), evaluations)
            is_frequent = not options.requires_rare_method and failures * (requested / number) >= ENOUGH_FAILURES
            if valid and failures < RARE_BELOW * valid and not is_frequent:
                estimate = _try_rare_method(response, responses, options, evaluator.study.search.seed)
                if isinstance(estimate, Estimate):
                    return estimate
                remark = estimate
            elif options.requires_rare_method:
                pilot = (
                    f"at least {100 * RARE_BELOW:g} % of {valid} vehicles are unsafe"
                    if valid
                    else (f"none of the first {number} vehicles could be simulated")
                )
                remark = f"{pilot}: plain Monte Carlo is used"
        if vehicles:
            interval = clopper_pearson(failures, vehicles, options.confidence)
    if not vehicles:
        raise SimulationError(f"study {evaluator.study.name!r}: none of {errors} vehicles could be simulated")
    share = failures / vehicles
    variation = float(np.sqrt((1 - share) / failures)) if failures else math.nan
    return Estimate(
        probability=share,
        coefficient_of_variation=variation,
        interval=interval,
        failures=failures,
        errors=errors,
        simulations=vehicles + errors,
        method="monte_carlo",
        remark=remark,
    )


def _needs_pilot(options: RiskOptions, study: Study) -> bool:
    """Whether a method for rare failures may follow; unless required, not for a share of the domain, which `rules`
    counts likewise.
    """
    may_be_rare = options.method == "auto" and bool(study.variation) and options.width is None
    return options.requires_rare_method or (may_be_rare and options.samples >= 2 * PILOT_VEHICLES)


def _try_rare_method(response: Response, responses: FloatArray, options: RiskOptions, seed: int) -> Estimate | str:
    """The estimate by a method for rare failures; why plain Monte Carlo has to continue if there is none."""
    if is_plateau(responses):
        return (
            "the response is a plateau: most vehicles nearest to failure have the same safety degree, so "
            "that methods for "
            "rare failures cannot approach failures; plain Monte Carlo is used"
        )
    if not options.requires_rare_method and find_spec("openturns") is None:
        return (
            f"fewer than {100 * RARE_BELOW:g} % of the first vehicles are unsafe; for a method that needs "
            "fewer vehicles "
            "for rare failures, in the checkout: pip install '.[rare]'"
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
