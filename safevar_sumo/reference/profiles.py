"""Uncertainty of fitted parameters: profiles of the loss over a search's trials, and sets of values that fit as well as the best."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.analysis.figures import save
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.parameters import Free
from safevar_sumo.reference.search import TrialSearch
from safevar_sumo.study import Study

SETS = 20
"""Maximum number of sets of values in a spread, including the best."""
DIGITS = 6
"""Significant digits of a spread's values."""


class ParameterSpace(Protocol):
    """Maps shares of the bounds, each in [0, 1], to values."""

    def values(self, shares: FloatArray) -> FloatArray: ...


class Profiles(NamedTuple):
    """Trials of a fit.

    Attributes
    ----------
    free
        The parameters.
    losses, values
        Losses of the trials near the lowest loss, shape (K,), and their values, shape (K, parameters); the best first.
    sets
        Rows of up to `SETS` trials that fit as well as the best and are as far apart as possible; the best first.
    limit
        The loss up to which a trial fits as well as the best.
    """

    free: Sequence[Free]
    losses: FloatArray
    values: FloatArray
    sets: list[int]
    limit: float

    @classmethod
    def of(cls, free: Sequence[Free], bounds: ParameterSpace, search: TrialSearch, best: FloatArray) -> Profiles:
        """The profiles of a finished search, whose best trial lies at `best`."""
        limit = search.loss * (1 + search.alike)
        near = sorted((one for one in search.kept if search.loss < one[0]), key=lambda one: one[0])
        losses = np.array([search.loss, *(loss for loss, _ in near)])
        shares = np.array([best, *(share for _, share in near)])
        return cls(free, losses, bounds.values(shares), _apart(shares[losses <= limit]), limit)

    def spread(self, study: int) -> dict[str, list[float]]:
        """The sets that fit as well as the best, in the form of a study's table [spread]."""
        return {free.key: [float(f"{value:.{DIGITS}g}") for value in self.values[self.sets, k]]
                for k, free in enumerate(self.free) if study in free.studies}

    def interval(self, k: int) -> tuple[float, float]:
        """Least and greatest value of a parameter among all trials that fit as well as the best."""
        values = self.values[self.losses <= self.limit, k]
        return float(values.min()), float(values.max())


def _apart(shares: FloatArray) -> list[int]:
    """Rows that are as far apart as possible, beginning with the first (farthest-point sampling)."""
    chosen = [0]
    nearest = np.linalg.norm(shares - shares[0], axis=1)
    while len(chosen) < min(SETS, len(shares)) and nearest.max() > 0:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(shares - shares[chosen[-1]], axis=1))
    return chosen


def plot_profiles(path: Path, profiles: Profiles, studies: Sequence[Study]) -> None:
    """Draw the loss against every parameter: each trial a dot, those that fit as well as the best in colour, the interval a band.

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
    rows = -(-len(profiles.free) // columns)
    with sns.axes_style("whitegrid"), plt.rc_context({"font.size": 9}):
        figure, axes = plt.subplots(rows, columns, figsize=(11, 1.7 * rows + 0.6), layout="constrained", squeeze=False, sharey=True)
        fits = profiles.losses <= profiles.limit
        for k, axis in enumerate(axes.flat):
            if k >= len(profiles.free):
                axis.set_axis_off()
                continue
            free, values = profiles.free[k], profiles.values[:, k]
            axis.axvspan(*profiles.interval(k), color="#0072b2", alpha=0.12, linewidth=0)
            axis.scatter(values[~fits], profiles.losses[~fits], s=3, alpha=0.25, color="#808080", linewidths=0)
            axis.scatter(values[fits], profiles.losses[fits], s=5, alpha=0.6, color="#0072b2", linewidths=0)
            axis.axvline(values[0], color="black", linewidth=0.8, linestyle="--")
            key = free.label(studies).replace("vehicle.parameters.", "").replace("ads.parameters.", "")
            axis.set_xlabel(key + ("" if free.bounds.unit == "-" else f" [{free.bounds.unit}]"))
            if k % columns == 0:
                axis.set_ylabel("loss")
        figure.suptitle(f"Loss of {' and '.join(study.name for study in studies)} over each parameter; band: fits as well as the best")
        save(figure, path, "plot")
        plt.close(figure)
