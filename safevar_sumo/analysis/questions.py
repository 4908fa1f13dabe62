"""The research questions by name, asked of several settings at once: tidy frames, and notes on what they lack."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from safevar_sumo.analysis import discussion
from safevar_sumo.analysis.discussion import combinations
from safevar_sumo.analysis.rq1 import rq1
from safevar_sumo.analysis.rq2 import rq2
from safevar_sumo.analysis.rq3 import critical, rq31, rq32, rq33, rq33_safety
from safevar_sumo.analysis.setting import MORE_IS_UNSAFE, NSGA2, OVER_NON_COLLISIONS, Setting, Unanswerable, collided
from safevar_sumo.errors import InputError, one_of

Frames = dict[str, pd.DataFrame]
SAFETY = "rq3.3-safety"
"""The footer of RQ3.3's table, a table of its own."""

OF_A_SETTING: Mapping[str, Callable[[Setting], Frames]] = {
    "rq1": lambda setting: {"rq1": rq1(setting)},
    "rq2": lambda setting: {"rq2": rq2(setting)},
    "rq3.1": lambda setting: {"rq3.1": rq31(setting)},
    "rq3.2": lambda setting: {"rq3.2": rq32(setting)},
    "rq3.3": lambda setting: {"rq3.3": rq33(setting), SAFETY: rq33_safety(setting)},
    "collisions": lambda setting: {"collisions": discussion.collisions(setting)},
    "combinations": lambda setting: {"combinations": combinations(setting)},
}
WEATHER = "weather"
QUESTIONS = (*OF_A_SETTING, WEATHER)


class Answer(NamedTuple):
    """The answer to a question: a tidy frame over all settings (empty if none can be asked), and what to know about it."""

    name: str
    frame: pd.DataFrame
    notes: tuple[str, ...]


def answer(settings: Sequence[Setting], question: str | None = None) -> list[Answer]:
    """Ask one question, or all of them.

    Raises
    ------
    InputError
        If there is no such question, or no setting holds what the one question, or any, asks for.
    """
    if question is not None and question not in QUESTIONS:
        raise InputError("--rq", f"there is no question {question!r}", one_of(QUESTIONS))
    answers, refusals, names = [], [], [setting.name for setting in settings]
    for name in QUESTIONS if question is None else (question,):
        frames, refused = _asked(name, settings)
        refusals += refused
        notes = [f"{error.source}: {error.problem}." for error in refused]
        if not frames:
            answers.append(Answer(name, pd.DataFrame(), tuple(notes)))
        for part, found in frames.items():
            frame = pd.concat(found, ignore_index=True)
            inside = {*frame["setting"], *frame["other"]} if name == WEATHER else set(names) - {error.source for error in refused}
            about = [note for setting in settings if setting.name in inside for note in _notes(name, setting)]
            answers.append(Answer(part, frame, tuple(dict.fromkeys([*notes, *about]))))
    if refusals and all(one.frame.empty for one in answers):
        raise refusals[0]
    return answers


def _asked(name: str, settings: Sequence[Setting]) -> tuple[dict[str, list[pd.DataFrame]], list[Unanswerable]]:
    """The frames of a question by table, and why some settings have none."""
    frames: dict[str, list[pd.DataFrame]] = {}
    refused = []
    for ask in _asking(name, settings):
        try:
            for part, frame in ask().items():
                frames.setdefault(part, []).append(frame)
        except Unanswerable as error:
            refused.append(error)
    return frames, refused


def _asking(name: str, settings: Sequence[Setting]) -> Iterable[Callable[[], Frames]]:
    """What to call for the question's frames: once per setting, or once for all weathers."""
    if name == WEATHER:
        return [lambda: {WEATHER: pd.concat([discussion.weather(*pair) for pair in discussion.weather_pairs(settings)])}]
    return [lambda setting=setting: OF_A_SETTING[name](setting) for setting in settings]  # type: ignore[misc]


def _notes(question: str, setting: Setting) -> list[str]:
    """What a reader of this table should know of a setting."""
    notes = setting.remarks
    if question in ("rq1", "rq2"):
        notes += _undefined(setting)
    if question == "rq1":
        lacking = [name for name, value in setting.original.items() if pd.isna(value)]
        if lacking:
            notes.append(f"{setting.name}: the original vehicle's {', '.join(lacking)} is undefined, nothing is compared with it.")
    if question == "rq2" and not setting.has_runs:
        notes.append(f"{setting.name}: igd, igd_plus and hypervolume need runs, which imported solutions do not have.")
    if question == "rq2" and setting.has_runs:
        empty = len(set(setting.finished) - {(name, run) for name, run in zip(setting.solutions["algorithm"], setting.solutions["run"],
                                                                             strict=True)})
        if empty:
            notes.append(f"{setting.name}: {empty} finished runs found no solution; they have no igd, igd_plus and hypervolume.")
    if question.startswith("rq3") or question in ("combinations", WEATHER):
        number = len(critical(setting))
        notes.append(f"{setting.name}: {number} critical solutions of {len(setting.solutions_of(NSGA2))} of {NSGA2}.")
    if question == "combinations" and combinations(setting).empty:
        notes.append(f"{setting.name}: no critical solution has exactly four characteristics changed.")
    return notes


def _undefined(setting: Setting) -> list[str]:
    """Which values are missing where they should be there."""
    told = []
    for metric in MORE_IS_UNSAFE:
        rows = setting.solutions[~collided(setting.solutions)] if metric in OVER_NON_COLLISIONS else setting.solutions
        number = int(rows[metric].isna().sum())
        if number:
            told.append(f"{setting.name}: {metric} is undefined in {number} of {len(rows)} solutions, which are left out of it.")
    return told
