"""Planted defects of all kinds are found, with the input that shows them; what is shipped and what
is right elsewhere passes.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.check import check_study, study_to_check, trials
from tests.support.in_process import SLOW, json_of, rows_of, run, write
from tools.manual import files_of

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
    first = None

    def start(self, n, nominal, step):
        return nominal.decel

    def drive(self, seen, memory):
        BODY
        near = (np.abs(seen.lateral) < 2.5) & (seen.gap < seen.speed**2 / (1.2 * memory) + 2)
        throttle = np.where(~near & (seen.speed < 5), 0.5, 0.0)
        return Command(throttle, np.where(near, 1.0, 0.0)), memory
"""
FILES = files_of("docs/tutorials/own_vehicle.md", "docs/tutorials/own_metric.md")
VEHICLE, SCENARIO, METRIC, OBJECTIVE, ALGORITHM = (
    FILES[f"{file}.py"].replace(name, "Mine")
    for file, name in (
        ("my_vehicle", "Cart"),
        ("my_scenario", "Trailer"),
        ("my_metrics", "JERK"),
        ("my_objective", "MEAN"),
        ("my_search", "Halving"),
    )
)
VEHICLE_STUDY = """extends = "native"
[vehicle]
model = "mine:Mine"
[vehicle.characteristics]
mass  = { unit = "kg", original = 1000, lower = 800, upper = 1600 }
power = { unit = "m/s^2", original = 3, lower = 2, upper = 4 }
grip  = { unit = "m/s^2", original = 8, lower = 5, upper = 9 }
"""
CONTROLLER = """calls = []


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
REACTS = """from safevar_sumo.scenarios import PedestrianCrossing


class Mine(PedestrianCrossing, frozen=True, kw_only=True):
    reactive_actors = False

    def observe(self, world, step, memory):
        if (world.speeds() > 6.0).any():
            world.walk("pedestrian", 0.5)
        return super().observe(world, step, memory)
"""


STUDY_OF = {
    "ads": 'extends = "smoke"\n[ads]\nmodel = "mine:Mine"\n',
    "traci": 'extends = "native"\n[ads]\nkind = "traci"\nmodel = "mine:Mine"\n',
    "vehicle": VEHICLE_STUDY,
    "scenario": 'extends = "smoke"\n[scenario]\nmodel = "mine:Mine"\n',
    "metric": 'extends = "smoke"\n[metrics]\nalso = ["mine:Mine"]\n',
    "objective": 'extends = "smoke"\n[search]\nobjectives = ["safety_degree", "mine:Mine"]\n',
    "algorithm": 'extends = "smoke"\n[search]\nalgorithms = ["mine:Mine"]\n',
}
"""A study with user code of each kind."""


MODULES = {
    "scalar": SCALAR,
    "arrays": ARRAYS,
    "vehicle": VEHICLE,
    "scenario": SCENARIO,
    "metric": METRIC,
    "objective": OBJECTIVE,
    "algorithm": ALGORITHM,
    "controller": CONTROLLER,
    "reacts": REACTS,
}
TABLE = Path(__file__).with_name("defects.toml").read_text(encoding="utf-8")
DEFECTS = {row["name"]: row for row in tomllib.loads(TABLE)["planted"]}


def with_defect(name: str) -> str:
    """The module that has a defect."""
    defect = DEFECTS[name]
    module = MODULES[defect["module"]]
    if "old" in defect:
        assert defect["old"] in module
        module = module.replace(defect["old"], defect["new"], 1)
    return module.replace("BODY", "pass")


FAST = ("random", "mean over vehicles", "out of range", "scenario beside its speed")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in FAST else SLOW) for name in DEFECTS]
)
def test_a_planted_defect_is_found_with_the_input_that_shows_it(
    name: str, in_tmp: Path
) -> None:
    defect = DEFECTS[name]
    module = with_defect(name)
    write("mine.py", module)
    write("mine.toml", STUDY_OF[defect["kind"]])
    (finding,) = check_study(study_to_check("mine.toml"))
    assert finding.check == defect["check"], finding
    assert defect["got"] in str(finding)
    file, _, line = finding.where.rpartition(":")
    assert Path(file).resolve() == (in_tmp / "mine.py").resolve()
    assert 1 <= int(line) <= len(module.splitlines())


@pytest.mark.parametrize(
    ("subject", "drive", "reason"),
    [
        ("mine:Mine", "return 0.0, 0.0", "never reaches the encounter"),
        ("mine.toml", "return (0.5, 0.0) if seen.time < 3 else (0.0, 1.0)", "brakes"),
    ],
)
def test_a_driver_who_does_not_get_to_the_encounter_does_not_pass(
    subject: str, drive: str, reason: str, in_tmp: Path
) -> None:
    write(
        "mine.py",
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Mine(ScalarAds):\n"
        f"    def drive(self, seen):\n        {drive}\n",
    )
    write("mine.toml", STUDY_OF["ads"])
    assert [
        (finding.check, reason in finding.finding)
        for finding in check_study(study_to_check(subject))
    ] == [("reaction", True)]


@SLOW
@pytest.mark.parametrize(
    ("pace", "found", "words"),
    [
        (2.5, [], ""),
        (4.0, ["meeting"], "have left after"),
        (-1.5, ["meeting"], "stays beside its way"),
    ],
)
def test_others_who_have_left_in_time_or_never_come_are_the_scenarios_matter(
    pace: float, found: list[str], words: str, in_tmp: Path
) -> None:
    """A deer runs from 12 m beside the lane to 50 m ahead, or away; the car, at 40 km/h, is there
    after 4.5 s.
    """
    write(
        "mine.py",
        "from safevar_sumo.scenarios import Track\n\n\nclass Deer:\n    speed = 40.0\n    duration"
        " = 12.0\n\n    def tracks(self, times):\n        return [Track.of('deer', 'deer', 50.0,"
        f" -12.0 + {pace} * times, vy={pace}, size=(0.6, 1.5))]\n",
    )
    write(
        "mine.toml",
        'extends = "wear"\nname = "mine"\n[scenario]\nmodel = "mine:Deer"\n',
    )
    findings = check_study(study_to_check("mine.toml"))
    assert [finding.check for finding in findings] == found
    assert all(
        "mine.py:4" in finding.where and words in finding.finding
        for finding in findings
    )


@SLOW
@pytest.mark.parametrize(
    "criterion", ["", '[unsafe]\ncriterion = "safety_degree < 99"\n']
)
def test_an_original_that_is_unsafe_does_not_pass(criterion: str, in_tmp: Path) -> None:
    """With a wrong sign a driving system hits the pedestrian; with a right one it stops nearer
    than 99 m.
    """
    wrong = SCALAR.replace("seen.gap < stopping", "seen.gap < -stopping").replace(
        "BODY", "pass"
    )
    write("mine.py", SCALAR.replace("BODY", "pass") if criterion else wrong)
    write("mine.toml", STUDY_OF["ads"] + criterion)
    (finding,) = check_study(study_to_check("mine.toml"))
    assert finding.check == "original", finding
    assert ("below 99 m" if criterion else "itself collides at ") in finding.finding
    assert "mine.py" in finding.where


@pytest.mark.parametrize(
    "study",
    [
        "smoke",
        pytest.param("wear", marks=SLOW),
    ],
)
def test_what_is_shipped_passes(study: str) -> None:
    """What is right of users is in the tutorials, whose studies begin with these checks."""
    assert not check_study(load_study(study))


def test_a_driving_system_that_does_not_end_is_a_finding_in_time(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "LONGEST_CHECK", 0.5)
    write(
        "mine.py",
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Mine(ScalarAds):\n"
        "    def drive(self, seen):\n        while True:\n            pass\n",
    )
    output = run("check mine:Mine", expect=1).stdout
    assert "took longer than the time limit of 0.5 s" in " ".join(output.split())


def test_the_command_prints_the_json_and_ends_with_its_exit_codes(in_tmp: Path) -> None:
    write("mine.py", with_defect("out of range"))
    write("mine.toml", STUDY_OF["ads"])
    answer = json_of("check mine.toml", expect=1)
    assert answer["numbers"]["passed"] is False
    (finding,) = rows_of(answer, "findings")
    assert {"finding", "where", "input", "expected"} <= set(finding)
    text = run("check mine:Mine --format csv", expect=1).stdout
    assert "ads.model = 'mine:Mine' returned brake = 100.0 from drive" in text
    assert "mine.py:11" in text
    write("mine.py", SCALAR.replace("BODY", "self.far = seen.gap"))
    passed = json_of("check mine.toml")
    assert (passed["numbers"]["passed"], rows_of(passed, "findings")) == (
        True,
        [],
    )


@SLOW
@pytest.mark.parametrize(
    ("longest", "options", "vehicles"),
    [(1e6, "", 100), (0.0, "", 3), (0.0, "--vehicles 7", 7)],
)
def test_it_says_how_many_vehicles_it_has_simulated_and_what_it_has_not_tried(
    longest: float,
    options: str,
    vehicles: int,
    in_tmp: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As many as the time allows, unless their number is given."""
    monkeypatch.setattr(trials, "LONGEST_CHECK", longest)
    write("mine.py", SCALAR.replace("BODY", "pass"))
    test = '[[matrix.tests]]\nname = "it"\nover = { turns_after = [0.5, 0.6, 0.7, 0.8, 0.9] }\n'
    write("mine.toml", STUDY_OF["ads"] + test)
    answer = json_of(f"check mine.toml {options}")
    assert answer["numbers"] == {"passed": True, "vehicles": vehicles, "points": 3}
    assert (
        f"{vehicles} vehicles in 3 test cases of the study. The check left out 2 further test"
        in (answer["verdict"])
    )
    assert ("--vehicles 100 checks more vehicles" in answer["verdict"]) == (
        vehicles == 3
    )
