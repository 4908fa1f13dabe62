"""The budget of an answer: how many simulations the question may do, and how much of the usual
search it does.

The options `--simulations` and `--quick` make a budget, once for each answer. The question then
states the usual number of simulations of each of its stages (`Evaluator.begin`). If the user, or
the time that a slow simulator takes, does not allow their sum, simulations are few. After that each
stage asks once how much it may simulate:

- `by_effort` gives a usual number times the effort, which is 1, less with `--quick`, and more if
  the user allows more simulations than are usual;
- `of_stage` also gives no more than a part of few simulations that are left.

How long a slow simulation takes is measured before.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from datetime import timedelta

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
from safevar_sumo.records import Evaluations, FloatArray, significant
from safevar_sumo.study import Study
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import print_text

LONGEST_QUESTION = 900.0
"""A question that takes at most this time does all its simulations by default [s]. Otherwise the
question does only as many simulations as fit into this time.
"""
LEAST_SETTINGS = 3
"""Fewest settings with which a question that samples settings gives an answer."""
QUICK_SHARE = 1 / 8
"""Largest number of simulations of a quick answer, as a share of the usual number."""
QUICK_EFFORTS = 1 / 40, QUICK_SHARE
"""Least and largest effort of a quick answer. (The effort is the amount of search, as a share of
the usual amount.) Usually a question proposes up to 40 boxes of joint limits: the least effort
suffices for one box.
"""
QUICK_SECONDS = 25.0
"""The effort of a quick answer is this number divided by the seconds that a vehicle drives at all
points, in all critical encounters if these are ranges, within `QUICK_EFFORTS`. The longer a vehicle
drives, the more a simulation costs, and the fewer simulations are done.
"""
MOST_EFFORT = 8.0
"""Largest effort if the user allows more simulations than are usual."""
TOTAL_DIGITS = 2
"""Number of digits to which a number of simulations is rounded that is derived from a time."""
MEASURED = 2
"""Number of simulations by which the duration of a simulation is measured."""
TIMED_VEHICLES = 512
"""Number of vehicles in the batch that measures how long a vehicle of a list takes."""


@dataclass
class Budget:
    """The simulations of an answer, also those with evaluators of other studies for it.

    Attributes
    ----------
    stated
        The largest number of simulations that the user allows; None if the user states no number.
    is_quick
        Whether the user asks for a rough answer with less search.
    effort
        The amount of search, as a share of the usual amount.
    questions
        Number of questions that share the time, such as all questions of a page.
    is_question
        Whether a question simulates, which prints its price before it begins.
    limit
        The largest number of simulations if they are few; otherwise None.
    most
        The largest number of simulations of a quick answer; infinite for other answers.
    spent
        Number of simulations so far.
    minimum
        The least number of simulations for an answer.
    """

    stated: int | None = None
    is_quick: bool = False
    effort: float = 1.0
    questions: int = 1
    is_question: bool = False
    limit: int | None = None
    most: float = float("inf")
    spent: int = 0
    minimum: int = 0

    def __post_init__(self) -> None:
        self.limit = self.stated

    @property
    def is_few(self) -> bool:
        """Whether fewer simulations are allowed than are usual."""
        return self.limit is not None

    @property
    def is_rough(self) -> bool:
        """Whether less is searched than usual."""
        return self.is_quick or self.is_few

    @property
    def left(self) -> float:
        """The number of simulations that may still be done; infinite without a limit."""
        most = self.most
        if self.limit is not None:
            most = min(self.limit, most)
        return most - self.spent

    def by_effort(self, number: float) -> int:
        """A usual number of simulations, settings or rounds, times the effort."""
        return int(number * self.effort)

    def of_stage(self, usual: float, price: int, part: int = 1) -> int:
        """The number of settings of a stage, at least 1: the usual number times the effort. Of few
        simulations the stage gets at most 1 / `part` of those that are left. A setting costs
        `price` simulations.
        """
        number = self.by_effort(usual)
        left = self.settings_left(price)
        if left is not None:
            number = min(number, left // part)
        return max(number, 1)

    def settings_left(self, price: int) -> int | None:
        """For how many settings, each of `price` simulations, few simulations still suffice; None
        if simulations are not few.
        """
        return int(self.left) // price if self.is_few else None

    def spend(self, simulations: int) -> None:
        """Count `simulations` that are about to begin.

        Raises
        ------
        InputError
            If the question may not do so many further simulations.
        """
        self.spent += simulations
        bound = self.stated if self.limit is None else self.limit
        if bound is not None and self.spent > bound:
            raise InputError(
                "simulations",
                f"{bound:,} do not suffice: {self.spent:,} are needed to go on",
                "a larger number",
            )

    def require(self, minimum: int) -> None:
        """Set the least number of simulations for an answer. Refuse a stated number below it."""
        self.minimum = minimum
        self._refuse_few(self.stated)

    def _refuse_few(self, number: int | None) -> None:
        """Refuse a number of simulations below the least one."""
        if number is not None and number < self.minimum:
            raise InputError(
                "simulations",
                f"{number:,} do not suffice: an answer takes at least {self.minimum:,}",
                f"{self.minimum} or more",
            )

    def open(
        self,
        expected: float,
        seconds: float | None,
        checked: int = 0,
        at_once: int = 1,
    ) -> None:
        """Set the limit and the effort of the question, and print its price.

        The limit is the number that the user allows. If the user states no number, there is no
        limit, unless all simulations would take too long.

        Parameters
        ----------
        expected
            Number of simulations that the question is expected to need.
        seconds
            Duration of all simulations over their number, with `at_once` simulations at the same
            time [s]; None if simulations are short, and were not measured.
        checked
            Number of simulations that the check of a simulator's class really did. The budget does
            not count this number, but a fixed part of the limit. Otherwise the answer would depend
            on whether an earlier command had already done the check.
        at_once
            Number of simulations at the same time.
        """
        # The number that a user states also covers two other parts: the check at the beginning, and
        # the first simulations, which are repeated at the end.
        parts = 0
        stated = self.stated
        if stated is not None and seconds is not None:
            parts = sum(spare(stated, self.minimum))
        self.limit = stated
        if stated is not None and stated >= expected + parts:
            self.limit = None
            # The effort is only half of the ratio of allowed to usual simulations, because some
            # searches need more simulations than they are expected to need.
            effort = stated / (2 * (expected + parts))
            self.effort = min(max(self.effort, effort), MOST_EFFORT)
        if seconds is None:
            return
        longest = LONGEST_QUESTION / self.questions
        if stated is None and expected * seconds > longest:
            self.limit = round_down(longest / seconds)
            parts = sum(spare(self.limit, self.minimum))
        words = price_in_words(expected, seconds)
        if self.limit is not None:
            self.spent += parts
            most = price_in_words(min(expected, self.limit), seconds)
            words = most.replace("about", "at most", 1)
            words += f", of about {expected:,.0f} in full"
        words += f" (one takes {significant(seconds * at_once, 2)} s"
        if at_once > 1:
            words += f", {at_once} at the same time"
        if checked and stated is None:
            words += f", besides {checked:,} for a check of the class"
        elif checked:
            words += f", with {checked:,} for a check of the class, which is shorter than usual"
        print_text(Console(file=sys.stderr), f"{words})")
        self._refuse_few(self.limit)


def round_down(number: float) -> int:
    """A number of simulations, rounded down to `TOTAL_DIGITS` significant digits; at least 1."""
    simulations = max(int(number), 1)
    unit = 10 ** max(len(str(simulations)) - TOTAL_DIGITS, 0)
    return int(simulations // unit * unit)


def price_in_words(simulations: float, seconds: float) -> str:
    """Words for a number of simulations and for their duration. One takes `seconds`."""
    duration = timedelta(seconds=round(simulations * seconds))
    return f"about {simulations:,.0f} simulations, about {duration}"


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
