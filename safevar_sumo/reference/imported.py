"""The published package's solutions as this program's: filtered, with its objectives, ready to be stored."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.results import UNKNOWN
from safevar_sumo.vehicles import CharacteristicSet

SHORT = {short: metric.name for metric in METRICS.values() for short in (metric.name, metric.title.lower())}
"""What a command calls the metrics."""
ORIGINAL_FORM = "sd=NUMBER,tet=NUMBER,tit=NUMBER,ave_dece=NUMBER"


def evaluations_of(data: ReferenceData, characteristics: CharacteristicSet) -> Evaluations:
    """Reference rows as evaluations; f_diff and f_numDiff are those of the filtered settings (method section 3)."""
    return Evaluations(
        settings=data.settings, outcome=np.where(data.collided, str(Outcome.COLLISION), UNKNOWN),
        collision_speed=np.where(data.collided, -data.metrics["safety_degree"], np.nan), metrics=data.metrics,
        f_diff=characteristics.largest_change(data.settings), f_num_diff=characteristics.number_changed(data.settings))


def original_metrics(given: str | None, published: Mapping[str, float]) -> dict[str, float | None]:
    """The original vehicle's metrics, as given (sd=2.7,tet=1.2,...) or else as published; None where neither tells.

    Raises
    ------
    InputError
        If what is given has another form, or nothing tells the safety degree.
    """
    original: dict[str, float | None] = {name: published.get(name) for name in METRICS}
    for part in given.split(",") if given is not None else ():
        name, _, text = (word.strip() for word in part.partition("="))
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if name not in SHORT or not np.isfinite(value):
            raise InputError("original", f"{part!r} in {given!r}", ORIGINAL_FORM)
        original[SHORT[name]] = value
    if original["safety_degree"] is None:
        raise InputError("original", "the study has no published values of the original vehicle", ORIGINAL_FORM)
    return original
