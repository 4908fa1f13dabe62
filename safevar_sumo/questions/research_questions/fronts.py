"""Quality indicators of the fronts (non-dominated solutions) that runs return; see docs/method.md,
section 7. IGD+ and hypervolume use normalised objectives; IGD, as published, uses objectives in
their units. The module also finds the non-dominated ones of all evaluations, counts evaluations,
and follows the growth of the hypervolume.
"""

from __future__ import annotations

import math
from itertools import pairwise

import moocore
import numpy as np
import pandas as pd

from safevar_sumo.questions.case import Results, UnanswerableError
from safevar_sumo.records import FloatArray
from safevar_sumo.results import RunName

MORE_IS_BETTER = {"igd_plus": False, "hypervolume": True, "igd": False}
INDICATOR_TITLES = {"igd_plus": "IGD+", "hypervolume": "HV", "igd": "IGD"}
NO_FRONT = (math.inf, 0.0, math.inf)
"""IGD+, hypervolume and IGD of a run without solutions: no run with solutions has worse values."""
USUAL_SHARE = 0.9
"""An algorithm that simulates less than this share of its budget gets a remark."""
CURVE_POINTS = 50
"""Maximum number of points of the curve that shows a run's convergence."""


def nondominated_points(points: FloatArray) -> FloatArray:
    """The distinct non-dominated points for minimisation, with shape (points, objectives)."""
    return np.asarray(moocore.filter_dominated(points))


def hypervolume(front: FloatArray, coordinate: float) -> float:
    """The volume between `front`, shape (points, objectives), and the reference point, all of whose
    coordinates are `coordinate`.
    """
    return float(moocore.hypervolume(front, ref=np.full(front.shape[1], coordinate)))


def normalised(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Points on a scale on which, for each objective, the best value of a reference front is 0, and
    its worst value is 1.

    If all values of an objective in the reference front are equal, the objective keeps its unit.
    """
    ideal = reference.min(axis=0)
    nadir = reference.max(axis=0)
    return np.asarray((points - ideal) / np.where(nadir > ideal, nadir - ideal, 1.0))


def minimised_values(case: Results, frame: pd.DataFrame) -> FloatArray:
    """The values of the objectives, with such signs that smaller values are better, shape (rows,
    objectives); NaN for an undefined value.
    """
    signs = {item.name: item.sign for item in case.scoring.objectives}
    return frame[list(signs)].to_numpy(float) * list(signs.values())


def points_of(case: Results, frame: pd.DataFrame) -> FloatArray:
    """The `minimised_values` of those rows in which all objectives are defined."""
    points = minimised_values(case, frame)
    return points[np.isfinite(points).all(axis=1)]


def reference_front(case: Results) -> FloatArray:
    """The non-dominated points among the solutions of all runs of all algorithms.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    points = points_of(case, case.solutions)
    if not len(points):
        raise UnanswerableError(
            case.name, "has no solution", "results with at least one solution"
        )
    return nondominated_points(points)


def compute_indicators(case: Results) -> pd.DataFrame:
    """IGD+, hypervolume and IGD of every finished run. The index has algorithm and run, and each
    indicator is a column. A run without solutions has the values of `NO_FRONT`.

    IGD is the mean Euclidean distance from each point of the reference front to the run's nearest
    point, in the objectives' units; IGD+ counts only the objectives in which this point is worse,
    and is normalised.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    reference = reference_front(case)
    scaled_reference = normalised(reference, reference)
    coordinate = case.study.search.reference_point
    rows = {}
    for run, group in frames_of_runs(case, case.solutions):
        rows[run] = NO_FRONT
        if len(points := points_of(case, group)):
            scaled = normalised(points, reference)
            igd_plus = moocore.igd_plus(scaled, ref=scaled_reference)
            igd = moocore.igd(points, ref=reference)
            rows[run] = float(igd_plus), hypervolume(scaled, coordinate), float(igd)
    index = pd.MultiIndex.from_tuples(rows, names=["algorithm", "run"])
    return pd.DataFrame(rows.values(), index, list(MORE_IS_BETTER))


def frames_of_runs(
    case: Results, frame: pd.DataFrame
) -> list[tuple[RunName, pd.DataFrame]]:
    """Each finished run with its rows of `frame`, in the study's order of algorithms. Raises
    UnanswerableError if no finished run has rows.
    """
    groups = dict(list(frame.groupby(["algorithm", "run"])))
    runs = [
        (algorithm, run)
        for algorithm in case.algorithms
        for run in case.runs_of(algorithm)
    ]
    if not runs:
        # The error of this call says that no run is finished.
        case.require_solutions()
    if not groups.keys() & set(runs):
        raise UnanswerableError(
            case.name, "has no evaluations", "results with the journals of their runs"
        )
    return [(run, groups.get(run, frame[:0])) for run in runs]


def valid_evaluations(case: Results, frame: pd.DataFrame) -> pd.DataFrame:
    """The rows of `frame` that a search may return: all objectives are defined, and the original
    vehicle is safe in the same encounter.
    """
    is_defined = np.isfinite(minimised_values(case, frame)).all(axis=1)
    return frame[is_defined & case.scoring.feasible_rows(frame)]


def nondominated_evaluations(case: Results) -> pd.DataFrame:
    """The evaluations of each finished run that no other evaluation of the run dominates. Random
    search returns exactly these.

    Raises
    ------
    UnanswerableError
        If there are no evaluations.
    """
    fronts = [case.evaluations[:0]]
    for _, evaluations in frames_of_runs(case, case.evaluations):
        rows = valid_evaluations(case, evaluations)
        if len(rows):
            points = minimised_values(case, rows)
            fronts.append(rows[moocore.is_nondominated(points, keep_weakly=True)])
    return pd.concat(fronts, ignore_index=True)


def describe_rules(case: Results) -> str:
    """A sentence that names the algorithms whose solutions are not exactly the
    `nondominated_evaluations`; "" if there are none, or if the evaluations are unknown.
    """
    if case.evaluations.empty:
        return ""

    columns = ["algorithm", "run", *case.characteristics.names]
    fronts = nondominated_evaluations(case)
    joined = case.solutions[columns].merge(fronts[columns], "outer", indicator=True)
    algorithms = joined.loc[joined["_merge"] != "both", "algorithm"].unique()
    if not len(algorithms):
        return ""
    return (
        "the algorithms choose their solutions by different rules, so means over solutions depend"
        f" on the rule. The solutions of {', '.join(map(case.title_of, algorithms))} are not all"
        " non-dominated vehicles of a run. The table rq2-common applies one rule to all."
    )


def count_evaluations(case: Results) -> pd.DataFrame:
    """The numbers of evaluations of every finished run. The columns are algorithm, run, requested,
    simulated and budget.

    Equal settings are simulated once, so `simulated` counts different settings. A run has requested
    its whole budget if a new setting is in its last generation; else it ended with its last new
    setting.

    Raises
    ------
    UnanswerableError
        If there are no runs.
    """
    search = case.study.search
    rows = []
    for (algorithm, run), group in frames_of_runs(case, case.evaluations):
        requested = group["evaluation"].max() + 1
        if requested > search.evaluations - search.population:
            requested = search.evaluations
        rows.append((algorithm, run, requested, len(group), search.evaluations))
    return pd.DataFrame(
        rows, columns=["algorithm", "run", "requested", "simulated", "budget"]
    )


def describe_evaluations(case: Results, counts: pd.DataFrame) -> str:
    """A phrase that states, for each algorithm, how many settings a run simulates on average, and
    why these are fewer than the budget. `counts` are rows of `count_evaluations`.
    """
    texts = []
    for algorithm, rows in counts.groupby("algorithm", sort=False):
        requested, simulated, budget = (
            rows[["requested", "simulated", "budget"]].mean().round()
        )
        text = f"{case.title_of(str(algorithm))} {simulated:,.0f} of {budget:,.0f}"
        reasons = []
        if requested < budget and algorithm in case.stop_by_themselves:
            reasons.append("it stops by its own rule")
        elif requested < budget:
            reasons.append("it ended early")
        if simulated < requested:
            reasons.append("equal vehicles are simulated once")
        if reasons:
            text += f" ({' and '.join(reasons)})"
        texts.append(text)
    return "; ".join(texts)


def why_few_evaluations(case: Results) -> str:
    """A remark on algorithms whose runs simulate less than `USUAL_SHARE` of their budget; "" if
    there are none. Algorithms that declare that they stop by themselves are not named.
    """
    if not case.has_runs or case.evaluations.empty or not case.finished:
        return ""
    counts = count_evaluations(case)
    algorithms = counts["algorithm"]
    sums = counts.groupby(algorithms)[["simulated", "budget"]].transform("sum")
    is_few = sums["simulated"] < USUAL_SHARE * sums["budget"]
    is_few &= ~algorithms.isin(list(case.stop_by_themselves))
    if not is_few.any():
        return ""
    texts = describe_evaluations(case, counts[is_few])
    return (
        f"The runs of {case.name} use less than {USUAL_SHARE:.0%} of the simulations that they may"
        f" use: {texts}. Check the options of the study."
    )


def compute_convergence(case: Results) -> pd.DataFrame:
    """The hypervolume of all settings that each run has simulated after several numbers of
    evaluations (different settings). The columns are algorithm, run, evaluations and hypervolume.

    Objectives are normalised as in `compute_indicators`. The numbers end with the longest run of
    the algorithm. The hypervolume is 0 as long as no evaluation dominates the reference point.

    Raises
    ------
    UnanswerableError
        If there are no evaluations or no solutions.
    """
    # All runs have the same numbers of evaluations, so that their medians can be computed.
    reference = reference_front(case)
    frames = []
    counts = np.linspace(0, case.study.search.evaluations, CURVE_POINTS + 1, dtype=int)
    ends = count_evaluations(case).groupby("algorithm")["simulated"].max()
    for (algorithm, run), group in frames_of_runs(case, case.evaluations):
        # The front so far and the new points are enough: a dominated point stays dominated.
        valid = valid_evaluations(case, group.assign(number=range(len(group))))
        points = normalised(minimised_values(case, valid), reference)
        numbers = valid["number"].to_numpy()
        counts_of_run = np.unique(np.minimum(counts, ends[algorithm]))
        front = points[:0]
        volumes = []
        for start, end in pairwise(counts_of_run):
            new_points = points[(start <= numbers) & (numbers < end)]
            front = nondominated_points(np.concatenate([front, new_points]))
            volumes.append(hypervolume(front, case.study.search.reference_point))
        columns = {
            "algorithm": algorithm,
            "run": run,
            "evaluations": counts_of_run[1:],
            "hypervolume": volumes,
        }
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def summarise_convergence(case: Results) -> pd.DataFrame:
    """The median and the quartiles of `compute_convergence` over the runs. The columns are
    algorithm, evaluations, hypervolume (the median), low and high (the quartiles).
    """
    growth = compute_convergence(case)
    volumes = growth.groupby(["algorithm", "evaluations"], sort=False)["hypervolume"]
    shares = {"hypervolume": 0.5, "low": 0.25, "high": 0.75}
    quartiles = {name: volumes.quantile(share) for name, share in shares.items()}
    return pd.DataFrame(quartiles).reset_index()
