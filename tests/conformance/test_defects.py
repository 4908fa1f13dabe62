"""Planted defects of all kinds are found, each with its file and line; what is shipped and what is right elsewhere passes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from safevar_sumo import testing
from safevar_sumo.conformance import KINDS, check, check_subject, find_subject, subjects_of, suite
from safevar_sumo.plugins import timeout
from safevar_sumo.study import load_study, study_names
from safevar_sumo.workers.isolation import check_code
from safevar_sumo.workers.retrying import RetryingPool
from tests.in_process import InlinePool, refused, run

SCALAR = """import random
import time
import numpy as np
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    seen_one = 0.0
    past = []

    def drive(self, seen):
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel) + 4
        BODY
        if abs(seen.lateral) < 2.5 and seen.gap < stopping:
            return 0.0, 1.0
        return 0.5 if seen.speed < 5 else 0.0, 0.0
"""
ARRAYS = """import numpy as np
from safevar_sumo.records import Command


class Mine:
    def start(self, n, nominal, step):
        return nominal.decel

    def drive(self, seen, memory):
        BODY
        near = (np.abs(seen.lateral) < 2.5) & (seen.gap < seen.speed**2 / (1.2 * memory) + 2)
        return Command(np.where(~near & (seen.speed < 5), 0.5, 0.0), np.where(near, 1.0, 0.0)), memory
"""
VEHICLE = (Path(__file__).parents[1] / "plugins/six/my_vehicle.py").read_text().replace("Cart", "Mine")
SCENARIO = (Path(__file__).parents[1] / "plugins/six/my_scenario.py").read_text().replace("Wall", "Mine")
METRIC = (Path(__file__).parents[1] / "plugins/six/my_metrics.py").read_text().replace("JERK", "Mine")
OBJECTIVE = (Path(__file__).parents[1] / "plugins/six/my_objective.py").read_text().replace("MEAN", "Mine")
ALGORITHM = (Path(__file__).parents[1] / "plugins/six/my_search.py").read_text().replace("Halving", "Mine")
VEHICLE_STUDY = """extends = "native"
[vehicle]
model = "mine:Mine"
[vehicle.characteristics]
mass  = { unit = "kg", original = 1000, lower = 800, upper = 1600 }
power = { unit = "m/s^2", original = 3, lower = 2, upper = 4 }
grip  = { unit = "m/s^2", original = 8, lower = 5, upper = 9 }
"""
BESIDE = """

class Other:
    def drive(self, seen, memory):
        return np.mean(seen.gap) + random.random()
"""
CONTROLLER = """STANDING_GAP = 3.0
calls = []


def Mine(traci, vehicle_id):
    traci.vehicle.setSpeedMode(vehicle_id, 0)
    speed = traci.vehicle.getSpeed(vehicle_id)
    BODY
    leader = traci.vehicle.getLeader(vehicle_id, 100)
    if leader and leader[1] < 3 + speed + speed**2 / 8:
        traci.vehicle.slowDown(vehicle_id, 0, max(speed / 4, 0.1))
        return
    traci.vehicle.setSpeed(vehicle_id, 12)
"""


class Defect(NamedTuple):
    """A module in which `line` is wrong, and the check that finds it."""

    kind: str
    check: str
    module: str
    line: str


def planted(kind: str, name: str, module: str, where: str, line: str, at: str = "") -> Defect:
    assert where in module, where
    return Defect(kind, name, module.replace(where, line, 1).replace("BODY", "pass"), at or line.strip().splitlines()[-1])


DEFECTS = {
    "ads random": planted("ads", "determinism", SCALAR, "BODY", "stopping += random.random()"),
    "ads clock": planted("ads", "determinism", SCALAR, "BODY", "stopping += time.time() * 1e3 % 10"),
    "ads class variable": planted("ads", "state", SCALAR, "BODY", "Mine.seen_one = stopping = stopping + 0.01 * Mine.seen_one"),
    "ads shared list": planted("ads", "state", SCALAR, "BODY", "self.past.append(1); stopping += len(self.past) / 1e3"),
    "ads module variable beside another class": planted("ads", "state", "known = {}\n" + SCALAR + BESIDE, "BODY",
                                                        "known['n'] = known.get('n', 0) + 1; stopping += 0.1 * (known['n'] % 2)"),
    "ads misspelt": planted("ads", "contract", SCALAR, "def drive(", "def drvie(", "class Mine"),
    "ads mean over vehicles": planted("ads", "batch", ARRAYS, "BODY", "memory = memory + np.mean(seen.speed)"),
    "ads changes what it sees": planted("ads", "inputs", ARRAYS, "BODY", "seen.gap[:] = np.minimum(seen.gap, 50)"),
    "ads never brakes": planted("ads", "reaction", SCALAR, "return 0.0, 1.0", "return 0.0, 0.0", "def drive(self, seen):"),
    "ads no number": planted("ads", "finite", SCALAR, "return 0.5 if", "return seen.gap * 0, 0.0\n        return 0.5 if",
                             "return seen.gap * 0, 0.0"),
    "ads out of range": planted("ads", "contract", SCALAR, "return 0.0, 1.0", "return 0.0, 100.0"),
    "ads wrong shape": planted("ads", "contract", ARRAYS, "BODY", "return (seen.speed[:2] * 0, 0), memory"),
    "ads signature": planted("ads", "contract", ARRAYS, "def drive(self, seen, memory):", "def drive(self, seen):"),
    "ads hangs": planted("ads", "speed", SCALAR, "BODY", "time.sleep(0.05)"),
    "ads holds a lambda": planted("ads", "picklable", SCALAR, "    past = []",
                                  "    def __init__(self):\n        self.f = lambda x: x\n", "def __init__(self):"),
    "vehicle divides by nothing": planted("vehicle", "finite", VEHICLE, "* 1000 / prepared[\"mass\"]",
                                          "* np.sqrt(1500 - prepared[\"mass\"])", "return State("),
    "vehicle keeps state": planted("vehicle", "state", VEHICLE, "        grip = ", "        self.top_speed *= 0.999\n        grip = ",
                                   "self.top_speed *= 0.999"),
    "vehicle uses no mass": planted("vehicle", "reaction", VEHICLE.replace("SumoType(prepared[\"mass\"]", "SumoType(1000 * n"),
                                    "1000 / prepared[\"mass\"]", "1", "def prepare(self, characteristics, road_friction, step):"),
    "vehicle uses no power": planted("vehicle", "reaction", VEHICLE.replace("prepared[\"power\"], ", "3 * n, "),
                                     "prepared[\"power\"] *", "3 *", "def prepare(self, characteristics, road_friction, step):"),
    "vehicle maximum over vehicles": planted("vehicle", "batch", VEHICLE, "* command.throttle -",
                                             "* np.max(state.speed + 1) -", "np.max(state.speed"),
    "scenario truth values": planted("scenario", "contract", SCENARIO, "gap < -100)", "gap)", "return Scene(gap, nothing, nothing, gap)"),
    "scenario never in conflict": planted("scenario", "reaction", SCENARIO, "trace.gap > 0", "trace.gap > 1e6",
                                          "def encounter(self, trace):"),
    "scenario no number": planted("scenario", "finite", SCENARIO, "return Scene(gap,", "return Scene(gap * np.nan,"),
    "metric over runs": planted("metric", "batch", METRIC, "    return np.max(", "    jerk = jerk - np.mean(jerk)\n    return np.max(",
                                  "jerk = jerk - np.mean(jerk)"),
    "metric is a function": Defect("metric", "contract", METRIC.partition("Mine = ")[0].replace("largest_jerk", "Mine"),
                                   "def Mine(runs, thresholds):"),
    "metric shape": planted("metric", "contract", METRIC, ", axis=0)\n\n", ", axis=1)\n\n", "return np.max("),
    "objective no number": planted("objective", "finite", OBJECTIVE, "/ characteristics.original",
                                   "/ (settings - characteristics.original)", "return np.add"),
    "objective is constant": planted("objective", "reaction", OBJECTIVE, "return np.add", "return 0 * share[:, 0] + 0 * np.add",
                                     "def mean_change"),
    "algorithm own random numbers": planted("algorithm", "determinism", ALGORITHM, "result, original,",
                                            "rng = np.random.default_rng()\n        result, original,", "rng = np.random.default_rng()"),
    "algorithm learns between runs": planted("algorithm", "state", ALGORITHM, "reach *= self.factor",
                                              "Mine.reach = reach = reach * 0.5 * getattr(Mine, 'reach', 1)", "Mine.reach = reach"),
    "algorithm unfiltered": planted("algorithm", "contract", ALGORITHM, "problem.characteristics.filter(settings)", "settings"),
    "controller random": planted("traci", "determinism", CONTROLLER.replace("calls = []", "import random"), "BODY",
                                 "speed = speed * random.random()"),
    "controller other vehicle": planted("traci", "contract", CONTROLLER, "BODY", "traci.vehicle.setSpeed('parked_ahead', 0)"),
    "controller signature": planted("traci", "contract", CONTROLLER, "def Mine(traci, vehicle_id):", "def Mine(vehicle_id):"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_is_named_with_file_and_line(name: str, in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    defect = DEFECTS[name]
    if name == "ads hangs":
        monkeypatch.setattr(suite, "RUN_LIMIT", 1.0)
    (in_tmp / "mine.py").write_text(defect.module)
    if defect.kind == "vehicle":
        (in_tmp / "mine.toml").write_text(VEHICLE_STUDY)
    report = check("mine:Mine")
    assert report.kind == defect.kind
    assert report.seconds < 10
    places = [(one.check, one.line) for one in report.findings]
    lines = [number for number, line in enumerate(defect.module.splitlines(), 1) if defect.line in line]
    assert places, "nothing is found"
    assert places[0][0] == defect.check, [str(one) for one in report.findings]
    assert places[0][1] in lines, [str(one) for one in report.findings]
    assert Path(report.findings[0].file).resolve() == (in_tmp / "mine.py").resolve()
    assert all((one.expected, one.got, one.advice) for one in report.findings)


@pytest.mark.slow
def test_the_time_limit_begins_after_a_module_and_its_library_are_imported(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "RUN_LIMIT", limit := 1.0)
    monkeypatch.setattr(timeout, "load_factor", lambda: 1.0)
    slow = f"import time\ntime.sleep({1.2 * limit})\n"
    (in_tmp / "library.py").write_text(slow)
    (in_tmp / "mine.py").write_text(slow + ALGORITHM.replace("    def search(self, problem, rng):\n", """    def search(self, problem, rng):
        import library
"""))
    assert "import library" in (in_tmp / "mine.py").read_text()
    report = check("mine:Mine")
    assert report.passed, "\n".join(map(str, report.findings))


RIGHT = {
    "scalar ads": SCALAR.replace("BODY", "self.far = seen.gap"),
    "ads over arrays": ARRAYS.replace("BODY", "memory = memory + 0 * seen.gap.shape[0]"),
    "vehicle": VEHICLE, "scenario": SCENARIO, "metric": METRIC, "objective": OBJECTIVE, "algorithm": ALGORITHM,
    "controller": CONTROLLER.replace("BODY", "calls.append(speed)"),
    "controller class": "class Mine:\n    def start(self, traci, vehicle_id):\n        self.speeds = []\n\n"
                        "    def step(self, traci, vehicle_id):\n        self.speeds.append(traci.vehicle.getSpeed(vehicle_id))\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGHT)
def test_what_is_right_passes(name: str, in_tmp: Path) -> None:
    (in_tmp / "mine.py").write_text(RIGHT[name])
    report = check("mine:Mine")
    assert report.passed, "\n".join(map(str, report.findings))


SHIPPED = [(kind, name) for kind, members in KINDS.items() for name in members]


@pytest.mark.parametrize(("kind", "name"), [
    pytest.param(kind, name, marks=[] if name in ("krauss", "nsga2", "f_diff", "tet") else [pytest.mark.slow]) for kind, name in SHIPPED])
def test_what_is_shipped_passes(kind: str, name: str) -> None:
    report = check_subject(find_subject(name))
    assert report.kind == kind
    assert report.passed, "\n".join(map(str, report.findings))


def test_a_study_is_not_tried_in_another_study() -> None:
    refused("check", "smoke", "--study", "nope", message=("--study: 'nope': 'smoke' is a study itself",))


@pytest.mark.parametrize("name", study_names())
def test_check_knows_everything_that_a_shipped_study_names(name: str) -> None:
    assert {"vehicle", "ads", "scenario"} <= {subject.kind for subject in subjects_of(load_study(name))}


@pytest.mark.slow
def test_the_command_prints_the_json_and_ends_with_its_exit_codes(in_tmp: Path) -> None:
    (in_tmp / "mine.py").write_text(DEFECTS["ads out of range"].module)
    (in_tmp / "mine.toml").write_text('extends = "smoke"\n[ads]\nmodel = "mine:Mine"\n')
    for subject, kind in (("mine:Mine", "ads"), ("mine.toml", "study")):
        report = json.loads(run("check", subject, "--json", expect=1).stdout)
        assert list(report) == ["subject", "kind", "passed", "findings", "seconds"]
        assert (report["subject"], report["kind"], report["passed"]) == (subject, kind, False)
        assert list(report["findings"][0]) == ["check", "file", "line", "expected", "got", "advice"]
    assert "mine.py:15: contract: returned brake = 100.0 from drive" in run("check", "mine:Mine", expect=1).stdout.replace("\n", "")
    (in_tmp / "mine.py").write_text(RIGHT["scalar ads"])
    assert json.loads(run("check", "mine:Mine", "--study", "mine.toml", "--json").stdout)["findings"] == []
    for wrong in ("mine:Nothing", "nothing:Mine", "aebb", "missing.toml"):
        run("check", wrong, expect=2)
    (in_tmp / "mine.py").write_text("1 / 0\n")
    run("check", "mine:Mine", expect=2)


@pytest.mark.slow
def test_everything_that_a_study_names_is_checked_and_remembered(in_tmp: Path) -> None:
    """An objective may be named by a metric's column; what has passed is not checked again until a file changes."""
    shutil.copytree(Path(__file__).parents[1] / "plugins/six", "six")
    study = load_study("six/mine.toml")
    assert {one.name for one in subjects_of(study)} == {
        "my_vehicle:Cart", "my_ads:Careful", "my_scenario:Wall", "my_metrics:JERK", "my_objective:MEAN", "nsga2", "my_search:Halving"}
    pool = RetryingPool(InlinePool(), study)
    assert check_code(study, {"sources": {"my_ads.py": "1"}}, pool) == []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "submit", lambda *_, **__: pytest.fail("checked again"))
        assert check_code(study, {"sources": {"my_ads.py": "1"}}, pool) == []
        with pytest.raises(pytest.fail.Exception):
            check_code(study, {"sources": {"my_ads.py": "2"}}, pool)


def test_an_authors_test_class_has_a_test_for_each_check(in_tmp: Path) -> None:
    (in_tmp / "mine.py").write_text(DEFECTS["ads never brakes"].module)

    class TestMine(testing.AdsChecks):
        subject = "mine:Mine"

    for name in testing.CHECK_NAMES:
        if name == "reaction":
            with pytest.raises(AssertionError, match="never brakes"):
                TestMine().test_check(name)
        else:
            TestMine().test_check(name)
    assert TestMine.test_check.pytestmark[0].args == ("check_name", testing.CHECK_NAMES)  # type: ignore[attr-defined]
