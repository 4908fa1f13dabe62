"""What leaks from setting to setting in rare states alone is found when a run ends, however its settings were shared out."""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.api.running import NullObserver, carried_out
from safevar_sumo.campaign import all_runs
from safevar_sumo.errors import ForeignError
from safevar_sumo.study import load_study
from tests.in_process import Here
from tests.plugins.beside import Mine

LATCH = """
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    seen_one = False

    def drive(self, seen):
        if seen.gap < 1.66:
            Mine.seen_one = True
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel)
        if seen.gap < stopping + 2.0 and abs(seen.lateral) < 2.5:
            return 0.0, 0.9 if Mine.seen_one else 1.0
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
"""


def test_a_class_that_remembers_what_only_a_rare_setting_does(mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(LATCH)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["nsga2"], "evaluations": 60, "runs": 1})
    for _ in range(2):  # the same command again does not get by either
        with pytest.raises(ForeignError, match=r"in run nsga2-00 and [\d.]+ alone; again by: python -m safevar_sumo simulate") as caught:
            carried_out(study, system, all_runs(study), tmp_path / "out", Here(), NullObserver(), 7)
        assert "ads.model = 'mine:Mine' a result depends on what else is simulated" in str(caught.value)
    assert not (tmp_path / "out/solutions.csv").exists()


SEARCH = """
class Mine:
    best = None

    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(10, rng))
        evaluated = yield settings
        if {own}.best is None:
            {own}.best = evaluated.settings[0].copy()
        settings[1] = {own}.best
        evaluated = yield settings
        return evaluated.take([0])
"""


@pytest.mark.parametrize(("own", "shared"), [("Mine", True), ("self", False)])
def test_an_algorithm_whose_runs_learn_from_each_other(own: str, shared: bool, mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(SEARCH.format(own=own), '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 20\nruns = 3\n')
    study = load_study(str(folder / "mine.toml"))

    def searched() -> object:
        return carried_out(study, system, all_runs(study), tmp_path / "out", Here(), NullObserver(), None)

    if shared:
        with pytest.raises(ForeignError, match="'mine:Mine' asks for other settings when run 2 is repeated alone"):
            searched()
    else:
        searched()


SAFER = """
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    made = 0

    def start(self, nominal, step):
        super().start(nominal, step)
        Mine.made += 1
        self.margin = 4.0 if Mine.made > 40 and Mine.made % 12 == 0 else 2.0

    def drive(self, seen):
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel)
        if seen.gap < stopping + self.margin and abs(seen.lateral) < 2.5:
            return 0.0, 1.0
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
"""


@pytest.mark.slow
def test_a_class_that_makes_every_twelfth_vehicle_safer(mine: Mine, folder: Path, tmp_path: Path) -> None:
    """Neither the most severe evaluation of a run nor its last one shows it."""
    system = mine(SAFER)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["rs"], "evaluations": 100, "runs": 2})
    with pytest.raises(ForeignError, match=r"ads.model = 'mine:Mine' a result depends on what else is simulated"):
        carried_out(study, system, all_runs(study), tmp_path / "out", Here(), NullObserver(), None)


CLOCK = """
import time

import numpy as np


class Mine:
    def search(self, problem, rng):
        for _ in range(2):
            rng = np.random.default_rng(1 + _ * time.time_ns())
            evaluated = yield problem.characteristics.filter(problem.uniform(10, rng))
        return evaluated.take([0])
"""


def test_an_algorithm_that_draws_from_the_clock(mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(CLOCK, '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 20\nruns = 1\n')
    study = load_study(str(folder / "mine.toml"))
    with pytest.raises(ForeignError, match="'mine:Mine' asks for other settings when run 0 is repeated alone"):
        carried_out(study, system, all_runs(study), tmp_path / "out", Here(), NullObserver(), None)


GREEDY = """
class Mine:
    def search(self, problem, rng):
        problem.characteristics.lower[:] = 0
        yield problem.characteristics.filter(problem.uniform(10, rng))
"""
IDLE = """
class Mine:
    def search(self, problem, rng):
        {body}
        return problem.original.take([])
"""


@pytest.mark.parametrize(("module", "problem"), [
    (GREEDY, "read-only"),
    (IDLE.format(body="if problem.evaluations == 0:\n            yield"), "ended in search without asking for any setting"),
    (IDLE.format(body="yield problem.characteristics.original[None][:0]"), "returned settings = .* from search"),
], ids=["lower", "nothing", "empty"])
def test_an_algorithm_that_changes_its_problem_or_asks_for_nothing(module: str, problem: str, mine: Mine, folder: Path,
                                                                  tmp_path: Path) -> None:
    system = mine(module, '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 10\nruns = 1\n')
    study = load_study(str(folder / "mine.toml"))
    with pytest.raises(ForeignError, match=problem):
        carried_out(study, system, all_runs(study), tmp_path / "out", Here(), NullObserver(), None)
