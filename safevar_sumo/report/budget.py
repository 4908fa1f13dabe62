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
    costly = []
    free = []
    samples = set()
    replays = 0
    if system.mover.takes_long:
        replays = simulations // PART_OF_REPLAYS
    remaining_simulations = simulations - replays
    for text in dict.fromkeys(texts):
        name, *options = text.split()
        # A question may state its number itself.
        if SIMULATIONS.flag in options:
            remaining_simulations -= int(options[options.index(SIMULATIONS.flag) + 1])
            continue
        sample = tuple(options) if name in ONE_SAMPLE else (text,)
        # A simulator that takes long keeps its samples, and has no repairs.
        if system.mover.takes_long and (sample in samples or name == "repair"):
            free.append(text)
        else:
            costly.append(text)
        samples.add(sample)

    times, repeats = BESIDES
    remaining_simulations -= len(free) * (
        times * simulations_of_setting(system) + repeats
    )
    part = remaining_simulations // max(len(costly), 1)
    if part < 1:
        raise InputError(
            "simulations",
            f"{simulations:,} do not suffice for {len(costly) + len(free)} questions",
            "a larger number, or fewer questions (--ask)",
        )
    return {**dict.fromkeys([*costly, *free], part), REPLAYS: replays}
