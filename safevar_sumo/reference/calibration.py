"""Free parameters of a study fitted to the original vehicle's published values and to reference rows.

What may be fitted stands in the study file under [calibration]. Characteristics, domains and thresholds are never
touched. Every second row is used for the fit, the others are held back and only reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from hashlib import sha256
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.computing import PersistentPool, Pool, evaluate_all, packed
from safevar_sumo.computing.many import BATCH
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.agreement import Agreement, agreement
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.scenarios import weather_of
from safevar_sumo.simulation import models_of
from safevar_sumo.study import Study, invalid
from safevar_sumo.vehicles import CharacteristicSet

WEIGHTS = {"safety_degree": 1.0, "tet": 0.3, "tit": 0.3, "ave_dece": 0.5}
"""What a metric's disagreement counts for."""
TOLERANCE = 0.05
"""Share of the published value of the original vehicle by which it may be missed at a cost of its weight."""
COLLISION_WEIGHT = 10.0
"""What the difference between the shares of collisions counts for."""
SPREAD = 0.05
"""Standard deviation of the first trials, as a share of a parameter's bounds."""
POPULATION = 12
"""Trials of a generation."""
LOST = 1e3
"""Cost of a trial in which something could not be simulated."""
FITTED = ("vehicle.parameters.", "ads.parameters.", "weather.")


class Calibration(NamedTuple):
    """Found values by parameter, the study with them, its cost, and both halves of every reference by its name."""

    values: dict[str, float]
    study: Study
    cost: float
    used: dict[str, Agreement]
    held_back: dict[str, Agreement]


def calibrate(study: Study, references: Mapping[str, ReferenceData], pool: Pool, trials: int, seed: int,
              done: Callable[[float, Study], None] = lambda cost, best: None) -> Calibration:
    """Fit by CMA-ES (Hansen 2016), which starts from the study's own values.

    Parameters
    ----------
    references
        Data by name; may be empty, then only the original vehicle's values count.
    trials
        How many sets of parameters are tried.
    done
        Is called after every trial with the lowest cost so far, and the study that has it.

    Raises
    ------
    InputError
        If the study declares nothing to fit, or something that cannot be, or has nothing to fit it to.
    SimulationError
        If the study cannot be simulated with its own values.
    """
    parameters = study.calibration
    if not parameters:
        raise InputError(f"study {study.name!r}", "has no table [calibration]", "the free parameters with bounds, unit and meaning")
    if not references and not study.published:
        raise InputError(f"study {study.name!r}", "has no table [published] and there is no reference file", "something to fit to")
    names = list(parameters)
    first = np.array([_value(study, name) for name in names])
    halves = {name: _half(data, 0) for name, data in references.items()}
    import cma  # only here: it takes longer to load than all the rest

    trial = _Trial(study, names, halves, pool)
    for name, value in zip(names, first.tolist(), strict=True):
        row = parameters[name]
        if not row.lower <= value <= row.upper:
            raise InputError(f"study {study.name!r}", f"{name} = {value}", f"a value in its bounds, [{row.lower:g}, {row.upper:g}]")
        for side in ("lower", "upper"):
            _check_bound(study, name, side, getattr(row, side))
    lower, upper = np.array([(row.lower, row.upper) for row in parameters.values()]).T
    strategy = cma.CMAEvolutionStrategy(np.clip((first - lower) / (upper - lower), 0, 1), SPREAD, {
        "bounds": [0, 1], "seed": seed + 1, "verbose": -9, "popsize": POPULATION})
    best, cost = study, trial.costs(first[np.newaxis])[0]
    if cost >= LOST:
        raise SimulationError(f"study {study.name!r} cannot be simulated with its own values")
    done(cost, best)
    for start in range(1, trials, strategy.popsize):
        shares = strategy.ask()
        candidates = lower + np.array(shares)[:trials - start] * (upper - lower)
        costs = trial.costs(candidates)
        for candidate, its_cost in zip(candidates, costs, strict=True):
            if its_cost < cost:
                best, cost = with_values(study, dict(zip(names, candidate.tolist(), strict=True))), its_cost
            done(cost, best)
        if len(costs) == len(shares):
            strategy.tell(shares, costs)
    values = {name: _value(best, name) for name in names}
    fitted = with_values(study, values)
    return Calibration(values, fitted, cost, _told(fitted, halves, pool),
                       _told(fitted, {name: _half(data, 1) for name, data in references.items()}, pool))


def _check_bound(study: Study, name: str, side: str, bound: float) -> None:
    """A search goes as far as its bounds: the models must take them."""
    try:
        models_of(with_values(study, {name: bound}), name)
    except InputError as error:
        legal = error.legal or error.problem
        raise InputError(f"study {study.name!r}", f"calibration.{name!r}.{side} = {bound:g}", legal) from None


def with_values(study: Study, values: Mapping[str, float]) -> Study:
    """A study with other values of some parameters, named by their keys in the study file.

    Raises
    ------
    InputError
        If there is no such parameter, or it does not take the value.
    """
    raw = _raw(study)
    for name, value in values.items():
        table, key = _place(study, raw, name)
        table[key] = value
    try:
        return msgspec.convert(raw, Study)
    except msgspec.ValidationError as error:
        raise invalid(f"study {study.name!r}", raw, error) from None


def _raw(study: Study) -> Any:
    """The study as tables; a weather that is given by its name as the table behind it."""
    return msgspec.to_builtins(msgspec.structs.replace(study, weather=weather_of(study.weather, f"study {study.name!r}")))


def _place(study: Study, raw: Any, name: str) -> tuple[Any, Any]:
    """The table or list that a parameter stands in, and its key or index there."""
    refused = InputError(f"study {study.name!r}", f"calibration.{name!r} is no parameter of the study",
                         f"a number that is given under {', '.join(prefix.rstrip('.') for prefix in FITTED)}")
    if not name.startswith(FITTED):
        raise refused
    *path, last = name.split(".")
    table = raw
    try:
        for key in path:
            table = table[int(key) if isinstance(table, list) else key]
        place: int | str = int(last) if isinstance(table, list) and last.isdecimal() else last
        if not isinstance(table[place], int | float):
            raise refused
    except (KeyError, IndexError, ValueError, TypeError):
        raise refused from None
    return table, place


def _value(study: Study, name: str) -> float:
    table, key = _place(study, _raw(study), name)
    return float(table[key])


def _half(data: ReferenceData, first: int) -> ReferenceData:
    """Every second row, from the first or the second."""
    metrics = {name: values[first::2] for name, values in data.metrics.items()}
    return ReferenceData(data.settings[first::2], metrics, data.skipped)


def data_lines(references: Mapping[str, ReferenceData], contents: Mapping[str, bytes]) -> list[str]:
    """Which data a calibration used: name, fingerprint of the file's bytes, and rows that were left out."""
    return [f"  {name}, SHA-256 {sha256(contents[name]).hexdigest()}"
            + (f", without {data.skipped} rows outside the domains" if data.skipped else "") for name, data in references.items()]


def calibration_comment(found: Calibration, study: Study, data: Sequence[str], trials: int, seed: int) -> str:
    """How the values of a calibrated study were found: for the head of its file."""
    halves = [
        f"  {name}: rho of the safety degree {_rho(found.used[name])} on the used half, {_rho(found.held_back[name])} on the other"
        for name in found.used]
    return "\n".join([
        f"Study {study.name!r}, calibrated by CMA-ES ({trials} trials, seed {seed}) to the original vehicle's",
        "published values" + (" and to every second row of" if data else "."), *data, f"Cost {found.cost:.4f}.", *halves])


def _rho(told: Agreement) -> str:
    rho = told.spearman["safety_degree"]
    return "undefined" if rho is None else f"{rho:.3f}"


class _Trial:
    """Costs of sets of parameters."""

    def __init__(self, study: Study, names: list[str], references: Mapping[str, ReferenceData], pool: Pool) -> None:
        self._study, self._names, self._references = study, names, references
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._pool = PersistentPool(pool, study)
        settings = [self._characteristics.original[np.newaxis], *(data.settings for data in references.values())]
        self._settings, self._row_of = np.unique(np.concatenate(settings), axis=0, return_inverse=True)

    def costs(self, candidates: FloatArray) -> list[float]:
        """Costs of candidates, shape (S, parameters)."""
        submitted = [self._submit(with_values(self._study, dict(zip(self._names, row, strict=True)))) for row in candidates.tolist()]
        return [self._cost(Evaluations.concatenate([part.result() for part in parts])) for parts in submitted]

    def _submit(self, study: Study) -> list[Future[Evaluations]]:
        work = packed(study)
        return [self._pool.submit(work, self._settings[start:start + BATCH]) for start in range(0, len(self._settings), BATCH)]

    def _cost(self, unique: Evaluations) -> float:
        if not unique.valid.all():
            return LOST
        evaluations = unique.take(self._row_of.ravel())
        cost = original_cost(evaluations.take([0]), self._study.published)
        row = 1
        for data in self._references.values():
            here = evaluations.take(np.arange(row, row + len(data.settings)))
            cost += reference_cost(agreement(data, here, {}, here), data) / len(self._references)
            row += len(data.settings)
        return cost


def original_cost(original: Evaluations, published: Mapping[str, float]) -> float:
    """Squared misses of the original vehicle's values, in tolerances, weighted by metric; mean."""
    misses = [
        WEIGHTS[name] * min(abs(original.metrics[name][0] / value - 1) / TOLERANCE, 10.0) ** 2
        if np.isfinite(original.metrics[name][0]) else 100.0
        for name, value in published.items() if name in METRICS]
    return float(np.mean(misses)) if misses else 0.0


def reference_cost(told: Agreement, data: ReferenceData) -> float:
    """Lost rank correlation and absolute error (in standard deviations of the reference), weighted, and collisions."""
    cost = 0.0
    for name, weight in WEIGHTS.items():
        values = data.metrics[name][~np.isnan(data.metrics[name])]
        if not values.size or np.ptp(values) == 0:
            continue
        rho, error = told.spearman[name], told.mean_absolute_error[name]
        cost += weight * (5 * (1 - (rho or 0.0)) + (np.inf if error is None else error) / float(np.std(values)))
    collisions = told.collisions
    missed = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
    return min(cost, LOST) + COLLISION_WEIGHT * missed / max(told.rows, 1)


def _told(study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> dict[str, Agreement]:
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    told = {}
    for name, data in references.items():
        evaluations = evaluate_all(study, np.concatenate([characteristics.original[np.newaxis], data.settings]), pool)
        here = evaluations.take(np.arange(1, len(evaluations)))
        told[name] = agreement(data, here, study.published, evaluations.take([0]))
    return told
