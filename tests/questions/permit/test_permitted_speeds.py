"""Speeds up to which cars stop before a wall, which are formulas: listed speeds, ranges, parameter
sets, allowed impacts and constraints.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

import safevar_sumo as sv
from safevar_sumo.campaign import batches
from safevar_sumo.questions import models
from safevar_sumo.study import Study
from tests.support.in_process import InlinePool, json_of, refused, rows_of, run, write

CARS = """
from typing import Annotated

import msgspec

from safevar_sumo.study import searched


class Listed(msgspec.Struct, frozen=True):
    '''Drives at a speed towards a wall, and brakes after a delay. Its speed cannot be searched.'''

    UNITS = {"decel": "m/s^2", "delay": "s", "load": "-"}
    OPTIONAL = ("delay",)
    speed: float = 10.0
    gap: float = 25.0
    grip: float = 1.0

    def simulate(self, setting):
        decel = self.grip * setting["decel"] / (1 + setting["load"])
        rest = self.gap - self.speed * setting["delay"] - self.speed**2 / 2 / decel
        if rest < 0:
            impact = min(self.speed, (-2 * decel * rest) ** 0.5)
            return {"outcome": "collision", "safety_degree": -impact, "impact_speed": impact}
        return {"outcome": "stopped", "safety_degree": rest}


class Car(Listed, frozen=True):
    speed: Annotated[float, searched(5.0, 30.0, "m/s", "speed")] = 10.0


class Shaky(Car, frozen=True):
    '''It collides from 13.2 to 13.7 m/s, and above 9.5 m/s with decelerations about 7.4.'''

    def simulate(self, setting):
        is_weak = self.speed > 9.5 and abs(setting["decel"] - 7.4) < 0.1
        if is_weak or 13.2 <= self.speed <= 13.7:
            return {"outcome": "collision", "safety_degree": -1.0, "impact_speed": 1.0}
        return Car.simulate(self, setting)
"""
STUDY = """
name = "walls"
title = "Brakes before a wall"
scenario.model = "cars:Car"
metrics = { ttc_threshold = 1.5, also = ["impact_excess"] }
search = { algorithms = ["rs"], population = 10, evaluations = 40, runs = 1, seed = 1 }
[vehicle.characteristics]
decel = { unit = "m/s^2", original = 8, lower = 3, upper = 9 }
delay = { unit = "s", original = 0.5, lower = 0, upper = 2 }
load = { unit = "-", original = 0, lower = 0, upper = 1 }
"""
TESTS = """
[[matrix.tests]]
name = "near"
over.speed = [8.0, 16.0]
[[matrix.tests]]
name = "wet"
parameters = { gap = 40.0, grip = 0.5 }
over.speed = [10.0, 30.0]
[[matrix.tests]]
name = "fast"
parameters = { gap = 1.0 }
over.speed = [18.0, 20.0]
"""
"""All tests exist up to 16 m/s, where the first ends; the last begins above."""
NEW = {"decel": 8.0, "delay": 0.5, "load": 0.0}
MARGIN = 1.0


class Wall(NamedTuple):
    """A test: its gap [m], the share of grip, and its speeds [m/s]."""

    name: str
    gap: float = 25.0
    grip: float = 1.0
    low: float = -np.inf
    high: float = np.inf

    def degree(self, car: dict[str, float], speed: float) -> float:
        """What is left in front of the wall [m] or, after a collision, minus its speed [m/s]."""
        decel = self.grip * car["decel"] / (1 + car["load"])
        rest = self.gap - speed * car["delay"] - speed**2 / 2 / decel
        if rest >= 0:
            return float(rest)
        return -min(speed, float(-2 * decel * rest) ** 0.5)


NEAR = Wall("near", low=8, high=16)
BOTH = [NEAR, Wall("wet", 40, 0.5, 10, 30)]
EACH_METRE = np.arange(8.0, 17.0)
EVERY_OTHER = np.arange(8.0, 17.0, 2.0)
"""Speeds from 8 to 16 m/s, by the step of 1 m/s or of 2 m/s."""


class Expected(NamedTuple):
    """The last speed at which a car is safe, and the first failure above it: its speed, its test
    and its safety degree.
    """

    up_to: float
    failing: float = np.nan
    wall: str | None = None
    degree: float = np.nan


def expected(
    car: dict[str, float],
    walls: list[Wall] = BOTH,
    speeds: Any = EACH_METRE,
    margin: float = MARGIN,
) -> Expected:
    """Second computation, for a car whose other values are those of the new one."""
    up_to = np.nan
    for speed in speeds:
        degrees = {
            wall.name: wall.degree(NEW | car, speed)
            for wall in walls
            if wall.low <= speed <= wall.high
        }
        worst = min(degrees, key=lambda name: degrees[name])
        if degrees[worst] < margin:
            return Expected(up_to, speed, worst, degrees[worst])
        up_to = speed
    return Expected(up_to)


@pytest.fixture(autouse=True)
def _few_simulations(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And no check of the class before each question."""
    monkeypatch.setattr(batches, "check_code", lambda study, pool: [])
    monkeypatch.setattr("safevar_sumo.questions.cases.LEAST_SIMULATIONS", 20)
    monkeypatch.setattr("safevar_sumo.questions.cases.USUAL_BUDGET", 100)
    write("cars.py", CARS)


def asked(study: str, **options: Any) -> sv.Answer:
    write("walls.toml", study)
    usual = {"others": "new", "margin": MARGIN, "pool": InlinePool()}
    return sv.permit("walls.toml", **(usual | options))


def row_of(study: str, car: dict[str, float], **options: Any) -> Any:
    """The answer about one car."""
    (row,) = asked(study, cars={"a": car}, **options).tables["cars"].to_dict("records")
    return row


WEAKER, LATER = 0.5, 0.125
"""Errors of a measured deceleration [m/s^2] and of a measured delay [s]."""
CAR_LIST = {
    "new": {},
    "late": {"delay": 1.5},
    "worn": {"decel": 6.5, "delay": 0.75, "load": 0.25},
    "old": {"decel": 3.5, "delay": 1.75},
}


def at_worst(car: dict[str, float]) -> dict[str, float]:
    """The car with the worst values that its measured ones may have."""
    worst = {"decel": -WEAKER, "delay": LATER}
    return {name: value + worst.get(name, 0) for name, value in car.items()}


def test_each_car_of_a_list_reaches_the_speed_of_the_formula() -> None:
    """A measured value is the worse end of its interval. Speeds are the ends of the range, and
    multiples of the step.
    """
    step = 3.0
    study = STUDY + TESTS
    for end, error in ("upper = 9", WEAKER), ("upper = 2", LATER):
        measured = f"{end}, precision = {{ value = {error}, source = 'test' }}"
        study = study.replace(end, measured)
    answer = asked(study, cars=CAR_LIST, step=step)
    speeds = np.unique(np.clip(step * np.arange(40), 8, 16))
    new = expected({}, speeds=speeds).up_to
    rows = answer.tables["cars"].set_index("car")
    for name, values in CAR_LIST.items():
        row = rows.loc[name]
        found = expected(at_worst(values), speeds=speeds)
        assert row["up_to"] == pytest.approx(found.up_to, nan_ok=True), name
        assert row["test"] == found.wall
        assert row["encounter"] == f"speed {found.failing:g} m/s"
        ending = f"collides at {-found.degree:.2f} m/s"
        assert (row["outcome"] == ending) == (found.degree < 0)
        verdict = "drive" if found.up_to >= new else "up to"
        assert row["verdict"] == ("stop" if np.isnan(found.up_to) else verdict)

        # The best of the repairs of one measured value, if it helps.
        after = {
            one: expected(at_worst(values) | {one: NEW[one]}, speeds=speeds).up_to
            for one in values
        }
        best = max(after.values(), default=np.nan)
        if best > np.nan_to_num(found.up_to):
            assert after[row["repair_first"]] == row["up_to_after_repair"] == best
        else:
            assert pd.isna(row["repair_first"])
    assert {*rows["new_car_up_to"]} == {new}
    assert rows["up_to"].dropna().is_monotonic_increasing
    numbers = answer.numbers
    assert rows["verdict"].value_counts().to_dict() == {
        "drive": numbers["drive"],
        "up to": numbers["limited"],
        "stop": numbers["stop"],
    }
    assert (numbers["cars"], numbers["not_driven_above"]) == (len(CAR_LIST), 16)
    assert "fast" in answer.verdict, "a test that was left out"


@pytest.mark.parametrize("model", ["Car", "Shaky"])
def test_the_total_of_the_bar_is_an_upper_bound_from_the_beginning(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With failures on the grid and between its speeds, repairs, and ends of assumed values."""
    monkeypatch.setattr("safevar_sumo.questions.cases.LEAST_SIMULATIONS", 100)
    measured = f"upper = 9, precision = {{ value = {WEAKER}, source = 'test' }}"
    study = STUDY.replace("cars:Car", f"cars:{model}").replace("upper = 9", measured)
    shown = list[tuple[int, int]]()
    answer = asked(
        study + TESTS,
        cars=CAR_LIST,
        step=4.0,
        progress=lambda phase, done, total: shown.append((done, total)),
    )
    done, totals = np.transpose(shown)
    assert (np.diff(totals) <= 0).all()
    assert (done[:-1] < totals[:-1]).all()
    assert answer.tables["cars"]["repair_first"].notna().any()


def test_the_assumed_value_that_matters_most_is_that_of_the_formula() -> None:
    """Each assumed value at each end of its domain, with the other values as they are."""
    for measured in ({"delay": 0.75}, {"decel": 7.0, "load": 0.5}):
        answer = asked(STUDY + TESTS, cars={"a": measured})
        (row,) = answer.tables["cars"].to_dict("records")
        ends = {"decel": (3, 9), "delay": (0, 2), "load": (0, 1)}
        failing = {
            name: min(
                expected(measured | {name: float(end)}).failing for end in ends[name]
            )
            for name in ends.keys() - measured.keys()
        }
        worst = min(failing, key=lambda name: failing[name])
        assert row["assumed_matters_most"] == worst
        assert f"unsafe already at {failing[worst]:g} m/s" in answer.verdict
        for name in failing:
            assert f"{name} {NEW[name]:g}" in row["assumed"]


def test_a_needed_speed_decides_the_exit_code() -> None:
    """The exit code is 0 only if each car of the list reaches it."""
    write("walls.toml", STUDY + TESTS)
    write("fleet.csv", "car,delay [s]\nnew,0.5\nb,1.5\n")
    least = expected({"delay": 1.5}, speeds=EVERY_OTHER).up_to
    typed = (
        f"permit walls.toml --cars fleet.csv --others new --step 2 --margin {MARGIN}"
    )
    for need, code, fast in ((least, 0, 2), (least + 1, 3, 1)):
        answer = json_of(typed, "--need", f"{need:g} m/s", expect=code)
        assert (answer["numbers"]["drive"], answer["numbers"]["need"]) == (fast, need)
    quick = json_of(typed, "--need", f"{least:g} m/s", "--quick", expect=3)
    assert quick["numbers"]["rough"], "a rough answer lets no car drive"
    assert (quick["numbers"]["drive"], quick["numbers"]["attacked"]) == (0, 0)
    reached = [row["up_to"] for row in rows_of(quick, "cars")]
    assert reached == [row["up_to"] for row in rows_of(answer, "cars")]
    refused(f"{typed} --need '17 m/s'", "need", "16 m/s")
    refused(f"{typed} --need '10 km/h'", "need")

    # The list for fleet software keeps the user's order.
    printed = run(f"{typed} --format csv --out out.csv").stdout
    assert Path("out.csv").read_text() == printed
    listing = pd.read_csv("out.csv")
    assert [*listing["car"]] == ["new", "b"]
    assert listing["up_to"][1] == least
    assert {*listing["rough"]} == {"no"}
    refused(f"{typed} --out fleet.csv", "fleet.csv is the list itself")
    refused(f"{typed} --quick --out rough.csv", "quick", "rough")


def test_between_two_speeds_of_the_grid_a_failure_counts() -> None:
    """No multiple of 1 m/s is unsafe; and between the ends of a measured value."""
    measured = f"upper = 9, precision = {{ value = {WEAKER}, source = 'test' }}"
    study = STUDY.replace("cars:Car", "cars:Shaky") + TESTS
    study = study.replace("upper = 9", measured)
    assert row_of(study, {"decel": 7.5})["up_to"] == 9
    assert row_of(study, {})["up_to"] == 13
    rough = row_of(study, {}, quick=True)
    assert (rough["up_to"], rough["verdict"]) == (expected({}).up_to, "up to")


OF_SETS = """
scenario.parameters.grip = 1.0
scenario.over.speed = { lower = 8, upper = 22, original = 10 }
"""


def test_each_parameter_set_has_its_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Further sets need no clearance; the least speed of all sets counts."""
    grips = [1.0, 0.75, 1.25]

    def other_sets(study: Study, fits: int | None) -> list[Study]:
        """Simulators of users have no parameter sets: here, sets of grip."""
        numbers = range(len(grips)) if fits is None else range(fits)
        return [
            sv.load_study(study, scenario={"parameters": {"grip": grips[number]}})
            for number in numbers[1:]
        ]

    monkeypatch.setattr(models, "other_sets", other_sets)
    study = STUDY.replace("metrics =", OF_SETS + "metrics =")
    speeds = np.arange(8.0, 23.0, 2.0)
    cars = {"weak": {"decel": 6.0}, "late": {"delay": 1.25}}
    answer = asked(study, cars=cars, step=2.0)
    rows = answer.tables["cars"].set_index("car")
    sets = answer.tables["sets"].set_index(["car", "fit"])["up_to"]

    def speeds_of(car: dict[str, float]) -> list[float]:
        """By the formula, in each set."""
        margins = [MARGIN, 0.0, 0.0]
        return [
            expected(car, [Wall("", grip=grip)], speeds, margin).up_to
            for grip, margin in zip(grips, margins, strict=True)
        ]

    for name, values in cars.items():
        found = speeds_of(values)
        assert sets[name].to_list() == found
        assert rows.loc[name, "up_to"] == min(found)
        assert rows.loc[name, "parameter_set"] == found.index(min(found))
    assert answer.numbers["fits"] == len(grips)
    assert {*rows["new_car_up_to"]} == {min(speeds_of({}))}


LISTED = """
[[matrix.tests]]
name = "near"
over.speed = [8.0, 13.0, 16.0]
[[matrix.tests]]
name = "wet"
model = "cars:WET"
parameters = { gap = 40.0, grip = 0.5 }
over.speed = [10.0, 30.0]
[[matrix.tests]]
name = "still"
parameters = { speed = 12.0 }
"""


@pytest.mark.parametrize(
    ("model", "wet", "listed"),
    [
        ("Listed", [10], [8, 10, 13, 16]),
        ("Car", [*range(10, 17)], [8, 13, 16]),
    ],
)
def test_speeds_that_cannot_be_searched_are_those_of_the_tests(
    model: str, wet: list[int], listed: list[int]
) -> None:
    """Nothing is known between them, also where another test drives there. A failure in a test
    with one speed of its own counts at every speed.
    """
    study = STUDY.replace("cars:Car", "cars:Listed") + LISTED.replace("WET", model)
    cars = {"new": {}, "weak": {"decel": 5.0}, "late": {"delay": 1.75}}
    answer = asked(study, cars=cars)
    rows = answer.tables["cars"].set_index("car")
    for name in ("new", "weak"):
        driven = [(NEAR, speed) for speed in (8, 13, 16)]
        driven += [(BOTH[1], speed) for speed in wet]
        car = NEW | cars[name]
        fails = [speed for wall, speed in driven if wall.degree(car, speed) < MARGIN]
        safe = [speed for speed in listed if speed < min(fails, default=np.inf)]
        assert rows.loc[name, "up_to"] == max(safe)
    late = rows.loc["late"]
    assert NEAR.degree(NEW | cars["late"], 8) > MARGIN, "safe at the least speed"
    assert (late["verdict"], late["test"]) == ("stop", "still")
    assert np.isnan(late["up_to"])
    assert ("8, 10, 13 and 16" in answer.tested) == (model == "Listed")
    with pytest.raises(sv.InputError, match=f"{listed[-2]} and {listed[-1]}"):
        asked(study, cars=cars, need="12")


def test_a_test_that_allows_impacts_is_passed_up_to_the_allowed_one() -> None:
    """18 km/h are 5 m/s."""
    allowed = 5.0
    tests = """
[matrix]
aggregate = "impact_excess >"
[[matrix.tests]]
name = "near"
allowed_impact_speed = 18
over.speed = [8.0, 30.0]
"""
    answer = asked(
        STUDY + tests,
        cars={"a": {"decel": 6.0}, "b": {}},
        unsafe="impact_excess > 0",
        margin=None,
    )
    assert "may drive" not in answer.verdict, "a test is no promise for the road"
    rows = answer.tables["cars"].set_index("car")["up_to"]
    for name, decel in ("a", 6.0), ("b", 8.0):
        speeds = np.arange(8.0, 31.0)
        rest = 25 - 0.5 * speeds - speeds**2 / 2 / decel
        impact = np.sqrt(np.maximum(-2 * decel * rest, 0))
        assert rows[name] == speeds[impact <= allowed].max()


def test_all_cars_within_limits_are_those_that_the_constraints_permit() -> None:
    """The weakest brakes have the least delay."""
    constraint = """
[[constraints]]
sum = { decel = 1, delay = -2 }
at_least = 3.0
unit = "m/s^2"
"""
    answer = asked(
        STUDY + constraint + TESTS,
        limits=["decel >= 4", "delay <= 1.5"],
        step=2.0,
    )
    worst = min(
        expected(
            {"delay": delay, "decel": max(4.0, 3 + 2 * delay)}, speeds=EVERY_OTHER
        ).up_to
        for delay in np.linspace(0, 1.5, 301)
    )
    (row,) = answer.tables["cars"].to_dict("records")
    assert row["up_to"] == worst
    free = asked(STUDY + TESTS, limits=["decel >= 4", "delay <= 1.5"], step=2.0)
    found = expected({"delay": 1.5, "decel": 4.0}, speeds=EVERY_OTHER)
    (row,) = free.tables["cars"].to_dict("records")
    assert row["up_to"] == found.up_to < worst
    assert "decel from 8 to 4 m/s^2 (-50.0 %)" in row["because"]
    assert row["simulate"].endswith(f"--set speed={found.failing}")
