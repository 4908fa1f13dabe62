"""Divides the simulations of a page (`--simulations`) over its questions and replays."""

from __future__ import annotations

from collections.abc import Sequence

from safevar_sumo.errors import InputError
from safevar_sumo.questions.ask import SIMULATIONS
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System

REPLAYS = "replays"
"""Name of the part of the simulations that is for the replays."""
SPEED = "speed"
"""Name of the part for the question about the speed of a sheet."""
PART_OF_REPLAYS = 10
"""Replays in a simulator that takes long get 1 / `PART_OF_REPLAYS` of all simulations."""
ONE_SAMPLE = ("risk", "rules")
"""Questions that share one sample of simulated vehicles, if their options are the same."""
BESIDES = 4, 6
"""Simulations of a question whose sample is simulated already: the number of settings (all of them
the original vehicle), and the number of further simulations, which repeat runs.
"""


def divided(texts: Sequence[str], simulations: int, system: System) -> dict[str, int]:
    """The largest numbers of simulations of each question, by its text, and of the `REPLAYS`.

    All questions have equal parts. A question that states its number itself has no part, but its
    number is subtracted first. Questions about a sample that another question has simulated need
    only few simulations of their part.

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
        # The text of a question may state the number of its simulations.
        if SIMULATIONS.flag in options:
            remaining_simulations -= int(options[options.index(SIMULATIONS.flag) + 1])
            continue
        sample = tuple(options) if name in ONE_SAMPLE else (text,)
        # A simulator that takes long keeps its samples for other questions, and has no repairs.
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
