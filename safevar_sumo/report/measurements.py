"""Numbers for a dossier that no question answers: validation with reference data, constants by origin, settings in SUMO
and with other time steps.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import scipy

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.model_spread import HALF_WIDTH, compute_model_spreads
from safevar_sumo.analysis.subject import load
from safevar_sumo.campaign.local import available_cores, local_pool
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import SafevarError
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, finite_or_none
from safevar_sumo.reference.agreement import rank_correlation
from safevar_sumo.reference.effects import HOLD_OUT, is_held_back, measure_coverage
from safevar_sumo.reference.rows import read_reference
from safevar_sumo.results import record
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo import Engine, is_recorded
from safevar_sumo.sumo.matrix import evaluate, simulate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Progress, show_no_progress
from safevar_sumo.vehicles import CharacteristicSet

CHECKED = 20
"""Number of solutions that are simulated in SUMO and with other time steps."""


def measure_validation(here: FloatArray, there: FloatArray) -> dict[str, float | None]:
    """The measures of two series of M paired values, shape (M,): those named in WP.29/2022/57 (cited after its
    readers), rank correlation and mean absolute error; None where undefined.

    Sprague and Geers: M = sqrt(sum h^2 / sum t^2) - 1, P = arccos(sum h t / sqrt(sum h^2 sum t^2)) / pi and the
    comprehensive error sqrt(M^2 + P^2).
    """
    error, square_here, square_there = here - there, here @ here, there @ there
    with np.errstate(all="ignore"):
        magnitude = np.sqrt(square_here / square_there) - 1
        phase = np.arccos(np.clip(here @ there / np.sqrt(square_here * square_there), -1, 1)) / np.pi
        is_testable = len(here) > 2 and np.ptp(here) > 0 and np.ptp(there) > 0
        measures = {
            "relative_error": np.mean(np.abs(error)) / np.mean(np.abs(there)),
            "rmse": np.sqrt(np.mean(error * error)),
            "largest_error": np.max(np.abs(error)),
            "sprague_geers_magnitude": magnitude,
            "sprague_geers_phase": phase,
            "sprague_geers": np.hypot(magnitude, phase),
            "pearson": scipy.stats.pearsonr(here, there).statistic if is_testable else np.nan,
            "t_test": scipy.stats.ttest_rel(here, there).pvalue if is_testable and np.ptp(error) > 0 else np.nan,
            "anova": scipy.stats.f_oneway(here, there).pvalue if is_testable else np.nan,
            "kolmogorov_smirnov": scipy.stats.ks_2samp(here, there).statistic,
            "kolmogorov_smirnov_p": scipy.stats.ks_2samp(here, there).pvalue,
            "mean_absolute_error": np.mean(np.abs(error)),
        }
    numbers = {name: finite_or_none(float(value)) for name, value in measures.items()}
    return {**numbers, "spearman": finite_or_none(rank_correlation(here, there))}


def validate_with(study: Study, reference: Path, pool: Pool, progress: Progress = show_no_progress) -> JsonObject:
    """The measures of the safety degree on the rows of a reference file that a fit uses, and on those held back."""
    data = read_reference(reference, CharacteristicSet.of(study))
    here = Evaluator(study, pool, progress).evaluate(data.settings, reference.name, ignore_constraints=True).f_safe
    there, held_back = data.metrics[SAFETY_DEGREE], is_held_back(data)
    result: JsonObject = {"file": reference.name, "sha256": data.fingerprint, "hold_out": HOLD_OUT}
    coverage = measure_coverage(data, study) if study.spread else None
    for name, rows in (("used", ~held_back), ("held_back", held_back)):
        defined = rows & np.isfinite(here) & np.isfinite(there)
        measures = measure_validation(here[defined], there[defined]) if defined.any() else {}
        result[name] = {"rows": int(defined.sum()), **measures}
    result["coverage"] = None if coverage is None else {"all_rows": coverage.all_rows, "held_back": coverage.held_back}
    return result


def check_study(study: Study, solutions: FloatArray, pool: Pool, progress: Progress = show_no_progress) -> JsonObject:
    """Numbers about a study's simulations: constants by origin; solutions, shape (M, n), in SUMO and with other time
    steps; the original vehicle's uncertainty.
    """
    evaluator, system = Evaluator(study, pool, progress), assemble(study, study.source)
    constants = count_constants(study)
    if system.rater is not None:  # thousands of cells: `explain` and `rating` have their own checks
        return {"constants": constants}
    distinct = np.unique(solutions, axis=0)
    chosen = distinct[np.linspace(0, len(distinct) - 1, min(CHECKED, len(distinct))).astype(int)]
    settings = np.concatenate([system.characteristics.original[np.newaxis], chosen])
    base = evaluator.evaluate(settings, "settings to check", ignore_constraints=True)
    in_sumo = evaluate(system, settings, Engine.LIBSUMO)
    one_scene = system.at(system.points[0]) if system.matrix else system
    step = simulate(one_scene, settings[:1]).trace.step
    return {
        "constants": constants,
        "settings": len(settings),
        "recorded": is_recorded(system),
        "same_in_sumo": sum(record(base, row) == record(in_sumo, row) for row in range(len(settings))),
        "time_step": step,
        "half_step": _with_step(evaluator, base, step / 2),
        "double_step": _with_step(evaluator, base, step * 2),
        "original": _uncertainty(study, float(base.f_safe[0])),
    }


def _with_step(evaluator: Evaluator, base: Evaluations, step: float) -> JsonObject:
    """How many settings end alike with another time step, the largest change of the safety degree, and the original's
    safety degree.
    """
    try:
        other = evaluator.with_step(step).evaluate(base.settings, f"time step {step:g} s", ignore_constraints=True)
    except SafevarError as error:
        return {"reason": " ".join(str(error).split())}
    change = np.abs(other.f_safe - base.f_safe)
    return {
        "same_outcome": int(np.sum(other.outcome == base.outcome)),
        "largest_change": finite_or_none(np.nanmax(change)) if np.isfinite(change).any() else None,
        "original": finite_or_none(other.f_safe[0]),
    }


def _uncertainty(study: Study, safety_degree: float) -> JsonObject:
    repeats = study.repeatability.get(SAFETY_DEGREE)
    original = CharacteristicSet.of(study).original[np.newaxis]
    spread = compute_model_spreads(study, original)[0]._asdict() if study.spread else {}
    return {
        "safety_degree": finite_or_none(safety_degree),
        "repeats": None if repeats is None else HALF_WIDTH * repeats,
        **spread,
    }


def count_constants(study: Study) -> dict[str, int]:
    """Numbers of a study by origin: the characteristics' originals and domains and what [published] and [repeatability]
    hold; parameters that a fit has found; all others of vehicle, ADS, scenario and weather, with their defaults.
    """
    system = assemble(study, study.source)
    models = ((system.vehicle, study.vehicle), (system.ads, study.ads), (system.scenario, study.scenario))
    tables = [model if isinstance(model, msgspec.Struct) else table.parameters for model, table in models]
    tables = msgspec.to_builtins([system.weather, *tables])
    ends = 3 * len(study.vehicle.characteristics)  # original, lower and upper
    published = ends + len(study.published) + len(study.repeatability)
    fitted = len(study.spread)
    return {"published": published, "fitted": fitted, "assumed": max(_count_numbers(tables) - fitted, 0)}


def _count_numbers(value: Any) -> int:
    if isinstance(value, dict | list | tuple):
        return sum(map(_count_numbers, value.values() if isinstance(value, dict) else value))
    return int(isinstance(value, int | float) and not isinstance(value, bool))


def print_checks(directory: str, reference: str = "") -> None:
    """Print the JSON of `check_study` on results or, with a reference file, of `validate_with`."""
    case = load(directory).case
    with local_pool(available_cores(), case.study.search.time_limit) as pool:
        if reference:
            answer = validate_with(case.study, Path(reference), pool)
        else:
            answer = check_study(case.study, settings_of(case), pool)
    print(json.dumps(answer, indent=2, allow_nan=False))


def settings_of(case: Case) -> FloatArray:
    """The settings of all solutions, shape (M, n)."""
    return case.solutions[list(case.characteristics.names)].to_numpy(float)
