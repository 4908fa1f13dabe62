"""How a page divides the simulations that it may do over its questions."""

from __future__ import annotations

from collections.abc import Sequence

from safevar_sumo.errors import InputError
from safevar_sumo.questions.options import SIMULATIONS
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System

REPLAYS, SPEED = "replays", "speed"
"""The names of the parts of the replays, and of the question about the speed of a sheet."""
PART_OF_REPLAYS = 10
ONE_SAMPLE = ("risk", "rules")
"""Questions that simulate one sample, if their options are the same."""
BESIDES = 4, 6
"""What a question that finds its sample simulates besides: the original vehicle so often, and so
many repeats.
"""


def divided(texts: Sequence[str], simulations: int, system: System) -> dict[str, int]:
    """How many simulations each question about a study may do, by its text, and the replays: equal
    parts of all; of questions that share a sample one has a part.

    Raises
    ------
    InputError
        If the simulations do not suffice for all questions.
    """
    own, others, known = list[str](), list[str](), set[tuple[str, ...]]()
    replays = simulations // PART_OF_REPLAYS if system.mover.takes_long else 0
    left = simulations - replays
    for text in dict.fromkeys(texts):
        name, *options = text.split()
        if SIMULATIONS.flag in options:  # which the question states itself
            left -= int(options[options.index(SIMULATIONS.flag) + 1])
            continue
        key = tuple(options) if name in ONE_SAMPLE else (text,)
        is_free = system.mover.takes_long and (key in known or name == "repair")  # which it refuses
        (others if is_free else own).append(text)
        known.add(key)

    # What all of them simulate besides counts.
    times, repeats = BESIDES
    left -= len(others) * (times * simulations_of_setting(system) + repeats)
    part = left // max(len(own), 1)
    if part < 1:
        problem = f"{simulations:,} do not suffice for {len(own) + len(others)} questions"
        raise InputError("simulations", problem, "a larger number, or fewer questions (--ask)")
    return {**dict.fromkeys([*own, *others], part), REPLAYS: replays}
