"""RQ3: how many, which and how large changes make the vehicle unsafe? Over NSGA-II's critical solutions."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.case import NSGA2, Case, Unanswerable, collided
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import SAFETY_DEGREE

ANY = "any"


def critical(case: Case) -> pd.DataFrame:
    """NSGA-II's solutions with a safety degree below the original's.

    Raises
    ------
    Unanswerable
        If NSGA-II is missing or the original's safety degree is not known.
    """
    solutions = case.solutions_of(NSGA2)
    if np.isnan(case.original[SAFETY_DEGREE]):
        raise Unanswerable(case.name, "does not tell the original vehicle's safety degree", "results that do")
    return solutions[solutions[SAFETY_DEGREE] < case.original[SAFETY_DEGREE]]


def changes(case: Case, solutions: pd.DataFrame) -> FloatArray:
    """v'' - v of every characteristic in its unit, shape (M, n)."""
    return np.asarray(solutions[list(case.characteristics.names)].to_numpy(dtype=float) - case.characteristics.original)


def by_number(case: Case, changed: FloatArray) -> dict[str, BoolArray]:
    """Which solutions have j characteristics changed, for j = "1".."n" and "any"."""
    number = np.count_nonzero(changed, axis=1)
    return {**{str(j): number == j for j in range(1, len(case.characteristics) + 1)}, ANY: np.ones(len(changed), dtype=bool)}


def rq31(case: Case) -> pd.DataFrame:
    """How many critical solutions of each run have exactly j characteristics changed; columns setting, run, j, count.

    Raises
    ------
    Unanswerable
        As `critical`, or if the solutions belong to no run.
    """
    found = critical(case)
    runs = case.runs_of(NSGA2)
    number = np.count_nonzero(changes(case, found), axis=1)
    of_run = found["run"].to_numpy()
    rows = [(case.name, run, str(j), int(np.count_nonzero((of_run == run) & (number == j))))
            for run in runs for j in range(1, len(case.characteristics) + 1)]
    return pd.DataFrame(rows, columns=["setting", "run", "j", "count"])


def rq32(case: Case) -> pd.DataFrame:
    """In which share of the critical solutions with j changed each characteristic is changed.

    Columns setting, characteristic, j ("1".."n", "any"), percent (None without such a solution), rank (by `any`, of
    j = "any" alone; ties share the better rank and the next one is skipped).

    Raises
    ------
    Unanswerable
        As `critical`.
    """
    changed = changes(case, critical(case))
    times = np.count_nonzero(changed, axis=0)
    rows = []
    for i, member in enumerate(case.characteristics):
        for j, chosen in by_number(case, changed).items():
            percent = 100 * float(np.mean(changed[chosen, i] != 0)) if chosen.any() else None
            rank = 1 + int(np.count_nonzero(times > times[i])) if j == ANY and len(changed) else None
            rows.append((case.name, member.name, j, percent, rank))
    return pd.DataFrame(rows, columns=["setting", "characteristic", "j", "percent", "rank"], dtype=object)


def rq33(case: Case) -> pd.DataFrame:
    """How large the changes are, increases and decreases apart, in the critical solutions with j changed.

    Columns setting, characteristic, direction, j ("1".."n", "any"), pc (mean of |v - v''| / v, a fraction), delta (mean
    signed change in the characteristic's unit), n (over how many changes); pc and delta are None where n is 0.

    Raises
    ------
    Unanswerable
        As `critical`.
    """
    changed = changes(case, critical(case))
    rows = []
    for i, member in enumerate(case.characteristics):
        for direction, sign in (("increase", 1), ("decrease", -1)):
            for j, chosen in by_number(case, changed).items():
                delta = changed[chosen, i]
                delta = delta[np.sign(delta) == sign]
                mean = float(np.mean(delta)) if delta.size else None
                pc = None if mean is None else abs(mean / member.original)
                rows.append((case.name, member.name, direction, j, pc, mean, delta.size))
    return pd.DataFrame(rows, columns=["setting", "characteristic", "direction", "j", "pc", "delta", "n"], dtype=object)


def rq33_safety(case: Case) -> pd.DataFrame:
    """What the critical solutions with j changed did to safety: the footer of RQ3.3's table.

    Columns setting, quantity, j, value, percent (of the original's value), n; value is None where n is 0. Quantities:
    avgSD_mD, mean reduction of the distance, without collisions [m]; avgSD_cS, mean speed of the collisions [m/s], no
    percent; TET [s] and TIT [s^2], mean increase, without collisions; aveDece, mean decrease, over all [m/s^2].

    Raises
    ------
    Unanswerable
        As `critical`.
    """
    found = critical(case)
    crash = collided(found).to_numpy()
    sd, tet, tit, dece = (found[name].to_numpy(dtype=float) for name in (SAFETY_DEGREE, "tet", "tit", "ave_dece"))
    original = case.original
    quantities = {
        "avgSD_mD": (np.where(crash, np.nan, original[SAFETY_DEGREE] - sd), original[SAFETY_DEGREE]),
        "avgSD_cS": (np.where(crash, -sd, np.nan), np.nan),
        "TET": (np.where(crash, np.nan, tet - original["tet"]), original["tet"]),
        "TIT": (np.where(crash, np.nan, tit - original["tit"]), original["tit"]),
        "aveDece": (original["ave_dece"] - dece, original["ave_dece"])}
    rows = []
    for quantity, (difference, whole) in quantities.items():
        for j, chosen in by_number(case, changes(case, found)).items():
            counted = difference[chosen & ~np.isnan(difference)]
            mean = float(np.mean(counted)) if counted.size else None
            percent = None if mean is None or np.isnan(whole) or whole == 0 else 100 * mean / abs(whole)
            rows.append((case.name, quantity, j, mean, percent, counted.size))
    return pd.DataFrame(rows, columns=["setting", "quantity", "j", "value", "percent", "n"], dtype=object)
