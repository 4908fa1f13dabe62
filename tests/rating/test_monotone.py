"""Wear that improves no cell earns no point: the whole protocol, simulated with vehicles that wear step by step."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from safevar_sumo.analysis.rating.compute import RatedVehicle, rate
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet

pytestmark = pytest.mark.slow
STUDY = load_study("euro_ncap_rating")
MEMBERS = CharacteristicSet.of(STUDY.vehicle.characteristics)
WORST = {"treadDepth": 1.6, "brakeTorque": 0.5, "sensorLatency": 0.3}
STEPS = np.linspace(0, 1, 4)
MATRIX = ("standard", "extended")
VEHICLES = 3
"""The original one, and others of which each characteristic has up to 0.4 of its domain's wear."""
GAIN = {
    "treadDepth": 4.2,
    "brakeTorque": 0.87,
    "brakeResponse": 0.16,
    "payload": 200.0,
    "sensorRange": 56.0,
    "sensorLatency": 0.16,
}
"""The vehicle of docs/rating.md, which has gained a layer since its tread was 5.1 mm deep."""


def monotone(better: RatedVehicle, worse: RatedVehicle, cells: list[int]) -> bool:
    """Whether the worse vehicle has no lower impact speed in any cell."""
    speeds = [np.nan_to_num(one.cells.impact[0, cells], nan=0.0) for one in (better, worse)]
    return bool((speeds[1] >= speeds[0]).all())


def test_wear_never_gains_points_in_a_monotone_matrix() -> None:
    rng, ladders, settings = np.random.default_rng(20), [], {}
    for number in range(VEHICLES):
        wear = 0.4 * rng.random() * (number > 0)
        vehicle = MEMBERS.original + wear * (rng.uniform(MEMBERS.lower, MEMBERS.upper) - MEMBERS.original)
        for name, worst in WORST.items():
            column, names = MEMBERS.names.index(name), []
            for step in STEPS:
                setting = vehicle.copy()
                setting[column] = MEMBERS.original[column] + step * (worst - MEMBERS.original[column])
                names.append(f"vehicle {number}, {name} {setting[column]:.2f}")
                settings[names[-1]] = setting
            ladders += pairwise(names)
    rating = rate(STUDY, settings)
    rated = {one.name: one for one in rating.vehicles}
    cells = {
        matrix.name: [
            number
            for number, cell in enumerate(rating.protocol.cells)
            if cell.matrix is matrix and cell.range_or_layer in MATRIX
        ]
        for matrix in rating.protocol.matrices
    }
    matrices, pairs, losses = 0, 0, 0
    for better, worse in ((rated[first], rated[then]) for first, then in ladders):
        for before, after in zip(better.tests, worse.tests, strict=True):
            pairs += 1
            if not monotone(better, worse, cells[before.matrix.name]):
                continue
            matrices += 1
            assert after.points[0] <= before.points[0], (better.name, worse.name, before.matrix.name)
            assert after.points[1] <= before.points[1], (better.name, worse.name, before.matrix.name)
            losses += after.points[:2] != before.points[:2]
    assert matrices >= 0.95 * pairs, f"{matrices} of {pairs} matrices are monotone"
    assert losses >= 20


def test_a_layer_may_be_gained_where_its_cell_is_lost() -> None:
    """The case that docs/rating.md explains, with its numbers."""
    rating = rate(STUDY, {str(tread): MEMBERS.setting({**GAIN, "treadDepth": tread}, "it") for tread in (5.1, 4.2)})
    newer, older = rating.vehicles[1:]
    before, after = (next(test for test in one.tests if test.matrix.name == "CPNCO day") for one in (newer, older))
    assert [round(one.points, 2) for one in (newer, older)] == [33.64, 32.64]
    assert [round(one.points[0], 3) for one in (before, after)] == [0.792, 0.667]
    assert [round(one.points[2], 3) for one in (before, after)] == [0.025, 0.05]
    assert [one.layers["Trajectory/Heading"] for one in (before, after)] == [False, True]
