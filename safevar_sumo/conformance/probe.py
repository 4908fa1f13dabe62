"""A probe: the situations that a subject is tried in; and the functions that all probes use."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.conformance.finding import load_factor
from safevar_sumo.conformance.subject import Subject
from safevar_sumo.plugins import Guard, Lookup, forget_foreign
from safevar_sumo.records import FloatArray
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.traci_module import importable
from safevar_sumo.vehicles import CharacteristicSet

Rows = npt.NDArray[np.intp]
Outputs = Mapping[str, np.ndarray]
"""Results by name; the last axis is that of the vehicles."""
POINTS = 2
"""Number of points of a matrix at which a study is tried."""


class NoReaction(NamedTuple):
    """A missing reaction of a subject; `methods` are those that should react."""

    methods: tuple[str, ...]
    expected: str
    got: str


class Probe(ABC):
    """Situations for `number` vehicles; `methods` are the subject's methods that are called."""

    methods: tuple[str, ...] = ()
    number: int

    def __init__(self, subject: Subject) -> None:
        self.subject = subject

    def system(self) -> System:
        """The system of the subject's study, with all foreign modules loaded anew."""
        forget_foreign()
        system = assemble(self.subject.study, self.subject.study.source)
        return replace(system, matrix=system.matrix[::max(len(system.matrix) // POINTS, 1)], rater=None)

    @abstractmethod
    def fresh(self) -> Any:
        """The subject, loaded anew."""

    @abstractmethod
    def run(self, model: Any, rows: Rows) -> Outputs:
        """Results of some of the vehicles, in that order."""

    def again(self, model: Any, rows: Rows) -> Outputs:
        """The same results again, from a subject that has run before."""
        return self.run(model, rows)

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[NoReaction]:
        """The reactions that are missing."""
        yield from ()

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        """Time per vehicle and step [s] of a run that took `seconds`, and a sentence on it."""
        return 0.0, ""


def loaded_again(subject: Subject) -> Any:
    """The class, function or record, from its module as it is loaded now."""
    if subject.is_ours or subject.member.file:
        return subject.member.target
    with importable():
        return Lookup("check", subject.study.origin.places).find({}, subject.name, subject.key).target


def guard_of(subject: Subject) -> Guard:
    return subject.member.guard or Guard("check", subject.key)


def timed(run: Callable[[], Any]) -> float:
    """Time that a call would take on an idle machine [s]."""
    start = time.perf_counter()
    run()
    return (time.perf_counter() - start) / load_factor()


def cost_of(seconds: float, reference: float, example: str, vehicles: int, steps: int) -> tuple[float, str]:
    """Time per vehicle and step [s] of a run that took `seconds`, and a sentence that compares it with the example's `reference` [s]."""
    own, ours = seconds / (vehicles * steps), reference / (vehicles * steps)
    return own, f"{own * 1e6:.2g} microseconds per vehicle and step, {vehicles} at once; ours ({example}) takes {ours * 1e6:.2g}"


def corners(members: CharacteristicSet) -> FloatArray:
    """The original, the corners of all domains together, both ends of every domain alone, and corners drawn at random."""
    lower, upper, number = members.lower, members.upper, np.arange(len(members))
    together = [members.original, lower, upper, np.where(number % 2, lower, upper), np.where(number % 2, upper, lower)]
    alone = [np.where(number == i, end, members.original) for i in number for end in (lower, upper)]
    drawn = np.where(np.random.default_rng(0).random((24, len(members))) < 0.5, lower, upper)
    return np.array([*together, *alone, *drawn])
