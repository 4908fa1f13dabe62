"""What a question costs where a simulation takes long: how many simulations it takes, how long that
is, and how many it may do.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from safevar_sumo.campaign.batches import forget_other, spare
from safevar_sumo.campaign.evaluation import (
    Selection,
    Task,
    carry_out,
    evaluate_settings,
)
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError
from safevar_sumo.questions.progress import Phases
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import print_text
from safevar_sumo.vehicles import CharacteristicSet

LONGEST = 900.0
"""Time up to which a question does by default all that it is made for [s]."""
MEASURED = 2
"""Settings that are simulated to know how long one takes."""
BATCH = 512
"""Vehicles that are simulated side by side to know how long one of a list takes."""
LEAST_SETTINGS = 3
"""Fewest settings with which a question that samples answers."""
QUICK = 1 / 40, 1 / 8
"""How much a quick answer searches, as a share of what is usual: at least so much that the box of
joint limits, which is usually sought up to 40 times, is sought once; and at most.
"""
QUICK_SECONDS = 25.0
"""This share times the seconds that a vehicle drives at all points: where it drives longer, each
simulation costs more, and fewer are done.
"""
MOST_EFFORT = 8.0
"""Largest such share where more simulations are allowed than are usual."""
DIGITS = 2
"""Digits of a number of simulations that is derived from a time."""


@dataclass
class Account:
    """The simulations of a question, also of its evaluators of other studies.

    Attributes
    ----------
    phases
        Their progress.
    allowance
        The largest number that the user allows; None if he says nothing.
    questions
        Number of questions of a page, which share the time.
    is_question
        Whether a question asks, which says first what it costs.
    limit
        The largest number of simulations; None if there is none.
    spent, minimum
        Simulations so far; the least number for an answer.
    effort
        How much is searched, as a share of what is usual.
    measure, undefined, judged
        The metric of the question's criterion, if it has one; the numbers of settings without a
        collision that have no such value, and of all.
    """

    phases: Phases
    allowance: int | None = None
    questions: int = 1
    is_question: bool = False
    limit: int | None = None
    spent: int = 0
    minimum: int = 0
    effort: float = 1.0
    measure: str = ""
    undefined: int = 0
    judged: int = 0

    @property
    def left(self) -> float:
        """Simulations that may follow."""
        if self.limit is None:
            return float("inf")
        return self.limit - self.spent

    @property
    def undefined_in_words(self) -> str:
        """How often the metric was undefined, in a sentence; empty if it never was."""
        if not self.undefined:
            return ""
        of_all = f"{self.undefined:,} of {self.judged:,} simulated settings, which count as safe"
        return f"Remark: {self.measure} is undefined, without a collision, in {of_all}."

    def spend(self, simulations: int) -> None:
        """Count simulations that begin.

        Raises
        ------
        InputError
            If they are more than may follow.
        """
        self.spent += simulations
        bound = self.allowance if self.limit is None else self.limit
        if bound is not None and self.spent > bound:
            raise InputError(
                "simulations",
                f"{bound:,} do not suffice: {self.spent:,} are needed to go on",
                "a larger number",
            )

    def require(self, minimum: int) -> None:
        """Refuse fewer simulations than the least number for an answer."""
        self.minimum = minimum
        self._refuse_few(self.allowance)

    def _refuse_few(self, number: int | None) -> None:
        """Refuse a number of simulations below the least one."""
        if number is not None and number < self.minimum:
            raise InputError(
                "simulations",
                f"{number:,} do not suffice: an answer takes at least {self.minimum:,}",
                f"{self.minimum} or more",
            )

    def open(self, expected: float, seconds: float | None, checked: int = 0) -> None:
        """Allow what the user allows, or all if that does not take too long; `expected` simulations
        are planned, one of which takes so many seconds, None for an unknown time that is short. The
        check of a simulator's class took `checked` simulations: whatever it took, its part of those
        that are allowed counts, so that the answer does not depend on what was checked before.
        """
        # A number that is stated holds for all: the check, and what is repeated at the end.
        parts = 0
        allowance = self.allowance
        if allowance is not None and seconds is not None:
            parts = sum(spare(allowance, self.minimum))
        self.limit = allowance
        if allowance is not None and allowance >= expected + parts:
            self.limit = None
            # Half of what is more than usual: some searches take longer than they are expected to.
            effort = allowance / (2 * (expected + parts))
            self.effort = min(max(self.effort, effort), MOST_EFFORT)
        if seconds is None:
            return
        longest = LONGEST / self.questions
        if allowance is None and expected * seconds > longest:
            self.limit = round_down(longest / seconds)
            parts = sum(spare(self.limit, self.minimum))
        words = _price(expected, seconds)
        if self.limit is not None:
            self.spent += parts
            price = _price(min(expected, self.limit), seconds).removeprefix("about ")
            words = f"at most {price}, of about {expected:,.0f} in full"
        words += f" (one takes {seconds:.2g} s"
        if checked and allowance is None:
            words += f", besides {checked:,} for a check of the class"
        elif checked:
            words += f", with {checked:,} for a check of the class, which is shorter than usual"
        print_text(Console(file=sys.stderr), f"{words})")
        self._refuse_few(self.limit)


def round_down(number: float) -> int:
    """A number of simulations with `DIGITS` digits, at least 1."""
    simulations = max(int(number), 1)
    unit = 10 ** max(len(str(simulations)) - DIGITS, 0)
    return int(simulations // unit * unit)


def seconds_of_simulation(study: Study, system: System, pool: Pool) -> float | None:
    """How long a simulation takes, by all workers together [s], from the original vehicle, which is
    simulated `MEASURED` times, and must do what it did when an interrupted command began; None
    where it takes milliseconds, as in SUMO.
    """
    if not system.mover.takes_long:
        return None
    settings = CharacteristicSet.of(study).original_settings
    original, seconds = _timed(Task(study=study), settings, pool)
    if system.repeats == 1 and not original.failed[0]:
        forget_other(study, pool, original)
    return seconds / (pool.workers * simulations_of_setting(system))


def print_price_of_list(
    study: Study, system: System, pool: Pool, simulations: float
) -> None:
    """Print how long a list of vehicles takes, which share batches: by the time of one at a point.
    This number bounds nothing, and what is timed does not count.
    """
    task = Task(study=study, selection=Selection(points=(len(system.points) // 2,)))
    batch = np.repeat(system.characteristics.original_settings, BATCH, axis=0)
    _, seconds = _timed(task, batch, pool)
    price = _price(simulations, seconds / (BATCH * pool.workers))
    print_text(Console(file=sys.stderr), f"{price}; cars that fail early take fewer")


def _timed(task: Task, settings: FloatArray, pool: Pool) -> tuple[Evaluations, float]:
    """What settings do, and how long a worker takes for them [s]."""
    jobs = [(task, settings)]
    # A worker starts, and so does its simulator.
    carry_out(evaluate_settings, jobs, pool)
    start = time.perf_counter()
    (evaluations,) = carry_out(evaluate_settings, jobs, pool)
    return evaluations, time.perf_counter() - start


def _price(simulations: float, seconds: float) -> str:
    """A number of simulations, and how long they take if one takes so many seconds."""
    return f"about {simulations:,.0f} simulations, about {_duration(simulations * seconds)}"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}"
