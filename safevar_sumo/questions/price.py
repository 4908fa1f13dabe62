"""The price of a question whose simulations take long: the number of simulations, their duration,
and the number that the question may do. An account counts the simulations.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
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
from safevar_sumo.errors import InputError, NobodyMoved
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.progress import Phases
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, significant
from safevar_sumo.study import Study
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import print_text

LONGEST_QUESTION = 900.0
"""A question that takes at most this time does all its simulations by default [s]. Otherwise the
question does only as many simulations as fit into this time.
"""
MEASURED = 2
"""Number of simulations by which the duration of a simulation is measured."""
TIMED_VEHICLES = 512
"""Number of vehicles in the batch that measures how long a vehicle of a list takes."""
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


@dataclass
class Account:
    """Counts and limits the simulations of a question, also of its evaluators of other studies.

    Attributes
    ----------
    phases
        The progress of the question.
    allowance
        The largest number of simulations that the user allows; None if the user states no number.
    questions
        Number of questions that share the time, such as all questions of a page.
    is_question
        Whether the simulations are those of a question, which prints its price before it begins.
    limit
        The largest number of simulations that the question may do; None without a limit.
    spent
        Number of simulations so far.
    minimum
        The least number of simulations for an answer.
    effort
        The amount of search, as a share of the usual amount.
    most
        The largest number of simulations of a quick answer; infinite for other answers.
    criterion
        The question's criterion, if a collision alone does not meet it; else None.
    met, collided, evaluated
        Numbers of settings that meet this criterion, that collide, and that were simulated.
    undefined
        Number of settings without a collision for which the metric that this criterion bounds is
        undefined.
    standing
        The vehicles (as bytes) that never moved in an encounter in which the original vehicle
        moves.
    has_moved
        Whether some changed vehicle had a valid simulation.
    """

    phases: Phases
    allowance: int | None = None
    questions: int = 1
    is_question: bool = False
    limit: int | None = None
    spent: int = 0
    minimum: int = 0
    effort: float = 1.0
    most: float = float("inf")
    criterion: Unsafe | None = None
    met: int = 0
    collided: int = 0
    evaluated: int = 0
    undefined: int = 0
    standing: set[bytes] = field(default_factory=set)
    has_moved: bool = False

    @property
    def is_limited(self) -> bool:
        """Whether the user or the time limits the number of simulations."""
        return self.limit is not None

    @property
    def left(self) -> float:
        """The number of simulations that may still be done; infinite without a limit."""
        if self.limit is None:
            return self.most - self.spent
        return min(self.limit, self.most) - self.spent

    @property
    def undefined_in_words(self) -> str:
        """A sentence that says how often the metric was undefined; "" if it never was."""
        if not self.undefined or self.criterion is None:
            return ""
        of_all = f"{self.undefined:,} of {self.evaluated:,} simulated settings, which count as safe"
        measure = self.criterion.measure
        return f"Remark: {measure} is undefined, without a collision, in {of_all}."

    def count(self, evaluations: Evaluations, standing: BoolArray) -> None:
        """Count evaluations that meet the question's criterion, that collide, and in which its
        metric is undefined, although the vehicle is not among those that are `standing`.
        """
        if self.criterion is None:
            return
        self.met += int(np.count_nonzero(self.criterion.of(evaluations)))
        self.collided += int(np.count_nonzero(evaluations.collided))
        self.evaluated += len(evaluations)
        if self.criterion.bound:
            is_safe = evaluations.valid & ~evaluations.collided & ~standing
            is_undefined = (
                np.isnan(evaluations.column(self.criterion.measure)) & is_safe
            )
            self.undefined += int(np.count_nonzero(is_undefined))

    @property
    def collided_in_words(self) -> str:
        """A sentence on vehicles that collide, although no vehicle meets the criterion; "" without
        such vehicles.
        """
        if self.met or not self.collided or self.criterion is None:
            return ""
        return (
            f"Remark: {self.collided:,} of the {self.evaluated:,} simulated vehicles collide,"
            f" although no vehicle is unsafe by the criterion ({self.criterion.description})."
        )

    @property
    def standing_in_words(self) -> str:
        """The number of vehicles that never moved, such as `3 simulated vehicles`."""
        return number_of(len(self.standing), "simulated vehicle")

    def refuse_standing(self) -> None:
        """Refuse a verdict if every changed vehicle stood.

        Raises
        ------
        NobodyMoved
            If some vehicle never moved, and no changed vehicle moved.
        """
        if self.standing and not self.has_moved:
            raise NobodyMoved("no changed vehicle moved")

    def spend(self, simulations: int) -> None:
        """Count `simulations` that are about to begin.

        Raises
        ------
        InputError
            If the question may not do so many further simulations.
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
        """Set the least number of simulations for an answer. Refuse an allowance below it."""
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
            Number of simulations that the check of a simulator's class really did. The account does
            not count this number, but a fixed part of the limit. Otherwise the answer would depend
            on whether an earlier command had already done the check.
        at_once
            Number of simulations at the same time.
        """
        # The number that a user states also covers two other parts: the check at the beginning, and
        # the first simulations, which are repeated at the end.
        parts = 0
        allowance = self.allowance
        if allowance is not None and seconds is not None:
            parts = sum(spare(allowance, self.minimum))
        self.limit = allowance
        if allowance is not None and allowance >= expected + parts:
            self.limit = None
            # The effort is only half of the ratio of allowed to usual simulations, because some
            # searches need more simulations than they are expected to need.
            effort = allowance / (2 * (expected + parts))
            self.effort = min(max(self.effort, effort), MOST_EFFORT)
        if seconds is None:
            return
        longest = LONGEST_QUESTION / self.questions
        if allowance is None and expected * seconds > longest:
            self.limit = round_down(longest / seconds)
            parts = sum(spare(self.limit, self.minimum))
        words = _price(expected, seconds)
        if self.limit is not None:
            self.spent += parts
            price = _price(min(expected, self.limit), seconds).removeprefix("about ")
            words = f"at most {price}, of about {expected:,.0f} in full"
        words += f" (one takes {significant(seconds * at_once, 2)} s"
        if at_once > 1:
            words += f", {at_once} at the same time"
        if checked and allowance is None:
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
    one point. It limits nothing, and the account does not count the measured simulations.
    """
    task = Task(study=study, selection=Selection(points=(len(system.points) // 2,)))
    batch = np.repeat(system.characteristics.original_settings, TIMED_VEHICLES, axis=0)
    _, seconds = _timed(task, batch, pool)
    price = _price(simulations, seconds / (TIMED_VEHICLES * pool.workers))
    print_text(Console(file=sys.stderr), f"{price}; cars that fail early take fewer")


def _timed(task: Task, settings: FloatArray, pool: Pool) -> tuple[Evaluations, float]:
    """The evaluations of settings, and the time that one worker takes for all of them [s]."""
    jobs = [(task, settings)]
    # The first simulations start a worker and its simulator: their time does not count.
    carry_out(evaluate_settings, jobs, pool)
    start = time.perf_counter()
    (evaluations,) = carry_out(evaluate_settings, jobs, pool)
    return evaluations, time.perf_counter() - start


def _price(simulations: float, seconds: float) -> str:
    """Words for a number of simulations and for their duration. One takes `seconds`."""
    duration = timedelta(seconds=round(simulations * seconds))
    return f"about {simulations:,.0f} simulations, about {duration}"
