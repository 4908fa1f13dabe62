"""Fits of one study, or of several studies together, to published data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.reference.agreement import Agreement, measure_agreement
from safevar_sumo.reference.effects import error_beyond_spread
from safevar_sumo.reference.fit_result import Calibration
from safevar_sumo.reference.fit_space import FitSpace, StudyFit
from safevar_sumo.reference.loss import MAX_LOSS
from safevar_sumo.reference.parameters import FittedParameter, free_parameters
from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.rows import COLUMNS, ReferenceData
from safevar_sumo.reference.search import SearchRace, StudyGroup
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all
from safevar_sumo.workers.evaluation import Pool

START_DEVIATION = 0.02
"""Initial standard deviation of a search that begins at known values, as a share of the bounds' width."""
POPULATION_DIVISOR = 3
"""Factor by which the population of a search from known values is smaller: the search adapts once a generation, and need not explore."""
STAGE_PERCENTAGES = (64, 16)
"""Percentages of the trials of a fit from scratch: for the first study, then for parameters of the other studies; the rest fit all."""
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
    start_studies, trials, rng = studies, fit.trials, np.random.default_rng(fit.seed)
    if has_stages := from_scratch and (len(studies) > 1 or fit.thinning > 1):
        start_studies, trials = _fit_in_stages(subjects, parameters, fit_data, pool, rng, done)
    space = FitSpace(parameters, [StudyFit(study, data, pool) for study, data in zip(start_studies, fit_data, strict=True)])
    race = SearchRace(space, fit.population, trials, done, fit.alike)
    if not from_scratch and race.try_studies([studies])[0] >= MAX_LOSS:
        names = " and ".join(f"study {study.name!r}" for study in studies)
        raise SimulationError(f"{names} cannot be simulated with {'its' if len(studies) == 1 else 'their'} own values")
    searches = [] if has_stages else race.begin_at_random_places(_first_indices(parameters), fit.starts, fit.screened, fit.width, rng)
    if has_stages or not from_scratch:
        population = _refining_population(fit.population, len(parameters))
        searches.append(race.begin(space.place_of(start_studies), START_DEVIATION, seed=fit.seed + 1, population=population))
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


def _first_indices(parameters: Sequence[FittedParameter]) -> list[int]:
    """For each parameter, the index of the first parameter with the same key: parameters with one key start at the same place."""
    keys = [parameter.key for parameter in parameters]
    return [keys.index(key) for key in keys]


def _fit_in_stages(subjects: Sequence[FitSubject], parameters: Sequence[FittedParameter], fit_data: Sequence[Mapping[str, ReferenceData]],
                   pool: Pool, rng: np.random.Generator, done: Callable[[float, StudyGroup], None]) -> tuple[StudyGroup, int]:
    """Fit the first study from random places, then the parameters of other studies, on thinned rows; also returns the trials left."""
    studies = tuple(subject.study for subject in subjects)
    fit, trials_left = studies[0].fit, studies[0].fit.trials
    first_parameters = [parameter._replace(study_indices=(0,)) for parameter in parameters if 0 in parameter.study_indices]
    other_parameters = [parameter._replace(study_indices=tuple(k - 1 for k in parameter.study_indices))
                        for parameter in parameters if 0 not in parameter.study_indices]
    stages = zip((first_parameters, other_parameters), ([0], list(range(1, len(studies)))), STAGE_PERCENTAGES, strict=True)
    for stage_parameters, indices, percentage in stages:
        trials = fit.trials * percentage // 100
        if stage_parameters and trials:
            thinned_data = [{name: _thin(data, fit.thinning) for name, data in fit_data[k].items()} for k in indices]
            space = FitSpace(stage_parameters, [StudyFit(studies[k], data, pool) for k, data in zip(indices, thinned_data, strict=True)])
            race = SearchRace(space, fit.population, trials, partial(_report_on_stage, done, studies, indices))
            race.run(race.begin_at_random_places(_first_indices(stage_parameters), fit.starts, fit.screened, fit.width, rng))
            assert race.best is not None, "there is at least one trial"
            studies, trials_left = _with_replacements(studies, indices, race.best), trials_left - trials
            values = [(parameter, value_of(studies[0], parameter.key)) for parameter in parameters if 0 in parameter.study_indices]
            studies = tuple(with_values(study, {parameter.key: value for parameter, value in values if k in parameter.study_indices})
                            for k, study in enumerate(studies))
    return studies, trials_left


def _report_on_stage(done: Callable[[float, StudyGroup], None], studies: StudyGroup, indices: Sequence[int], loss: float,
                     best: StudyGroup) -> None:
    done(loss, _with_replacements(studies, indices, best))


def _with_replacements(studies: StudyGroup, indices: Sequence[int], replacements: StudyGroup) -> StudyGroup:
    """The studies, with replacements at some indices."""
    return tuple(replacements[indices.index(k)] if k in indices else study for k, study in enumerate(studies))


def _thin(data: ReferenceData, thinning: int) -> ReferenceData:
    """Every `thinning`-th row in the order of the safety degree, which keeps the distribution of the safety degree."""
    rows = np.zeros(len(data.settings), dtype=bool)
    rows[np.argsort(data.metrics[SAFETY_DEGREE], kind="stable")[thinning // 2::thinning]] = True
    return data.take(rows)


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
