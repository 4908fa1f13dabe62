"""Preventability of collisions (ISO 34502, UN R157): would a reference driver have avoided them in the same vehicle?

If a competent driver avoids a collision, the driving system failed. If not even full braking at the first possible
moment avoids it, the vehicle is the cause. UN R157 means its driver for cars that cut in, cut out or brake on
motorways; its use for pedestrians is ours. So the share that he avoids is a range: it is computed for a later reaction,
too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.words import join_phrases, number_of, share_in_words
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import ModelTable
from safevar_sumo.sumo.matrix import simulate, study_at
from safevar_sumo.sumo.system import System, assemble

MAX_SIMULATIONS = 20_000
"""Approximate maximum number of simulations; if all given collisions need more, a random sample of them is simulated.
"""

DELAY = 0.4
"""Time by which the competent driver reacts later in the second of the two computations [s]."""
LATER_REACTION = CompetentDriver().reaction_time + DELAY
"""Reaction time in the second computation [s]."""
SIMULATIONS = 3
"""Simulations of each collision: a competent driver, the same with the later reaction, and full braking."""


class PreventableBy(StrEnum):
    """The weakest reference driver that avoids a collision in the same vehicle; NOBODY if none avoids it."""

    COMPETENT_DRIVER = "preventable by a competent driver"
    FULL_BRAKING = "preventable by full braking at the first possible moment"
    NOBODY = "physically unavoidable"


class Avoidance(NamedTuple):
    """The weakest driver who avoids a collision, and whether the competent driver does with `LATER_REACTION`."""

    by: PreventableBy
    later: bool


class LaterReaction(msgspec.Struct, frozen=True, kw_only=True):
    """The share of the collisions that the competent driver avoids with the later reaction time `reaction` [s]."""

    reaction: float
    competent_driver: float | None

    def __str__(self) -> str:
        """Its words after those of the share, such as `39 % if he needs 0.4 s longer`."""
        return f"{share_in_words(self.competent_driver or 0.0)} if he needs {DELAY:g} s longer"


class PreventedShares(msgspec.Struct, frozen=True, kw_only=True):
    """Shares of the simulated collisions (see `Preventability`) by category in the JSON of `explain`, None without a
    collision.

    `looked_at` is the number of simulated collisions; `interval_competent_driver` the 95 % interval of the share
    `competent_driver`; `later` the share with a later reaction.
    """

    competent_driver: float | None
    full_braking: float | None
    nobody: float | None
    looked_at: int
    interval_competent_driver: list[float] | None
    later: LaterReaction


@dataclass(frozen=True, kw_only=True)
class Preventability:
    """Counts of collisions, or of a random sample of them, by category: the weakest driver that avoids each collision.

    The collisions are the distinct solutions that collide, or of a study without results the drawn settings that
    collide.

    Attributes
    ----------
    counts
        Number of simulated collisions in each category; the categories are disjoint.
    collisions
        Number of all these collisions, simulated with the reference drivers or not.
    later
        Number of simulated collisions that the competent driver avoids with `LATER_REACTION`.
    """

    counts: Mapping[PreventableBy, int]
    collisions: int
    later: int

    @property
    def looked_at(self) -> int:
        """Number of collisions simulated with the reference drivers."""
        return sum(self.counts.values())

    def share(self, category: PreventableBy) -> float | None:
        """The share of a category among the simulated collisions; None if no collision was simulated."""
        return self.counts.get(category, 0) / self.looked_at if self.looked_at else None

    def interval(self, category: PreventableBy) -> tuple[float, float] | None:
        """95 % confidence interval of a category's share in all `collisions`; None if no collision was simulated.

        If all collisions were simulated, the share has no sampling error and the interval is the share itself. For a
        sample the interval is Clopper and Pearson's. It is slightly too wide, as it has no correction for a finite
        population.
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
        later = self.later / self.looked_at if self.looked_at else None
        return PreventedShares(
            competent_driver=self.share(PreventableBy.COMPETENT_DRIVER),
            full_braking=self.share(PreventableBy.FULL_BRAKING),
            nobody=self.share(PreventableBy.NOBODY),
            looked_at=self.looked_at,
            interval_competent_driver=None if interval is None else list(interval),
            later=LaterReaction(reaction=LATER_REACTION, competent_driver=later),
        )

    def __str__(self) -> str:
        """A sentence; empty if no collision was simulated."""
        if not self.looked_at:
            return ""
        competent_driver, full_braking, nobody = (share_in_words(self.share(by) or 0.0) for by in PreventableBy)
        parts = [f"a competent driver avoids {competent_driver} ({self.shares.later})"]
        if self.counts.get(PreventableBy.FULL_BRAKING):
            another = "another " if competent_driver != "none" and full_braking.endswith("%") else ""
            parts.append(f"only full braking at the first possible moment avoids {another}{full_braking}")
        if self.counts.get(PreventableBy.NOBODY):
            parts.append(f"{nobody} are physically unavoidable")
        sample = "" if self.looked_at == self.collisions else f", drawn at random from {self.collisions}"
        return f"In the same vehicle, of {number_of(self.looked_at, 'collision')}{sample}, {join_phrases(parts)}."


def assess_preventability(
    evaluator: Evaluator, collisions: Evaluations, max_simulations: int = MAX_SIMULATIONS
) -> Preventability:
    """Classify M evaluated collisions by the weakest driver that avoids them; equal settings count once.

    If that takes more than about `max_simulations` simulations, only a random sample is simulated, drawn with the
    study's seed. A setting that cannot be simulated with a reference driver is not counted.
    """
    distinct = np.unique(collisions.settings, axis=0, return_index=True)[1]
    shuffled = np.random.default_rng(evaluator.study.search.seed).permutation(distinct)
    sample = shuffled[: max(max_simulations // SIMULATIONS, 1)]
    avoidances = [avoidance for avoidance in classify_collisions(evaluator, collisions.take(sample)) if avoidance]
    return Preventability(
        counts=Counter(avoidance.by for avoidance in avoidances),
        collisions=len(distinct),
        later=sum(avoidance.later for avoidance in avoidances),
    )


def classify_collisions(evaluator: Evaluator, collisions: Evaluations) -> list[Avoidance | None]:
    """Who avoids each of M evaluated collisions, simulated at its worst point; None where that cannot be simulated."""
    avoidances: list[Avoidance | None] = [None] * len(collisions)
    system = assemble(evaluator.study)
    worst = np.zeros(len(collisions), dtype=np.intp) if collisions.worst_points is None else collisions.worst_points
    for point_index in np.unique(worst).tolist():
        rows, point = np.flatnonzero(worst == point_index), system.points[point_index]
        study = study_at(evaluator.study, point.name, source=point.name) if system.matrix else evaluator.study
        at_point = _classify_at_point(evaluator.for_study(study), system.at(point), collisions.settings[rows])
        for row, avoidance in zip(rows.tolist(), at_point, strict=True):
            avoidances[row] = avoidance
    return avoidances


def _classify_at_point(evaluator: Evaluator, system: System, settings: FloatArray) -> list[Avoidance | None]:
    """Who avoids collisions at one point; full braking is tried only if the competent driver collides."""
    approach = approach_parameters(system)

    def drive(driver: str, rows: FloatArray, stage: str, **parameters: float) -> Evaluations:
        ads = ModelTable(model=driver, parameters={**approach, **parameters})
        return evaluator.for_study(replace(evaluator.study, ads=ads)).evaluate(rows, f"{stage} in the same vehicle")

    competent_driver = drive("competent_driver", settings, "a competent driver")
    later = drive("competent_driver", settings, f"the same driver {DELAY:g} s later", reaction_time=LATER_REACTION)
    collisions = np.flatnonzero(competent_driver.collided)
    full_braking = drive("full_braking", settings[collisions], "full braking")
    categories = [PreventableBy.COMPETENT_DRIVER if valid else None for valid in competent_driver.valid]
    for row, collided, valid in zip(collisions.tolist(), full_braking.collided, full_braking.valid, strict=True):
        categories[row] = (PreventableBy.NOBODY if collided else PreventableBy.FULL_BRAKING) if valid else None
    return [
        None if category is None else Avoidance(category, avoided)
        for category, avoided in zip(categories, (later.valid & ~later.collided).tolist(), strict=True)
    ]


def approach_parameters(system: System) -> dict[str, Any]:
    """Parameters with which a reference driver approaches from rest as the driving system does with the original
    vehicle.

    The driver replays the throttle until the driving system first brakes or reaches its peak speed, and holds that
    speed, so that both are at the same position when the danger begins. If the run begins at speed, the driver keeps
    that speed.
    """
    trace = simulate(system, system.characteristics.original[np.newaxis]).trace
    speed, is_braking = trace.speed[:, 0], trace.brake[:, 0] > 0
    if speed[0] > 0 or not speed.any():
        return {}
    end = min(int(np.argmax(speed)), int(np.argmax(is_braking)) if is_braking.any() else len(speed))
    return {"cruise_speed": float(speed.max()), "start_throttle": trace.throttle[:end, 0].tolist()}
