"""Checks before a search find models in which one setting affects another; a run ends with its
end.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.plugins import UserCode
from safevar_sumo.plugins.contract import checked_class
from safevar_sumo.records import Command
from safevar_sumo.results import load_runs
from safevar_sumo.sumo.matrix import drive_and_score, drive_worst
from safevar_sumo.vehicles import Vehicle
from tests.support.holding import Pedals
from tests.support.in_process import (
    SLOW,
    json_of,
    numbers_of,
    refused,
    run,
    searched,
    write,
)
from tests.support.made_up import assert_same_results, changed, original_of, system_of
from tests.support.user_code import Mine
from tools.manual import files_of

SEARCH = """
class Mine:
    best = None

    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(10, rng))
        evaluated = yield settings
        if self.best is None:
            self.best = evaluated.settings[0].copy()
        settings[1] = self.best
        evaluated = yield settings
        return evaluated.take([0])
"""


def test_an_algorithm_whose_runs_do_not_learn_from_each_other_is_not_accused(
    mine: Mine, folder: Path, tmp_path: Path
) -> None:
    mine(SEARCH, '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 20\nruns = 3\n')
    searched(load_study(str(folder / "mine.toml")), tmp_path / "out")


SIX = """
extends = "cart.toml"
name = "six"
[ads]
model = "my_ads:Careful"
parameters = { margin = 4.0 }
[metrics]
also = ["my_metrics:JERK"]
[search]
algorithms = ["nsga2", "my_search:Halving"]
objectives = ["safety_degree", "jerk", "my_objective:MEAN"]
[search.Halving]
factor = 0.7
"""
"""Six members from outside: those of the tutorials."""


@SLOW
def test_members_of_user_code_are_searched_and_tabulated(in_tmp: Path) -> None:
    pages = (f"docs/tutorials/own_{page}.md" for page in ("ads", "vehicle", "metric"))
    for name, text in files_of(*pages).items():
        write(name, text)
    write("six.toml", SIX)
    run("study six.toml --out out --runs 1 --evaluations 20 --quiet")
    solutions = load_runs("out").solutions
    assert set(solutions["algorithm"]) == {"nsga2", "Halving"}
    assert np.isfinite(solutions[["jerk", "mean_change"]].to_numpy()).all()
    tables = json_of("tables out")["tables"]
    for question in ("rq1", "rq2"):
        assert "jerk" in {row["metric"] for row in tables[question]["rows"]}


LATE = """
from safevar_sumo.ads import ScalarAds

class Late(ScalarAds):
    number = 0

    def __init__(self):
        Late.number += 1
        self.is_late = Late.number > 1_200

    def drive(self, seen):
        if abs(seen.lateral) < 2.5 and seen.gap < 10 and not self.is_late:
            return 0.0, 1.0
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
"""
"""A driving system that no longer brakes after 1,200 instances: more than `check` makes."""


@SLOW
@pytest.mark.parametrize(
    "command", ["rules late.toml --samples 1500", "study late.toml --out out --quiet"]
)
def test_a_state_that_shows_late_is_an_error_at_the_end(
    command: str, in_tmp: Path
) -> None:
    write("late.py", LATE)
    write(
        "late.toml",
        'extends = "smoke"\nname = "late"\n[ads]\nmodel = "late:Late"\n'
        '[search]\nalgorithms = ["rs"]\nruns = 1\nevaluations = 1500\n',
    )
    refused(command, "when a worker simulated its first batch again", "late:Late")
    assert not [*Path().rglob("*.jsonl")], "nothing is continued"


NATIVE = system_of("native")
MASS = 1700.0
"""Of the heavy vehicle [kg]."""
HEAVY = changed(NATIVE, mass=MASS)


BRAKES = Pedals(
    lambda seen: (
        np.where((np.arange(len(seen.speed)) > 0) & (seen.time > 1), 0.05, 1),
        0,
    )
)
"""Full throttle, and hardly any for the light one of two."""


LENGTH = len(drive_worst(replace(NATIVE, ads=BRAKES), HEAVY).trace.time)
"""Samples until the heavy vehicle collides."""


class Diverges(Vehicle):
    """The heavy vehicle has this speed from so many steps on."""

    def __init__(self, speed: float, steps: int = LENGTH) -> None:
        self._inner = NATIVE.vehicle
        self.speed = speed
        self.steps = steps

    UNITS = NATIVE.vehicle.UNITS
    sumo_type, at_rest, at_speed, sense = (
        staticmethod(getattr(NATIVE.vehicle, name))
        for name in ("sumo_type", "at_rest", "at_speed", "sense")
    )

    def prepare(self, characteristics: Any, *arguments: Any) -> Any:
        self._is_heavy = characteristics["mass"] == MASS
        self._calls = 0
        return self._inner.prepare(characteristics, *arguments)

    def advance(self, prepared: Any, state: Any, command: Command) -> Any:
        self._calls += 1
        result = self._inner.advance(prepared, state, command)
        return result._replace(
            speed=np.where(
                self._is_heavy & (self._calls >= self.steps), self.speed, result.speed
            )
        )


USERS = checked_class(UserCode("vehicle.model = 'mine:Mine'", Diverges), Vehicle)


BOTH = np.concatenate([HEAVY, original_of(NATIVE)])


@pytest.mark.parametrize(
    "vehicle", [Diverges(np.nan), *map(USERS, (np.nan, -3.0, 900.0))]
)
def test_a_vehicle_that_diverges_after_its_own_collision_has_the_result_that_it_has_alone(
    vehicle: Vehicle,
) -> None:
    system = replace(NATIVE, ads=BRAKES, vehicle=vehicle)
    alone = drive_and_score(system, BOTH[:1])
    together = drive_and_score(system, BOTH)
    assert len(drive_worst(system, BOTH).trace.time) > LENGTH, (
        "the other vehicle drives longer"
    )
    assert_same_results(together.take([0]), alone)
    assert alone.collided.all()


@pytest.mark.parametrize(
    "vehicle", [Diverges(np.nan, LENGTH - 1), USERS(-3.0, LENGTH - 1)]
)
def test_a_vehicle_that_diverges_before_its_end_is_an_error_in_every_batch(
    vehicle: Vehicle,
) -> None:
    for settings in (BOTH[:1], BOTH):
        with pytest.raises(InputError, match=r"speed (is nan|= -3\.0)"):
            drive_and_score(replace(NATIVE, ads=BRAKES, vehicle=vehicle), settings)


def test_a_module_beside_the_study_may_have_the_name_of_one_that_is_loaded(
    in_tmp: Path,
) -> None:
    write(
        "random.py",
        "import random\n"
        "from safevar_sumo.ads.aeb import Aeb\n"
        "class Mine(Aeb, frozen=True, kw_only=True):\n"
        "    braking_share: float = random.choice([0.3])\n",
    )
    write(
        "mine.toml",
        'extends = "wear"\nname = "mine"\n[ads]\nmodel = "random:Mine"\nparameters = {}\n',
    )
    assert numbers_of("simulate mine.toml")["f_safe"] == pytest.approx(1.16, abs=0.01)
