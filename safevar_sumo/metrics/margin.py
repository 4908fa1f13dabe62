"""The distance that a vehicle has to keep: by default the error of its model."""

from __future__ import annotations

from safevar_sumo.study import SAFETY_DEGREE, Study

DEFAULT_MARGIN = 0.3
"""Distance to keep in a study that states no error of its model [m]."""


def margin_of(study: Study, margin: float | None) -> float:
    """The distance to keep [m]: the stated one, else the study's error of its model, else
    `DEFAULT_MARGIN`.
    """
    if margin is None:
        return study.model_error.get(SAFETY_DEGREE, DEFAULT_MARGIN)
    return margin
