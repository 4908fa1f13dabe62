"""Whether a file of OpenSCENARIO plays, and what happens in it: the command `check FILE.xosc`."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import STEP, Played, Source, open_file, play
from safevar_sumo.questions.answer import Answer, Column, Columns, tabulate
from safevar_sumo.questions.words import number_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETERS: Columns = {
    "parameter": "parameter of the file",
    "value": "its value in the file",
    "range": "what a file of values says",
}
ACTORS: Columns = {
    "actor": "who moves; Ego is the vehicle under test",
    "kind": "what it is",
    "length": Column("m", "length", ".2f"),
    "width": Column("m", "width", ".2f"),
    "ahead": Column("m", "how far its middle is ahead of Ego's front at the start", ".1f"),
    "left": Column("m", "how far its middle is to the left of Ego's front at the start", ".1f"),
    "speed": Column("m/s", "speed at the start", ".1f"),
    "last_speed": Column("m/s", "speed at the end", ".1f"),
}
EVENTS: Columns = {
    "event": "event of the file",
    "whose": "actors that it moves",
    "begins": Column("s", "when it begins beside an Ego that keeps its speed", ".2f"),
    "ends": Column("s", "when it ends", ".2f"),
}
REMARKS: Columns = {"remark": "what has no effect, and how what was played was understood"}
TABLES = {"parameters": PARAMETERS, "actors": ACTORS, "events": EVENTS, "file_remarks": REMARKS}
"""The tables on a file of OpenSCENARIO."""


def check_scenario(file: str, ego: str, findings: Columns) -> Answer:
    """The answer on a concrete file, or on the first combination of a logical one."""
    name = os.path.basename(file)
    tables = {}
    played = None
    problem: tuple[str, ...] = ()
    try:
        source = open_file(os.path.abspath(file))
        tables["parameters"] = tabulate("Parameters", PARAMETERS, _parameters(source))
        played = play(source.concrete, next(source.combinations({}), {}), ego)
    except InputError as error:
        problem = (error.problem, file, "", error.legal, "file", "change the file as expected")
        verdict = f"{name} does not play: {error.problem}. Expected: {error.legal}."
    if played is not None:
        moving = number_of(len(played.others), "other actor")
        verdict = (
            f"{name} plays for {played.duration:.1f} s: {ego} at {played.speed:.1f} m/s, and"
            f" {moving}."
        )
        if played.uneventful:
            verdict += f" Nothing happens to {ego}: {played.uneventful}."
        if played.depends_until:
            verdict += (
                f" Until {played.depends_until:.1f} s it depends on an {ego} that keeps its speed:"
                " a driving system that acts before makes an invalid test."
            )
        tables |= {
            "actors": tabulate("Actors", ACTORS, _actors(played, ego)),
            "events": tabulate("Events, in their order", EVENTS, played.events),
            "file_remarks": tabulate("Remarks", REMARKS, [(one,) for one in played.remarks]),
        }
    no_study: Any = None
    return Answer(
        question="check",
        study=no_study,
        verdict=verdict,
        numbers={"passed": not problem},
        tables={"findings": tabulate("Findings", findings, [problem] if problem else []), **tables},
        folded=("findings",),
        draw=None if played is None else partial(_draw, played, ego, name),
    )


def _parameters(source: Source) -> list[tuple[str, str, str]]:
    ranges = {
        name: f"{choice.ends[0]:g} to {choice.ends[1]:g}"
        if choice.ends
        else ", ".join(dict.fromkeys(values[place] for values in choice.sets))
        for choice in source.choices
        for place, name in enumerate(choice.names)
    }
    return [(name, value, ranges.get(name, "")) for name, value in source.values.items()]


def _actors(played: Played, ego: str) -> list[tuple[object, ...]]:
    shape = played.ego
    speeds = float(played.profile[0]), played.speed
    rows: list[tuple[object, ...]] = [
        (ego, shape.kind, shape.length, shape.width, -shape.length / 2, 0.0, *speeds)
    ]
    for one in played.others:
        place = (one.place[0] - played.start.place) / played.start.facing
        size = one.shape.kind, one.shape.length, one.shape.width
        rows.append((one.name, *size, place.real, place.imag, one.speed[0], one.speed[-1]))
    return rows


def _draw(played: Played, ego: str, name: str, answer: Answer) -> Figure:
    """The paths of all actors' middles, beside Ego's; a dot where each begins."""
    from safevar_sumo.questions.figures import escape_dollars, new_figure

    figure, axes = new_figure(name, 1, 1, (8.0, 4.0))
    axis = axes[0][0]
    way = played.speed * played.duration + STEP * float((played.profile - played.speed).sum())
    paths = {ego: np.array([-played.ego.length / 2, way])}
    for one in played.others:
        paths[one.name] = (one.place - played.start.place) / played.start.facing
    for label, path in paths.items():
        (line,) = axis.plot(path.real, path.imag, label=escape_dollars(label))
        axis.plot(path.real[:1], path.imag[:1], "o", color=line.get_color())
    axis.set_xlabel("ahead of Ego's start [m]")
    axis.set_ylabel("to the left [m]")
    axis.legend()
    return figure
