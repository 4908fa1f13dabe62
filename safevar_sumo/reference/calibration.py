"""Fits of one study, or of several studies together, to published data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.parameters import value_of
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.reference.agreement import Agreement, measure_agreement
from safevar_sumo.reference.effects import error_beyond_spread
from safevar_sumo.reference.ensemble import invert
from safevar_sumo.reference.fit_result import Calibration
from safevar_sumo.reference.fit_space import FitSpace, StudyFit
from safevar_sumo.reference.loss import MAX_LOSS
from safevar_sumo.reference.parameters import free_parameters
from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.rows import COLUMNS, ReferenceData
from safevar_sumo.reference.search import CmaSearch, SearchRace, StudyGroup
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all
from safevar_sumo.workers.evaluation import Pool

START_DEVIATION = 0.02
"""Initial standard deviation of a search that begins at known values, as a share of the bounds' width."""
POPULATION_DIVISOR = 3
"""Factor by which the population of a search from known values is smaller: the search adapts once a generation, and need not explore."""
RANDOM_DEVIATION = 0.3
"""Initial standard deviation of a search that begins at a random place."""
ENSEMBLE_DEVIATION = 0.05
"""Initial standard deviation of a search that begins at the end of an ensemble Kalman inversion, in the mean over the parameters."""
ERROR_DECIMALS = 3
"""Decimals of a study's model error [m]."""


class FitSubject(NamedTuple):
    """A study, and the reference data that it is fitted to, by name."""

    study: Study
    references: Mapping[str, ReferenceData]


def calibrate(study: Study, references: Mapping[str, ReferenceData], pool: Pool,
              done: Callable[[float, Study], None] = lambda loss, best: None, *, from_scratch: bool = False) -> Calibration:
    """Fit one study; see `calibrate_together`."""
    return calibrate_together([FitSubject(study, references)], pool, lambda loss, best: done(loss, best[0]), from_scratch=from_scratch)[0]


def calibrate_together(subjects: Sequence[FitSubject], pool: Pool, done: Callable[[float, StudyGroup], None] = lambda loss, best: None, *,
                       from_scratch: bool = False) -> list[Calibration]:
    """Fit studies by CMA-ES (Hansen 2016), as their tables [fit] state; the first study's table sets trials, seed, starts and population.

    Parameters
    ----------
    subjects
        Studies with their data; a study without data is fitted to the original vehicle's published values alone.
    done
        Called after every trial with the lowest loss so far, and the studies with this loss.
    from_scratch
        Whether to start only at random places, without the values that the studies give to the free parameters.

    Raises
    ------
    InputError
        If no study has free parameters, a parameter cannot be fitted, or a study has neither data nor published values.
    SimulationError
        If the studies cannot be simulated with the values in their files.
    """
    studies = tuple(subject.study for subject in subjects)
    if not any(study.calibration for study in studies):
        raise InputError(studies[0].source, "has no table [calibration]", "the free parameters with bounds, unit and meaning")
    for subject in subjects:
        _check_subject(subject)
    fit, parameters = studies[0].fit, free_parameters(studies)
    if from_scratch and not fit.starts:
        raise InputError(studies[0].source, "fit.starts = 0", "at least 1 for a fit from scratch")
    fit_data, test_data = [], []
    for study, references in subjects:
        is_test = {name: np.arange(len(data.settings)) % study.fit.hold_out == study.fit.hold_out - 1 for name, data in references.items()}
        fit_data.append({name: data.take(~is_test[name]) for name, data in references.items()})
        test_data.append({name: data.take(is_test[name]) for name, data in references.items()})
    space = FitSpace(parameters, [StudyFit(study, data, pool) for study, data in zip(studies, fit_data, strict=True)])
    race = SearchRace(space, fit.population, fit.trials, done, fit.alike)
    if not from_scratch and race.try_studies([studies])[0].loss >= MAX_LOSS:
        names = " and ".join(f"study {study.name!r}" for study in studies)
        raise SimulationError(f"{names} cannot be simulated with {'its' if len(studies) == 1 else 'their'} own values")
    rng = np.random.default_rng(fit.seed)
    max_trials = race.trials_left // (2 * max(fit.starts, 1))
    searches = [_begin_at_random(race, len(parameters), fit.ensemble, max_trials, rng) for _ in range(fit.starts)]
    if not from_scratch:
        population = _refining_population(fit.population, len(parameters))
        searches.append(race.begin(space.place_of(studies), START_DEVIATION, seed=fit.seed + 1, population=population))
    race.run(searches)
    assert race.best is not None, "there is at least one trial"
    lowest_losses, results = [search.lowest_loss for search in searches if search.lowest_loss < np.inf], []
    profiles = Profiles.of(parameters, space, race, space.place_of(race.best))
    for k, best_study in enumerate(race.best):
        study_parameters = [parameter for parameter in parameters if k in parameter.study_indices]
        best = msgspec.structs.replace(best_study, spread=profiles.spread(k))
        error = {SAFETY_DEGREE: round(error_beyond_spread(best, fit_data[k]), ERROR_DECIMALS)} if fit_data[k] else {}
        best = msgspec.structs.replace(best, model_error=error)
        results.append(Calibration(
            values={parameter.key: value_of(best, parameter.key) for parameter in study_parameters}, study=best, loss=race.lowest_loss,
            reached=lowest_losses, used=_measure_agreements(best, fit_data[k], pool),
            held_back=_measure_agreements(best, test_data[k], pool),
            bounds={parameter.key: parameter.bounds for parameter in study_parameters}, search=fit,
            together=tuple(study.name for study in studies if study is not studies[k]),
            shared=frozenset(parameter.key for parameter in study_parameters if len(parameter.study_indices) > 1),
            intervals={parameter.key: profiles.interval(i) for i, parameter in enumerate(parameters) if k in parameter.study_indices},
            profiles=profiles))
    return results


def _refining_population(population: int, parameter_count: int) -> int:
    """A population `POPULATION_DIVISOR` times smaller, but at least the default population of CMA-ES (Hansen 2016)."""
    return min(population, max(population // POPULATION_DIVISOR, 4 + int(3 * math.log(parameter_count))))


def _begin_at_random(race: SearchRace, dimension: int, ensemble_size: int, max_trials: int, rng: np.random.Generator) -> CmaSearch:
    """Begin a search at the best place of an ensemble Kalman inversion; without an ensemble, or trials for one, at a random place."""
    ensemble_size = min(ensemble_size, max_trials)
    if ensemble_size < 2:
        return race.begin(rng.random(dimension), RANDOM_DEVIATION, seed=int(rng.integers(1, 2**31)))
    inversion = invert(race, dimension, ensemble_size, max_trials, rng)
    return race.begin(inversion.place, ENSEMBLE_DEVIATION, seed=int(rng.integers(1, 2**31)), axes=inversion.axes)


def _check_subject(subject: FitSubject) -> None:
    source = subject.study.source
    if not subject.references and not subject.study.published:
        raise InputError(source, "has no table [published] and there is no reference file", "something to fit to")
    for name in subject.study.fit.weights:
        if name not in COLUMNS:
            raise InputError(source, f"fit.weights.{name} is no metric of the reference", f"some of {', '.join(COLUMNS)}")


def _measure_agreements(study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> dict[str, Agreement]:
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    agreements = {}
    for name, data in references.items():
        evaluations = evaluate_all(study, np.concatenate([characteristics.original[np.newaxis], data.settings]), pool)
        simulated_rows = evaluations.take(np.arange(1, len(evaluations)))
        agreements[name] = measure_agreement(data, simulated_rows, study, evaluations.take([0]))
    return agreements
