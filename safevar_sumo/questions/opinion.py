"""Does another vehicle model confirm the failures? Minimal causes of failures are simulated in our model, A, and with
CommonRoad's multi-body vehicle, B; the driving system keeps its knowledge of our original vehicle.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, Column, contents, tabulate
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import explain
from safevar_sumo.questions.explain.robustness import MIN_ROBUST_SHARE, draw_neighbours, robustness_in_words
from safevar_sumo.questions.multi_body import load_bmw_parameters
from safevar_sumo.questions.pairs import (
    ENDS,
    SETTING_COLUMNS,
    SIDES,
    UNSAFE_IN,
    counts_of,
    draw_pairs,
    paired_test,
    table_of_pairs,
)
from safevar_sumo.questions.second_vehicle import SPIN_LIMIT, SecondVehicle
from safevar_sumo.questions.words import ending_in_words, join_phrases, number_of
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, JsonObject
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import Progress, show_no_progress

if TYPE_CHECKING:
    from safevar_sumo.questions.case import Case

Verdict = Literal["outside", "confirmed", "contradicted", "borderline"]
"""The second model's verdict on a cause."""
COLUMNS = {name: column._replace(is_shown=name == "solution") for name, column in SETTING_COLUMNS.items()} | {
    "opinion": Column("", ", ".join(get_args(Verdict))),
    "changes": Column("", "the cause: values in their units"),
    "encounter": Column("", "its encounter", ".5g"),
    "because": Column("", "the reason"),
}
SIMULATION_LIMIT = 12_000
"""Approximate number of simulations of the search for minimal causes, the same as for a report."""
STAGE = "second vehicle model"
CHANGE_SHARES = np.arange(1, 10) / 10
"""Shares of a cause's changes that the second model simulates, to locate the share from which they are unsafe."""


@question
@contents("unsafe", *UNSAFE_IN.values(), "p", "a12", *get_args(Verdict), *ENDS, settings=COLUMNS)
def opinion(subject: Case, evaluator: Evaluator, *, solution: tuple[str, ...] = (), unsafe: Criterion = None) -> Answer:
    """Check the minimal causes of failures with a second vehicle model.

    Parameters
    ----------
    solution
        Handle of a solution, such as nsga2:3:0; may be repeated. By default the failures that a report explains.
    unsafe
        What is unsafe: a collision, a safety degree below X, or at most X points of a rating.
    """
    assemble_both_systems(subject.study)
    criterion = evaluator.choose_criterion(unsafe, subject)
    explained = explain.compute(subject, evaluator, solution=solution, unsafe=criterion, limit=SIMULATION_LIMIT, fits=0)
    causes = explained.tables["causes"]
    frame, originals = judge_causes(subject.study, causes, criterion, evaluator.progress)
    driven = frame[frame["opinion"] != "outside"]
    p, a12 = paired_test(*driven[["a_degree", "b_degree"]].dropna().to_numpy(float).T)
    found = Counter(frame["opinion"])
    numbers: JsonObject = {"unsafe": str(criterion), **counts_of(driven), "p": p, "a12": a12}
    numbers |= {verdict: found[verdict] for verdict in get_args(Verdict)} | originals
    total = number_of(len(frame), "minimal cause")
    verdict = (
        f"CommonRoad's multi-body vehicle confirms {found['confirmed']} of {total} and contradicts "
        f"{found['contradicted']}; {found['borderline']} are borderline, and it has no answer on {found['outside']} "
        f"({criterion.description})."
    )
    columns = {name: column for name, column in COLUMNS.items() if name in frame}
    if safe := [name for name in explained.tables["solutions"]["solution"] if name not in {*causes["solution"]}]:
        verdict += f" Without a cause (safe, or the original itself is unsafe): {join_phrases(safe)}."
    return Answer(
        question="opinion",
        study=subject.study,
        verdict=verdict,
        numbers=numbers,
        tables={"settings": tabulate("Minimal causes with both models", columns, frame)},
        draw=partial(draw_pairs, titles=("our model", "the second")),
    )


def assemble_both_systems(study: Study) -> tuple[System, SecondVehicle]:
    """A study's system, and the second vehicle, which can replace the system's.

    Raises
    ------
    InputError
        If commonroad-vehicle-models is not installed, or the second model cannot represent the vehicle at all.
    """
    load_bmw_parameters()  # raises the error if the package is not installed
    system = assemble(study)
    return system, SecondVehicle(system.vehicle, study)


class _Runs(NamedTuple):
    """Simulations with both models of N settings, the study's original vehicle and then causes: in rows 0 to N - 1 the
    settings, in the N after them the original vehicle in the encounter of each.

    `scaled` says whether the second model is unsafe with each of `CHANGE_SHARES` of a setting's changes, shape (N, K);
    `here` and `there` are the endings of all rows in words.
    """

    settings: FloatArray
    ours: Evaluations
    theirs: Evaluations
    scaled: BoolArray
    here: list[str]
    there: list[str]


def judge_causes(
    study: Study, causes: pd.DataFrame, unsafe: Unsafe, progress: Progress = show_no_progress
) -> tuple[pd.DataFrame, JsonObject]:
    """Simulate minimal causes, rows of the table `causes` of `explain`, with both models, each in its encounter: a row
    of `COLUMNS` for each, and how both original vehicles end. Raises the errors of `assemble_both_systems`.
    """
    system, vehicle = assemble_both_systems(study)
    second_system = replace(system, vehicle=vehicle)
    rows = causes.to_dict("records")
    count = len(causes) + 1
    progress(STAGE, 0, count)
    frame, runs = _drive_both(system, second_system, rows, unsafe)
    judged = list[tuple[Verdict, dict[str, float], dict[str, float], str]]()
    for row, cause in enumerate(rows, 1):
        verdict, because = _judge(second_system, vehicle, runs, row, cause, unsafe, study.search.seed)
        words = f"with our model it {runs.here[row]}; {because}"
        judged.append((verdict, cause["changes"], cause.get("encounter", {}), words))
        progress(STAGE, row + 1, count)
        if vehicle.reasons_to_omit(cause["changes"]):
            frame.loc[row, ["b_outcome", "b_degree"]] = None, np.nan
    originals = {str(name): frame[name][0] for name in ENDS}
    frame = frame.iloc[1:count].reset_index(drop=True)
    frame = pd.concat([frame, pd.DataFrame(judged, columns=["opinion", "changes", "encounter", "because"])], axis=1)
    frame.loc[frame["opinion"] == "outside", "unsafe_in"] = ""
    return frame if study.scenario.search else frame.drop(columns="encounter"), originals


def _drive_both(
    system: System, second_system: System, causes: Sequence[dict[Any, Any]], unsafe: Unsafe
) -> tuple[pd.DataFrame, _Runs]:
    """Simulate the original vehicle and the causes with both models: a frame with `SETTING_COLUMNS`, and the runs."""
    characteristics = system.characteristics
    values = [{}, *(cause["changes"] | cause.get("encounter", {}) for cause in causes)]
    settings = np.stack([characteristics.setting(one, beyond=True) for one in values])
    originals = characteristics.with_original_vehicle(settings)
    both = np.concatenate([settings, originals])
    # Shares of each setting's changes, one setting after the other; shape (settings, shares, n).
    changes = (settings - originals)[:, np.newaxis]
    scaled = originals[:, np.newaxis] + CHANGE_SHARES[:, np.newaxis] * changes
    ours = evaluate(system, both)
    theirs = evaluate(second_system, np.concatenate([both, scaled.reshape(-1, len(characteristics))]))
    names = ["", *(cause["solution"] for cause in causes)] * 2
    there = theirs.take(range(len(both)))
    frame = table_of_pairs(names, ours, there, unsafe.of(ours), unsafe.of(there))
    fails_scaled = unsafe.of(theirs)[len(both) :].reshape(len(settings), -1)
    endings = [_endings_of(frame, side, system.contact) for side in SIDES]
    return frame, _Runs(settings, ours, theirs, fails_scaled, *endings)


def _endings_of(frame: pd.DataFrame, side: str, contact: float) -> list[str]:
    """How each row of a frame with `SETTING_COLUMNS` ends on a side."""
    ends = zip(frame[f"{side}_outcome"], frame[f"{side}_degree"], strict=True)
    return [ending_in_words(outcome, degree, contact) for outcome, degree in ends]


def _judge(
    second_system: System,
    vehicle: SecondVehicle,
    runs: _Runs,
    row: int,
    cause: dict[Any, Any],
    unsafe: Unsafe,
    seed: int,
) -> tuple[Verdict, str]:
    """The verdict on a cause, and its reason."""
    if reason := _why_outside(second_system, vehicle, runs, row, cause, unsafe):
        return "outside", reason
    of_original = runs.there[len(runs.settings) + row]
    is_unsafe = bool(unsafe.of(runs.theirs)[row])
    verdict: Verdict = "contradicted"
    because = f"safe with the second model: it {runs.there[row]}; the original vehicle {of_original}"
    if is_unsafe:
        verdict = "confirmed"
        safe_share = np.max(CHANGE_SHARES, initial=0.0, where=~runs.scaled[row])  # the largest that is still safe
        because = (
            f"also unsafe with the second model: it {runs.there[row]}; the original vehicle is safe: it {of_original}. "
            f"{safe_share:.0%} to {safe_share + CHANGE_SHARES[0]:.0%} of the changes are enough with the second "
            f"model, {cause['fraction']:.1%} with ours"
        )
    reason = _why_borderline(second_system, runs.settings[row], cause["robust_share"], is_unsafe, unsafe, seed)
    return ("borderline", f"{reason}; {because}") if reason else (verdict, because)


def _why_outside(
    second_system: System, vehicle: SecondVehicle, runs: _Runs, row: int, cause: dict[Any, Any], unsafe: Unsafe
) -> str:
    """Why the second model has no verdict on a cause; empty if it has one."""
    if reasons := vehicle.reasons_to_omit(cause["changes"]):
        return "; ".join(reasons)
    own = len(runs.settings) + row
    if unsafe.of(runs.ours)[own]:
        return "the original vehicle itself is unsafe, so that no change is a cause"
    is_too_close = second_system.measuring.scoring.violation(runs.theirs)[row]
    if unsafe.of(runs.theirs)[own] or not runs.theirs.valid[own] or is_too_close:
        return f"the original vehicle itself is not safe with the second model: it {runs.there[own]}"
    if not runs.theirs.valid[row]:
        return f"with the second model it {runs.there[row]}"
    if vehicle.has_spun(runs.settings[row][second_system.characteristics.of_vehicle]):
        return f"its wheels spin with the second model, more than {SPIN_LIMIT:g} m/s faster than the car"
    return ""


def _why_borderline(
    second_system: System, setting: FloatArray, robust_share: float, is_unsafe: bool, unsafe: Unsafe, seed: int
) -> str:
    """Why a cause is borderline, by its neighbours in our model, else in the second; empty if it is not."""
    if np.isnan(robust_share):  # in a rated study, whose neighbours take too long
        return ""
    if robust_share < MIN_ROBUST_SHARE:
        return f"with our model {robustness_in_words(robust_share)}"
    neighbours = draw_neighbours(second_system.characteristics, setting[np.newaxis], seed)
    runs = evaluate(second_system, neighbours[second_system.region.feasible(neighbours)])
    counts = runs.valid & (second_system.measuring.scoring.violation(runs) == 0)
    share = np.mean((unsafe.of(runs) == is_unsafe)[counts]) if counts.any() else 0.0
    result = "unsafe" if is_unsafe else "safe"
    if share >= MIN_ROBUST_SHARE:
        return ""
    return f"with the second model only {share:.0%} of the neighbours are {result}, too"
