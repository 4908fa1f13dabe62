"""Preventability of collisions (ISO 34502, UN R157): would a reference driver have avoided them in the same vehicle?

If a competent driver avoids a collision, the driving system failed. If not even full braking at the first possible
moment avoids it, the vehicle is the cause. UN R157 means its driver for cars that cut in, cut out or brake on
motorways; its use for pedestrians is ours. How fast a driver reacts to a pedestrian is therefore uncertain: the share
of collisions that the driver avoids is computed for a later reaction, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from msgspec.structs import replace

from safevar_sumo.ads.reference_drivers import CompetentDriver
from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.words import number_of, share_in_words
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
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


Avoidance = tuple[PreventableBy, bool]
"""The weakest driver who avoids a collision, and whether the competent driver does with `LATER_REACTION`."""


@dataclass(frozen=True, kw_only=True)
class Preventability:
    """Counts of collisions, or of a random sample of them, by category: the weakest driver that avoids a collision.

    The collisions are the distinct solutions that collide; without results, the settings drawn from the study's domain
    that collide.

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

    def share(self, category: PreventableBy) -> float:
        """The share of a category among the simulated collisions; 0 if no collision was simulated."""
        return self.counts.get(category, 0) / max(self.looked_at, 1)

    @property
    def shares(self) -> dict[str, float]:
        """The shares of all categories, and `later`, by name; empty if no collision was simulated."""
        if not self.looked_at:
            return {}
        return {by.name.lower(): self.share(by) for by in PreventableBy} | {"later": self.later / self.looked_at}

    def to_dict(self) -> JsonObject:
        """The shares, None without a simulated collision, and the competent driver's 95 % interval, for JSON.

        If all collisions were simulated, the share has no sampling error and the interval is the share itself. For a
        sample the interval is Clopper and Pearson's. It is slightly too wide, as it has no correction for a finite
        population.
        """
        number, shares, interval = self.looked_at, self.shares, None
        if number:
            driver, count = PreventableBy.COMPETENT_DRIVER, self.counts.get(PreventableBy.COMPETENT_DRIVER, 0)
            interval = [self.share(driver)] * 2 if number == self.collisions else [*clopper_pearson(count, number)]
        return {
            **{by.name.lower(): shares.get(by.name.lower()) for by in PreventableBy},
            "looked_at": number,
            "interval_competent_driver": interval,
            "later": {"reaction": LATER_REACTION, "competent_driver": shares.get("later")},
        }

    @property
    def range_in_words(self) -> str:
        """The share of collisions that the competent driver avoids: `71 % (39 % if he needs 0.4 s longer)`."""
        later = share_in_words(self.later / max(self.looked_at, 1))
        return f"{share_in_words(self.share(PreventableBy.COMPETENT_DRIVER))} ({later} if he needs {DELAY:g} s longer)"

    def __str__(self) -> str:
        """A sentence; empty if no collision was simulated."""
        if not self.looked_at:
            return ""
        sample = "" if self.looked_at == self.collisions else f", drawn at random from {self.collisions}"
        return (
            f"In the same vehicle, of {number_of(self.looked_at, 'collision')}{sample}, a competent driver avoids "
            f"{self.range_in_words}; only full braking at the first possible moment: "
            f"{share_in_words(self.share(PreventableBy.FULL_BRAKING))}; nobody: "
            f"{share_in_words(self.share(PreventableBy.NOBODY))}."
        )


def assess_preventability(
    evaluator: Evaluator, collisions: Evaluations, max_simulations: int = MAX_SIMULATIONS
) -> Preventability:
    """Classify M evaluated collisions by the weakest driver that avoids them; equal settings count once.

    If that takes more than about `max_simulations` simulations, only a random sample is simulated, drawn with the
    study's seed. A setting that cannot be simulated with a reference driver is not counted.
    """
    _, distinct = np.unique(collisions.settings, axis=0, return_index=True)
    shuffled = np.random.default_rng(evaluator.study.search.seed).permutation(distinct)
    sample = shuffled[: max(max_simulations // SIMULATIONS, 1)]
    avoidances = list(filter(None, classify_collisions(evaluator, collisions.take(sample))))
    return Preventability(
        counts=Counter(by for by, _ in avoidances),
        collisions=len(distinct),
        later=sum(avoids_later for _, avoids_later in avoidances),
    )


def classify_collisions(evaluator: Evaluator, collisions: Evaluations) -> list[Avoidance | None]:
    """Who avoids each of M evaluated collisions at its worst point; None if a reference driver cannot be simulated."""
    avoidances: list[Avoidance | None] = [None] * len(collisions)
    system = assemble(evaluator.study)
    worst = np.zeros(len(collisions), dtype=np.intp) if collisions.worst_points is None else collisions.worst_points
    for point_index in np.unique(worst).tolist():
        rows, point = np.flatnonzero(worst == point_index).tolist(), system.points[point_index]
        study = study_at(evaluator.study, point.name, source=point.name) if system.matrix else evaluator.study
        at_point = _classify_at_point(evaluator.for_study(study), system.at(point), collisions.settings[rows])
        for row, avoidance in zip(rows, at_point, strict=True):
            avoidances[row] = avoidance
    return avoidances


def _classify_at_point(evaluator: Evaluator, system: System, settings: FloatArray) -> list[Avoidance | None]:
    """Who avoids collisions at one point; full braking is tried only if the competent driver collides."""
    approach = approach_parameters(system)

    def drive(driver: str, settings: FloatArray, **parameters: float) -> Evaluations:
        ads = ModelTable(model=driver, parameters={**approach, **parameters})
        with_driver = evaluator.for_study(replace(evaluator.study, ads=ads))
        return with_driver.evaluate(settings, "reference drivers in the same vehicle")

    competent = drive("competent_driver", settings)
    later = drive("competent_driver", settings, reaction_time=LATER_REACTION)
    full_braking = drive("full_braking", settings[competent.collided])
    categories = np.full(len(settings), PreventableBy.COMPETENT_DRIVER, dtype=object)
    categories[competent.collided] = np.where(full_braking.collided, PreventableBy.NOBODY, PreventableBy.FULL_BRAKING)
    is_valid = competent.valid.copy()
    is_valid[competent.collided] = full_braking.valid
    avoids_later = (later.valid & ~later.collided).tolist()
    return [
        (PreventableBy(category), avoids) if valid else None
        for category, avoids, valid in zip(categories, avoids_later, is_valid, strict=True)
    ]


def approach_parameters(system: System) -> JsonObject:
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
