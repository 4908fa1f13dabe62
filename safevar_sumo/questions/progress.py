"""Progress of a question: its phases one after another, and the share of the whole, which never
falls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import accumulate

from safevar_sumo.campaign.questions import COMPILING
from safevar_sumo.terminal import Phase, Progress


class Phases:
    """Progress of a question whose phases come one after another, without a way back.

    A phase is planned, or is the first part of its name. What is not planned, belongs to an earlier
    phase, or begins again, counts in the phase under way. No count and no share of the whole falls.
    """

    def __init__(self, show: Progress) -> None:
        self._show_phase = show
        self._planned: list[str] = []
        self._repeated = ""
        self._ends = [0.0]
        """Planned phases, the one of several rounds, and shares of the whole at the phases' ends,
        first at the beginning.
        """
        self._number = self._round = 0
        self._names = [""]
        """The number of the planned phase under way, and of its round, from 1; 0 before the first;
        names of all phases so far.
        """
        self._part, self._done_in_part, self._total_of_part = "", 0, 0
        """The part of the phase that is under way: its name, what is done, and its total."""
        self._done = self._before_part = self._before_round = 0
        """What is done in the phase in all, and was done before this part and this round."""
        self._is_stage = False
        self._expected: int | None = None
        """Whether a stage is open, and how many settings are done at its end, if that is known."""
        self._share = 0.0

    def plan(self, usual_shares: Mapping[str, float], repeated: str = "") -> None:
        """Plan the phases, each with its usual share of the time; the `repeated` one has rounds, of
        which nobody knows how many follow.
        """
        self._planned = [*usual_shares]
        self._repeated = repeated
        total = sum(usual_shares.values())
        self._ends = [0.0, *(end / total for end in accumulate(usual_shares.values()))]

    def show_part(self, part: str, done: int, total: int) -> None:
        """Show the progress of a part: by itself a phase, or within a stage."""
        if part == COMPILING:
            self._show_phase(Phase(part, self._share), done, total)
            return
        if not self._is_stage:
            self._begin(part)
        # A part that follows another one, or begins again, goes on where that one ended.
        if part != self._part or done < self._done_in_part:
            self._before_part = self._done - done
        self._part, self._done_in_part, self._total_of_part = part, done, total
        self._done = self._before_part + done
        self._show()

    @contextmanager
    def stage(self, name: str, total: int | None) -> Iterator[Callable[[int], None]]:
        """Within the block, all parts count in one phase of about `total` settings, None where that
        is open; a stage within a stage is a part of it. The function that it yields takes a better
        estimate of how many follow the part under way.
        """
        if self._is_stage:
            yield lambda left: None
            return
        self._begin(name)
        if name == self._names[-1] == self._repeated:
            self._round += 1
            self._before_round = self._done
        self._end_part()
        self._is_stage = True
        self._expected = None if total is None else self._done + total
        self._show()

        def expect(left: int) -> None:
            self._expected = self._before_part + self._total_of_part + left

        try:
            yield expect
        finally:
            self._is_stage = False
            self._end_part()

    def _begin(self, name: str) -> None:
        """Begin the phase of this name, if it is later than the one under way."""
        number = self._planned.index(name) + 1 if name in self._planned else 0
        if number > self._number or (not self._number and name not in self._names):
            self._number = number
            self._names.append(name)
            self._round = self._done = self._before_round = 0
            self._end_part()

    def _end_part(self) -> None:
        self._part, self._done_in_part, self._total_of_part = "", 0, 0
        self._before_part = self._done

    def _show(self) -> None:
        """Show the phase under way."""
        # What is known of its total.
        total = self._before_part + self._total_of_part if self._total_of_part else 0
        if self._is_stage:
            total = 0 if self._expected is None else max(self._expected, total)

        # The share of the phase; of rounds the next ones get half, a third, ... of what is left.
        share = 0.0
        if total > self._before_round:
            share = (self._done - self._before_round) / (total - self._before_round)
        name = self._names[-1]
        if name == self._repeated:
            share = 1 - 1 / (max(self._round, 1) + share)
            name += f", round {max(self._round, 1)}"
        if self._number:
            begin, end = self._ends[self._number - 1 : self._number + 1]
            self._share = max(self._share, begin + share * (end - begin))
            if len(self._planned) > 1:
                name = f"{self._number} of {len(self._planned)}, {name}"
        self._show_phase(Phase(name, self._share), self._done, total)
