"""Does a search exploit the model? What published rows say that lie next to what it found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from safevar_sumo.analysis.case import Case, collided
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.rows import ReferenceData

NEIGHBOURS = 5


class Nearness(NamedTuple):
    """Solutions of one algorithm and the published rows nearest to each.

    Distances are Euclidean in widths of the domains, medians over the five nearest: of the solutions to published rows, and of
    published rows to each other. Safety degrees are means [m, -m/s]; `also_collide` is the share of collisions among the rows
    next to solutions that collide.
    """

    setting: str
    algorithm: str
    solutions: int
    distance: float
    distance_there: float
    safety_here: float
    safety_there: float
    collisions: int
    also_collide: float | None


def nearness(case: Case, references: Sequence[ReferenceData]) -> list[Nearness]:
    """By algorithm; references are rows of this study's vehicle."""
    domains = case.characteristics
    width = domains.upper - domains.lower
    rows = np.concatenate([data.settings for data in references]) / width
    safety = np.concatenate([data.metrics["safety_degree"] for data in references])
    tree, number = scipy.spatial.cKDTree(rows), min(NEIGHBOURS, len(rows))
    among = tree.query(rows, number + 1)[0][:, 1:] if len(rows) > number else np.full((1, 1), np.nan)
    found = []
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        if solutions.empty:
            continue
        places: FloatArray = solutions[list(domains.names)].to_numpy(dtype=float) / width
        distance, nearest = (np.reshape(part, (len(places), number)) for part in tree.query(places, number))
        hit = collided(solutions).to_numpy()
        found.append(Nearness(
            case.name, algorithm, len(solutions), float(np.median(distance)), float(np.median(among)),
            float(np.nanmean(solutions["safety_degree"])), float(safety[nearest].mean()), int(hit.sum()),
            float((safety[nearest[hit]] <= 0).mean()) if hit.any() else None))
    return found
