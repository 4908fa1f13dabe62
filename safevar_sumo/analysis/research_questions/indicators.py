"""Quality of a run's front (docs/method.md, section 7): IGD on the objectives in their units, IGD+ and hypervolume on normalised ones."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import moocore
import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import MetricFacts
from safevar_sumo.records import FloatArray

MORE_IS_BETTER = {"igd": False, "igd_plus": False, "hypervolume": True}
INDICATOR_TITLES = {"igd": "IGD", "igd_plus": "IGD+", "hypervolume": "HV"}
REFERENCE_COORDINATE = 1.1
"""Each coordinate of the hypervolume's reference point for objectives normalised to 0..1: a tenth beyond the nadir."""


def titles_of(metrics: Iterable[MetricFacts]) -> dict[str, str]:
    """Titles of metrics and quality indicators in tables, by name."""
    return {**INDICATOR_TITLES, **{metric.name: metric.title for metric in metrics}}


def nondominated_points(points: FloatArray) -> FloatArray:
    """The distinct non-dominated points for minimisation, with shape (points, objectives)."""
    return np.asarray(moocore.filter_dominated(_check_points(points, "the set of points")))


def igd(front: FloatArray, reference: FloatArray) -> float:
    """Mean Euclidean distance from each point of the reference front to the nearest point of `front`."""
    return float(moocore.igd(_check_points(front, "the front"), ref=_check_points(reference, "the reference front")))


def igd_plus(front: FloatArray, reference: FloatArray) -> float:
    """IGD with distances that count only the objectives in which `front` is worse."""
    return float(moocore.igd_plus(_check_points(front, "the front"), ref=_check_points(reference, "the reference front")))


def hypervolume(front: FloatArray) -> float:
    """The volume between `front` and the reference point."""
    points = _check_points(front, "the front")
    return float(moocore.hypervolume(points, ref=np.full(points.shape[1], REFERENCE_COORDINATE)))


class Scale(NamedTuple):
    """Normalises objectives: `ideal` becomes 0, `ideal + width`, the nadir, becomes 1."""

    ideal: FloatArray
    width: FloatArray

    @classmethod
    def of(cls, reference: FloatArray) -> Scale:
        """The scale from the best to the worst value of each objective in a reference front; the width is 1 if both are equal."""
        ideal, nadir = reference.min(axis=0), reference.max(axis=0)
        return cls(ideal, np.where(nadir > ideal, nadir - ideal, 1.0))

    def normalised(self, points: FloatArray) -> FloatArray:
        return np.asarray((points - self.ideal) / self.width)


def defined_minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The objectives' values, smaller being better, of the rows in which all of them are defined; shape (points, objectives)."""
    points = _minimised_values(case, frame)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The objectives' values, smaller being better; NaN where undefined."""
    signs = [objective.sign for objective in case.scoring.objectives]
    return np.asarray(frame[[objective.name for objective in case.scoring.objectives]].to_numpy(dtype=float) * signs)


def reference_front(case: Case) -> FloatArray:
    """The non-dominated union of the results of all runs of all algorithms.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    points = defined_minimised_values(case, case.solutions)
    if not len(points):
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    return nondominated_points(points)


def compute_indicators(case: Case) -> pd.DataFrame:
    """IGD, IGD+ and hypervolume of every finished run that has solutions; columns algorithm, run, igd, igd_plus and hypervolume.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    rows = []
    runs = [(algorithm, run) for algorithm in case.algorithms for run in case.runs_of(algorithm)]
    reference = reference_front(case)
    scale = Scale.of(reference)
    scaled_reference = scale.normalised(reference)
    by_run = dict(list(case.solutions.groupby(["algorithm", "run"])))
    for algorithm, run in runs:
        front = defined_minimised_values(case, by_run[algorithm, run]) if (algorithm, run) in by_run else np.zeros((0, 0))
        if len(front):
            scaled_front = scale.normalised(front)
            rows.append((algorithm, run, igd(front, reference), igd_plus(scaled_front, scaled_reference), hypervolume(scaled_front)))
    return pd.DataFrame(rows, columns=["algorithm", "run", *MORE_IS_BETTER])


CURVE_POINTS = 50
"""Maximum number of points of a run's curve."""


def compute_convergence(case: Case) -> pd.DataFrame:
    """The hypervolume of each run's settings after a number of evaluations; columns algorithm, run, evaluations, hypervolume.

    A run that ended early keeps its last hypervolume. The hypervolume is 0 as long as no setting dominates the reference point.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    runs = [(algorithm, run) for algorithm in case.algorithms for run in case.runs_of(algorithm)]
    scale = Scale.of(reference_front(case))
    budget = case.study.search.evaluations
    evaluation_counts = np.unique(np.linspace(min(case.study.search.population, budget), budget, CURVE_POINTS).astype(int))
    by_run = dict(list(case.evaluations.groupby(["algorithm", "run"])))
    frames = [pd.DataFrame({"algorithm": algorithm, "run": run, "evaluations": evaluation_counts,
                            "hypervolume": _hypervolumes_after(case, by_run[algorithm, run], scale, evaluation_counts)})
              for algorithm, run in runs if (algorithm, run) in by_run]
    if not frames:
        raise UnanswerableError(case.name, "has no evaluations", "results with the journals of their runs")
    return pd.concat(frames, ignore_index=True)


def _hypervolumes_after(case: Case, evaluations: pd.DataFrame, scale: Scale, evaluation_counts: np.ndarray) -> list[float]:
    """Hypervolume of the first k evaluations, for each count k."""
    scaled_points = scale.normalised(_minimised_values(case, evaluations))
    is_defined = np.isfinite(scaled_points).all(axis=1)
    scaled_points, evaluation_indices = scaled_points[is_defined], evaluations["evaluation"].to_numpy()[is_defined]
    ends = np.searchsorted(evaluation_indices, evaluation_counts, side="left")
    front, volumes = np.zeros((0, scaled_points.shape[1])), []
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        front = np.concatenate([front, scaled_points[start:end]])
        front = nondominated_points(front) if len(front) else front
        volumes.append(hypervolume(front) if len(front) else 0.0)
    return volumes


def _check_points(points: FloatArray, name: str) -> FloatArray:
    """Refuse empty sets and undefined points, for which indicators would return their best value."""
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or not array.size:
        raise InputError(name, "is empty or has not two dimensions", "at least one point, shape (points, objectives)")
    if not np.isfinite(array).all():
        raise InputError(name, "holds an undefined value", "points with finite objectives")
    return array
