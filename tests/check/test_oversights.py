"""Oversights are found in the user's code, with advice that fits; no shipped class has any, and a
study starts despite them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.check import (
    ADVICE_FOR_SIMULATORS,
    advice_for,
    check_study,
    oversights,
)
from safevar_sumo.check.trials import Finding
from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, json_of, rows_of, run, write
from tests.support.made_up import original_of, system_of
from tools.manual import files_of

METRICS = """import numpy as np
from safevar_sumo.metrics import Measure


def once_passed(runs, thresholds):
    gap = runs.trace.gap
    return ((gap[:-1] > 0) & (gap[1:] < -20)).any(axis=0).astype(float)


def side(runs, thresholds):
    return (runs.contact.side == "left").astype(float)


def ones(runs, thresholds):
    return np.ones(len(runs))


def nothing(settings, characteristics):
    return np.zeros(len(settings))


FUNCTION = Measure(name="mine", title="mine", unit="-", of="OF", needs=NEEDS, function=CODE)
"""
ALGORITHM = """class Mine:
    title = "mine"

    def search(self, problem, rng):
        evaluations = yield problem.characteristics.filter(problem.uniform(8, rng))
        return evaluations.take([0, 1, 0])
"""
STUDY = 'extends = "smoke"\nname = "mine"\n[search]\n'
SIMULATOR_FILES = files_of("docs/simulators.md")
VEHICLE_FILES = files_of("docs/tutorials/own_vehicle.md")


def findings_of(study: str) -> list[Finding]:
    write("mine.toml", study)
    return check_study(load_study("mine.toml"), vehicles=3)


@pytest.mark.parametrize(
    ("code", "of", "needs", "told"),
    [
        ("ones", "runs", "()", "constant: mine is 1 in all runs"),
        ("nothing", "settings", "()", "constant: mine is 0 in all runs"),
        ("once_passed", "runs", "('gap',)", ""),
        ("side", "runs", "()", ""),
    ],
)
def test_a_metric_is_constant_if_nothing_changes_it(
    code: str, of: str, needs: str, told: str, in_tmp: Path
) -> None:
    """And not if it is 0 in all runs that were simulated, because nothing happened there."""
    module = METRICS.replace("OF", of).replace("NEEDS", needs).replace("CODE", code)
    write("mine.py", module)
    found = findings_of(f'{STUDY}objectives = ["f_safe", "mine:FUNCTION"]\n')
    assert len(found) == (told != "")
    for finding in found:
        assert str(finding).startswith(told)
        assert finding.where.startswith(str(in_tmp / "mine.py"))


@SLOW
def test_a_study_starts_despite_an_oversight(in_tmp: Path) -> None:
    """Here an algorithm that returns a solution twice."""
    write("mine.py", ALGORITHM)
    (found,) = findings_of(f'{STUDY}algorithms = ["mine:Mine"]\nruns = 1\n')
    assert str(found).startswith("duplicates: search returns 1 of 3 solutions again")
    run("study mine.toml --out results")


def test_code_of_the_package_has_no_oversight() -> None:
    """A metric may be undefined in the run of the original vehicle, and changes with the run."""
    study = load_study("native", metrics={"also": [*OPTIONAL_METRICS]})
    system = assemble(study)
    for name in ALGORITHMS:
        assert not [*oversights._find_duplicates(study, name)], name
    runs = drive_all(system, original_of(system))
    for name, measure in system.measuring.measures.items():
        if measure.of == "runs":
            values = measure.of_runs(runs, system.metrics_table)
            assert not [*oversights._find_constant(system, name, values, "")], name


@pytest.mark.parametrize("study", ["smoke", "lgsvl", "native", "wear"])
def test_vehicles_of_the_package_follow_the_time_step(study: str) -> None:
    assert not [*oversights._find_ignored_step(system_of(study))]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("prepared['power'] * command.throttle", "the throttle changes the speed by"),
        ("grip * command.brake", "the brake changes the speed by"),
    ],
)
def test_a_vehicle_that_ignores_the_time_step_is_found(
    change: str, told: str, in_tmp: Path
) -> None:
    """At each pedal; the vehicle of the tutorial, which does not, has no finding."""
    module = VEHICLE_FILES["my_vehicle.py"].replace('"', "'")
    write("my_scenario.py", VEHICLE_FILES["my_scenario.py"])
    write("my_vehicle.py", module.replace(change, f"{change} / prepared['step']"))
    (found,) = findings_of(VEHICLE_FILES["cart.toml"])
    assert found.check == "step"
    assert told in found.finding
    write("my_vehicle.py", module)
    assert not [*oversights._find_ignored_step(system_of("mine.toml"))]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            'deceleration = setting["brake_force"]',
            'setting["mass"] += 100\n        deceleration = setting["brake_force"]',
            "modified: simulate changes mass of its setting from 1500.0 to 1600.0",
        ),
        (
            "rows.append((time, speed,",
            "before, self.last = getattr(self, 'last', speed), speed\n"
            "            rows.append((time, before,",
            "shift: simulate returns a speed that is 1 sample late",
        ),
        ("np.zeros(len(time))", "-speeds", "contract: "),
    ],
)
def test_an_oversight_in_a_simulator_is_found_in_the_users_file(
    old: str, new: str, told: str, in_tmp: Path
) -> None:
    """A changed setting, a speed of the sample before, and an obstacle's relative speed."""
    module = SIMULATOR_FILES["my_simulator.py"]
    assert old in module
    write("my_simulator.py", module.replace(old, new))
    write("mine.toml", SIMULATOR_FILES["truck.toml"])
    (finding,) = rows_of(json_of("check mine.toml --vehicles 3", expect=1), "findings")
    assert f"{finding['check']}: {finding['finding']}".startswith(told)
    assert finding["where"].startswith(str(in_tmp / "my_simulator.py"))
    assert "metric" not in finding["advice"]


def test_advice_fits_a_simulator(in_tmp: Path) -> None:
    for name, text in SIMULATOR_FILES.items():
        write(name, text)
    finding = Finding("alone", "", "")
    assert (
        advice_for(finding, load_study("truck.toml")) == ADVICE_FOR_SIMULATORS["alone"]
    )
    assert "over the vehicles" in advice_for(finding, load_study("smoke"))


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
