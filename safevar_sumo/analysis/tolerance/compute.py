"""Computes how far each characteristic may go by itself, in pairs, and with all others: in the largest safe box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.answer import Tolerance
from safevar_sumo.analysis.tolerance.boxes import SafeBox, find_safe_box, random_settings
from safevar_sumo.analysis.tolerance.joint import JointLimits, find_joint_limits
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan, scan_pairs, scan_with_sets
from safevar_sumo.analysis.tolerance.trade import find_trade
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Limit, Study, limits_of
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
    study = evaluator.study
    columns = _columns_of(study, options.characteristics)
    limits = _limits_of(study, options, columns)
    if options.pairs and len(columns) < 2:
        raise InputError("pairs", "one characteristic makes no pair", "at least two characteristics")
    if options.trade is not None:
        if len(options.trade) != 2:
            raise InputError("trade", repr(",".join(options.trade)), "two characteristics, separated by a comma")
        _check_names("trade", options.trade, list(study.vehicle.characteristics))
    original = evaluator.evaluate_original()
    unsafe = evaluator.choose_criterion(options.unsafe, source, original)
    # A box of a rated study would take thousands of whole test matrices.
    needs_box = not unsafe.of(original)[0] and not is_rated(study)
    if needs_box:  # drawing a setting raises the error if hardly any is feasible, before the long scans
        bounds = evaluator.characteristics.lower, evaluator.characteristics.upper
        random_settings(evaluator, columns, *bounds, 1, np.random.default_rng(study.search.seed))
    scans = scan_with_sets(evaluator, columns, unsafe, 0 if is_rated(study) else options.fits)
    pairs = scan_pairs(evaluator, columns, unsafe) if options.pairs else None
    box, together = SafeBox(), None
    if needs_box:
        changes = [{scan.characteristic.name: end} for scan in scans for interval in scan.unsafe for end in interval]
        changes += [pair.nearest for pair in pairs or [] if pair.nearest]
        unsafe_settings = settings_of(evaluator.characteristics, changes)
        known = _known_settings(source, columns, unsafe)
        box = find_safe_box(evaluator, columns, unsafe, unsafe_settings, known)
        if limits:
            together = find_joint_limits(evaluator, columns, unsafe, limits, scans, unsafe_settings, known)
    return Tolerance(
        study=study,
        unsafe=unsafe,
        original=original,
        alone=scans,
        pairs=pairs,
        joint=box._replace(characteristics=tuple(evaluator.characteristics.names[column] for column in columns)),
        no_verdict=evaluator.no_verdict,
        limits=limits,
        together=together,
        first_failures=_first_failures(evaluator, scans, together),
        trade=None if options.trade is None else find_trade(evaluator, options.trade, unsafe, limits),
    )


def _columns_of(study: Study, characteristics: Sequence[str] | None) -> list[int]:
    names = list(study.vehicle.characteristics)
    _check_names("characteristics", characteristics or (), names)
    return [column for column, name in enumerate(names) if characteristics is None or name in characteristics]


def _check_names(source: str, chosen: Sequence[str], names: Sequence[str]) -> None:
    """Raise an error if a chosen name is unknown or given twice."""
    for name in chosen:
        if name not in names:
            raise unknown_name(source, f"there is no characteristic {name!r}", name, names)
    if len(set(chosen)) < len(chosen):
        raise InputError(source, f"{','.join(chosen)}: a characteristic is named twice", "each characteristic once")


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


def _first_failures(
    evaluator: Evaluator, scans: Sequence[OneAtATimeScan], together: JointLimits | None
) -> dict[str, Evaluations]:
    """What fails first beyond the limits of each characteristic: alone or, if it is safe alone, with the others at
    their limits.
    """
    beyond = {} if together is None else dict(together.beyond)
    for scan in scans:
        if scan.unsafe:
            name, original = scan.characteristic.name, scan.characteristic.original
            nearest = min(np.ravel(scan.unsafe).tolist(), key=lambda end: (abs(end - original), end))
            (beyond[name],) = settings_of(evaluator.characteristics, [{name: nearest}])
    if not beyond:
        return {}
    evaluations = evaluator.evaluate(np.array(list(beyond.values())), "what fails first")
    return {name: evaluations.take([row]) for row, name in enumerate(beyond)}


def _known_settings(source: Study | Case, columns: Sequence[int], unsafe: Unsafe) -> FloatArray:
    """The distinct unsafe solutions of results that change no other characteristics than `columns`, shape (K, n)."""
    if isinstance(source, Study):
        return np.zeros((0, len(source.vehicle.characteristics)))
    names, original = list(source.characteristics.names), source.characteristics.original
    settings = source.solutions[unsafe.rows(source.solutions)][names].to_numpy(dtype=float)
    other_columns = np.setdiff1d(np.arange(len(names)), columns)
    return np.unique(settings[(settings == original)[:, other_columns].all(axis=1)], axis=0)
