"""Fit one study, or several together, to published data; describe the fit for the head of a study file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.effects import error_beyond_spread
from safevar_sumo.reference.fit import MAX_LOSS, ReferenceLoss, Together, TrialSearch, original_loss
from safevar_sumo.reference.parameters import Free, free_parameters
from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.rows import COLUMNS, ReferenceData
from safevar_sumo.reference.validation import Agreement, agreement
from safevar_sumo.study import SAFETY_DEGREE, FitTable, FreeParameter, Study
from safevar_sumo.sumo import Engine, settings_per_batch
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all, inputs_of
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.interrupts import awaited
from safevar_sumo.workers.retrying import RetryingPool

EDGE = 0.01
"""A value nearer to a bound than this share of the bounds' width lies on its bound."""


def calibration_comment(result: Calibration, study: Study, references: Mapping[str, ReferenceData], *, from_scratch: bool) -> str:
    """A fit in words: data with fingerprints, search, loss, agreement on both parts, shared parameters, values on a bound."""
    fit = result.search
    start = "random places only" if from_scratch else f"its own values and {fit.starts} random places" if fit.starts else "its own values"
    parts = [
        f"  {name}: rho of the safety degree {_rho(result.used[name])} on the rows used, {_rho(result.held_back[name])} on those held back"
        for name in result.used]
    rows = f" and to all but every {_ordinal(study.fit.hold_out)} row of" if references else "."
    together = f" together with {' and '.join(map(repr, result.together))}" if result.together else ""
    own = [name for name in result.values if name not in result.shared]
    return "\n".join([
        f"Study {study.name!r}, calibrated{together} by CMA-ES ({fit.trials} trials, seed {fit.seed}, from {start})",
        f"to the original vehicle's published values{rows}", *(_data_line(name, data) for name, data in references.items()),
        *([f"Parameters of its own: {', '.join(own) or 'none'}; it shares the others."] if result.together else []),
        f"{cost_line(result)}.", *parts,
        *(f"{name} lies on its bound." for name in on_a_bound(result.values, result.bounds))])


def cost_line(calibration: Calibration) -> str:
    """The lowest loss, and the lowest loss of each search, if any."""
    reached = ", ".join(f"{loss:.4f}" for loss in calibration.reached)
    return f"Loss {calibration.loss:.4f}" + (f"; lowest loss of each search: {reached}" if reached else "")


def on_a_bound(values: Mapping[str, float], free: Mapping[str, FreeParameter]) -> list[str]:
    """Names of the parameters whose values lie on a bound."""
    return [name for name, value in values.items()
            if min(value - free[name].lower, free[name].upper - value) <= EDGE * (free[name].upper - free[name].lower)]


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _data_line(name: str, data: ReferenceData) -> str:
    without = f", without {data.skipped} rows outside the domains" if data.skipped else ""
    return f"  {name}, SHA-256 {data.fingerprint}{without}"


def _rho(result: Agreement) -> str:
    rho = result.spearman[SAFETY_DEGREE]
    return "undefined" if rho is None else f"{rho:.3f}"


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


class Calibration(NamedTuple):
    """Fitted values and bounds by parameter, the study with these values, their loss, and agreement with both parts of each reference.

    `reached` is the lowest loss of each search; the last search starts at the studies' own values, except in a fit from scratch.
    `together` names the studies that were fitted with this one, `shared` the parameters that it shares with one of them,
    `search` is the table [fit] that set trials, seed and starts, `intervals` are the least and the greatest value of each
    parameter that fit as well, `profiles` are the losses of the trials.
    """

    values: dict[str, float]
    study: Study
    loss: float
    reached: list[float]
    used: dict[str, Agreement]
    held_back: dict[str, Agreement]
    bounds: dict[str, FreeParameter]
    search: FitTable
    together: tuple[str, ...] = ()
    shared: frozenset[str] = frozenset()
    intervals: Mapping[str, tuple[float, float]] = MappingProxyType({})
    profiles: Profiles | None = None


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
    trial = _Trial(free, [_Fitted(study, data, pool) for study, data in zip(start, used, strict=True)])
    search = TrialSearch(trial, fit.population, trials, done, fit.alike)
    if not from_scratch and search.try_studies([studies])[0] >= MAX_LOSS:
        names = " and ".join(f"study {study.name!r}" for study in studies)
        raise SimulationError(f"{names} cannot be simulated with {'its' if len(studies) == 1 else 'their'} own values")
    searches = [] if staged else search.from_random_places(_first_of_key(free), fit.starts, fit.screened, fit.width, rng)
    if staged or not from_scratch:
        searches.append(search.begin(trial.shares(start), NEAR, fit.seed + 1, _refining_population(fit.population, len(free))))
    search.race(searches)
    assert search.best is not None, "there is at least one trial"
    reached, results = [one.lowest for one in searches if one.lowest < np.inf], []
    profiles = Profiles.of(free, trial, search, trial.shares(search.best))
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
            trial = _Trial(parameters, [_Fitted(studies[k], data, pool) for k, data in zip(indices, thinned, strict=True)])
            search = TrialSearch(trial, fit.population, trials, partial(_done_with_some, done, studies, indices))
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


class _Trial:
    """Losses of studies that differ in free parameters."""

    def __init__(self, free: Sequence[Free], fitted: Sequence[_Fitted]) -> None:
        self._free, self._fitted = free, fitted
        self._lower, self._upper = np.array([(one.bounds.lower, one.bounds.upper) for one in free]).T
        self._log = np.array([one.bounds.log for one in free])
        self._start, self._width = self._scaled(self._lower), self._scaled(self._upper) - self._scaled(self._lower)

    def _scaled(self, values: FloatArray) -> FloatArray:
        return np.log(values, out=values.copy(), where=self._log)

    def values(self, shares: FloatArray) -> FloatArray:
        """Values at places in the unit cube of the bounds, shape (..., parameters)."""
        scaled = self._start + np.asarray(shares) * self._width
        return np.asarray(np.clip(np.exp(scaled, out=scaled.copy(), where=self._log), self._lower, self._upper))

    def at(self, shares: FloatArray) -> Together:
        """The studies at a place in the unit cube of the bounds."""
        values = self.values(shares).tolist()
        return tuple(
            with_values(one.study, {free.key: value for free, value in zip(self._free, values, strict=True) if k in free.studies})
            for k, one in enumerate(self._fitted))

    def shares(self, studies: Together) -> FloatArray:
        """Where studies lie in the unit cube of the bounds."""
        values = np.array([value_of(studies[free.studies[0]], free.key) for free in self._free])
        return np.asarray(np.clip((self._scaled(values) - self._start) / self._width, 0, 1))

    def losses(self, studies: Sequence[Together]) -> list[float]:
        submitted = [[one.submit(study) for one, study in zip(self._fitted, together, strict=True)] for together in studies]
        return [float(np.mean([one.loss(parts) for one, parts in zip(self._fitted, batches, strict=True)])) for batches in submitted]


class _Fitted:
    """A study to fit, and the data to fit it to."""

    def __init__(self, study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> None:
        self.study = study
        self._references = [(len(data.settings), ReferenceLoss(data, study)) for data in references.values()]
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._inputs, self._pool = inputs_of(study, pool), RetryingPool(pool, study)
        settings = [self._characteristics.original[np.newaxis], *(data.settings for data in references.values())]
        self._settings, self._row_of = np.unique(np.concatenate(settings), axis=0, return_inverse=True)
        batches = max(1, round(len(self._settings) / settings_per_batch(assemble(study), Engine.RECORDED)))  # larger ones cost less
        self._size = math.ceil(len(self._settings) / batches)

    def submit(self, study: Study) -> list[Future[Evaluations]]:
        work, size = packed(study, self._inputs), self._size
        return [self._pool.submit(work, self._settings[start:start + size]) for start in range(0, len(self._settings), size)]

    def loss(self, parts: Sequence[Future[Evaluations]]) -> float:
        unique = Evaluations.concatenate([awaited(part) for part in parts])
        if not unique.valid.all():
            return MAX_LOSS
        evaluations = unique.take(self._row_of.ravel())
        loss = original_loss(evaluations.take([0]), self.study.published, self.study.fit)
        row = 1
        for rows, reference_loss in self._references:
            loss += reference_loss.of(evaluations.take(np.arange(row, row + rows))) / len(self._references)
            row += rows
        return loss


def _agreements(study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> dict[str, Agreement]:
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    parts = {}
    for name, data in references.items():
        evaluations = evaluate_all(study, np.concatenate([characteristics.original[np.newaxis], data.settings]), pool)
        here = evaluations.take(np.arange(1, len(evaluations)))
        parts[name] = agreement(data, here, study, evaluations.take([0]))
    return parts


def fitted_as(study: Study, fitted: Study) -> Study:
    """The fitted study under a name of its own, so that nobody takes it for the study that it was fitted from."""
    return msgspec.structs.replace(fitted, name=f"{study.name}-calibrated")
