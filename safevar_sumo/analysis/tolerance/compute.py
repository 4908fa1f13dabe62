"""Computes how far each characteristic may go by itself, in pairs, and with all others."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, open_evaluator
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.analysis.tolerance.answer import Tolerance
from safevar_sumo.analysis.tolerance.safe_box import SafeBox, find_safe_box, names_of, refuse_tied
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan, Pair, scan, scan_pairs
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study


def find_tolerances(
    source: Study | Case,
    options: ToleranceOptions,
    *,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Tolerance:
    """Find how far the characteristics of a study may go. The filter is not applied, as the question is about the
    vehicle.

    The joint box holds none of the unsafe solutions of results.

    Raises
    ------
    InputError
        If `unsafe` or a name cannot be used, the study cannot be assembled, or hardly any setting of a box satisfies
        its constraints.
    """
    study = study_in(source)
    columns = _columns_of(study, options.characteristics)
    if options.pairs and len(columns) < 2:
        raise InputError("pairs", "one characteristic makes no pair", "at least two characteristics")
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        original = evaluator.evaluate_original()
        unsafe = evaluator.choose_criterion(options.unsafe, source, original)
        # a box of a rated study would take thousands of whole test matrices
        needs_box = not unsafe.of(original)[0] and not is_rated(study)
        if needs_box:
            refuse_tied(evaluator, columns)
        scans = scan(evaluator, columns, unsafe)
        pairs = scan_pairs(evaluator, columns, unsafe) if options.pairs else None
        solutions = None if isinstance(source, Study) else source.solutions[unsafe.rows(source.solutions)]
        box = SafeBox(characteristics=names_of(evaluator, columns))
        if needs_box:
            box = find_safe_box(evaluator, columns, unsafe, _unsafe_settings(evaluator, scans, pairs or []), solutions)
        return Tolerance(
            study=study,
            unsafe=unsafe,
            original=original,
            alone=scans,
            pairs=pairs,
            joint=box,
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
    changes += [dict(zip(pair.names, pair.nearest, strict=True)) for pair in pairs if pair.nearest]
    original = dict(zip(evaluator.characteristics.names, evaluator.characteristics.original, strict=True))
    return pd.DataFrame(changes, columns=list(original), dtype=float).fillna(original).to_numpy()
