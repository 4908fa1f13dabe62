"""Fits of one study, or of several studies together, to published data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.figures import BLUE, GREY, new_panels, save
from safevar_sumo.campaign.batches import evaluate_all
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.agreement import Agreement, measure_agreement
from safevar_sumo.reference.effects import error_beyond_spread, is_held_back
from safevar_sumo.reference.fit_space import MAX_LOSS, FitSpace, FittedParameter, StudyFit, StudyGroup, free_parameters
from safevar_sumo.reference.rows import COLUMNS, ReferenceData
from safevar_sumo.reference.search import CmaSearch, SearchRace, invert
from safevar_sumo.study import SAFETY_DEGREE, FitTable, Study, unit_text
from safevar_sumo.vehicles import CharacteristicSet

START_DEVIATION = 0.02
"""Initial standard deviation of a search that begins at known values, as a share of the bounds' width."""
POPULATION_DIVISOR = 3
"""Factor by which the population of a search from known values is smaller: the search adapts once a generation, and
need not explore."""
RANDOM_DEVIATION = 0.3
"""Initial standard deviation of a search that begins at a random place."""
ENSEMBLE_DEVIATION = 0.05
"""Initial standard deviation of a search that begins at the end of an ensemble Kalman inversion, in the mean over the
parameters."""
ERROR_DECIMALS = 3
"""Decimals of a study's model error [m]."""
BOUND_MARGIN = 0.01
"""A value lies on a bound if its distance from the bound is at most this share of the bounds' width."""
MAX_SETS = 20
"""Maximum number of parameter sets in a table [spread], including the best set."""


class FitSubject(NamedTuple):
    """A study, and the reference data that it is fitted to, by name."""

    study: Study
    references: Mapping[str, ReferenceData]


class FittedValue(NamedTuple):
    """The value of a parameter, and the least and greatest value that fit as well as the best."""

    parameter: FittedParameter
    value: float
    interval: tuple[float, float]

    @property
    def is_on_bound(self) -> bool:
        bounds = self.parameter.bounds
        return min(self.value - bounds.lower, bounds.upper - self.value) <= BOUND_MARGIN * (bounds.upper - bounds.lower)

    @property
    def is_shared(self) -> bool:
        return len(self.parameter.study_indices) > 1


class Profiles(NamedTuple):
    """Trials of a fit whose loss is near the lowest loss.

    Attributes
    ----------
    parameters
        The fitted parameters.
    losses, values
        Losses of the K trials, shape (K,), and their parameter values, shape (K, parameters). The best trial comes
        first.
    sets
        Indices of up to `MAX_SETS` trials that fit as well as the best and lie as far apart as possible. The best trial
        comes first.
    limit
        The loss up to which a trial fits as well as the best.
    """

    parameters: Sequence[FittedParameter]
    losses: FloatArray
    values: FloatArray
    sets: list[int]
    limit: float

    @classmethod
    def of(
        cls, parameters: Sequence[FittedParameter], space: FitSpace, races: Sequence[SearchRace], alike: float
    ) -> Profiles:
        """The profiles of finished races.

        A trial fits as well as the best if its loss exceeds the lowest loss by at most the share `alike`. The best
        trials of all races that fit so well are among the sets.
        """
        loss_of = itemgetter(0)  # of a trial: its loss and place
        bests = sorted(((race.lowest_loss, race.best_place) for race in races), key=loss_of)
        others = [trial for race in races for trial in race.kept if loss_of(trial) > race.lowest_loss]
        trials, limit = [*bests, *sorted(others, key=loss_of)], loss_of(bests[0]) * (1 + alike)
        losses, places = np.array([loss for loss, _ in trials]), np.array([place for _, place in trials])
        alike_trials = np.flatnonzero(losses <= limit)
        sets = alike_trials[_distant_trials(places[alike_trials], sum(loss <= limit for loss, _ in bests))].tolist()
        return cls(parameters, losses, space.values(places), sets, limit)

    def spread(self, study: int) -> dict[str, list[float]]:
        """Values of each parameter of the study with this index, one for each of the `sets`: the table [spread]."""
        return {
            parameter.key: self.values[self.sets, k].tolist()
            for k, parameter in enumerate(self.parameters)
            if study in parameter.study_indices
        }

    def fitted_values(self, study: int) -> dict[str, FittedValue]:
        """The best trial's values of the parameters of the study with this index, by key."""
        return {
            parameter.key: FittedValue(parameter, float(self.values[0, k]), self.interval(k))
            for k, parameter in enumerate(self.parameters)
            if study in parameter.study_indices
        }

    def interval(self, k: int) -> tuple[float, float]:
        """Least and greatest value of parameter k in the trials that fit as well as the best."""
        values = self.values[self.losses <= self.limit, k]
        return float(values.min()), float(values.max())


def _distant_trials(places: FloatArray, first: int) -> list[int]:
    """Indices of the `first` trials and of others that lie as far apart as possible, by farthest-point sampling."""
    indices = list(range(min(first, MAX_SETS)))
    distances = np.linalg.norm(places[:, np.newaxis] - places[indices], axis=2).min(axis=1)
    while len(indices) < min(MAX_SETS, len(places)) and distances.max() > 0:
        indices.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(places - places[indices[-1]], axis=1))
    return indices


class Calibration(NamedTuple):
    """The fit of one study: the fitted values by key, the study with these values, and its agreement with each
    reference.

    `loss` is that of all studies fitted together; `reached` holds the lowest loss of each search, of which the last
    starts at the values in the study files, except in a fit from scratch. `used` is the agreement with the rows that
    the fit used, `held_back` with the others.
    """

    values: dict[str, FittedValue]
    study: Study
    loss: float
    reached: list[float]
    used: dict[str, Agreement]
    held_back: dict[str, Agreement]
    profiles: Profiles

    @property
    def loss_line(self) -> str:
        """A sentence with the lowest loss of all searches, and of each search."""
        losses = ", ".join(f"{loss:.4f}" for loss in self.reached)
        return f"Loss {self.loss:.4f}" + (f"; lowest loss of each search: {losses}" if losses else "")


def calibrate(
    subjects: Sequence[FitSubject],
    pool: Pool,
    done: Callable[[float, StudyGroup], None] = lambda loss, best: None,
    *,
    from_scratch: bool = False,
) -> list[Calibration]:
    """Fit studies by CMA-ES (Hansen 2016), as their tables [fit] state; the first study's table sets trials, seed,
    starts and population.

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
    studies = [subject.study for subject in subjects]
    _check_subjects(subjects, from_scratch)
    fit, parameters = studies[0].fit, free_parameters(studies)
    fit_data, test_data = (
        [
            {name: data.take(is_held_back(data, study.fit.hold_out) == is_test) for name, data in references.items()}
            for study, references in subjects
        ]
        for is_test in (False, True)
    )
    space = FitSpace(parameters, [StudyFit(study, data, pool) for study, data in zip(studies, fit_data, strict=True)])
    best_loss, best_place = np.inf, space.own_place()

    def after_trial(loss: float, place: FloatArray) -> None:
        nonlocal best_loss, best_place
        if loss < best_loss:
            best_loss, best_place = loss, place
        done(best_loss, space.studies_at(best_place))

    races, reached = [], []
    for seed in range(fit.seed, fit.seed + fit.repeats):
        races.append(SearchRace(space.misfits_at, fit.population, fit.trials, after_trial))
        reached += _run_race(races[-1], space, fit, seed, from_scratch)
    profiles = Profiles.of(parameters, space, races, fit.alike)

    def calibration_of(k: int, best: Study) -> Calibration:
        """The fit of the study with index k, whose fitted parameters are in `best`."""
        best = msgspec.structs.replace(best, spread=profiles.spread(k))
        error = {SAFETY_DEGREE: round(error_beyond_spread(best, fit_data[k]), ERROR_DECIMALS)} if fit_data[k] else {}
        best = msgspec.structs.replace(best, model_error=error)
        used, held_back = (_measure_agreements(best, data[k], pool) for data in (fit_data, test_data))
        return Calibration(profiles.fitted_values(k), best, best_loss, reached, used, held_back, profiles)

    return [calibration_of(k, best) for k, best in enumerate(space.studies_at(best_place))]


def _run_race(race: SearchRace, space: FitSpace, fit: FitTable, seed: int, from_scratch: bool) -> list[float]:
    """Spend a race's trials on searches from random places and from the studies' own; returns their lowest losses."""
    if not from_scratch and race.try_places([space.own_place()])[0].loss >= MAX_LOSS:
        names = [f"study {study.name!r}" for study in space.studies_at(space.own_place())]
        raise SimulationError(
            f"{' and '.join(names)} cannot be simulated with {'its' if len(names) == 1 else 'their'} own values"
        )
    rng, dimension = np.random.default_rng(seed), len(space.own_place())
    max_trials = race.trials_left // (2 * max(fit.starts, 1))
    searches = [_begin_at_random(race, dimension, fit.ensemble, max_trials, rng) for _ in range(fit.starts)]
    if not from_scratch:
        default_population = 4 + int(3 * math.log(dimension))  # of CMA-ES (Hansen 2016)
        population = min(fit.population, max(fit.population // POPULATION_DIVISOR, default_population))
        searches.append(CmaSearch(race, space.own_place(), START_DEVIATION, seed=seed + 1, population=population))
    race.run(searches)
    return [search.lowest_loss for search in searches if search.lowest_loss < np.inf]


def _check_subjects(subjects: Sequence[FitSubject], from_scratch: bool) -> None:
    first = subjects[0].study
    if not any(subject.study.calibration for subject in subjects):
        raise InputError(
            first.source, "has no table [calibration]", "the free parameters with bounds, unit and meaning"
        )
    for study, references in subjects:
        if not references and not study.published:
            raise InputError(
                study.source, "has no table [published] and there is no reference file", "something to fit to"
            )
        for name in study.fit.weights:
            if name not in COLUMNS:
                raise InputError(
                    study.source, f"fit.weights.{name} is no metric of the reference", f"some of {', '.join(COLUMNS)}"
                )
    if from_scratch and not first.fit.starts:
        raise InputError(first.source, "fit.starts = 0", "at least 1 for a fit from scratch")


def _begin_at_random(
    race: SearchRace, dimension: int, ensemble_size: int, max_trials: int, rng: np.random.Generator
) -> CmaSearch:
    """Begin a search at the best place of an ensemble Kalman inversion; without an ensemble, or trials for one, at a
    random place.
    """
    ensemble_size = min(ensemble_size, max_trials)
    if ensemble_size < 2:
        return CmaSearch(race, rng.random(dimension), RANDOM_DEVIATION, seed=int(rng.integers(1, 2**31)))
    place, axes = invert(race, dimension, ensemble_size, max_trials, rng)
    return CmaSearch(race, place, ENSEMBLE_DEVIATION, seed=int(rng.integers(1, 2**31)), axes=axes)


def _measure_agreements(study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> dict[str, Agreement]:
    original, agreements = CharacteristicSet.of(study).original, {}
    for name, data in references.items():
        evaluations = evaluate_all(study, np.concatenate([original[np.newaxis], data.settings]), pool)
        rows = evaluations.take(np.arange(1, len(evaluations)))
        agreements[name] = measure_agreement(data, rows, study, evaluations.take([0]))
    return agreements


def describe_fit(subject: FitSubject, result: Calibration, studies: Sequence[Study], *, from_scratch: bool) -> str:
    """The fit of one of `studies` in words: search, loss, files with fingerprints and rank correlations, parameters of
    its own, and parameters that lie on a bound.
    """
    (study, references), fit, values = subject, studies[0].fit, result.values.items()
    together = "".join(f", together with {other.name!r}" for other in studies if other is not study)
    start = "random places only" if from_scratch else f"its own values and {fit.starts} random places"
    own_names = ", ".join(name for name, value in values if not value.is_shared)
    lines = [
        f"Study {study.name!r}, calibrated{together}.",
        f"CMA-ES: {fit.trials} trials, seed {fit.seed}, from {start}. {result.loss_line}.",
        "Fitted to the original vehicle's published values and to rows of files, "
        f"of which one in {study.fit.hold_out} is held back.",
    ]
    for name, data in references.items():
        used, held_back = (
            "-" if (rho := fits[name].spearman[SAFETY_DEGREE]) is None else f"{rho:.3f}"
            for fits in (result.used, result.held_back)
        )
        lines.append(
            f"  {name}, SHA-256 {data.fingerprint}, {data.skipped} rows left out; rho of the safety degree {used}, "
            f"held back {held_back}"
        )
    if together:
        lines.append(f"Parameters of its own: {own_names}; it shares the others.")
    return "\n".join([*lines, *(f"{name} lies on its bound." for name, value in values if value.is_on_bound)])


def plot_profiles(path: Path, profiles: Profiles, studies: Sequence[Study]) -> None:
    """Draw the loss over each parameter: a dot for each trial, in colour if it fits as well as the best, and a band for
    the interval.

    Raises
    ------
    InputError
        If the file cannot be written or its ending names no picture format.
    """
    names = [study.name for study in studies]
    title = f"Loss of {' and '.join(names)} over each parameter; band: fits as well as the best"
    figure, axes = new_panels(title, len(profiles.parameters), 4, (2.75, 1.7), min_width=11.0, title_height=0.6)
    for axis in axes[1:]:
        axis.sharey(axes[0])
    is_as_good = profiles.losses <= profiles.limit
    for k, (axis, parameter) in enumerate(zip(axes, profiles.parameters, strict=True)):
        values = profiles.values[:, k]
        axis.axvspan(*profiles.interval(k), color=BLUE, alpha=0.12, linewidth=0)
        axis.scatter(values, profiles.losses, s=4, alpha=0.5, c=np.where(is_as_good, BLUE, GREY), linewidths=0)
        axis.axvline(values[0], color="black", linewidth=0.8, linestyle="--")
        label = parameter.key.replace("vehicle.parameters.", "").replace("ads.parameters.", "")
        if len(parameter.study_indices) < len(names):
            label = f"{', '.join(names[i] for i in parameter.study_indices)}: {label}"
        axis.set(xlabel=label + unit_text(parameter.bounds.unit, " [{}]"), ylabel="loss")
    save(figure, path, "plot")
