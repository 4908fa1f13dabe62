"""What a study's disagreement with its references costs; see `FitTable`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import msgspec
import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.validation import Agreement
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import FitTable, Study, invalid
from safevar_sumo.sumo.system import models_of

LARGEST = 1e3
"""Of what a reference can cost; that of a study which cannot be simulated at all."""
FARTHEST = 10.0
"""Tolerances beyond which the original vehicle's miss costs no more: a value that there is not is so far away."""


def original_cost(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> float:
    """Misses of the original vehicle's values, weighted by metric; mean.

    Squared up to the tolerance and in proportion beyond it (Huber 1964): squares would have a search fit one vehicle first, and
    the rows only as far as that leaves it room.
    """
    misses = [fit.weights.get(name, 0.0) * _huber(original.metrics[name][0] / value - 1, fit.tolerance)
              for name, value in published.items() if name in METRICS]
    return fit.original * float(np.mean(misses)) if misses else 0.0


def _huber(miss: float, tolerance: float) -> float:
    """A relative miss in tolerances, squared up to one; twice as much, less one, beyond."""
    distance = min(abs(miss) / tolerance, FARTHEST) if np.isfinite(miss) else FARTHEST
    return distance * distance if distance <= 1 else 2 * distance - 1


def reference_cost(result: Agreement, data: ReferenceData, fit: FitTable) -> float:
    """Lost rank correlation and absolute error (in standard deviations of the reference), weighted, and collisions."""
    cost = 0.0
    for name, weight in fit.weights.items():
        values = data.metrics[name][~np.isnan(data.metrics[name])]
        if not values.size or np.ptp(values) == 0:
            continue
        rho, error = result.spearman[name], result.mean_absolute_error[name]
        cost += weight * (fit.rank * (1 - (rho or 0.0)) + (np.inf if error is None else error) / float(np.std(values)))
    collisions = result.collisions
    missed = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
    return min(cost, LARGEST) + fit.collisions * missed / max(result.rows, 1)


class Trial(Protocol):
    """What is tried: studies by their place in the unit cube of the bounds, and what they cost."""

    def at(self, shares: FloatArray) -> Study: ...

    def costs(self, studies: Sequence[Study]) -> list[float]: ...


class Search:
    """Keeps the best study of all that are tried, and count of the trials that are left.

    Parameters
    ----------
    population
        Trials in a generation.
    done
        Is called after every trial with the lowest cost so far, and the study that has it.
    """

    def __init__(self, trial: Trial, population: int, trials: int, done: Callable[[float, Study], None]) -> None:
        self.best: Study | None = None
        self.cost, self.left = np.inf, trials
        self.trial, self.population, self._done = trial, population, done

    def tried(self, studies: Sequence[Study]) -> list[float]:
        """What studies cost."""
        costs = self.trial.costs(studies)
        self.left -= len(costs)
        for study, cost in zip(studies, costs, strict=True):
            if self.best is None or cost < self.cost:
                self.best, self.cost = study, cost
            self._done(self.cost, self.best)
        return costs

    def begun(self, place: FloatArray, spread: float, seed: int) -> OneSearch:
        """A search from a place in the unit cube, `spread` wide at first (standard deviation)."""
        return OneSearch(self, place, spread, seed)

    def race(self, searches: Sequence[OneSearch]) -> None:
        """Successive halving (Jamieson and Talwalkar 2016) of all trials that are left.

        Rounds have as many trials each, shared by half as many searches each time; the last has two, and the winner what is left over.
        """
        racing = list(searches)
        rounds = max(1, (len(racing) - 1).bit_length())
        share = self.left // rounds
        for _ in range(rounds):
            each = share // len(racing)
            for one in racing:
                one.go_on(each - each % self.population if each > self.population else each)
            racing = sorted(racing, key=lambda one: one.lowest)[:(len(racing) + 1) // 2]
        racing[0].go_on(self.left)


class OneSearch:
    """CMA-ES (Hansen 2016) from one place; `lowest` is the least that it has found to cost."""

    def __init__(self, search: Search, place: FloatArray, spread: float, seed: int) -> None:
        import cma  # only here: it takes longer to load than all the rest

        self._search, self.lowest = search, np.inf
        self._strategy: Any = cma.CMAEvolutionStrategy(place, spread, {
            "bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": search.population, "maxstd": np.inf})

    def go_on(self, trials: int) -> None:
        """Generation after generation; nothing is learnt from a last one that is cut short."""
        search = self._search
        for left in range(trials, 0, -search.population):
            shares = self._strategy.ask()
            costs = search.tried([search.trial.at(share) for share in shares[:left]])
            self.lowest = min(self.lowest, min(costs))
            if len(costs) == len(shares):
                self._strategy.tell(shares, costs)


FITTED = ("vehicle.parameters.", "ads.parameters.", "weather.")


def check_bound(study: Study, name: str, side: str, bound: float) -> None:
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
            table = table[_key(table, key)]
        place = _key(table, last)
        if not isinstance(table[place], int | float):
            raise refused
    except (KeyError, IndexError, ValueError, TypeError):
        raise refused from None
    return table, place


def _key(table: Any, name: str) -> int | str:
    """A list's places are told in one way only: two names of one parameter would be fitted against each other."""
    return int(name) if isinstance(table, list) and name == str(int(name)) else name


def value_of(study: Study, name: str) -> float:
    """What a parameter is in the study."""
    table, key = _place(study, _raw(study), name)
    return float(table[key])
