"""Quality of a run's front (docs/method.md, section 7): IGD on the objectives in their units, IGD+ and hypervolume on
normalised ones.
"""

from __future__ import annotations

import moocore
import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray

MORE_IS_BETTER = {"igd": False, "igd_plus": False, "hypervolume": True}
INDICATOR_TITLES = {"igd": "IGD", "igd_plus": "IGD+", "hypervolume": "HV"}
REFERENCE_COORDINATE = 1.1
"""Each coordinate of the hypervolume's reference point for objectives normalised to 0..1: a tenth beyond the nadir."""
SURFACE_PERCENTAGES = (50.0, 100.0)
"""An attainment surface is computed for each of these percentages of the runs, and for the percentage that one run is
(the best of all)."""
CURVE_POINTS = 50
"""Maximum number of points of a run's curve."""


def _check_points(points: FloatArray) -> FloatArray:
    """Refuse empty sets and undefined points, for which indicators would return their best value."""
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or not array.size or not np.isfinite(array).all():
        raise InputError(
            "a set of points", "is empty or holds an undefined value", "at least one point, shape (points, objectives)"
        )
    return array


def nondominated_points(points: FloatArray) -> FloatArray:
    """The distinct non-dominated points for minimisation, with shape (points, objectives)."""
    return np.asarray(moocore.filter_dominated(_check_points(points)))


def igd(front: FloatArray, reference: FloatArray) -> float:
    """Mean Euclidean distance from each point of the reference front to the nearest point of `front`."""
    return float(moocore.igd(_check_points(front), ref=_check_points(reference)))


def igd_plus(front: FloatArray, reference: FloatArray) -> float:
    """IGD with distances that count only the objectives in which `front` is worse."""
    return float(moocore.igd_plus(_check_points(front), ref=_check_points(reference)))


def hypervolume(front: FloatArray) -> float:
    """The volume between `front` and the reference point."""
    points = _check_points(front)
    return float(moocore.hypervolume(points, ref=np.full(points.shape[1], REFERENCE_COORDINATE)))


def normalised(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Points on the scale from the best (0) to the worst value (1) of each objective in a reference front.

    The scale's width is 1 if both are equal.
    """
    ideal, nadir = reference.min(axis=0), reference.max(axis=0)
    return np.asarray((points - ideal) / np.where(nadir > ideal, nadir - ideal, 1.0))


def minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The objectives' values, smaller being better, shape (rows, objectives); NaN where undefined."""
    signs = [objective.sign for objective in case.scoring.objectives]
    return frame[[objective.name for objective in case.scoring.objectives]].to_numpy(dtype=float) * signs


def defined_minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The `minimised_values` of the rows in which all objectives are defined."""
    points = minimised_values(case, frame)
    return points[np.isfinite(points).all(axis=1)]


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
    """IGD, IGD+ and hypervolume of every finished run that has solutions; index algorithm and run, a column for each
    indicator.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    runs = [(algorithm, run) for algorithm in case.algorithms for run in case.runs_of(algorithm)]
    reference = reference_front(case)
    fronts = {key: defined_minimised_values(case, group) for key, group in case.solutions.groupby(["algorithm", "run"])}
    rows = {}
    for run in (run for run in runs if len(fronts.get(run, ()))):
        scaled_front, scaled_reference = (normalised(points, reference) for points in (fronts[run], reference))
        rows[run] = igd(fronts[run], reference), igd_plus(scaled_front, scaled_reference), hypervolume(scaled_front)
    index = pd.MultiIndex.from_tuples(rows, names=["algorithm", "run"])
    return pd.DataFrame(rows.values(), index, list(MORE_IS_BETTER))


def compute_convergence(case: Case) -> pd.DataFrame:
    """The hypervolume of each run's settings after a number of evaluations; columns algorithm, run, evaluations,
    hypervolume.

    A run that ended early keeps its last hypervolume. The hypervolume is 0 as long as no setting dominates the
    reference point.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    runs = [(algorithm, run) for algorithm in case.algorithms for run in case.runs_of(algorithm)]
    reference, budget = reference_front(case), case.study.search.evaluations
    evaluation_counts = np.unique(
        np.linspace(min(case.study.search.population, budget), budget, CURVE_POINTS).astype(int)
    )
    by_run = dict(list(case.evaluations.groupby(["algorithm", "run"])))
    frames = []
    for algorithm, run in (run for run in runs if run in by_run):
        points = normalised(minimised_values(case, by_run[algorithm, run]), reference)
        is_defined = np.isfinite(points).all(axis=1)
        points = points[is_defined]
        ends = np.searchsorted(by_run[algorithm, run]["evaluation"].to_numpy()[is_defined], evaluation_counts)
        front, volumes = points[:0], []
        for new_points in np.split(points, ends)[:-1]:
            front = np.concatenate([front, new_points])
            front = nondominated_points(front) if len(front) else front
            volumes.append(hypervolume(front) if len(front) else 0.0)
        frames.append(
            pd.DataFrame({"algorithm": algorithm, "run": run, "evaluations": evaluation_counts, "hypervolume": volumes})
        )
    if not frames:
        raise UnanswerableError(case.name, "has no evaluations", "results with the journals of their runs")
    return pd.concat(frames, ignore_index=True)


def compute_attainment(case: Case) -> dict[str, dict[float, FloatArray]]:
    """Empirical attainment surfaces of the first two objectives, by algorithm and percentage of its runs.

    A surface is K points, shape (K, 2), in the objectives' units, sorted by the first objective. For each of its
    points, that percentage of the runs found a setting at least as good (Fonseca, Guerreiro, Lopez-Ibanez, Paquete
    2011).

    Raises
    ------
    UnanswerableError
        If there are no runs with solutions.
    """
    surfaces: dict[str, dict[float, FloatArray]] = {}
    signs = np.array([objective.sign for objective in case.scoring.objectives[:2]])
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        fronts = [
            defined_minimised_values(case, solutions[solutions["run"] == run])[:, :2] for run in case.runs_of(algorithm)
        ]
        fronts = [front for front in fronts if len(front)]
        if fronts:
            run_indices = np.repeat(np.arange(len(fronts)), [len(front) for front in fronts])
            percentages = sorted({100 / len(fronts), *SURFACE_PERCENTAGES})
            points = moocore.eaf(np.concatenate(fronts), run_indices, percentiles=percentages)
            surfaces[algorithm] = {
                percentage: (minimised := points[points[:, 2] == percentage, :2])[
                    np.argsort(minimised[:, 0], kind="stable")
                ]
                * signs
                for percentage in np.unique(points[:, 2]).tolist()
            }
    if not surfaces:
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    return surfaces
