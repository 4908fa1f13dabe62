"""Fit one study, or several together, to published data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.reference.effects import error_beyond_spread
from safevar_sumo.reference.fit_result import Calibration
from safevar_sumo.reference.fit_space import FitSpace, FittedStudy
from safevar_sumo.reference.loss import MAX_LOSS
from safevar_sumo.reference.parameters import Free, free_parameters
from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.rows import COLUMNS, ReferenceData
from safevar_sumo.reference.search import Together, TrialSearch
from safevar_sumo.reference.validation import Agreement, agreement
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all
from safevar_sumo.workers.evaluation import Pool

NEAR = 0.02
"""Initial standard deviation of a search around known values, as a share of the bounds' width."""
REFINEMENT = 3
"""A search around known values has a population this many times smaller: it need not find a valley, and learns once a generation."""
STAGES = (64, 16)
"""Percentages of the trials from scratch that fit the first study alone, and then the others' own parameters; the rest fit all."""
MILLIMETRES = 3
"""Decimals of a study's model error [m]."""


class FitSubject(NamedTuple):
    """A study and the data that it is fitted to, by name."""

    study: Study
    references: Mapping[str, ReferenceData]


def calibrate(study: Study, references: Mapping[str, ReferenceData], pool: Pool,
              done: Callable[[float, Study], None] = lambda loss, best: None, *, from_scratch: bool = False) -> Calibration:
    """Fit one study; see `calibrate_together`."""
    return calibrate_together([FitSubject(study, references)], pool, lambda loss, best: done(loss, best[0]), from_scratch=from_scratch)[0]


def calibrate_together(subjects: Sequence[FitSubject], pool: Pool, done: Callable[[float, Together], None] = lambda loss, best: None, *,
                       from_scratch: bool = False) -> list[Calibration]:
    """Fit by CMA-ES (Hansen 2016), as the studies' tables [fit] say; trials, seed, starts and population are the first study's.

    Parameters
    ----------
    subjects
        Studies with their data; without data, only the original vehicle's values count.
    done
        Called after every trial with the lowest loss so far, and the studies that have it.
    from_scratch
        Ignore the studies' own values of the free parameters: start only at random places.

    Raises
    ------
    InputError
        If no study has free parameters, one of them cannot be fitted, or a study has nothing to fit it to.
    SimulationError
        If the studies cannot be simulated with their own values.
    """
    studies = tuple(subject.study for subject in subjects)
    if not any(study.calibration for study in studies):
        raise InputError(studies[0].source, "has no table [calibration]", "the free parameters with bounds, unit and meaning")
    for subject in subjects:
        _check(subject)
    fit, free = studies[0].fit, free_parameters(studies)
    if from_scratch and not fit.starts:
        raise InputError(studies[0].source, "fit.starts = 0", "at least 1 for a fit from scratch")
    used, held_back = [], []
    for study, references in subjects:
        rows = {name: np.arange(len(data.settings)) % study.fit.hold_out == study.fit.hold_out - 1 for name, data in references.items()}
        used.append({name: data.take(~rows[name]) for name, data in references.items()})
        held_back.append({name: data.take(rows[name]) for name, data in references.items()})
    start, trials, rng = studies, fit.trials, np.random.default_rng(fit.seed)
    if staged := from_scratch and (len(studies) > 1 or fit.thinning > 1):
        start, trials = _by_stages(subjects, free, used, pool, rng, done)
    space = FitSpace(free, [FittedStudy(study, data, pool) for study, data in zip(start, used, strict=True)])
    search = TrialSearch(space, fit.population, trials, done, fit.alike)
    if not from_scratch and search.try_studies([studies])[0] >= MAX_LOSS:
        names = " and ".join(f"study {study.name!r}" for study in studies)
        raise SimulationError(f"{names} cannot be simulated with {'its' if len(studies) == 1 else 'their'} own values")
    searches = [] if staged else search.from_random_places(_first_of_key(free), fit.starts, fit.screened, fit.width, rng)
    if staged or not from_scratch:
        searches.append(search.begin(space.shares(start), NEAR, fit.seed + 1, _refining_population(fit.population, len(free))))
    search.race(searches)
    assert search.best is not None, "there is at least one trial"
    reached, results = [one.lowest for one in searches if one.lowest < np.inf], []
    profiles = Profiles.of(free, space, search, space.shares(search.best))
    for k, best in enumerate(search.best):
        parameters = [one for one in free if k in one.studies]
        best = msgspec.structs.replace(best, spread=profiles.spread(k))
        beyond = {SAFETY_DEGREE: round(error_beyond_spread(best, used[k]), MILLIMETRES)} if used[k] else {}
        best = msgspec.structs.replace(best, model_error=beyond)
        results.append(Calibration(
            {one.key: value_of(best, one.key) for one in parameters}, best, search.loss, reached, _agreements(best, used[k], pool),
            _agreements(best, held_back[k], pool), {one.key: one.bounds for one in parameters}, fit,
            tuple(study.name for study in studies if study is not studies[k]),
            frozenset(one.key for one in parameters if len(one.studies) > 1),
            {one.key: profiles.interval(i) for i, one in enumerate(free) if k in one.studies}, profiles))
    return results


def _refining_population(population: int, parameters: int) -> int:
    """A population `REFINEMENT` times smaller, but not below the usual one of CMA-ES (Hansen 2016)."""
    return min(population, max(population // REFINEMENT, 4 + int(3 * math.log(parameters))))


def _first_of_key(free: Sequence[Free]) -> list[int]:
    """For each parameter, the first one with its key: studies' own values start at one place, for they describe one model."""
    keys = [one.key for one in free]
    return [keys.index(key) for key in keys]


def _by_stages(subjects: Sequence[FitSubject], free: Sequence[Free], used: Sequence[Mapping[str, ReferenceData]], pool: Pool,
               rng: np.random.Generator, done: Callable[[float, Together], None]) -> tuple[Together, int]:
    """Fit, on thinned rows, the first study from random places, then the others' own parameters; also returns the trials left."""
    studies = tuple(subject.study for subject in subjects)
    fit, trials_left = studies[0].fit, studies[0].fit.trials
    first = [one._replace(studies=(0,)) for one in free if 0 in one.studies]
    others = [one._replace(studies=tuple(k - 1 for k in one.studies)) for one in free if 0 not in one.studies]
    for parameters, indices, share in zip((first, others), ([0], list(range(1, len(studies)))), STAGES, strict=True):
        trials = fit.trials * share // 100
        if parameters and trials:
            thinned = [{name: _thinned(data, fit.thinning) for name, data in used[k].items()} for k in indices]
            space = FitSpace(parameters, [FittedStudy(studies[k], data, pool) for k, data in zip(indices, thinned, strict=True)])
            search = TrialSearch(space, fit.population, trials, partial(_done_with_some, done, studies, indices))
            search.race(search.from_random_places(_first_of_key(parameters), fit.starts, fit.screened, fit.width, rng))
            assert search.best is not None, "there is at least one trial"
            studies, trials_left = _replaced(studies, indices, search.best), trials_left - trials
            values = [(one, value_of(studies[0], one.key)) for one in free if 0 in one.studies]
            studies = tuple(with_values(study, {one.key: value for one, value in values if k in one.studies})
                            for k, study in enumerate(studies))
    return studies, trials_left


def _done_with_some(done: Callable[[float, Together], None], studies: Together, indices: Sequence[int], loss: float,
                    best: Together) -> None:
    done(loss, _replaced(studies, indices, best))


def _replaced(studies: Together, indices: Sequence[int], replacements: Together) -> Together:
    """Studies with those at some indices replaced."""
    return tuple(replacements[indices.index(k)] if k in indices else study for k, study in enumerate(studies))


def _thinned(data: ReferenceData, thinning: int) -> ReferenceData:
    """Every `thinning`-th row in the order of the safety degree, so that the few rows are distributed as all rows are."""
    rows = np.zeros(len(data.settings), dtype=bool)
    rows[np.argsort(data.metrics[SAFETY_DEGREE], kind="stable")[thinning // 2::thinning]] = True
    return data.take(rows)


def _check(subject: FitSubject) -> None:
    source = subject.study.source
    if not subject.references and not subject.study.published:
        raise InputError(source, "has no table [published] and there is no reference file", "something to fit to")
    for name in subject.study.fit.weights:
        if name not in COLUMNS:
            raise InputError(source, f"fit.weights.{name} is no metric of the reference", f"some of {', '.join(COLUMNS)}")


def _agreements(study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> dict[str, Agreement]:
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    parts = {}
    for name, data in references.items():
        evaluations = evaluate_all(study, np.concatenate([characteristics.original[np.newaxis], data.settings]), pool)
        here = evaluations.take(np.arange(1, len(evaluations)))
        parts[name] = agreement(data, here, study, evaluations.take([0]))
    return parts
