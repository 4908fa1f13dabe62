"""Measures how long a question with slow simulations takes."""

from __future__ import annotations

import sys
import time

import numpy as np
from rich.console import Console

from safevar_sumo.campaign.batches import forget_other
from safevar_sumo.campaign.evaluation import (
    Selection,
    Task,
    carry_out,
    evaluate_settings,
)
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.questions.budget import price_in_words
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import print_text

MEASURED = 2
"""Number of simulations by which the duration of a simulation is measured."""
TIMED_VEHICLES = 512
"""Number of vehicles in the batch that measures how long a vehicle of a list takes."""


def seconds_of_simulation(study: Study, system: System, pool: Pool) -> float | None:
    """The mean duration of a simulation if all workers simulate at the same time [s]. The result is
    None if a simulation takes milliseconds, as in SUMO.

    The original vehicle is simulated `MEASURED` times. Results that an interrupted command has
    stored are forgotten if the original vehicle drives in another way now.
    """
    if not system.mover.takes_long:
        return None
    settings = system.characteristics.original_settings
    original, seconds = _timed(Task(study=study), settings, pool)
    if system.repeats == 1 and not original.failed[0]:
        forget_other(study, pool, original)
    return seconds / (pool.workers * simulations_of_setting(system))


def print_price_of_list(
    study: Study, system: System, pool: Pool, simulations: float
) -> None:
    """Print how long a list of vehicles takes. The duration is measured with a batch of vehicles at
    one point. It limits nothing, and the budget does not count the measured simulations.
    """
    task = Task(study=study, selection=Selection(points=(len(system.points) // 2,)))
    batch = np.repeat(system.characteristics.original_settings, TIMED_VEHICLES, axis=0)
    _, seconds = _timed(task, batch, pool)
    price = price_in_words(simulations, seconds / (TIMED_VEHICLES * pool.workers))
    print_text(Console(file=sys.stderr), f"{price}; cars that fail early take fewer")


def _timed(task: Task, settings: FloatArray, pool: Pool) -> tuple[Evaluations, float]:
    """The evaluations of settings, and the time that one worker takes for all of them [s]."""
    jobs = [(task, settings)]
    # The first simulations start a worker and its simulator: their time does not count.
    carry_out(evaluate_settings, jobs, pool)
    start = time.perf_counter()
    (evaluations,) = carry_out(evaluate_settings, jobs, pool)
    return evaluations, time.perf_counter() - start
