"""Uncertainty of fitted parameters: the losses of trials by parameter, and sets of values that fit as well as the
best.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.figures import BLUE, GREY, new_panels, save
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.fit_space import FitSpace, FittedParameter
from safevar_sumo.reference.search import SearchRace
from safevar_sumo.study import Study, unit_text

MAX_SETS = 20
"""Maximum number of parameter sets in a table [spread], including the best set."""


class Profiles(NamedTuple):
    """Trials of a fit whose loss is near the lowest loss.

    Attributes
    ----------
    parameters
        The fitted parameters.
    losses, values
        Losses of the K trials, shape (K,), and their parameter values, shape (K, parameters). The best trial comes
        first.
    sets
        Indices of up to `MAX_SETS` trials that fit as well as the best and lie as far apart as possible. The best trial
        comes first.
    limit
        The loss up to which a trial fits as well as the best.
    """

    parameters: Sequence[FittedParameter]
    losses: FloatArray
    values: FloatArray
    sets: list[int]
    limit: float

    @classmethod
    def of(cls, parameters: Sequence[FittedParameter], space: FitSpace, race: SearchRace, alike: float) -> Profiles:
        """The profiles of a finished race; a trial fits as well as the best up to `alike` times the lowest loss above
        it.
        """
        limit = race.lowest_loss * (1 + alike)
        trials = sorted((trial for trial in race.kept if race.lowest_loss < trial[0]), key=lambda trial: trial[0])
        losses = np.array([race.lowest_loss, *(loss for loss, _ in trials)])
        places = np.array([race.best_place, *(place for _, place in trials)])
        return cls(parameters, losses, space.values(places), _distant_trials(places[losses <= limit]), limit)

    def spread(self, study: int) -> dict[str, list[float]]:
        """Values of each parameter of the study with this index, one for each of the `sets`: the table [spread]."""
        return {
            parameter.key: self.values[self.sets, k].tolist()
            for k, parameter in enumerate(self.parameters)
            if study in parameter.study_indices
        }

    def interval(self, k: int) -> tuple[float, float]:
        """Least and greatest value of parameter k in the trials that fit as well as the best."""
        values = self.values[self.losses <= self.limit, k]
        return float(values.min()), float(values.max())


def _distant_trials(places: FloatArray) -> list[int]:
    """Indices of trials that lie as far apart as possible, from the first trial on (farthest-point sampling)."""
    indices = [0]
    distances = np.linalg.norm(places - places[0], axis=1)
    while len(indices) < min(MAX_SETS, len(places)) and distances.max() > 0:
        indices.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(places - places[indices[-1]], axis=1))
    return indices


def plot_profiles(path: Path, profiles: Profiles, studies: Sequence[Study]) -> None:
    """Draw the loss over each parameter: a dot for each trial, in colour if it fits as well as the best, and a band for
    the interval.

    Raises
    ------
    InputError
        If the file cannot be written or its ending names no picture format.
    """
    names = [study.name for study in studies]
    title = f"Loss of {' and '.join(names)} over each parameter; band: fits as well as the best"
    figure, axes = new_panels(title, len(profiles.parameters), 4, (2.75, 1.7), 11.0, 0.6)
    for axis in axes[1:]:
        axis.sharey(axes[0])
    is_as_good = profiles.losses <= profiles.limit
    for k, (axis, parameter) in enumerate(zip(axes, profiles.parameters, strict=True)):
        values = profiles.values[:, k]
        axis.axvspan(*profiles.interval(k), color=BLUE, alpha=0.12, linewidth=0)
        axis.scatter(values, profiles.losses, s=4, alpha=0.5, c=np.where(is_as_good, BLUE, GREY), linewidths=0)
        axis.axvline(values[0], color="black", linewidth=0.8, linestyle="--")
        key = parameter.key.replace("vehicle.parameters.", "").replace("ads.parameters.", "")
        owners = [] if len(parameter.study_indices) == len(names) else [names[i] for i in parameter.study_indices]
        axis.set(
            xlabel=f"{', '.join(owners)}: " * bool(owners) + key + unit_text(parameter.bounds.unit, " [{}]"),
            ylabel="loss",
        )
    save(figure, path, "plot")
