"""Collisions are SUMO's own; here they are held against geometry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safevar_sumo.records import Command, Nominal, Observation, Outcome, SimulationRuns
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import System, assemble


class _Pedals:
    """Drives vehicle i with a constant throttle of its own, and brakes it at a moment of its own."""

    def __init__(self, throttle: np.ndarray, brakes_at: np.ndarray) -> None:
        self._throttle, self._brakes_at = throttle, brakes_at

    def start(self, n: int, nominal: Nominal, step: float) -> None:
        return None

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        brakes = seen.time >= self._brakes_at
        return Command(np.where(brakes, 0.0, self._throttle), np.where(brakes, 1.0, 0.0)), memory


def driven(study: str, n: int, brakes_until: float = 9.0) -> tuple[System, SimulationRuns]:
    """The original vehicle n times, with pedals that make for n different encounters."""
    system = assemble(load_study(study))
    rng = np.random.default_rng(7)
    ads = _Pedals(rng.uniform(0.3, 1.0, n), rng.uniform(1.5, brakes_until, n))
    system = System(**{**{name: getattr(system, name) for name in System.__dataclass_fields__}, "ads": ads})
    return system, simulate(system, np.repeat(system.characteristics.original[np.newaxis], n, axis=0))


@pytest.mark.parametrize("study", ["sun", "lgsvl", "native"])
def test_sumo_reports_a_collision_just_where_bodies_overlap(study: str) -> None:
    _, run = driven(study, 120)
    _held_against_geometry(study, run)
    assert 10 < np.count_nonzero(run.outcome == Outcome.COLLISION) < 110


def test_sumo_reports_who_hardly_touches_a_pedestrian_with_a_corner() -> None:
    """It cuts the corners off some shapes of vehicles (`guiShape`); the network's must not be one of them."""
    _, run = driven("sun", 800, brakes_until=4.0)
    hit = np.flatnonzero(run.outcome == Outcome.COLLISION)
    last = [np.flatnonzero(run.trace.active[:, vehicle])[-1] for vehicle in hit]
    assert np.any((np.abs(run.trace.lateral[last, hit]) > 0.9) & (run.trace.gap[last, hit] > -0.2))
    _held_against_geometry("sun", run)


def _held_against_geometry(study: str, run: SimulationRuns) -> None:
    trace, collided = run.trace, run.outcome == Outcome.COLLISION
    half_width, person, thickness = (2.1284 / 2, 0.478, 0.215) if study == "sun" else (1.85 / 2, 0.0, 0.0)
    beside = np.abs(trace.lateral) <= half_width + thickness + 0.02 if study == "sun" else np.ones_like(trace.active)
    within = (trace.gap < -0.02) & (trace.gap > -trace.vehicle_length - person + 0.02)
    surely_beside = np.abs(trace.lateral) <= half_width - 0.02 if study == "sun" else beside
    overlaps = (trace.active & within & surely_beside).any(axis=0)
    touches = (trace.active & (trace.gap <= 0.02) & beside).any(axis=0)
    assert np.all(collided[overlaps])
    assert np.all(touches[collided])
