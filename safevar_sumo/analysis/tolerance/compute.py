"""Computes how far each characteristic may go by itself, in pairs, and with all others: in the largest safe box."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import find_boundary_shares, settings_on_lines
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.answer import SafeBox, Tolerance
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan, Pair, scan, scan_pairs
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles.region import REJECTIONS

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS = 256, 1024
"""Number of Sobol points, and of corners, in the first search of a box, and in a second search if the first finds
nothing unsafe.
"""
MAX_LINES = 16
"""Maximum number of unsafe settings, the nearest first, from which the search goes back towards the original."""
STEP_BACK = 0.999
"""The box ends at this share of the way to the nearest unsafe setting."""
MIN_FACTOR = 1e-6
"""Smallest factor of a box; below it there is no safe box."""


def find_tolerances(source: Study | Case, options: ToleranceOptions, evaluator: Evaluator) -> Tolerance:
    """Find how far the characteristics of a study may go. The filter is not applied, as the question is about the
    vehicle.

    The joint box holds none of the unsafe solutions of results.

    Raises
    ------
    InputError
        If `unsafe` or a name cannot be used, or hardly any setting of a box satisfies the study's constraints.
    """
    study = evaluator.study
    columns = _columns_of(study, options.characteristics)
    if options.pairs and len(columns) < 2:
        raise InputError("pairs", "one characteristic makes no pair", "at least two characteristics")
    original = evaluator.evaluate_original()
    unsafe = evaluator.choose_criterion(options.unsafe, source, original)
    # A box of a rated study would take thousands of whole test matrices. Characteristics that constraints tie so
    # closely that hardly any setting in a box is feasible are refused first.
    needs_box = not unsafe.of(original)[0] and not is_rated(study)
    if needs_box:
        _random_settings(evaluator, columns, 1.0, 1, np.random.default_rng(study.search.seed))
    scans = scan(evaluator, columns, unsafe)
    pairs = scan_pairs(evaluator, columns, unsafe) if options.pairs else None
    box = SafeBox()
    if needs_box:
        found, known = _unsafe_settings(evaluator, scans, pairs or []), _known_settings(source, columns, unsafe)
        box = find_safe_box(evaluator, columns, unsafe, found, known)
    return Tolerance(
        study=study,
        unsafe=unsafe,
        original=original,
        alone=scans,
        pairs=pairs,
        joint=box._replace(characteristics=tuple(evaluator.characteristics.names[column] for column in columns)),
        no_verdict=evaluator.no_verdict,
    )


def _columns_of(study: Study, characteristics: Sequence[str] | None) -> list[int]:
    names, chosen = list(study.vehicle.characteristics), characteristics or ()
    for name in chosen:
        if name not in names:
            raise unknown_name("characteristics", f"there is no characteristic {name!r}", name, names)
    if len(set(chosen)) < len(chosen):
        raise InputError(
            "characteristics", f"{','.join(chosen)}: a characteristic is named twice", "each characteristic once"
        )
    return [column for column, name in enumerate(names) if characteristics is None or name in characteristics]


def _unsafe_settings(evaluator: Evaluator, scans: Sequence[OneAtATimeScan], pairs: Sequence[Pair]) -> FloatArray:
    """The K unsafe settings of scans and pairs, shape (K, n)."""
    changes = [{scan.characteristic.name: end} for scan in scans for interval in scan.unsafe for end in interval]
    changes += [pair.nearest for pair in pairs if pair.nearest]
    original = dict(zip(evaluator.characteristics.names, evaluator.characteristics.original, strict=True))
    return pd.DataFrame(changes, columns=list(original), dtype=float).fillna(original).to_numpy()


def find_safe_box(
    evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, unsafe_settings: FloatArray, known: FloatArray
) -> SafeBox:
    """The largest safe box, in which `columns` vary, around an original vehicle that is safe itself.

    The box ends before all of `unsafe_settings`, shape (K, n), each the nearest of its line. From the unsafe solutions
    of a search, `known`, shape (L, n), it shrinks as from unsafe settings that it finds itself.

    Notes
    -----
    The search of a box simulates Sobol points and as many corners, where all changes add up. From unsafe settings the
    search goes back towards the original, and the box shrinks to end before the first unsafe setting on the way, until
    the search finds nothing unsafe. These settings determined the box, so they prove nothing about it.

    The box is then tested with settings drawn independently and uniformly in it, by a separate random generator. If any
    is unsafe, the box shrinks and is searched and tested again. Test k, k = 1, 2, ..., may be wrong with probability
    alpha_k = alpha / 2^k, alpha = 1 - `confidence`: if test k accepts, the bound is Clopper and Pearson's upper bound
    at confidence 1 - alpha_k for the share of the box that is unsafe or cannot be simulated. Box k depends on earlier
    samples alone, so given box k the bound fails with probability at most alpha_k; all tests together fail with
    probability sum alpha_k <= alpha, whichever of them accepts. Later tests draw more settings, so that the bound stays
    `MAX_UNSAFE_SHARE` if all of them can be simulated.
    """

    def shrunk(factor: float, unsafe_found: FloatArray) -> float:
        """The factor of a box that ends before all unsafe settings found on the straight ways from the original to some
        of these.
        """
        nearest = unsafe_found[np.argsort(_box_factors(evaluator, unsafe_found), kind="stable")[:MAX_LINES]]
        starts = np.tile(evaluator.characteristics.original, (len(nearest), 1))
        shares, _ = find_boundary_shares(evaluator, starts, nearest, unsafe, stage="nearest unsafe settings")
        edges = settings_on_lines(starts, nearest, shares[:, np.newaxis])[:, 0]
        return min(factor, float(np.min(_box_factors(evaluator, edges)))) * STEP_BACK

    factor, seed = 1.0, evaluator.study.search.seed
    if len(unsafe_settings):
        factor = min(factor, STEP_BACK * float(np.min(_box_factors(evaluator, unsafe_settings))))
    if len(known):
        factor = shrunk(factor, known)
    search = attempt = 0
    while factor >= MIN_FACTOR:
        for point_count in (FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS):
            sobol = sobol_points(point_count, len(columns), seed + search)
            settings = _settings_in_box(evaluator, columns, factor, np.concatenate([sobol, np.round(sobol)]))  # corners
            unsafe_found, _ = _unsafe_in_box(evaluator, factor, settings, unsafe)
            if len(unsafe_found):
                break
        else:
            attempt += 1
            error_probability = (1 - CONFIDENCE) / 2**attempt
            samples = math.ceil(math.log(error_probability) / math.log1p(-MAX_UNSAFE_SHARE))
            settings = _random_settings(evaluator, columns, factor, samples, np.random.default_rng((seed, attempt)))
            unsafe_found, failed = _unsafe_in_box(evaluator, factor, settings, unsafe)
            if not len(unsafe_found):
                safe = len(settings) - failed
                bound = float(scipy.stats.beta.ppf(1 - error_probability, failed + 1, safe)) if safe else 1.0
                return SafeBox(factor, CONFIDENCE, len(settings), failed, attempt, bound)
        factor, search = shrunk(factor, unsafe_found), search + 1
    return SafeBox(attempts=attempt)


def _known_settings(source: Study | Case, columns: Sequence[int], unsafe: Unsafe) -> FloatArray:
    """The distinct unsafe solutions of results that change no other characteristics than these, shape (K, n)."""
    if isinstance(source, Study):
        return np.zeros((0, len(source.vehicle.characteristics)))
    names, original = list(source.characteristics.names), source.characteristics.original
    settings = source.solutions[unsafe.rows(source.solutions)][names].to_numpy(dtype=float)
    others = np.setdiff1d(np.arange(len(names)), columns)
    return np.unique(settings[(settings == original)[:, others].all(axis=1)], axis=0)


def _settings_in_box(evaluator: Evaluator, columns: Sequence[int], factor: float, points: FloatArray) -> FloatArray:
    """Settings in a box around the original, from points of the unit cube; shape (K, n)."""
    characteristics, indices = evaluator.characteristics, list(columns)
    lower = characteristics.original - factor * (characteristics.original - characteristics.lower)
    upper = characteristics.original + factor * (characteristics.upper - characteristics.original)
    settings = np.tile(characteristics.original, (len(points), 1))
    settings[:, indices] = lower[indices] + points * (upper - lower)[indices]
    return settings


def _random_settings(
    evaluator: Evaluator, columns: Sequence[int], factor: float, number: int, rng: np.random.Generator
) -> FloatArray:
    """Feasible settings drawn uniformly in a box; fewer than `number` where few are feasible, an error where none
    is.
    """
    settings = evaluator.region.draw_feasible(
        lambda count: _settings_in_box(evaluator, columns, factor, rng.random((count, len(columns)))), number
    )
    if not len(settings):
        raise InputError(
            evaluator.study.source,
            f"fewer than 1 in {REJECTIONS} random settings satisfy the constraints, which leaves "
            f"no box to test: {evaluator.region}",
            "characteristics that the constraints do not tie to each other",
        )
    return settings


def _unsafe_in_box(evaluator: Evaluator, factor: float, settings: FloatArray, unsafe: Unsafe) -> tuple[FloatArray, int]:
    """The unsafe settings, shape (K, n), and the number of feasible settings that could not be simulated."""
    evaluations = evaluator.evaluate(settings, f"all characteristics within {factor:.0%} of the domain")
    return settings[unsafe.of(evaluations)], int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))


def _box_factors(evaluator: Evaluator, settings: FloatArray) -> FloatArray:
    """Factors of the boxes on whose surfaces K settings lie, shape (K,)."""
    characteristics = evaluator.characteristics
    change = settings - characteristics.original
    room = np.where(
        change < 0, characteristics.original - characteristics.lower, characteristics.upper - characteristics.original
    )
    return np.asarray(
        np.max(np.divide(np.abs(change), room, out=np.zeros_like(change), where=room > 0), axis=1, initial=0.0)
    )
