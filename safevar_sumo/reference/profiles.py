"""Uncertainty of fitted parameters: the losses of trials by parameter, and sets of values that fit as well as the best."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.analysis.figures import save
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.parameters import FittedParameter
from safevar_sumo.reference.search import SearchRace
from safevar_sumo.study import Study, unit_text

MAX_SETS = 20
"""Maximum number of parameter sets in a table [spread], including the best set."""


class ParameterSpace(Protocol):
    """Maps places in the unit cube of the parameters' bounds to values."""

    def values(self, places: FloatArray) -> FloatArray: ...


class Profiles(NamedTuple):
    """Trials of a fit whose loss is near the lowest loss.

    Attributes
    ----------
    parameters
        The fitted parameters.
    losses, values
        Losses of the K trials, shape (K,), and their parameter values, shape (K, parameters). The best trial comes first.
    sets
        Indices of up to `MAX_SETS` trials that fit as well as the best and lie as far apart as possible. The best trial comes first.
    limit
        The loss up to which a trial fits as well as the best.
    """

    parameters: Sequence[FittedParameter]
    losses: FloatArray
    values: FloatArray
    sets: list[int]
    limit: float

    @classmethod
    def of(cls, parameters: Sequence[FittedParameter], space: ParameterSpace, race: SearchRace, best_place: FloatArray) -> Profiles:
        """The profiles of a finished race whose best trial was at `best_place`."""
        limit = race.lowest_loss * (1 + race.alike)
        trials = sorted((trial for trial in race.kept if race.lowest_loss < trial.loss), key=lambda trial: trial.loss)
        losses = np.array([race.lowest_loss, *(trial.loss for trial in trials)])
        places = np.array([best_place, *(trial.place for trial in trials)])
        return cls(parameters, losses, space.values(places), _distant_trials(places[losses <= limit]), limit)

    def spread(self, study: int) -> dict[str, list[float]]:
        """Values of each parameter of the study with this index, one for each of the `sets`: the table [spread]."""
        return {parameter.key: self.values[self.sets, k].tolist()
                for k, parameter in enumerate(self.parameters) if study in parameter.study_indices}

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
    """Draw the loss over each parameter: a dot for each trial, in colour if it fits as well as the best, and a band for the interval.

    Raises
    ------
    InputError
        If the file cannot be written or its ending names no picture format.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import seaborn as sns

    columns = 4
    rows = -(-len(profiles.parameters) // columns)
    with sns.axes_style("whitegrid"), plt.rc_context({"font.size": 9}):
        figure, axes = plt.subplots(rows, columns, figsize=(11, 1.7 * rows + 0.6), layout="constrained", squeeze=False, sharey=True)
        is_as_good = profiles.losses <= profiles.limit
        for k, axis in enumerate(axes.flat):
            if k >= len(profiles.parameters):
                axis.set_axis_off()
                continue
            parameter, values = profiles.parameters[k], profiles.values[:, k]
            axis.axvspan(*profiles.interval(k), color="#0072b2", alpha=0.12, linewidth=0)
            axis.scatter(values[~is_as_good], profiles.losses[~is_as_good], s=3, alpha=0.25, color="#808080", linewidths=0)
            axis.scatter(values[is_as_good], profiles.losses[is_as_good], s=5, alpha=0.6, color="#0072b2", linewidths=0)
            axis.axvline(values[0], color="black", linewidth=0.8, linestyle="--")
            key = parameter.label(studies).replace("vehicle.parameters.", "").replace("ads.parameters.", "")
            axis.set_xlabel(key + unit_text(parameter.bounds.unit, " [{}]"))
            if k % columns == 0:
                axis.set_ylabel("loss")
        figure.suptitle(f"Loss of {' and '.join(study.name for study in studies)} over each parameter; band: fits as well as the best")
        save(figure, path, "plot")
        plt.close(figure)
