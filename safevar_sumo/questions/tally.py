"""Counts what came out of the simulations of an answer, for the remarks of every question."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from safevar_sumo.errors import NobodyMoved
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import BoolArray, Evaluations


@dataclass
class Tally:
    """Counts what came out of the simulations of an answer, also of evaluators of other studies.

    Attributes
    ----------
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

    criterion: Unsafe | None = None
    met: int = 0
    collided: int = 0
    evaluated: int = 0
    undefined: int = 0
    standing: set[bytes] = field(default_factory=set)
    has_moved: bool = False

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
