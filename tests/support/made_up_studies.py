"""Made-up studies: characteristics from 0 to 10 with an original of 5, and a pool whose unsafe
region is known.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign.evaluation import Task, evaluate_settings
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.drives import (
    AreUnsafe,
    Drives,
    Encounters,
    Judge,
    Judged,
    Scope,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.study import CharacteristicTable, Study
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import InlinePool
from tests.support.made_up import made_up_evaluations

Robustness = Callable[[Drives], FloatArray]
"""The robustness of M made-up drives, shape (M,): below 0 unsafe."""
ONE_TEST = {
    "title": "one test",
    "matrix": {
        "tests": [
            {"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [40]}}
        ]
    },
}
"""What is changed in the study `wear`, so that cars drive at one of its points only."""
ORIGINAL, LOWER, UPPER = 5.0, 0.0, 10.0
Region = Callable[[FloatArray], BoolArray]


def made_up_study(n: int) -> Study:
    smoke = load_study("smoke", scenario={"over": False, "margin": 0.3})
    rows = {
        name: CharacteristicTable(
            unit="N m", original=ORIGINAL, lower=LOWER, upper=UPPER
        )
        for name in "abcdefghijkl"[:n]
    }
    return replace(
        smoke,
        name="made-up",
        spread={},
        vehicle=replace(smoke.vehicle, characteristics=rows),
    )


def nowhere(settings: FloatArray) -> BoolArray:
    return np.zeros(len(settings), dtype=bool)


def everywhere(settings: FloatArray) -> BoolArray:
    return np.ones(len(settings), dtype=bool)


def two_metres(settings: FloatArray) -> FloatArray:
    return np.full(len(settings), 2.0)


class Plant(InlinePool):
    """A pool in which settings in `region` collide at 1 m/s, settings in `failing` fail, and all
    others have the safety degree `degree`.
    """

    def __init__(
        self,
        study: Study,
        region: Region,
        degree: Callable[[FloatArray], FloatArray] = two_metres,
        failing: Region = nowhere,
    ):
        super().__init__()
        self._characteristics = CharacteristicSet.of(study)
        self._region, self._degree, self._failing = region, degree, failing
        self.seen: set[bytes] = set()

    def compute(self, function: Callable[..., Any], task: Task, *arguments: Any) -> Any:
        return self.evaluate(*arguments) if function is evaluate_settings else ""

    def evaluate(self, settings: FloatArray) -> Evaluations:
        fails = self._failing(settings)
        collides = self._region(settings) & ~fails
        degree = np.where(collides, -1.0, self._degree(settings))
        outcome = np.where(collides, "collision", "stopped").astype("U16")
        degree[fails], outcome[fails] = np.nan, "simulator-error"
        self.seen |= {row.tobytes() for row in settings}
        return made_up_evaluations(
            degree,
            settings=settings,
            outcome=outcome,
            collision_speed=np.where(collides, 1.0, np.nan),
            f_diff=self._characteristics.largest_change(settings),
            f_num_diff=self._characteristics.number_changed(settings),
        )


def made_up_evaluator(n: int, region: Region) -> Evaluator:
    study = made_up_study(n)
    return Evaluator(study, Plant(study, region))


def made_up_model(n: int, region: Region, fit: int = 0) -> Model:
    return Model(fit, made_up_evaluator(n, region), Unsafe())


def box(settings: FloatArray) -> BoolArray:
    """a above 7 and b below 3: 9 % of two domains."""
    return (settings[:, 0] > 7) & (settings[:, 1] < 3)


def two_islands(settings: FloatArray) -> BoolArray:
    """a from 6.5 to 7, and a above 9: 15 % of its domain."""
    return ((settings[:, 0] > 6.5) & (settings[:, 0] < 7)) | (settings[:, 0] > 9)


def model_of(study: Study, **unsafe: Any) -> Model:
    """Its own model, which is simulated here."""
    return Model(0, Evaluator(study, InlinePool(), verified=0), Unsafe(**unsafe))


def scope_of(n: int, *, worlds: int = 1, center: FloatArray | None = None) -> Scope:
    """n values from 0 to 10, some worlds, a phase and another place."""
    ends = np.zeros(n), np.full(n, 10.0)
    return Scope(*ends, range(worlds), np.zeros(1), np.ones(1), center=center)


def places(*values: float) -> Encounters:
    """Encounters at these places."""
    number = len(values)
    world = np.zeros(number, dtype=np.intp)
    return Encounters(world, np.zeros(number), np.array(values)[:, np.newaxis])


def drives_of(*vehicles: list[float]) -> Drives:
    return Drives(np.array(vehicles), places(*[0.0] * len(vehicles)))


def judge_by(robustness: Robustness) -> Judge:
    """A judge of drives that all count and have valid simulations."""
    return lambda drives: Judged.simulated(drives, robustness(drives))


def are_unsafe_by(robustness: Robustness) -> AreUnsafe:
    return lambda drives: robustness(drives) < 0
