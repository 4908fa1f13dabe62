"""What a study's disagreement with its references costs; see `FitTable`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.effects import effects_apart
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.validation import Agreement
from safevar_sumo.study import SAFETY_DEGREE, FitTable, Study
from safevar_sumo.vehicles import CharacteristicSet

LARGEST = 1e5
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


def reference_cost(result: Agreement, data: ReferenceData, here: Evaluations, study: Study) -> float:
    """Lost rank correlation and absolute error, weighted by metric, differences of effects, and collisions.

    Errors count in standard deviations of repeats of one setting there; where these are not known, in those of the reference.
    """
    fit, cost = study.fit, 0.0
    for name, weight in fit.weights.items():
        values = data.metrics[name][~np.isnan(data.metrics[name])]
        if not values.size or np.ptp(values) == 0:
            continue
        rho, error = result.spearman[name], result.mean_absolute_error[name]
        unit = study.repeatability.get(name) or float(np.std(values))
        cost += weight * (fit.rank * (1 - (rho or 0.0)) + (np.inf if error is None else error) / unit)
        if name == SAFETY_DEGREE and fit.effects:
            apart = effects_apart(data, here, CharacteristicSet.of(study.vehicle.characteristics))
            cost += fit.effects * float(np.mean(np.abs(apart))) / unit
    collisions = result.collisions
    missed = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
    return min(cost, LARGEST) + fit.collisions * missed / max(result.rows, 1)


Together = tuple[Study, ...]
"""Studies that are fitted together."""


class Trial(Protocol):
    """What is tried: studies that are fitted together, by their place in the unit cube of the bounds, and what they cost."""

    def at(self, shares: FloatArray) -> Together: ...

    def costs(self, tried: Sequence[Together]) -> list[float]: ...


NOTED = 1.25
"""Times the lowest cost up to which a trial is kept: what profiles and the spread are made of."""


SCREENING = 4
"""Screening takes one trial in so many at most."""


class Search:
    """Keeps the best of all that are tried, and count of the trials that are left.

    Parameters
    ----------
    population
        Trials in a generation.
    done
        Is called after every trial with the lowest cost so far, and the studies that have it.
    alike
        Share of the lowest cost within which trials fit as well.
    """

    def __init__(self, trial: Trial, population: int, trials: int, done: Callable[[float, Together], None], alike: float = 0.0) -> None:
        self.alike = alike
        self.best: Together | None = None
        self.cost, self.left = np.inf, trials
        self.seen: list[tuple[float, FloatArray]] = []
        """Costs and places of what was tried and came to no more than `NOTED` times the lowest cost until then."""
        self.trial, self.population, self._done = trial, population, done

    def tried(self, studies: Sequence[Together]) -> list[float]:
        """What studies cost."""
        costs = self.trial.costs(studies)
        self.left -= len(costs)
        for together, cost in zip(studies, costs, strict=True):
            if self.best is None or cost < self.cost:
                self.best, self.cost = together, cost
            self._done(self.cost, self.best)
        return costs

    def begun(self, place: FloatArray, spread: float, seed: int) -> OneSearch:
        """A search from a place in the unit cube, `spread` wide at first (standard deviation)."""
        return OneSearch(self, place, spread, seed)

    def from_random_places(self, same: Sequence[int], starts: int, screened: int, spread: float,
                           rng: np.random.Generator) -> list[OneSearch]:
        """Searches from random places, or from the best of `screened` ones, on which a share of the trials at most is spent.

        Each parameter begins at the same share of its bounds as the one whose number `same` says.
        """
        screened = min(screened, self.left // SCREENING) if starts else 0
        if screened < max(starts, 1):
            return [self.begun(rng.random(len(same))[same], spread, int(rng.integers(1, 2**31))) for _ in range(starts)]
        places = rng.random((screened, len(same)))[:, same]
        costs = [cost for k in range(0, screened, self.population)
                 for cost in self.tried([self.trial.at(place) for place in places[k:k + self.population]])]
        return [self.begun(places[k], spread, int(rng.integers(1, 2**31))) for k in np.argsort(costs, kind="stable")[:starts]]

    def race(self, searches: Sequence[OneSearch]) -> None:
        """Successive halving (Jamieson and Talwalkar 2016) of all trials that are left.

        Rounds have as many trials each, shared by half as many searches each time; the last has one, and what is left over.
        """
        racing = list(searches)
        rounds = 1 + (len(racing) - 1).bit_length()
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
            search.seen += [(cost, share) for cost, share in zip(costs, shares, strict=False) if cost <= NOTED * search.cost]
            self.lowest = min(self.lowest, min(costs))
            if len(costs) == len(shares):
                self._strategy.tell(shares, costs)
