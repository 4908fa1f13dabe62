"""Oversights are found in the user's code, with advice that fits; no shipped class has any, and a
study starts despite them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.check import check_study, oversights
from safevar_sumo.check.findings import CHECKS, SIMULATOR, Finding
from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.system import assemble
from tests.in_process import SLOW, json_of, rows_of, run, write
from tests.manual import files_of

METRICS = """import numpy as np
from safevar_sumo.metrics import Measure


def largest(runs, thresholds):
    return runs.trace.speed.max(axis=0)


def once_passed(runs, thresholds):
    gap = runs.trace.gap
    return ((gap[:-1] > 0) & (gap[1:] < -20)).any(axis=0).astype(float)


def side(runs, thresholds):
    return (runs.contact.side == "left").astype(float)


def nothing(settings, characteristics):
    return np.zeros(len(settings))


FUNCTION = Measure(name="mine", title="mine", unit="-", of="OF", NEEDS function=CODE)
"""
SIMULATOR_FILES = files_of("docs/simulators.md")
VEHICLE_FILES = files_of("docs/tutorials/own_vehicle.md")
ALGORITHM = """class Mine:
    title = "mine"

    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(8, rng))
        evaluations = yield settings
        BODY
"""


def findings_of(study: str) -> list[Finding]:
    write("mine.toml", study)
    return check_study(load_study("mine.toml"), vehicles=3)


@pytest.mark.parametrize(
    ("code", "of", "needs", "is_constant"),
    [
        ("lambda runs, _: np.ones(len(runs))", "runs", "", True),
        ("nothing", "settings", "", True),
        ("largest", "runs", 'needs=("speed",),', False),
        ("once_passed", "runs", 'needs=("gap",),', False),
        ("side", "runs", "", False),
    ],
)
def test_a_metric_is_constant_if_nothing_changes_it(
    code: str, of: str, needs: str, is_constant: bool, in_tmp: Path
) -> None:
    """And not if it is 0 in all runs that were simulated, because nothing happened there."""
    module = METRICS.replace("OF", of).replace("NEEDS", needs).replace("CODE", code)
    write("mine.py", module)
    found = findings_of(
        'extends = "smoke"\nname = "mine"\n[search]\nobjectives = ["f_safe", "mine:FUNCTION"]\n'
    )
    assert [finding.check for finding in found] == ["constant"] * is_constant
    if is_constant:
        assert Path(found[0].where.rpartition(":")[0]) == in_tmp / "mine.py"
        assert found[0].finding.startswith("mine is ")


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("return evaluations.take([0, 0, 1, 1, 2, 2])", "returns 3 of 6 solutions"),
        (
            "yield settings\n        yield settings\n        return evaluations",
            "yields 16 of 24 settings again",
        ),
        ("return evaluations.take([0, 1, 2, 3, 4, 5, 6, 6])", ""),
        ("return evaluations", ""),
    ],
)
def test_an_algorithm_that_repeats_settings_is_found(
    body: str, told: str, in_tmp: Path
) -> None:
    write("mine.py", ALGORITHM.replace("BODY", body))
    found = findings_of(
        'extends = "smoke"\nname = "mine"\n[search]\nalgorithms = ["mine:Mine"]\n'
    )
    assert [finding.check for finding in found] == ["duplicates"] * bool(told)
    assert all(told in finding.finding for finding in found)


def test_algorithms_of_the_package_repeat_few_settings() -> None:
    study = load_study("native")
    system = assemble(study)
    for name in ALGORITHMS:
        assert not [*oversights._find_duplicates(study, system, name)], name


@pytest.mark.parametrize("study", ["smoke", "lgsvl", "native", "wear"])
def test_vehicles_of_the_package_follow_the_time_step(study: str) -> None:
    assert not [*oversights._find_ignored_step(assemble(load_study(study)))]


@pytest.mark.parametrize(
    ("pedal", "told"),
    [
        (
            "(prepared['power'] * command.throttle - grip * command.brake)",
            "accelerates",
        ),
        (
            "prepared['power'] * command.throttle * prepared['step'] - grip * command.brake",
            "brakes with up to",
        ),
    ],
)
def test_a_vehicle_that_ignores_the_time_step_is_found(
    pedal: str, told: str, in_tmp: Path
) -> None:
    """At each pedal; the vehicle of the tutorial, which does not, has no finding."""
    module = VEHICLE_FILES["my_vehicle.py"]
    line = '(prepared["power"] * command.throttle - grip * command.brake) * prepared["step"]'
    assert line in module
    write("my_vehicle.py", module.replace(line, pedal))
    write("my_scenario.py", VEHICLE_FILES["my_scenario.py"])
    found = findings_of(VEHICLE_FILES["cart.toml"])
    assert [finding.check for finding in found] == ["step"]
    assert told in found[0].finding
    write("my_vehicle.py", module)
    assert not findings_of(VEHICLE_FILES["cart.toml"])


def test_metrics_of_the_package_are_not_constant() -> None:
    """All but the time after an encroachment, which is undefined in a run without any."""
    system = assemble(load_study("native", metrics={"also": [*OPTIONAL_METRICS]}))
    runs = drive_all(system, system.characteristics.original_settings)
    for name, measure in system.measuring.measures.items():
        if measure.of == "runs":
            values = measure.of_runs(runs, system.metrics_table)
            found = [*oversights._find_constant(system, name, values, "")]
            assert not found, name


@pytest.mark.parametrize(
    ("change", "check", "told"),
    [
        (
            'deceleration = setting["brake_force"]',
            "modified",
            "simulate changes mass of its setting from 1500 to 1600",
        ),
        ("rows.append((time, speed,", "shift", "speed that is 1 sample late"),
        (
            "np.zeros(len(time))",
            "contract",
            "an obstacle_speed relative to the vehicle",
        ),
    ],
)
def test_an_oversight_in_a_simulator_gets_advice_for_a_simulator(
    change: str, check: str, told: str, in_tmp: Path
) -> None:
    """A changed setting, a speed of the sample before, and an obstacle's relative speed."""
    changed = {
        "modified": f'setting["mass"] += 100\n        {change}',
        "shift": "before, rows_speed = getattr(self, 'rows_speed', speed), speed\n"
        "            self.rows_speed = rows_speed\n            rows.append((time, before,",
        "contract": "-speeds",
    }[check]
    module = SIMULATOR_FILES["my_simulator.py"]
    assert change in module
    write("my_simulator.py", module.replace(change, changed))
    write("mine.toml", SIMULATOR_FILES["truck.toml"])
    answer = json_of("check mine.toml --vehicles 3", expect=1)
    (finding,) = rows_of(answer, "findings")
    assert finding["check"] == check
    assert told in finding["finding"] + finding["expected"]
    assert finding["where"].startswith(str(in_tmp / "my_simulator.py"))
    advice = CHECKS[check]
    assert finding["advice"] == advice.get(SIMULATOR, advice[""])
    assert "metric" not in finding["advice"]


@SLOW
def test_a_study_starts_despite_an_oversight(in_tmp: Path) -> None:
    write("mine.py", ALGORITHM.replace("BODY", "return evaluations.take([0, 0])"))
    write(
        "mine.toml",
        'extends = "smoke"\nname = "mine"\n[search]\nalgorithms = ["mine:Mine"]\nruns = 1\n',
    )
    run("study mine.toml --out results")


def test_a_metric_that_the_package_defines_is_not_named_by_a_line_of_the_package(
    in_tmp: Path,
) -> None:
    """The place is the key and the name in the study, if the user's file only imports it."""
    write(
        "mine.py",
        "from msgspec.structs import replace\nfrom safevar_sumo.metrics import OPTIONAL_METRICS\n"
        "MINE = replace(OPTIONAL_METRICS['drac'], name='mine', needs=())\n",
    )
    (finding,) = findings_of('extends = "smoke"\n[metrics]\nalso = ["mine:MINE"]\n')
    assert finding.where == "metrics.also = 'mine:MINE'"
    assert "needs do not state" in finding.finding


def test_repetitions_count_changed_settings_alone() -> None:
    original = np.array([1.0, 2.0])
    settings = np.array([[1, 2], [1, 2], [3, 2], [3, 2], [3, 2], [1, 4]], float)
    assert oversights._repetitions(settings, original) == 2
