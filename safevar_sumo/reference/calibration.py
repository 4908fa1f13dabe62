"""How the values of a calibrated study were found, in words for the head of its file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.fit import LARGEST, Search, check_bound, original_cost, reference_cost, value_of, with_values
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.validation import Agreement, agreement
from safevar_sumo.study import SAFETY_DEGREE, FreeParameter, Study
from safevar_sumo.sumo import Engine, settings_per_batch
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all, inputs_of
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.local import result_of
from safevar_sumo.workers.retrying import RetryingPool

EDGE = 0.01
"""Nearer than this share of its width to an end, a value stands on its bound."""


def calibration_comment(result: Calibration, study: Study, references: Mapping[str, ReferenceData], *, from_scratch: bool) -> str:
    """Data with fingerprints, search, cost, agreement on both parts, and what stands on its bound."""
    fit = study.fit
    start = "random places alone" if from_scratch else f"its own values and {fit.starts} random places" if fit.starts else "its own values"
    parts = [
        f"  {name}: rho of the safety degree {_rho(result.used[name])} on the rows used, {_rho(result.held_back[name])} on those held back"
        for name in result.used]
    others = f" and to all but each {_ordinal(fit.hold_out)} row of" if references else "."
    return "\n".join([
        f"Study {study.name!r}, calibrated by CMA-ES ({fit.trials} trials, seed {fit.seed}, from {start})",
        f"to the original vehicle's published values{others}", *(_data_line(name, data) for name, data in references.items()),
        f"{cost_line(result)}.", *parts,
        *(f"{name} stands on its bound." for name in on_a_bound(result.values, study.calibration))])


def cost_line(calibration: Calibration) -> str:
    """The cost of what was found, and what each search came to if there was any."""
    reached = ", ".join(f"{cost:.4f}" for cost in calibration.reached)
    return f"Cost {calibration.cost:.4f}" + (f"; each search came to {reached}" if reached else "")


def on_a_bound(values: Mapping[str, float], free: Mapping[str, FreeParameter]) -> list[str]:
    """Names of the values that a search would have moved farther."""
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


NEAR, WIDE = 0.05, 0.3
"""Standard deviation of the first trials around known values, and around a random place, as a share of a parameter's bounds."""


class Calibration(NamedTuple):
    """Found values by parameter, the study with them, its cost, and both parts of every reference by its name.

    `reached` is the lowest cost that each search came to, the last one from the study's own values unless these were forgotten.
    """

    values: dict[str, float]
    study: Study
    cost: float
    reached: list[float]
    used: dict[str, Agreement]
    held_back: dict[str, Agreement]


def calibrate(study: Study, references: Mapping[str, ReferenceData], pool: Pool,
              done: Callable[[float, Study], None] = lambda cost, best: None, *, from_scratch: bool = False) -> Calibration:
    """Fit by CMA-ES (Hansen 2016), as the study's table [fit] says.

    Parameters
    ----------
    references
        Data by name; may be empty, then only the original vehicle's values count.
    done
        Is called after every trial with the lowest cost so far, and the study that has it.
    from_scratch
        Forget the study's own values of what is free: only the random places count.

    Raises
    ------
    InputError
        If the study declares nothing to fit, or something that cannot be, or has nothing to fit it to.
    SimulationError
        If the study cannot be simulated with its own values.
    """
    fit, first = study.fit, _checked(study, references, from_scratch)
    used, held_back = {}, {}
    for name, data in references.items():
        rows = np.arange(len(data.settings)) % fit.hold_out == fit.hold_out - 1
        used[name], held_back[name] = data.take(~rows), data.take(rows)
    trial = _Trial(study, used, pool)
    search = Search(trial, fit.population, fit.trials, done)
    if not from_scratch and search.tried([study])[0] >= LARGEST:
        raise SimulationError(f"study {study.name!r} cannot be simulated with its own values")
    rng = np.random.default_rng(fit.seed)
    searches = [search.begun(rng.random(len(first)), WIDE, int(rng.integers(1, 2**31))) for _ in range(fit.starts)]
    if not from_scratch:
        searches.append(search.begun(trial.shares(study), NEAR, fit.seed + 1))
    search.race(searches)
    assert search.best is not None, "there is a trial at least"
    values = {name: value_of(search.best, name) for name in study.calibration}
    best = with_values(study, values)
    return Calibration(values, best, search.cost, [one.lowest for one in searches if one.lowest < np.inf],
                       _told(best, used, pool), _told(best, held_back, pool))


def _checked(study: Study, references: Mapping[str, ReferenceData], from_scratch: bool) -> dict[str, float]:
    """The study's own values, after a look at all that a fit needs."""
    source = f"study {study.name!r}"
    if not study.calibration:
        raise InputError(source, "has no table [calibration]", "the free parameters with bounds, unit and meaning")
    if not references and not study.published:
        raise InputError(source, "has no table [published] and there is no reference file", "something to fit to")
    if from_scratch and not study.fit.starts:
        raise InputError(source, "fit.starts = 0", "at least 1 for a fit from scratch")
    for name in study.fit.weights:
        if name not in METRICS:
            raise InputError(source, f"fit.weights.{name} is no metric", f"some of {', '.join(METRICS)}")
    first = {name: value_of(study, name) for name in study.calibration}
    for name, value in first.items():
        row = study.calibration[name]
        if not row.lower <= value <= row.upper:
            raise InputError(source, f"{name} = {value}", f"a value in its bounds, [{row.lower:g}, {row.upper:g}]")
        for side in ("lower", "upper"):
            check_bound(study, name, side, getattr(row, side))
    return first


class _Trial:
    """Costs of studies that differ in free parameters."""

    def __init__(self, study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> None:
        self.study, self._references = study, references
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._inputs = inputs_of(study, pool)
        self._lower, self._upper = np.array([(row.lower, row.upper) for row in study.calibration.values()]).T
        self._pool = RetryingPool(pool, study)
        settings = [self._characteristics.original[np.newaxis], *(data.settings for data in references.values())]
        self._settings, self._row_of = np.unique(np.concatenate(settings), axis=0, return_inverse=True)
        self._size = min(settings_per_batch(assemble(study), Engine.RECORDED), len(self._settings))

    def at(self, shares: FloatArray) -> Study:
        """The study at a place in the unit cube of the bounds."""
        values = self._lower + np.asarray(shares) * (self._upper - self._lower)
        return with_values(self.study, dict(zip(self.study.calibration, values.tolist(), strict=True)))

    def shares(self, study: Study) -> FloatArray:
        """Where a study lies in the unit cube of the bounds."""
        values = np.array([value_of(study, name) for name in self.study.calibration])
        return np.asarray(np.clip((values - self._lower) / (self._upper - self._lower), 0, 1))

    def costs(self, studies: Sequence[Study]) -> list[float]:
        submitted = [self._submit(study) for study in studies]
        return [self._cost(Evaluations.concatenate([result_of(part) for part in parts])) for parts in submitted]

    def _submit(self, study: Study) -> list[Future[Evaluations]]:
        work, size = packed(study, self._inputs), self._size
        return [self._pool.submit(work, self._settings[start:start + size]) for start in range(0, len(self._settings), size)]

    def _cost(self, unique: Evaluations) -> float:
        if not unique.valid.all():
            return LARGEST
        evaluations, fit = unique.take(self._row_of.ravel()), self.study.fit
        cost = original_cost(evaluations.take([0]), self.study.published, fit)
        row = 1
        for data in self._references.values():
            here = evaluations.take(np.arange(row, row + len(data.settings)))
            cost += reference_cost(agreement(data, here, self.study, here), data, fit) / len(self._references)
            row += len(data.settings)
        return cost


def _told(study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> dict[str, Agreement]:
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    parts = {}
    for name, data in references.items():
        evaluations = evaluate_all(study, np.concatenate([characteristics.original[np.newaxis], data.settings]), pool)
        here = evaluations.take(np.arange(1, len(evaluations)))
        parts[name] = agreement(data, here, study, evaluations.take([0]))
    return parts


def fitted_as(study: Study, fitted: Study) -> Study:
    """The found study under a name of its own: nobody is to take it for the one whose published values it stands beside."""
    return msgspec.structs.replace(fitted, name=f"{study.name}-calibrated")
