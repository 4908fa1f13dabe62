"""The baselines of the published study (method section 6): random search, and the fuzzer
SafeFuzzer.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.random import Generator

from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, Scoring
from safevar_sumo.metrics.base import F_SAFE
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Algorithm, Problem, Search
from safevar_sumo.study import ORIGINAL_DEGREE, Table


class RandomSearch(Algorithm, Table, frozen=True, kw_only=True):
    """Samples vehicles uniformly in the domains; the result is the non-dominated archive of all
    simulations.
    """

    def search(self, problem: Problem, rng: Generator) -> Search:
        unfiltered = problem.uniform(problem.evaluations, rng)
        settings = problem.characteristics.filter(unfiltered)
        archive = problem.original.take([])
        for start in range(0, len(settings), problem.population):
            evaluated = yield settings[start : start + problem.population]
            candidates = Evaluations.concatenate([archive, evaluated])
            archive = problem.nondominated(candidates)
        return archive


MAX_REDRAWS = 100
"""Largest number of further draws after an infeasible setting."""
PositiveCount = Annotated[int, Meta(ge=1, le=1_000_000)]


class SafeFuzzer(Algorithm, Table, frozen=True, kw_only=True):
    """Changes a few characteristics of the original vehicle, to values in ranges that become
    narrower around less safe vehicles.

    The score of a vehicle (`_scores`) compares the vehicle with the others of its generation, and
    does not change later.

    Parameters
    ----------
    generation
        Number of vehicles in a generation.
    kept
        Number of vehicles in the result: those with the best scores.
    warm_up
        Number of simulations before ranges become narrower or a generation must improve.
    generations_between_updates, generations_without_improvement
        Number of generations between two updates of the ranges, and number without a new lowest
        score after which the search ends.
    safety_weight
        Weight of the first objective in the score; the other objectives have weight 1.
    """

    stops_by_itself: ClassVar[bool] = True
    generation: PositiveCount = 50
    kept: PositiveCount = 50
    warm_up: Annotated[int, Meta(ge=0)] = 500
    generations_between_updates: PositiveCount = 5
    generations_without_improvement: PositiveCount = 5
    safety_weight: Annotated[float, Meta(ge=0, le=1e6)] = 6.0

    def search(self, problem: Problem, rng: Generator) -> Search:
        ranges = Ranges(problem)
        generations = []
        scores = []
        lowest_score = np.inf
        budget = problem.evaluations
        used = 0
        n_unimproved = 0
        window_start = 0
        while used < budget and n_unimproved < self.generations_without_improvement:
            size = min(self.generation, budget - used)
            evaluated = yield ranges.draw(size, rng)
            used += size
            generations.append(evaluated)

            # The search ends when its lowest score has not fallen for some generations.
            scores.append(_scores(evaluated, problem.scoring, self.safety_weight))
            lowest_in_generation = np.nanmin(scores[-1], initial=np.inf)
            is_improved = lowest_in_generation < lowest_score or used <= self.warm_up
            n_unimproved += 1
            if is_improved:
                n_unimproved = 0
            lowest_score = min(lowest_score, lowest_in_generation)

            # Ranges narrow to the less safe settings of the generations since the last update.
            is_due = len(generations) % self.generations_between_updates == 0
            if used >= self.warm_up and is_due:
                ranges.narrow(Evaluations.concatenate(generations[window_start:]))
                window_start = len(generations)
        ranking = np.argsort(np.concatenate(scores), kind="stable")
        best = Evaluations.concatenate(generations).take(ranking[: self.kept])
        return best.take(problem.scoring.valid(best))


class Ranges:
    """The ranges from which SafeFuzzer draws values, and the largest number of characteristics that
    it changes at once.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._characteristics = problem.characteristics
        self._scoring = problem.scoring
        self._original_objective = problem.scoring.values(problem.original)[0, 0]
        self.lower = problem.characteristics.lower.copy()
        self.upper = problem.characteristics.upper.copy()
        self.max_changes = len(problem.characteristics.vehicle)

    def draw(self, number: int, rng: Generator) -> FloatArray:
        """Draw filtered settings, shape (number, n). Each setting changes k characteristics; k is
        drawn uniformly from 1 to `max_changes`. The encounter is drawn uniformly from its ranges.
        """
        settings = [self._draw_feasible_setting(rng) for _ in range(number)]
        return self._characteristics.filter(np.concatenate(settings))

    def _draw_feasible_setting(self, rng: Generator) -> FloatArray:
        """Draw a feasible setting, shape (1, n). If `MAX_REDRAWS` further draws are infeasible, the
        last setting is moved towards the original until it is feasible.
        """
        for _ in range(1 + MAX_REDRAWS):
            setting = self._draw_setting(rng)
            if self._problem.feasible(setting)[0]:
                return setting
        return self._problem.repaired(setting)

    def _draw_setting(self, rng: Generator) -> FloatArray:
        """Draw a setting with changes of some characteristics, which may violate constraints, shape
        (1, n).
        """
        setting = self._characteristics.original_settings.copy()
        # The characteristics of the vehicle come first, then the parameters of the encounter.
        n_vehicle = len(self._characteristics.vehicle)
        n_changes = rng.integers(1, self.max_changes, endpoint=True)
        changed = rng.choice(n_vehicle, n_changes, replace=False)
        for i in [*changed, *range(n_vehicle, len(self._characteristics))]:
            setting[0, i] = self._draw_value(i, rng)
        return setting

    def _draw_value(self, i: int, rng: Generator) -> float:
        """Draw a value of characteristic `i`, uniformly from the values of its range that the
        filter keeps.

        The filter replaces values that differ from the original by less than a threshold. If the
        range has no other values, the result is the original value.
        """
        original = self._characteristics.original[i]
        threshold = self._characteristics.threshold[i]
        width_below = max(original - threshold - self.lower[i], 0.0)
        width_above = max(self.upper[i] - original - threshold, 0.0)
        if width_below + width_above <= 0:
            return float(original)
        position = rng.uniform(0.0, width_below + width_above)
        if position < width_below:
            return float(self.lower[i] + position)
        return float(self.upper[i] - (position - width_below))

    def narrow(self, window: Evaluations) -> None:
        """Set the ends of each range to the mean of the increased values and the mean of the
        decreased values. Only settings of `window` count that are less safe than the original.
        """
        objectives = self._scoring.values(window)[:, 0]
        is_less_safe = objectives < self._original_objectives(window)
        less_safe = window.take(self._scoring.valid(window) & is_less_safe)
        if not len(less_safe):
            return

        for i, original in enumerate(self._characteristics.original):
            values = less_safe.settings[:, i]
            if np.any(values > original):
                self.upper[i] = np.mean(values[values > original])
            if np.any(values < original):
                self.lower[i] = np.mean(values[values < original])
        # Python's `round` takes halves to even numbers, not upwards.
        rounded_mean = np.floor(np.mean(less_safe.f_num_diff) + 0.5)
        self.max_changes = max(1, int(rounded_mean))

    def _original_objectives(self, window: Evaluations) -> FloatArray:
        """The first objective of the original vehicle, for each setting of `window`. If the
        objective is a safety degree and encounters are ranges, the original vehicle drives in the
        encounter of the setting.
        """
        has_own_degrees = self._scoring.safe_original is not None
        if has_own_degrees and self._scoring.objectives[0] == F_SAFE:
            return window.column(ORIGINAL_DEGREE)
        return np.full(len(window), self._original_objective)


def _scores(
    evaluations: Evaluations, scoring: Scoring, safety_weight: float
) -> FloatArray:
    """The scores of a generation. Less is better; NaN for settings that are not valid. By default
    the score is (6 SD_norm + f_diff + num_norm) / 8.

    SD_norm is the safety degree, scaled to [0, 1] over the generation ("after each generation, the
    value of each objective is normalised"). num_norm = (f_num_diff - 1) / (n - 1) for n
    characteristics. In a study with other objectives, the first objective replaces the safety
    degree. Further objectives are scaled to [0, 1], too.
    """
    is_valid = scoring.valid(evaluations)[:, np.newaxis]
    values = np.where(is_valid, scoring.values(evaluations), np.nan)
    max_further_changes = max(evaluations.settings.shape[1] - 1, 1)
    score = safety_weight * _normalise(values[:, 0])
    for objective, column in zip(scoring.objectives[1:], values[:, 1:].T, strict=True):
        term = _normalise(column)
        if objective.name == F_DIFF.name:
            term = column
        elif objective.name == F_NUM_DIFF.name:
            term = (column - 1) / max_further_changes
        score = score + term
    return score / (safety_weight + len(scoring.objectives) - 1)


def _normalise(values: FloatArray) -> FloatArray:
    """Scale values to [0, 1] by their minimum and maximum; equal values become 0, and NaN stays
    NaN.
    """
    if np.all(np.isnan(values)):
        return values
    minimum = np.nanmin(values)
    return (values - minimum) / (np.nanmax(values) - minimum or 1.0)
