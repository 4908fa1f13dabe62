"""The quality of the fronts that runs return (docs/method.md, section 7): IGD+ and hypervolume on normalised
objectives, and its growth with the evaluations; IGD, as published, on objectives in their units; and the number of
evaluations.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import moocore
import numpy as np
import pandas as pd

from safevar_sumo.questions.case import Case, UnanswerableError
from safevar_sumo.records import FloatArray

MORE_IS_BETTER = {"igd_plus": False, "hypervolume": True, "igd": False}
INDICATOR_TITLES = {"igd_plus": "IGD+", "hypervolume": "HV", "igd": "IGD"}
REFERENCE_COORDINATE = 1.1
"""Each coordinate of the hypervolume's reference point for objectives normalised to 0..1: a tenth beyond the nadir."""
USUAL_SHARE = 0.9
"""Share of its budget from which on nobody asks why an algorithm simulates less."""
CURVE_POINTS = 50
"""Maximum number of points of a run's convergence."""


def nondominated_points(points: FloatArray) -> FloatArray:
    """The distinct non-dominated points for minimisation, with shape (points, objectives)."""
    return np.asarray(moocore.filter_dominated(points))


def hypervolume(front: FloatArray) -> float:
    """The volume between `front` and the reference point."""
    return float(moocore.hypervolume(front, ref=np.full(front.shape[1], REFERENCE_COORDINATE)))


def normalised(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Points on the scale from the best (0) to the worst value (1) of each objective in a reference front.

    Where the best value is also the worst, an objective keeps its unit.
    """
    ideal = reference.min(axis=0)
    nadir = reference.max(axis=0)
    return np.asarray((points - ideal) / np.where(nadir > ideal, nadir - ideal, 1.0))


def minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The objectives' values, smaller being better, shape (rows, objectives); NaN where undefined."""
    signs = [objective.sign for objective in case.scoring.objectives]
    return frame[[objective.name for objective in case.scoring.objectives]].to_numpy(dtype=float) * signs


def points_of(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The `minimised_values` of those rows in which all objectives are defined."""
    points = minimised_values(case, frame)
    return points[np.isfinite(points).all(axis=1)]


def reference_front(case: Case) -> FloatArray:
    """The non-dominated union of the results of all runs of all algorithms.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    points = points_of(case, case.solutions)
    if not len(points):
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    return nondominated_points(points)


def compute_indicators(case: Case) -> pd.DataFrame:
    """IGD+, hypervolume and IGD of every finished run that has solutions; index algorithm and run, a column for each
    indicator.

    IGD is the mean Euclidean distance from each point of the reference front to the run's nearest point, in the
    objectives' units; IGD+ counts only the objectives in which this point is worse, and is normalised.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    reference = reference_front(case)
    scaled_reference = normalised(reference, reference)
    rows = {}
    for run, group in _frames_of_runs(case, case.solutions):
        if len(points := points_of(case, group)):
            scaled = normalised(points, reference)
            igd_plus = moocore.igd_plus(scaled, ref=scaled_reference)
            igd = moocore.igd(points, ref=reference)
            rows[run] = float(igd_plus), hypervolume(scaled), float(igd)
    index = pd.MultiIndex.from_tuples(rows, names=["algorithm", "run"])
    return pd.DataFrame(rows.values(), index, list(MORE_IS_BETTER))


def _frames_of_runs(case: Case, frame: pd.DataFrame) -> Iterator[tuple[tuple[str, int], pd.DataFrame]]:
    """The finished runs that have rows, each with its rows, in the study's order of algorithms."""
    groups = dict(list(frame.groupby(["algorithm", "run"])))
    runs = [(algorithm, run) for algorithm in case.algorithms for run in case.runs_of(algorithm)]
    yield from ((run, groups[run]) for run in runs if run in groups)


def count_evaluations(case: Case) -> pd.DataFrame:
    """The evaluations of every finished run; columns algorithm, run, requested, simulated, budget.

    Equal settings are simulated once, so `simulated` counts different settings. A run has requested its whole budget if
    a new setting is in its last generation; else it ended with its last new setting.

    Raises
    ------
    UnanswerableError
        If there are no runs.
    """
    search = case.study.search
    rows = []
    for (algorithm, run), group in _frames_of_runs(case, case.evaluations):
        last = int(group["evaluation"].max()) + 1
        requested = search.evaluations if last > search.evaluations - search.population else last
        rows.append((algorithm, run, requested, len(group), search.evaluations))
    if not rows:
        raise UnanswerableError(case.name, "has no evaluations", "results with the journals of their runs")
    return pd.DataFrame(rows, columns=["algorithm", "run", "requested", "simulated", "budget"])


def describe_evaluations(case: Case, counts: pd.DataFrame) -> str:
    """How many settings a run of each algorithm simulates, the mean of `count_evaluations`, and why fewer than the
    budget.
    """
    texts = []
    for algorithm, rows in counts.groupby("algorithm", sort=False):
        requested, simulated, budget = rows[["requested", "simulated", "budget"]].mean().round()
        end = "it stops by its own rule" if algorithm in case.stop_by_themselves else "it ended early"
        reasons = [end] if requested < budget else []
        reasons += ["equal settings are simulated once"] if simulated < requested else []
        words = f" ({' and '.join(reasons)})" if reasons else ""
        texts.append(f"{case.title_of(str(algorithm))} {simulated:,.0f} of {budget:,.0f}{words}")
    return "; ".join(texts)


def few_evaluations(case: Case) -> str:
    """A remark on algorithms whose runs simulate less than `USUAL_SHARE` of their budget, without those that say that
    they stop by themselves; "" without any.
    """
    if not case.has_runs or case.evaluations.empty or not case.finished_runs:
        return ""
    counts = count_evaluations(case)
    sums = counts.groupby("algorithm", sort=False)[["simulated", "budget"]].transform("sum")
    is_few = (sums["simulated"] < USUAL_SHARE * sums["budget"]) & ~counts["algorithm"].isin([*case.stop_by_themselves])
    if not is_few.any():
        return ""
    share = f"{USUAL_SHARE:.0%}"
    texts = describe_evaluations(case, counts[is_few])
    return f"{case.name}: less than {share} of a run's evaluations are simulated: {texts}. Are the options as meant?"


def compute_convergence(case: Case) -> pd.DataFrame:
    """The hypervolume of each run's solutions, of those found after a number of evaluations; columns algorithm, run,
    evaluations, hypervolume.

    The numbers end with the longest run of the algorithm, and with the hypervolume of `compute_indicators`. It is 0 as
    long as no solution dominates the reference point.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    reference = reference_front(case)
    search = case.study.search
    frames = []
    counts = np.linspace(min(search.population, search.evaluations), search.evaluations, CURVE_POINTS, dtype=int)
    ends = count_evaluations(case).groupby("algorithm")["requested"].max()
    names = list(case.characteristics.names)
    returned = {run: _settings_of(rows, names) for run, rows in _frames_of_runs(case, case.solutions)}
    for (algorithm, run), group in _frames_of_runs(case, case.evaluations):
        solutions = {*returned.get((algorithm, run), ())}
        is_solution = np.array([setting in solutions for setting in _settings_of(group, names)])
        points = normalised(minimised_values(case, group), reference)
        is_defined = np.isfinite(points).all(axis=1) & is_solution & case.scoring.feasible_rows(group)
        numbers = group["evaluation"].to_numpy()
        counts_of_run = np.unique(np.minimum(counts, ends[algorithm]))
        front = points[:0]
        volumes = []
        for start, end in pairwise([0, *counts_of_run]):
            new_points = points[is_defined & (start <= numbers) & (numbers < end)]
            front = nondominated_points(np.concatenate([front, new_points]))
            volumes.append(hypervolume(front))
        columns = {"algorithm": algorithm, "run": run, "evaluations": counts_of_run, "hypervolume": volumes}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def _settings_of(frame: pd.DataFrame, names: list[str]) -> list[bytes]:
    """The settings in a frame, as bytes that are equal where they are."""
    return [row.tobytes() for row in frame[names].to_numpy(dtype=float)]
