"""Progress of a question: its phases one after another, and its simulations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from safevar_sumo.terminal import Progress

OVERRUN = 0.18
"""The least share of its simulations so far that follow in a phase of rounds whose number is not
known: nobody knows whether this round is the last.
"""


LEAST_SHARE = 0.06
"""The least share of its simulations so far that follow in a phase that says what it expects."""


class Phases:
    """Progress of a question whose phases come one after another, without a way back.

    A phase is planned, or is the first part that is simulated. What is not planned, or belongs to
    an earlier phase, counts in the phase under way.
    """

    def __init__(self, show: Progress) -> None:
        self._show_whole = show
        self._points = 1
        """Number of points at which a setting is simulated."""
        self._later = dict[str, float]()
        """The planned phases that have not begun, with their expected numbers of simulations."""
        self._done = self._before = 0
        """Number of simulations so far, and of those before the phase under way."""
        self._name = self._round = ""
        self._is_stage = False
        self._expected = self._planned_round = 0.0
        """The phase under way, its round, whether all parts belong to it, how many simulations it
        is expected to take, and each of its rounds if their number is known.
        """
        self._waiting = 0
        """Number of simulations that the part under way still has to do."""

    def plan(self, settings: Mapping[str, float], points: int = 1) -> None:
        """Plan the phases, each with the number of settings that it is expected to simulate, at so
        many points.
        """
        self._points = points
        self._later = {name: points * number for name, number in settings.items()}

    def begin_part(self, part: str, simulations: int) -> None:
        """Begin a part, by itself a phase or within one."""
        if not self._is_stage:
            self._begin(part)
        self._waiting = simulations
        self._show()

    def add(self, simulations: int) -> None:
        """Count simulations that the part under way has done."""
        self._done += simulations
        self._waiting -= simulations
        self._show()

    def say(self, text: str, number: int, total: int) -> None:
        """Show something that is no simulation."""
        self._show_whole(text, *self._counts())

    @contextmanager
    def stage(
        self, name: str, settings: float | None = None
    ) -> Iterator[Callable[[float], None]]:
        """Within the block, all parts count in one phase, of about so many settings, by default as
        planned; a stage within a stage is a part of it. The function that it yields takes a better
        estimate of how many follow.
        """
        if self._is_stage:
            yield lambda number: None
            return
        self._begin(name, settings)
        self._is_stage = True
        self._show()
        try:
            yield self.expect
        finally:
            self._is_stage = False

    def begin_round(self, number: int, rounds: int, *, is_known: bool = False) -> None:
        """Begin a round of the phase under way, from 1 on; there are at most, or known to be, as
        many as `rounds`.
        """
        self._round = f", round {number} of {'' if is_known else 'at most '}{rounds}"
        simulations = self._done - self._before
        if not is_known:
            self._expected = max(self._expected, (1 + OVERRUN) * simulations)
        else:
            # The mean of the rounds so far, and of one as it was planned.
            self._planned_round = self._planned_round or self._expected / rounds
            self._expected = simulations + (rounds - number + 1) * (
                (self._planned_round + simulations) / number
            )
        self._show()

    def _begin(self, name: str, settings: float | None = None) -> None:
        """Begin a phase, if it is later than the one under way."""
        if name not in self._later and self._name:
            return
        planned = 0.0
        for earlier in list(self._later):
            if name not in self._later:
                break
            planned = self._later.pop(earlier)
        self._name, self._round = name, ""
        self._planned_round = 0.0
        self._before = self._done
        self._waiting = 0
        self._expected = planned if settings is None else self._points * settings

    def expect(self, settings: float) -> None:
        """Expect that so many settings follow in the phase under way, and at least a small share of
        those so far: nobody knows whether one of them fails, and more are necessary.
        """
        simulations = self._done - self._before
        self._expected = simulations + max(
            self._points * settings, LEAST_SHARE * simulations
        )

    def _show(self) -> None:
        self._show_whole(f"{self._name}{self._round}", *self._counts())

    def _counts(self) -> tuple[int, int]:
        """The number of simulations that are done, and the expected total."""
        remainder = max(self._before + self._expected - self._done, self._waiting)
        return self._done, round(self._done + remainder + sum(self._later.values()))
