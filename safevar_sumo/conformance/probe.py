"""The base class of probes, which try a subject in several situations; and functions that several probes use."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.conformance.subject import Subject
from safevar_sumo.plugins import Guard, Lookup, load_factor, unload_user_modules
from safevar_sumo.records import FloatArray
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.traci_module import substitute_traci
from safevar_sumo.vehicles import CharacteristicSet

Indices = npt.NDArray[np.intp]
"""Indices of the vehicles of a probe."""
Outputs = Mapping[str, np.ndarray]
"""Results by name; the last axis runs over the vehicles."""
MATRIX_POINTS = 2
"""Approximate number of a study's test points that are simulated."""


class MissingReaction(NamedTuple):
    """A missing reaction of a subject; `methods` names the methods that should react, `check` the check that fails."""

    methods: tuple[str, ...]
    expected: str
    got: str
    check: str = "reaction"


class Probe(ABC):
    """Tries a subject with `vehicle_count` vehicles; `methods` names the methods of the subject that the probe calls."""

    methods: tuple[str, ...] = ()
    vehicle_count: int

    def __init__(self, subject: Subject) -> None:
        self.subject = subject

    def reload_system(self) -> System:
        """The system of the subject's study, with all user code reloaded and only a few points of the matrix."""
        unload_user_modules()
        system = assemble(self.subject.study, self.subject.study.source)
        return replace(system, matrix=system.matrix[::max(len(system.matrix) // MATRIX_POINTS, 1)], rater=None)

    @abstractmethod
    def load(self) -> Any:
        """The subject, reloaded."""

    @abstractmethod
    def run(self, model: Any, vehicles: Indices) -> Outputs:
        """The results of `vehicles`, in this order."""

    def repeat(self, model: Any, vehicles: Indices) -> Outputs:
        """The results of a second run of the subject."""
        return self.run(model, vehicles)

    def missing_reactions(self, model: Any, outputs: Outputs) -> Iterator[MissingReaction]:
        yield from ()

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        """Time per vehicle and step [s] of a run that took `seconds`, and a sentence on this time."""
        return 0.0, ""


def target_of(subject: Subject) -> Any:
    """A subject's class, function or record in the module that is loaded now."""
    if not subject.is_user_code or subject.member.file:
        return subject.member.target
    with substitute_traci():
        return Lookup("check", subject.study.origin.places).find({}, subject.name, subject.key).target


def guard_of(subject: Subject) -> Guard:
    return subject.member.guard or Guard("check", subject.key)


def measure_time(run: Callable[[], Any]) -> float:
    """Time that a call would take on an idle machine [s]."""
    start = time.perf_counter()
    run()
    return (time.perf_counter() - start) / load_factor()


def cost_of(seconds: float, example_seconds: float, example: str, n: int, steps: int) -> tuple[float, str]:
    """Time per vehicle and step [s] of a run of n vehicles, and a sentence that compares it with a shipped example's time."""
    cost, example_cost = seconds / (n * steps), example_seconds / (n * steps)
    return cost, f"{cost * 1e6:.2g} microseconds per vehicle and step, {n} at once; ours ({example}) takes {example_cost * 1e6:.2g}"


def corners_of(characteristics: CharacteristicSet) -> FloatArray:
    """The original, four corners of all domains, both ends of each domain with all else original, and 24 random corners."""
    lower, upper, indices = characteristics.lower, characteristics.upper, np.arange(len(characteristics))
    common_corners = [characteristics.original, lower, upper, np.where(indices % 2, lower, upper), np.where(indices % 2, upper, lower)]
    single_ends = [np.where(indices == i, end, characteristics.original) for i in indices for end in (lower, upper)]
    random_corners = np.where(np.random.default_rng(0).random((24, len(characteristics))) < 0.5, lower, upper)
    return np.array([*common_corners, *single_ends, *random_corners])
