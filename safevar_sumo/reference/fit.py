"""The loss of a study's disagreement with its references (see `FitTable`), and searches for the lowest loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.effects import Regression
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.validation import agreement
from safevar_sumo.study import SAFETY_DEGREE, FitTable, Study
from safevar_sumo.vehicles import CharacteristicSet

MAX_LOSS = 1e5
"""Largest loss of a reference; also the loss of a study that cannot be simulated."""
MAX_DEVIATION = 10.0
"""Largest deviation of the original vehicle's values [tolerances]; also that of an undefined value."""


def original_loss(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> float:
    """Mean deviation of the original vehicle's values from the published ones, weighted by metric.

    Deviations are squared up to the tolerance and linear beyond it (Huber 1964): with squares alone a search would fit this one
    vehicle first, and the rows only as far as that allows.
    """
    deviations = [fit.weights.get(name, 0.0) * _huber(original.metrics[name][0] / value - 1, fit.tolerance)
                  for name, value in published.items() if name in METRICS]
    return fit.original * float(np.mean(deviations)) if deviations else 0.0


def _huber(deviation: float, tolerance: float) -> float:
    """Huber's loss of a relative deviation, x tolerances large: x^2 up to 1, 2 x - 1 beyond."""
    x = min(abs(deviation) / tolerance, MAX_DEVIATION) if np.isfinite(deviation) else MAX_DEVIATION
    return x * x if x <= 1 else 2 * x - 1


class ReferenceLoss:
    """The loss of a study beside one reference: missing rank correlation and absolute errors, weighted by metric, differing effects, and
    differing collisions.

    Errors are in standard deviations of repeats of one setting in the reference, or, if unknown, of the reference's values.
    """

    def __init__(self, data: ReferenceData, study: Study) -> None:
        self._data, self._study, self._units = data, study, dict[str, float]()
        for name in study.fit.weights:
            values = data.metrics[name][~np.isnan(data.metrics[name])]
            if values.size and np.ptp(values) > 0:
                self._units[name] = study.repeatability.get(name) or float(np.std(values))
        self._regression = Regression.over(data.settings, CharacteristicSet.of(study.vehicle.characteristics))
        self._effects = self._regression.effects(data.metrics[SAFETY_DEGREE])

    def of(self, here: Evaluations) -> float:
        """The loss of evaluations of the reference's settings."""
        fit, loss, result = self._study.fit, 0.0, agreement(self._data, here, self._study, here)
        for name, unit in self._units.items():
            rho, error = result.spearman[name], result.mean_absolute_error[name]
            loss += fit.weights[name] * (fit.rank * (1 - (rho or 0.0)) + (np.inf if error is None else error) / unit)
            if name == SAFETY_DEGREE and fit.effects:
                differences = np.nan_to_num(self._regression.effects(here.f_safe) - self._effects)
                loss += fit.effects * float(np.mean(np.abs(differences))) / unit
        collisions = result.collisions
        differing = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
        return min(loss, MAX_LOSS) + fit.collisions * differing / max(result.rows, 1)


Together = tuple[Study, ...]
"""Studies that are fitted together."""


class Trial(Protocol):
    """Studies that are fitted together, by their place in the unit cube of the bounds, and their losses."""

    def at(self, shares: FloatArray) -> Together: ...

    def losses(self, studies: Sequence[Together]) -> list[float]: ...


KEPT_LOSS = 1.25
"""Trials up to this multiple of the lowest loss are kept, for profiles and the spread."""
SCREENING = 4
"""Screening takes at most one in this number of trials."""


class TrialSearch:
    """Keeps the best studies of all trials, and counts the trials left.

    Parameters
    ----------
    population
        Trials in a generation of a search that has no population of its own.
    done
        Called after every trial with the lowest loss so far, and the studies that have it.
    alike
        Trials whose loss exceeds the lowest by at most this share of it fit as well as the best.
    """

    def __init__(self, trial: Trial, population: int, trials: int, done: Callable[[float, Together], None], alike: float = 0.0) -> None:
        self.alike = alike
        self.best: Together | None = None
        self.loss, self.left = np.inf, trials
        self.kept: list[tuple[float, FloatArray]] = []
        """Losses and places of the trials whose loss is at most `KEPT_LOSS` times the lowest loss until then."""
        self.trial, self.population, self._done = trial, population, done

    def try_studies(self, studies: Sequence[Together]) -> list[float]:
        """The losses of studies, a trial each."""
        losses = self.trial.losses(studies)
        self.left -= len(losses)
        for together, loss in zip(studies, losses, strict=True):
            if self.best is None or loss < self.loss:
                self.best, self.loss = together, loss
            self._done(self.loss, self.best)
        return losses

    def begin(self, place: FloatArray, spread: float, seed: int, population: int | None = None) -> OneSearch:
        """A search from a place in the unit cube, `spread` wide at first (standard deviation), with a population of its own if given."""
        return OneSearch(self, place, spread, seed, population or self.population)

    def from_random_places(self, same: Sequence[int], starts: int, screened: int, spread: float,
                           rng: np.random.Generator) -> list[OneSearch]:
        """Searches from random places, or from the best of `screened` random places; `SCREENING` limits their number.

        Parameter i starts at the same share of its bounds as parameter `same[i]`.
        """
        screened = min(screened, self.left // SCREENING) if starts else 0
        if screened < max(starts, 1):
            return [self.begin(rng.random(len(same))[same], spread, int(rng.integers(1, 2**31))) for _ in range(starts)]
        places = rng.random((screened, len(same)))[:, same]
        losses = [loss for k in range(0, screened, self.population)
                 for loss in self.try_studies([self.trial.at(place) for place in places[k:k + self.population]])]
        return [self.begin(places[k], spread, int(rng.integers(1, 2**31))) for k in np.argsort(losses, kind="stable")[:starts]]

    def race(self, searches: Sequence[OneSearch]) -> None:
        """Spend all trials left by successive halving (Jamieson and Talwalkar 2016).

        All rounds have the same number of trials, and each has half as many searches as the one before; the last search gets the remainder.
        """
        racing = list(searches)
        rounds = 1 + (len(racing) - 1).bit_length()
        share = self.left // rounds
        for _ in range(rounds):
            each = share // len(racing)
            for one in racing:
                one.advance(each - each % one.population if each > one.population else each)
            racing = sorted(racing, key=lambda one: one.lowest)[:(len(racing) + 1) // 2]
        racing[0].advance(self.left)


class OneSearch:
    """CMA-ES (Hansen 2016) from one place, with its population; `lowest` is its lowest loss so far."""

    def __init__(self, search: TrialSearch, place: FloatArray, spread: float, seed: int, population: int) -> None:
        import cma  # takes longer to load than all the rest

        self._search, self.lowest, self.population = search, np.inf, population
        self._strategy: Any = cma.CMAEvolutionStrategy(place, spread, {
            "bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": population, "maxstd": np.inf})

    def advance(self, trials: int) -> None:
        """Run generations; CMA-ES does not learn from a last generation that is cut short."""
        search = self._search
        for left in range(trials, 0, -self.population):
            shares = self._strategy.ask()
            losses = search.try_studies([search.trial.at(share) for share in shares[:left]])
            search.kept += [(loss, share) for loss, share in zip(losses, shares, strict=False) if loss <= KEPT_LOSS * search.loss]
            self.lowest = min(self.lowest, min(losses))
            if len(losses) == len(shares):
                self._strategy.tell(shares, losses)
