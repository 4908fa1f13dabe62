"""The base class of probes, which try a subject in several situations; and functions that several probes use."""

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
from safevar_sumo.plugins import Guard, Lookup, unload_user_modules
from safevar_sumo.records import FloatArray
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.traci_module import importable
from safevar_sumo.vehicles import CharacteristicSet

Rows = npt.NDArray[np.intp]
Outputs = Mapping[str, np.ndarray]
"""Results by name; the last axis runs over the vehicles."""
POINTS = 2
"""Approximate number of points of a matrix at which a study is tried."""


class NoReaction(NamedTuple):
    """A missing reaction of a subject; `methods` names the methods that should react."""

    methods: tuple[str, ...]
    expected: str
    got: str


class Probe(ABC):
    """Tries a subject with `number` vehicles; `methods` names the methods of the subject that a run calls."""

    methods: tuple[str, ...] = ()
    number: int

    def __init__(self, subject: Subject) -> None:
        self.subject = subject

    def system(self) -> System:
        """The system of the subject's study, with all user code reloaded."""
        unload_user_modules()
        system = assemble(self.subject.study, self.subject.study.source)
        return replace(system, matrix=system.matrix[::max(len(system.matrix) // POINTS, 1)], rater=None)

    @abstractmethod
    def load(self) -> Any:
        """The subject, reloaded."""

    @abstractmethod
    def run(self, model: Any, rows: Rows) -> Outputs:
        """Results of the vehicles `rows`, in this order."""

    def repeat(self, model: Any, rows: Rows) -> Outputs:
        """The results of a second run of the subject."""
        return self.run(model, rows)

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[NoReaction]:
        """The missing reactions."""
        yield from ()

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        """Time per vehicle and step [s] of a run that took `seconds`, and a sentence on this time."""
        return 0.0, ""


def loaded_again(subject: Subject) -> Any:
    """The class, function or record of a subject, from the module as it is loaded now."""
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
    """Time per vehicle and step [s] of a run that took `seconds`, and a sentence that compares it with `example` (`reference` s)."""
    cost, example_cost = seconds / (vehicles * steps), reference / (vehicles * steps)
    return cost, f"{cost * 1e6:.2g} microseconds per vehicle and step, {vehicles} at once; ours ({example}) takes {example_cost * 1e6:.2g}"


def corners(members: CharacteristicSet) -> FloatArray:
    """The original, four corners of all domains, both ends of each domain with all else original, and 24 random corners."""
    lower, upper, indices = members.lower, members.upper, np.arange(len(members))
    common_corners = [members.original, lower, upper, np.where(indices % 2, lower, upper), np.where(indices % 2, upper, lower)]
    single_ends = [np.where(indices == i, end, members.original) for i in indices for end in (lower, upper)]
    random_corners = np.where(np.random.default_rng(0).random((24, len(members))) < 0.5, lower, upper)
    return np.array([*common_corners, *single_ends, *random_corners])
