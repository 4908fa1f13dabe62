"""Whose failure is it? The same vehicle driven by others (ISO 34502; UN R157): the driving system's, or the vehicle's."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from enum import StrEnum

import numpy as np

from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.ads.full_braking import FullBraking
from safevar_sumo.records import BoolArray, FloatArray, Outcome
from safevar_sumo.simulation import System, assemble, at_worst, simulate
from safevar_sumo.study import Study

MOST = 40
"""Of so many collisions at the most a summary says whose they are."""


class Whose(StrEnum):
    """Who would have avoided a collision in the same vehicle."""

    COMPETENT = "preventable by a competent driver"
    BRAKING = "preventable by full braking at the first possible moment"
    NOBODY = "preventable by nobody"


def whose_failures(study: Study, settings: FloatArray) -> list[Whose]:
    """For every setting in which the driving system fails, shape (M, n), who would not have; in a matrix at its worst point.

    A failure that a competent driver avoids in the same vehicle is the driving system's; one that nobody avoids is the vehicle's.
    Who starts from rest drives up to the speed that the driving system reaches with the original vehicle.
    """
    if not len(settings):
        return []
    system = assemble(study)
    if not system.matrix:
        return _told(system, settings)
    return [whose for setting in settings for whose in _told(at_worst(system, setting[np.newaxis]), setting[np.newaxis])]


def summary(study: Study, settings: FloatArray) -> str:
    """One line on the collisions of a study's solutions, shape (M, n), each setting once."""
    unique = np.unique(settings, axis=0)[:MOST]
    if not len(unique):
        return ""
    number = Counter(whose_failures(study, unique))
    parts = [f"{number[one]} {one}" for one in Whose if number[one]]
    return f"Whose failure ({len(unique)} {'collision' if len(unique) == 1 else 'collisions'} looked at): {', '.join(parts)}."


def _told(system: System, settings: FloatArray) -> list[Whose]:
    competent, braking = (_avoids(system, driver, settings) for driver in (CompetentDriver, FullBraking))
    return [Whose.COMPETENT if one else Whose.BRAKING if other else Whose.NOBODY for one, other in zip(competent, braking, strict=True)]


def _avoids(system: System, driver: type[CompetentDriver | FullBraking], settings: FloatArray) -> BoolArray:
    original = simulate(system, system.characteristics.original[np.newaxis]).trace.speed[:, 0]
    cruise_speed = float(original.max()) if original[0] == 0 else None
    outcome = simulate(replace(system, ads=driver(cruise_speed=cruise_speed or None)), settings).outcome
    return np.asarray(outcome != Outcome.COLLISION)
