"""Computes how far each characteristic may go alone, and with all others: in the largest safe box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.metrics import Unsafe, margin_of
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.tolerance import ToleranceOptions
from safevar_sumo.questions.tolerance.answer import Tolerance
from safevar_sumo.questions.tolerance.boxes import random_settings
from safevar_sumo.questions.tolerance.joint import find_joint_limits
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan, scan_with_sets
from safevar_sumo.questions.tolerance.sheet import describe_failures
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Limit, Study, limits_of
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet


def find_tolerances(source: Study | Case, options: ToleranceOptions, evaluator: Evaluator) -> Tolerance:
    """Find how far the characteristics of a study may go.

    The filter is not applied, as the question is about the vehicle. The joint box holds none of the unsafe solutions of
    results.

    Raises
    ------
    InputError
        If `unsafe` or a name cannot be used, or hardly any setting of a box satisfies the study's constraints.
    """
    study, system = evaluator.study, assemble(evaluator.study)
    columns = _columns_of(study, options.characteristics)
    limits = _limits_of(study, options, columns)
    original = evaluator.evaluate_original()
    unsafe = replace(_criterion_of(source, options, evaluator, original), contact=contact_degree(system))
    # A box of a rated study would take thousands of whole test matrices.
    needs_box = not unsafe.of(original)[0] and not is_rated(study)
    if needs_box:  # drawing a setting raises the error if hardly any is feasible, before the long scans
        bounds = evaluator.characteristics.lower, evaluator.characteristics.upper
        random_settings(evaluator, columns, *bounds, 1, np.random.default_rng(study.search.seed))
    scans = scan_with_sets(evaluator, columns, unsafe, 0 if is_rated(study) else options.fits)
    together = None
    if needs_box:
        ends = [{scan.characteristic.name: end} for scan in scans for interval in scan.unsafe for end in interval]
        known = [settings_of(evaluator.characteristics, ends), _known_settings(source, columns, unsafe)]
        together = find_joint_limits(evaluator, columns, unsafe, limits, scans, np.concatenate(known))
    beyond_alone, beyond = (
        describe_failures(evaluator, settings, system.points, unsafe)
        for settings in (_nearest_unsafe(evaluator, scans), {} if together is None else together.beyond)
    )
    return Tolerance(
        study=study,
        unsafe=unsafe,
        original=original,
        alone=scans,
        together=together,
        no_verdict=evaluator.no_verdict,
        limits=limits,
        beyond_alone=beyond_alone,
        beyond=beyond,
    )


def _criterion_of(
    source: Study | Case, options: ToleranceOptions, evaluator: Evaluator, original: Evaluations
) -> Unsafe:
    """The criterion; a collision includes what keeps less than the margin, unless a collision itself is asked for."""
    unsafe = evaluator.choose_criterion(options.unsafe, source, original)
    if unsafe != Unsafe() or (options.unsafe is not None and options.margin is None):
        return unsafe
    return replace(unsafe, keep=margin_of(evaluator.study, options.margin))


def _columns_of(study: Study, characteristics: Sequence[str] | None) -> list[int]:
    names, chosen = list(study.vehicle.characteristics), characteristics or ()
    for name in chosen:
        if name not in names:
            raise unknown_name("characteristics", f"there is no characteristic {name!r}", name, names)
    if len(set(chosen)) < len(chosen):
        problem = f"{','.join(chosen)}: a characteristic is named twice"
        raise InputError("characteristics", problem, "each characteristic once")
    return [column for column, name in enumerate(names) if characteristics is None or name in characteristics]


def _limits_of(study: Study, options: ToleranceOptions, columns: Sequence[int]) -> dict[str, Limit]:
    """The limits of the study and of the options for the characteristics that vary."""
    rows = study.vehicle.characteristics
    varied = [list(rows)[column] for column in columns]
    for name in limits_of(options.limits, rows):
        if name not in varied:
            raise unknown_name("limits", f"{name} does not vary with these --characteristics", name, varied)
    return {name: limit for name, limit in limits_of(options.limits, rows, study.limits).items() if name in varied}


def settings_of(characteristics: CharacteristicSet, changes: Sequence[Mapping[str, float]]) -> FloatArray:
    """The K settings with these values of some characteristics, all others as in the original; shape (K, n)."""
    original = dict(zip(characteristics.names, characteristics.original, strict=True))
    return pd.DataFrame(changes, columns=list(original), dtype=float).fillna(original).to_numpy()


def _nearest_unsafe(evaluator: Evaluator, scans: Sequence[OneAtATimeScan]) -> dict[str, FloatArray]:
    """The unsafe setting of each characteristic alone that is nearest to the original, by name."""
    nearest = {}
    for scan in scans:
        if scan.unsafe:
            name, original = scan.characteristic.name, scan.characteristic.original
            value = min(np.ravel(scan.unsafe).tolist(), key=lambda end: (abs(end - original), end))
            (nearest[name],) = settings_of(evaluator.characteristics, [{name: value}])
    return nearest


def _known_settings(source: Study | Case, columns: Sequence[int], unsafe: Unsafe) -> FloatArray:
    """The distinct unsafe solutions of results that change no other characteristics than `columns`, shape (K, n)."""
    if isinstance(source, Study):
        return np.zeros((0, len(source.vehicle.characteristics)))
    names, original = list(source.characteristics.names), source.characteristics.original
    settings = source.solutions[unsafe.rows(source.solutions)][names].to_numpy(dtype=float)
    other_columns = np.setdiff1d(np.arange(len(names)), columns)
    return np.unique(settings[(settings == original)[:, other_columns].all(axis=1)], axis=0)
