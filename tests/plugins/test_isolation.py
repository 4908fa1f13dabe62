"""Checks before a search find models in which one setting affects another; options that write files are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.api.running import carry_out_runs
from safevar_sumo.campaign import all_runs
from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins.check import refuse_defects
from safevar_sumo.results import load_runs
from safevar_sumo.study import load_study
from tests.in_process import InlinePool, SilentObserver, refused, run
from tests.plugins.beside import ADS as USES_ADS
from tests.plugins.beside import Mine


def checked(mine: Mine, module: str, folder: Path, table: str = USES_ADS) -> None:
    mine(module, table)
    refuse_defects(load_study(str(folder / "mine.toml")))


CONSTRAINT = """import numpy as np

calls = []


def mine(values):
    calls.append(1)
    mass = values["mass"]
    {line}


def step(traci, vehicle_id):
    pass
"""
CONSTRAINED = '[[constraints]]\nfunction = "mine:mine"\nunit = "kg"\nat_most = 1e9\n'


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("return mass + np.random.random(len(mass))", "the value is .* in a second run"),
        ("return mass + len(calls)", "the value is .* in a second run"),
        ("return mass - np.mean(mass)", "the value is .* in (another order|a smaller batch)"),
        ("return mass + np.arange(len(mass))", "the value is .* in another order"),
        ("mass[:] = 0; return mass", "read-only"),
    ],
    ids=["random", "counts", "mean", "place", "changes arguments"],
)
def test_a_constraint_whose_function_is_none_of_the_setting_alone_is_refused(
    line: str, message: str, mine: Mine, folder: Path
) -> None:
    with pytest.raises(UserCodeError, match=rf"'mine:mine' .*{message}"):
        checked(mine, CONSTRAINT.format(line=line), folder, CONSTRAINED)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["study", "tolerance"])
def test_a_random_constraint_is_refused_before_the_first_batch(command: str, mine: Mine, folder: Path) -> None:
    mine(CONSTRAINT.format(line="return mass + np.random.random(len(mass))"), CONSTRAINED)
    for _ in range(2):
        refused(
            command,
            str(folder / "mine.toml"),
            message=("constraints.function = 'mine:mine'", "in a second run", "mine.py:"),
        )


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
def test_an_algorithm_whose_runs_learn_from_each_other(
    own: str, shared: bool, mine: Mine, folder: Path, tmp_path: Path
) -> None:
    system = mine(SEARCH.format(own=own), '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 20\nruns = 3\n')
    study = load_study(str(folder / "mine.toml"))

    def searched() -> object:
        return carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), None)

    if shared:
        with pytest.raises(UserCodeError, match=r"'mine:Mine' setting 11 is .* in another run .*mine.py:2"):
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
        self.margin = 4.0 if Mine.made > 300 else 2.0

    def drive(self, seen):
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel)
        if seen.gap < stopping + self.margin and abs(seen.lateral) < 2.5:
            return 0.0, 1.0
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
"""


@pytest.mark.slow
def test_a_class_that_changes_after_three_hundred_vehicles(mine: Mine, folder: Path, tmp_path: Path) -> None:
    """The checks at the start do not reveal it; what the run simulates again does, and the same command again does not
    get by either.
    """
    system = mine(SAFER)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["rs"], "evaluations": 450, "runs": 1})
    for _ in range(2):
        with pytest.raises(
            UserCodeError, match=r"rs-00 and \S+ alone; to reproduce it: python -m safevar_sumo simulate"
        ) as caught:
            carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), 50)
        assert "ads.model = 'mine:Mine' a result depends on what else is simulated" in str(caught.value)
    assert not (tmp_path / "out/solutions.csv").exists()


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
    with pytest.raises(UserCodeError, match=r"'mine:Mine' setting 10 is .* in another run .*mine.py:7"):
        carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), None)


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


@pytest.mark.parametrize(
    ("module", "problem"),
    [
        (GREEDY, "read-only"),
        (
            IDLE.format(body="if problem.evaluations == 0:\n            yield"),
            "ended in search without yielding any setting",
        ),
        (IDLE.format(body="yield problem.characteristics.original[None][:0]"), "returned settings = .* from search"),
    ],
    ids=["lower", "nothing", "empty"],
)
def test_an_algorithm_that_changes_its_problem_or_asks_for_nothing(
    module: str, problem: str, mine: Mine, folder: Path, tmp_path: Path
) -> None:
    system = mine(module, '[search]\nalgorithms = ["mine:Mine"]\nevaluations = 10\nruns = 1\n')
    study = load_study(str(folder / "mine.toml"))
    with pytest.raises(UserCodeError, match=problem):
        carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), None)


@pytest.fixture
def six(in_tmp: Path) -> None:
    shutil.copytree(Path(__file__).parent / "six", "six")


def test_members_of_user_code_are_simulated_and_scored(six: None) -> None:
    output = json.loads(run("simulate", "six/mine.toml", "--set", "grip=5", "--json").stdout)
    assert output["jerk"] > 0
    assert output["mean_change"] == pytest.approx(3 / 8 / 3)


@pytest.mark.slow
def test_members_of_user_code_are_searched_and_tabulated(six: None) -> None:
    run("study", "six/mine.toml", "--out", "out", "--runs", "1", "--evaluations", "20", "--quiet")
    solutions = load_runs("out").solutions
    assert set(solutions["algorithm"]) == {"nsga2", "Halving"}
    assert np.isfinite(solutions[["jerk", "mean_change"]].to_numpy()).all()
    assert solutions["f_diff"].max() <= 1 / 2 + 1e-9, "the weight of mass halves its changes"
    for question in ("rq1", "rq2"):
        rows = json.loads(run("tables", "out", "--rq", question, "--format", "json").stdout)
        assert "jerk" in {row["metric"] for row in rows}
