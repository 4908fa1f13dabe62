"""Shows the progress of a question: its phases, and the number of simulations."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

from safevar_sumo.records import NamedValues
from safevar_sumo.terminal import Progress

LOGGER = logging.getLogger(__name__)
OVERRUN = 0.18
"""In a phase with an unknown number of rounds, at least this share of its simulations so far is
expected to follow, because nobody knows whether a round is the last.
"""
LEAST_SHARE_TO_COME = 0.06
"""In a stage, at least this share of its simulations so far is expected to follow: a failure may
make more simulations necessary.
"""


class Phases:
    """The progress of a question. Phases come one after another, and never come back.

    A phase is planned, or is the first part that is simulated. A part that is not planned, or that
    belongs to an earlier phase, counts in the present phase.
    """

    def __init__(self, show: Progress) -> None:
        self._show_whole = show
        self._points = 1
        """Number of points at which a setting is simulated."""
        self._later = NamedValues()
        """The planned phases that have not begun, with their expected numbers of simulations."""
        self._done = self._before = 0
        """Number of simulations so far, and number of simulations before the present phase."""
        self._name = self._round = ""
        self._is_stage = False
        self._expected = self._planned_round = 0.0
        """The present phase: its name, its round, whether all parts belong to it, the expected
        number of its simulations, and the number of simulations planned for each round (0 if
        unknown).
        """
        self._waiting = 0
        """Number of simulations that the present part still has to do."""
        self._most = math.inf
        """Largest number of simulations that the question may do."""
        self._never_grows = False
        """Whether a total also bounds the totals after it."""
        self._begun_at = time.monotonic()
        """The time at which the present phase began [s]."""

    def plan(
        self, settings: NamedValues, points: int = 1, most: float = math.inf
    ) -> None:
        """Plan the phases: `settings` holds the expected number of settings of each phase. A
        setting is simulated at `points` points. At most `most` further simulations may follow.
        """
        self._points = points
        self._most = self._done + most
        self._later = {
            name: points * number for name, number in settings.items() if number
        }

    def plan_most(self, settings: NamedValues, points: int) -> None:
        """Plan the phases by their largest numbers of settings: no total is larger than an earlier
        one.
        """
        self.plan(settings, points)
        self._never_grows = True

    def begin_part(self, part: str, simulations: int) -> None:
        """Begin a part of `simulations` simulations, which may be a phase or belong to a phase."""
        if not self._is_stage:
            self._begin(part)
        self._waiting = simulations
        self._show()

    def add(self, simulations: int) -> None:
        """Count simulations that the present part has done."""
        self._done += simulations
        self._waiting -= simulations
        self._show()

    def say(self, text: str, number: int, total: int) -> None:
        """Show a text about work that is no simulation."""
        self._show_whole(text, *self._counts())

    @contextmanager
    def stage(self, name: str, settings: float | None = None) -> Iterator[None]:
        """Count all parts within the block in one phase, of about `settings` settings, by default
        as planned. A stage within a stage belongs to the outer stage.
        """
        if self._is_stage:
            yield
            return
        self._begin(name, settings)
        self._is_stage = True
        self._show()
        try:
            yield
        finally:
            self._is_stage = False

    def begin_round(self, number: int, rounds: int, *, is_known: bool = False) -> None:
        """Begin round `number` (from 1 on) of the present phase. There are `rounds` rounds if
        `is_known`, else at most so many.
        """
        self._round = f", round {number} of {'' if is_known else 'at most '}{rounds}"
        simulations = self._done - self._before
        if not is_known:
            self._expected = max(self._expected, (1 + OVERRUN) * simulations)
        else:
            # A round is expected to take the mean of the rounds so far and of a planned round.
            self._planned_round = self._planned_round or self._expected / rounds
            self._expected = simulations + (rounds - number + 1) * (
                (self._planned_round + simulations) / number
            )
        self._show()

    def _begin(self, name: str, settings: float | None = None) -> None:
        """Begin a phase, if it comes after the present phase."""
        if name not in self._later and self._name:
            return
        self.log_end()
        planned = 0.0
        while name in self._later:
            planned = self._later.pop(next(iter(self._later)))
        self._name, self._round = name, ""
        self._planned_round = 0.0
        self._before = self._done
        self._waiting = 0
        self._expected = planned if settings is None else self._points * settings

    def log_end(self) -> None:
        """Log that the present phase ends, with its simulations and its time."""
        seconds = time.monotonic() - self._begun_at
        if self._name:
            simulations = self._done - self._before
            LOGGER.info("%s: %d simulations, %.1f s", self._name, simulations, seconds)
        self._begun_at = time.monotonic()

    def expect(self, settings: float) -> None:
        """Expect that `settings` settings follow in the present phase."""
        self._expected = self._done - self._before + self._points * settings

    def _show(self) -> None:
        """Show the present phase and the numbers of simulations."""
        self._show_whole(f"{self._name}{self._round}", *self._counts())

    def _counts(self) -> tuple[int, int]:
        """The number of simulations that are done, and the expected total."""
        simulations = self._done - self._before
        remainder = max(self._expected - simulations, self._waiting)
        if self._is_stage:
            # The more a stage exceeds its plan, the more is expected to follow.
            excess = simulations - self._expected
            remainder = max(remainder, excess, LEAST_SHARE_TO_COME * simulations)
        expected = self._done + remainder + sum(self._later.values())
        total = max(min(expected, self._most), self._done)
        if self._never_grows:
            self._most = total
        return self._done, round(total)
