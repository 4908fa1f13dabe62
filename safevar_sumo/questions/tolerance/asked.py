"""What is asked about limits: the characteristics, the specified limits, and the criterion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, about, check_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Limit, Study, limits_of


class Asked(NamedTuple):
    """A question about limits.

    Attributes
    ----------
    columns
        The columns of the characteristics that vary.
    limits
        The specified limits, by name.
    unsafe
        What is unsafe, with the distance to keep.
    original
        The evaluation of the original vehicle.
    criterion, margin
        The options from which `unsafe` comes.
    fits
        Number of parameter sets in which the limits hold; None for all.
    budget
        Number of simulations that search for a counterexample.
    is_quick
        Whether the answer is rough, so that no limit is called kept.
    at_tests
        Whether limits hold at the points of the study's tests alone, and not between them.
    up_to
        The parameter and the value at which the study was cut, as `NAME=V`; None if it was not.
    left_out
        The names of the tests that are above this value.
    smaller
        The evaluators of the study cut at smaller values, in ascending order: its limits lie within
        those of each.
    """

    subject: Subject
    evaluator: Evaluator
    columns: list[int]
    limits: dict[str, Limit]
    unsafe: Unsafe
    original: Evaluations
    criterion: Unsafe | None
    margin: float | None
    fits: int | None
    budget: int
    is_quick: bool = False
    at_tests: bool = False
    up_to: str | None = None
    left_out: Sequence[str] = ()
    smaller: Sequence[Evaluator] = ()

    @property
    def unsafe_solutions(self) -> FloatArray:
        """The distinct unsafe solutions of results that change no other characteristics than those
        that vary, and parameters of the scenario; shape (K, n).
        """
        members = self.evaluator.characteristics
        if isinstance(self.subject, Study):
            return np.zeros((0, len(members)))
        frame = self.subject.solutions[self.unsafe.rows(self.subject.solutions)]
        settings = frame[list(members.names)].to_numpy(dtype=float)
        varies = ~members.of_vehicle
        varies[self.columns] = True
        is_original = (settings == members.original)[:, ~varies].all(axis=1)
        settings = np.unique(settings[is_original], axis=0)
        if self.up_to is None or not len(settings):
            return settings
        # They are unsafe in the whole study; those in encounters above the value do not count.
        settings = settings[((settings >= members.lower) & (settings <= members.upper)).all(axis=1)]
        evaluations = self.evaluator.evaluate(settings, "unsafe solutions")
        return np.asarray(settings[evaluations.valid & self.unsafe.of(evaluations)])


def columns_of(names: Sequence[str], characteristics: Sequence[str]) -> list[int]:
    """The columns of chosen characteristics, of all without a choice."""
    chosen = [name.strip() for text in characteristics for name in text.split(",")]
    for name in chosen:
        check_name("characteristics", f"there is no characteristic {name!r}", name, names)
        if chosen.count(name) > 1:
            raise InputError("characteristics", f"{name} is given twice", "each name once")
    return [column for column, name in enumerate(names) if not chosen or name in chosen]


def specified_limits(
    study: Study, texts: Sequence[str], columns: Sequence[int]
) -> dict[str, Limit]:
    """The limits of the study and of the option for the characteristics that vary."""
    rows = study.vehicle.characteristics
    varied = [list(rows)[column] for column in columns]
    with about("limits"):
        for name in limits_of(texts, rows):
            check_name("", f"{name} does not vary with these --characteristics", name, varied)
        return {
            name: limit
            for name, limit in limits_of(texts, rows, study.limits).items()
            if name in varied
        }
