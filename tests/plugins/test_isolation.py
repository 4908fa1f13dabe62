"""Checks before a search find models in which one setting affects another; options that write files are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.api.running import carry_out_runs
from safevar_sumo.campaign import all_runs
from safevar_sumo.conformance import refuse_defects
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.results import load_runs
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers import isolation
from safevar_sumo.workers.retrying import RetryingPool
from tests.in_process import InlinePool, SilentObserver, refused, run
from tests.plugins.beside import ADS as USES_ADS
from tests.plugins.beside import SCALAR, Mine

ADS = ("import numpy as np\n\n\nclass Mine:\n    def start(self, n, nominal, step):\n        return 0\n\n"
       "    def drive(self, seen, memory):\n")
MEAN = ADS + "        return (0 * seen.speed + 0.5 + 0.01 * np.mean(seen.speed), 0), memory\n"
CLASS = SCALAR + "    calls = 0\n\n    def drive(self, seen):\n        Mine.calls += 1\n        return 1 / (1 + Mine.calls / 1e4), 0.0\n"
SELF = ADS + "        self.count = getattr(self, 'count', 0) + 1\n        return (0 * seen.speed + 1 / self.count, 0), memory\n"
RANDOM = SCALAR + "    def drive(self, seen):\n        return np.random.random(), 0.0\n\n\nimport numpy as np\n"
PLACE = ADS + "        return (np.linspace(0.2, 0.8, len(seen.speed)), 0), memory\n"
HONEST = SCALAR + "    def drive(self, seen):\n        return 0.5, 0.0\n"


def checked(mine: Mine, module: str, folder: Path, table: str = USES_ADS) -> None:
    mine(module, table)
    refuse_defects(load_study(str(folder / "mine.toml")))


@pytest.mark.parametrize(("module", "message"), [
    (MEAN, "in two halves (|alone|in another order)"), (CLASS, "in a second run"), (SELF, "in a second run"),
    (RANDOM, "when the run is repeated"), (PLACE, "in another order")], ids=["mean", "class", "self", "random", "place"])
def test_an_ads_that_mixes_settings_up_is_refused(module: str, message: str, mine: Mine, folder: Path) -> None:
    with pytest.raises(UserCodeError, match=rf"'mine:Mine' (throttle|brake) of vehicle \d+ is .* {message}") as caught:
        checked(mine, module, folder)
    assert "mine.py:" in str(caught.value)


def test_an_honest_ads_is_accepted(mine: Mine, folder: Path) -> None:
    checked(mine, HONEST, folder)


@pytest.mark.parametrize("option", ['<fcd-output value="fcd.xml"/>', '<output><summary-output value="x"/></output>',
                                    '<remote-port value="8813"/>', '<random value="true"/>', '<additional-files value="a.xml"/>',
                                    '<log value="x"/>', '<save-state.times value="1"/>', '<device.fcd.period value="1"/>'])
def test_a_folder_whose_configuration_writes_files_or_opens_sockets_is_refused(option: str, folder: Path) -> None:
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", folder / "road")
    (folder / "mine.toml").write_text('extends = "native"\nname = "mine"\n[scenario.parameters]\nnetwork = "road"\n')
    system = assemble(load_study(str(folder / "mine.toml")))
    assert system.scenario.network == str(folder / "road"), "a folder beside the study"
    file = folder / "road/scenario.sumocfg"
    file.write_text(file.read_text().replace("</configuration>", f"{option}</configuration>"))
    with pytest.raises(InputError, match=r"sets SUMO's option '[a-z.-]+'"):
        assemble(load_study(str(folder / "mine.toml")))


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


@pytest.mark.parametrize(("line", "message"), [
    ("return mass + np.random.random(len(mass))", "the value of vehicle .* when the run is repeated"),
    ("return mass + len(calls)", "the value of vehicle .* in a second run"),
    ("return mass - np.mean(mass)", "the value of vehicle .* in two halves"),
    ("return mass + np.arange(len(mass))", "the value of vehicle .* in another order"),
    ("mass[:] = 0; return mass", "read-only")], ids=["random", "counts", "mean", "place", "changes arguments"])
def test_a_constraint_whose_function_is_none_of_the_setting_alone_is_refused(line: str, message: str, mine: Mine, folder: Path) -> None:
    with pytest.raises(UserCodeError, match=rf"'mine:mine' .*{message}"):
        checked(mine, CONSTRAINT.format(line=line), folder, CONSTRAINED)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["study", "tolerance"])
def test_a_random_constraint_is_refused_before_the_first_batch(command: str, mine: Mine, folder: Path) -> None:
    mine(CONSTRAINT.format(line="return mass + np.random.random(len(mass))"), CONSTRAINED)
    for _ in range(2):
        refused(command, str(folder / "mine.toml"), message=("constraints.function = 'mine:mine'", "when the run is repeated", "mine.py:"))


REACTS = """from safevar_sumo.scenarios import PedestrianCrossing


class Mine(PedestrianCrossing, frozen=True, kw_only=True):
    reactive_actors = False

    def observe(self, world, step, memory):
        if (world.speeds() > 6.0).any():
            world.walk("pedestrian", 0.5)
        return super().observe(world, step, memory)
"""


def test_actors_that_react_undeclared_are_an_error_each_time_that_names_the_vehicle(mine: Mine, folder: Path) -> None:
    """The original reaches 5.7 m/s, the fastest vehicle 6.1 m/s."""
    mine(REACTS, '[scenario]\nmodel = "mine:Mine"\n')
    for _ in range(2):
        with pytest.raises(UserCodeError, match=r"(?s)is (\S+) in the recorded scene and (?!\1)\S+ in SUMO with .*reactive_actors = True"):
            refuse_defects(load_study(str(folder / "mine.toml")))


def test_warnings_about_user_code_are_kept_and_repeated(mine: Mine, folder: Path) -> None:
    mine(HONEST)
    study, inputs = load_study(str(folder / "mine.toml")), {"sources": {"mine.py": str(folder)}}
    for _ in range(2):
        assert "never brakes" in "".join(isolation.check_code(study, inputs, RetryingPool(InlinePool(), study)))
        isolation._passed_checks.clear()  # as in another process


LATCH = """
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    seen_one = False

    def drive(self, seen):
        if seen.gap < 1.0 and seen.visibility == 1:
            Mine.seen_one = True
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel)
        if seen.gap < stopping + 2.0 and abs(seen.lateral) < 2.5:
            return 0.0, 0.9 if Mine.seen_one else 1.0
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
"""


@pytest.mark.slow
def test_a_class_that_remembers_what_only_a_rare_setting_does(mine: Mine, folder: Path, tmp_path: Path) -> None:
    system = mine(LATCH)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["nsga2"], "evaluations": 60, "runs": 1})
    for _ in range(2):  # the same command again does not get by either
        with pytest.raises(UserCodeError, match=r"nsga2-00 and \S+ alone; to reproduce it: python -m safevar_sumo simulate") as caught:
            carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), 7)
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
        return carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), None)

    if shared:
        with pytest.raises(UserCodeError, match=r"'mine:Mine' settings requested .* in a second run .*mine.py:9"):
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
    """Neither the most severe nor the last evaluation of a run reveals the class; the checks at the start or another evaluation do."""
    system = mine(SAFER)
    study = load_study(str(folder / "mine.toml"), search={"algorithms": ["rs"], "evaluations": 100, "runs": 2})
    with pytest.raises(UserCodeError, match=r"ads.model = 'mine:Mine' (a result depends on what else is simulated|.* in another order)"):
        carry_out_runs(study, system, all_runs(study), tmp_path / "out", InlinePool(), SilentObserver(), None)


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
    with pytest.raises(UserCodeError, match=r"'mine:Mine' settings requested .* when the run is repeated .*mine.py:10"):
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


@pytest.mark.parametrize(("module", "problem"), [
    (GREEDY, "read-only"),
    (IDLE.format(body="if problem.evaluations == 0:\n            yield"), "ended in search without yielding any setting"),
    (IDLE.format(body="yield problem.characteristics.original[None][:0]"), "returned settings = .* from search"),
], ids=["lower", "nothing", "empty"])
def test_an_algorithm_that_changes_its_problem_or_asks_for_nothing(module: str, problem: str, mine: Mine, folder: Path,
                                                                  tmp_path: Path) -> None:
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
