"""The command `check FILE.xosc`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.in_process import json_of, run
from tests.openscenario.writing import (
    AT_ONCE,
    PARAMETER,
    at,
    body,
    event,
    lane_change,
    logical,
    private,
    speed,
    teleport,
    write,
)

SOON = event(lane_change(-1, "linear", "time", 3), AT_ONCE.format(2), "Soon")
FIRST = event(speed(5, "linear", "time", 1), AT_ONCE.format(0.5), "First", "parallel")
NEVER = event(speed(0), AT_ONCE.format(99), "Never")


def rows(answer: dict, table: str) -> list[list]:  # type: ignore[type-arg]
    return answer["tables"][table]["rows"]  # type: ignore[no-any-return]


def test_a_file_that_plays_has_actors_parameters_and_events_in_their_order(tmp_path: Path) -> None:
    file = write(tmp_path, NEVER, SOON, FIRST, parameters=PARAMETER)
    picture = tmp_path / "paths.png"
    answer = json_of("check", file, "--plot", str(picture))
    assert picture.stat().st_size > 5000
    assert answer["numbers"] == {"passed": True}
    assert answer["verdict"].startswith(
        "scenario.xosc plays for 14.0 s: Ego at 20.0 m/s, and 1 other"
    )
    assert [list(row.values()) for row in rows(answer, "events")] == [
        ["First", "Car", 0.5, 1.5],
        ["Soon", "Car", 2.0, 5.0],
        ["Never", "Car", None, None],
    ]
    (parameter,) = rows(answer, "parameters")
    assert parameter == {"parameter": "v", "value": "3", "range": ""}
    ego, car = rows(answer, "actors")
    assert (ego["actor"], ego["speed"], ego["ahead"]) == ("Ego", 20, -2)
    assert (car["ahead"], car["left"]) == (pytest.approx(50 - 2), pytest.approx(-4))
    assert (car["speed"], car["last_speed"]) == (10, 5)
    assert "the event Never never fires" in [row["remark"] for row in rows(answer, "file_remarks")]


def test_a_logical_file_has_ranges_and_plays_its_first_combination(tmp_path: Path) -> None:
    write(tmp_path, event(speed("$v")), parameters=PARAMETER)
    answer = json_of("check", logical(tmp_path, 7, 9))
    assert rows(answer, "parameters")[0]["range"] == "7, 9"
    assert rows(answer, "actors")[1]["last_speed"] == 7


def test_a_file_that_does_not_play_says_why_and_what_is_expected(tmp_path: Path) -> None:
    file = write(tmp_path, car=(teleport(at(-9, 100)), speed(10)))
    output = run("check", file, expect=1)
    assert "road 1 has no lane -9 at s = 100.0 m. Expected: one of -2, -1, 1, 2" in output.stdout
    (finding,) = rows(json.loads(run("check", file, "--json", expect=1).stdout), "findings")
    assert finding["expected"] == "one of -2, -1, 1, 2"


def test_the_vehicle_under_test_is_named(tmp_path: Path) -> None:
    hero = private("hero", teleport(at(-1, 50)), speed(20))
    file = write(tmp_path, ego=hero, entities=body("hero") + body("Car", 5.0))
    assert "there are: hero, Car. Expected: ego = one of Car, hero" in run(
        "check", file, expect=1
    ).stdout.replace("\n", " ")
    assert json_of("check", file, "--ego", "hero")["numbers"] == {"passed": True}
