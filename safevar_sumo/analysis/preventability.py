"""Preventability of collisions (ISO 34502, UN R157): would a reference driver have avoided them in the same vehicle?

If a competent driver avoids a collision, the driving system failed. If not even full braking at the first possible moment
avoids it, the vehicle is the cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.words import number_of
from safevar_sumo.records import FloatArray
from safevar_sumo.study import ModelTable, Study
from safevar_sumo.sumo.matrix import simulate, simulate_all_points, study_at, worst_points
from safevar_sumo.sumo.system import System, assemble

MAX_SIMULATIONS = 20_000
"""Approximate maximum number of simulations; if all given collisions need more, a random sample of them is simulated."""

SETTINGS_PER_CALL = 20
"""Number of settings simulated in one call at all points of a test matrix: enough to fill the batches of simulations."""

REFERENCE_DRIVERS = ("competent_driver", "full_braking")
"""Models of the drivers, the weaker one first."""


class PreventableBy(StrEnum):
    """The weakest reference driver that avoids a collision in the same vehicle; NOBODY if none avoids it."""

    COMPETENT_DRIVER = "preventable by a competent driver"
    FULL_BRAKING = "preventable by full braking at the first possible moment"
    NOBODY = "physically unavoidable"


class PreventedShares(msgspec.Struct, frozen=True, kw_only=True):
    """Shares of the simulated collisions (see `Preventability`) by category in the JSON of `explain`, None without a collision.

    `looked_at` is the number of simulated collisions; `interval_competent_driver` the 95 % interval of the share `competent_driver`.
    """

    competent_driver: float | None
    full_braking: float | None
    nobody: float | None
    looked_at: int
    interval_competent_driver: list[float] | None


@dataclass(frozen=True, kw_only=True)
class Preventability:
    """Counts of collisions, or of a random sample of them, by category: the weakest driver that avoids each collision.

    The collisions are the distinct solutions that collide, or of a study without results the drawn settings that collide.

    Attributes
    ----------
    counts
        Number of simulated collisions in each category; the categories are disjoint.
    collisions
        Number of all these collisions, simulated with the reference drivers or not.
    """

    counts: Mapping[PreventableBy, int]
    collisions: int

    @property
    def looked_at(self) -> int:
        """Number of collisions simulated with the reference drivers."""
        return sum(self.counts.values())

    def share(self, category: PreventableBy) -> float | None:
        """The share of a category among the simulated collisions; None if no collision was simulated."""
        return self.counts.get(category, 0) / self.looked_at if self.looked_at else None

    def interval(self, category: PreventableBy) -> tuple[float, float] | None:
        """95 % confidence interval of a category's share in all `collisions`; None if no collision was simulated.

        If all collisions were simulated, the share has no sampling error and the interval is the share itself. For a sample the
        interval is Clopper and Pearson's. It is slightly too wide, as it has no correction for a finite population.
        """
        share = self.share(category)
        if share is None:
            return None
        if self.looked_at == self.collisions:
            return share, share
        return clopper_pearson(self.counts.get(category, 0), self.looked_at)

    @property
    def shares(self) -> PreventedShares:
        """The shares as `explain --json` prints them."""
        interval = self.interval(PreventableBy.COMPETENT_DRIVER)
        return PreventedShares(
            competent_driver=self.share(PreventableBy.COMPETENT_DRIVER), full_braking=self.share(PreventableBy.FULL_BRAKING),
            nobody=self.share(PreventableBy.NOBODY), looked_at=self.looked_at,
            interval_competent_driver=None if interval is None else list(interval))

    def __str__(self) -> str:
        """One line; empty if no collision was simulated."""
        if not self.looked_at:
            return ""
        sample = "" if self.looked_at == self.collisions else f"{self.looked_at}, drawn at random, of "
        parts = [f"{100 * (self.share(category) or 0):.0f} % {category.replace('by full', 'only by full')}"
                 for category in PreventableBy if self.counts.get(category)]
        return f"Preventability in the same vehicle ({sample}{number_of(self.collisions, 'collision')}): {', '.join(parts)}."


def assess_preventability(evaluator: Evaluator, settings: FloatArray, max_simulations: int = MAX_SIMULATIONS) -> Preventability:
    """Classify settings that collide, shape (M, n), by the weakest driver that avoids the collision; equal settings count once.

    If that takes more than about `max_simulations` simulations, only a random sample is simulated, drawn with the study's seed.
    A setting that cannot be simulated with a reference driver is not counted.
    """
    unique = np.unique(settings, axis=0)
    simulations_per_setting = len(REFERENCE_DRIVERS) + len(assemble(evaluator.study).matrix)
    sample_size = max(max_simulations // simulations_per_setting, 1)
    rows = np.random.default_rng(evaluator.study.search.seed).permutation(len(unique))[:sample_size]
    return Preventability(counts=Counter(filter(None, classify_collisions(evaluator, unique[rows]))), collisions=len(unique))


def classify_collisions(evaluator: Evaluator, settings: FloatArray) -> list[PreventableBy | None]:
    """The category of each of the settings that collide, shape (M, n); in a test matrix, each is simulated at its worst point.

    The category is None if the setting cannot be simulated.
    """
    categories: list[PreventableBy | None] = [None] * len(settings)
    system = assemble(evaluator.study)
    worst = _find_worst_points(evaluator, system, settings)
    for point_index in np.unique(worst).tolist():
        rows = np.flatnonzero(worst == point_index)
        point = system.points[point_index]
        study = study_at(evaluator.study, point.name, source=point.name) if system.matrix else evaluator.study
        point_categories = _classify_at_point(evaluator.for_study(study), system.at(point), settings[rows])
        for row, category in zip(rows.tolist(), point_categories, strict=True):
            categories[row] = category
    return categories


def _find_worst_points(evaluator: Evaluator, system: System, settings: FloatArray) -> npt.NDArray[np.intp]:
    """Index of the worst point of every setting."""
    worst = np.zeros(len(settings), dtype=np.intp)
    if system.matrix:
        for start in range(0, len(settings), SETTINGS_PER_CALL):
            evaluator.progress("worst points of the collisions", start, len(settings))
            worst[start:start + SETTINGS_PER_CALL] = worst_points(simulate_all_points(system, settings[start:start + SETTINGS_PER_CALL]))
    return worst


def _classify_at_point(evaluator: Evaluator, system: System, settings: FloatArray) -> list[PreventableBy | None]:
    """Categories of collisions at one point. Full braking is tried only if the competent driver collides, so categories are disjoint."""
    parameters = approach_parameters(system)
    competent_evaluator, braking_evaluator = (evaluator.for_study(_study_with_driver(evaluator.study, name, parameters))
                                              for name in REFERENCE_DRIVERS)
    competent_driver = competent_evaluator.evaluate(settings, "a competent driver in the same vehicle")
    collisions = np.flatnonzero(competent_driver.collided)
    full_braking = braking_evaluator.evaluate(settings[collisions], "full braking in the same vehicle")
    categories: list[PreventableBy | None] = [PreventableBy.COMPETENT_DRIVER if valid else None for valid in competent_driver.valid]
    for row, collided, valid in zip(collisions.tolist(), full_braking.collided, full_braking.valid, strict=True):
        categories[row] = (PreventableBy.NOBODY if collided else PreventableBy.FULL_BRAKING) if valid else None
    return categories


def approach_parameters(system: System) -> dict[str, Any]:
    """Parameters with which a reference driver approaches from rest as the driving system does with the original vehicle.

    The driver replays the throttle until the driving system first brakes or reaches its peak speed, and holds that speed, so that
    both are at the same position when the danger begins. If the run begins at speed, the driver keeps that speed.
    """
    trace = simulate(system, system.characteristics.original[np.newaxis]).trace
    speed, is_braking = trace.speed[:, 0], trace.brake[:, 0] > 0
    if speed[0] > 0 or not speed.any():
        return {}
    end = min(int(np.argmax(speed)), int(np.argmax(is_braking)) if is_braking.any() else len(speed))
    return {"cruise_speed": float(speed.max()), "start_throttle": trace.throttle[:end, 0].tolist()}


def _study_with_driver(study: Study, driver: str, parameters: Mapping[str, Any]) -> Study:
    return replace(study, ads=ModelTable(model=driver, parameters=dict(parameters)))
