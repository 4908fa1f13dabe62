"""Recorded tracks: what a table says is met, by closed forms; results depend on its bytes."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.scenarios.recorded_tracks import (
    TRACK_COLUMNS,
    RecordedTracks,
    read_tracks,
)
from safevar_sumo.study import data_files
from safevar_sumo.sumo.system import assemble
from tests.support.holding import Hold, driven
from tests.support.in_process import SLOW, json_of, run
from tools.manual import files_of

PAGE = files_of("docs/recorded_tracks.md")
LENGTH, WIDTH = 4.0, 2.0
SPEED = 72.0 / 3.6
STEP = 0.05


def rows_of(
    name: str, times: Any, x: float, y: float, speed: float = 0.0, **pose: float
) -> Any:
    """Rows of a body that moves along the lane from a place ahead and to the left of `ego`."""
    turn, size = pose.get("turn", 0.0), pose.get("size", LENGTH)
    for time in times:
        place = complex(x + speed * (time - times[0]), y) * complex(
            math.cos(turn), math.sin(turn)
        )
        yield time, name, 7.0 + place.real, -3.0 + place.imag, turn, speed, size, WIDTH


def table(*bodies: Any, start: float = 0.0, turn: float = 0.0) -> str:
    """A file of these bodies and of `ego`, whose motion does not matter."""
    ego = rows_of("ego", [start], 0.0, 0.0, turn=turn)
    Path("walk.csv").write_text(
        "\n".join(
            ",".join(map(str, row))
            for row in (TRACK_COLUMNS, *ego, *(row for rows in bodies for row in rows))
        )
    )
    return "walk.csv"


def held(*bodies: Any, **how: float) -> SimulationRuns:
    """The run of a vehicle that keeps its speed among bodies."""
    return driven(RecordedTracks(file=table(*bodies, **how), speed=SPEED * 3.6), Hold())


@pytest.mark.parametrize("turn", [0.0, 2.5, -math.pi / 2])
@pytest.mark.parametrize("start", [0.0, 1234.5])
def test_a_slower_leader_is_hit_where_and_as_fast_as_the_closed_form_says(
    turn: float, start: float, in_tmp: Path
) -> None:
    leader = rows_of("leader", [start, start + 50.0], 50.0, 0.0, 5.0, turn=turn)
    result = held(leader, start=start, turn=turn)
    assert result.outcome[0] == Outcome.COLLISION
    assert result.collision_speed[0] == pytest.approx(SPEED, abs=1e-6)
    assert result.closing_speed[0] == pytest.approx(SPEED - 5.0, abs=1e-6)
    arrives = (50.0 - LENGTH) / (SPEED - 5.0)
    assert result.trace.time[result.trace.last_active[0]] == pytest.approx(
        math.ceil(arrives / STEP) * STEP
    )
    assert result.trace.gap[0, 0] == pytest.approx(50.0 - LENGTH, abs=1e-6)


def test_who_stands_beside_the_way_is_passed_at_the_lateral_gap(in_tmp: Path) -> None:
    result = held(rows_of("van", [0.0, 50.0], 60.0, 3.1))
    assert result.outcome[0] == Outcome.PASSED
    assert result.encounter.separation.min() == pytest.approx(3.1 - WIDTH, abs=1e-6)


def test_a_heading_turns_the_way_round_through_pi_as_the_shorter_way(
    in_tmp: Path,
) -> None:
    halves = [(0.0, 3.1), (1.0, -3.1)]
    row = "{},van,60,30,{},0,4,2\n"
    Path("walk.csv").write_text(
        f"{','.join(TRACK_COLUMNS)}\n0,ego,0,0,0,1,4,2\n"
        + "".join(row.format(*one) for one in halves)
    )
    (track,) = RecordedTracks(file="walk.csv").tracks(np.array([[0.0], [0.5], [1.0]]))
    assert track.along[1, 0] == pytest.approx(-1.0)
    assert track.left[:, 0] == pytest.approx(
        [math.sin(3.1), 0.0, math.sin(-3.1)], abs=1e-9
    )


def test_a_body_is_there_from_its_first_to_its_last_row_alone(in_tmp: Path) -> None:
    """In the way until 1 s, and from 4 s on, where the vehicle is between 1.8 and 2.2 s."""
    steady = rows_of("van", range(50), 200.0, 30.0)
    early = rows_of("early", [0.0, 1.0], 44.0, 0.0)
    late = rows_of("late", [4.0, 5.0], 44.0, 0.0)
    result = held(early, late, rows_of("inside", [30.0, 31.0], 0.0, 0.0), steady)
    assert result.outcome[0] == Outcome.PASSED
    assert result.encounter.separation[:21, 0].min() == pytest.approx(
        40.0 - SPEED, abs=1e-6
    )
    hidden = np.flatnonzero(
        ~np.broadcast_to(result.trace.visible, result.trace.gap.shape)[:, 0]
    )
    assert hidden.size == 0 or hidden.min() > 20
    alone = held(rows_of("late", [1.0, 3.0], 44.0, 0.0))
    assert alone.outcome[0] == Outcome.COLLISION
    assert not alone.encounter.in_conflict[:20].any()
    assert np.isinf(alone.trace.gap[:20]).all()


MINE = PAGE["walk.toml"]
SEARCH = '[search]\nalgorithms = ["rs"]\nruns = 1\nevaluations = 20\npopulation = 10\n'


def write() -> None:
    Path("walk.csv").write_text(PAGE["walk.csv"])
    Path("walk.toml").write_text(MINE + SEARCH)


@SLOW
def test_a_study_is_checked_and_its_limits_are_sought(in_tmp: Path) -> None:
    write()
    run("check walk.toml --vehicles 4")
    limits = json_of("tolerance walk.toml --quick --simulations 200")
    rows = limits["tables"]["limits"]["rows"]
    assert {"treadDepth", "payload"} <= {row["characteristic"] for row in rows}


def test_a_matrix_plays_several_files(in_tmp: Path) -> None:
    write()
    Path("far.csv").write_text(PAGE["walk.csv"].replace("45.0", "85.0"))
    test = {"name": "walks", "over": {"file": ["walk.csv", "far.csv"]}}
    scenario = {"model": "recorded_tracks", "parameters": {"file": "walk.csv"}}
    study = load_study("wear", scenario=scenario, matrix={"tests": [test]})
    assert [*data_files(study)] == ["walk.csv", "far.csv"]
    assert [point.scenario.duration for point in assemble(study).points] == [5.0, 5.0]


LOG = """\
Version: v2.37.4
Scenario File Name: cut-in.xosc, Vehicle Count: 2
Index [-] , TimeStamp [s] , {}
"""
NAMES = [
    "Entity_Name [-]",
    "Entity_ID [-]",
    "Current_Speed [m/s]",
    "Wheel_Angle [rad]",
    "Wheel_Rotation [rad]",
    "bb_x [m]",
    "bb_y [m]",
    "bb_z [m]",
    "bb_length [m]",
    "bb_width [m]",
    "bb_height [m]",
    "World_Position_X [m]",
    "World_Position_Y [m]",
    "World_Position_Z [m]",
    "World_Heading_Angle [rad]",
    "World_Pitch_Angle [rad]",
]


def test_the_lines_of_the_page_make_a_table_of_a_log_of_esmini(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = "".join(f"#{number} {name} , " for number in (1, 2) for name in NAMES)
    lines = (
        f"{index}, {index * 0.1:.6f}, Ego, 0, 10.0, 0, 0, 1.4, 0.0, 0.9, 5.0, 2.0, 1.8, "
        f"{index * 1.0}, 0.0, 0.0, 0.0, 0.0, Van, 1, 5.0, 0, 0, 2.0, 0.0, 0.9, 6.0, 2.2, 2.5, "
        f"30.0, {index * 0.5}, 0.0, {math.pi / 2}, 0.0, \n"
        for index in range(3)
    )
    Path("log.csv").write_text(LOG.format(header) + "".join(lines))
    Path("from_esmini.py").write_text(PAGE["from_esmini.py"])
    monkeypatch.setattr("sys.argv", ["from_esmini.py", "log.csv", "walk.csv"])
    runpy.run_path("from_esmini.py")
    scenario = RecordedTracks(file="walk.csv", ego="Ego")
    assert (scenario.vut_length, scenario.vut_width, scenario.duration) == (
        5.0,
        2.0,
        0.2,
    )
    (van,) = scenario.tracks(np.array([[0.0], [0.1]]))
    assert (van.name, van.length[0, 0], van.width[0, 0]) == ("Van", 6.0, 2.2)
    assert van.x[:, 0] == pytest.approx(30.0 - 1.4 - 2.5)
    assert van.y[:, 0] == pytest.approx([2.0, 2.5])
    assert van.left[:, 0] == pytest.approx(1.0)


HEADER = "time,name,x,y,heading,speed,length,width\n0,ego,0,0,0,11.1,4.6,1.8\n"


def rows_of_walker(heading: float, size: str = "0.5,0.6") -> str:
    return HEADER + "".join(
        f"{time},walker,45,{y},{heading},1.5,{size}\n"
        for time, y in ((0.0, -5.0), (5.0, 2.5))
    )


@pytest.mark.parametrize(
    ("heading", "meaning"),
    [(90.0, "degrees"), (0.0, "degrees clockwise from y"), (1.5708, "")],
)
def test_headings_in_degrees_are_named(
    heading: float, meaning: str, in_tmp: Path
) -> None:
    Path("walk.csv").write_text(rows_of_walker(heading))
    if not meaning:
        assert {*read_tracks("walk.csv")} == {"ego", "walker"}
        return
    with pytest.raises(
        InputError, match=f"walker moves where its headings point in {meaning}\n"
    ):
        read_tracks("walk.csv")


@pytest.mark.parametrize(
    ("size", "is_told"),
    [("1.8,4.6", True), ("4.6,1.8", False), ("0.5,0.6", False), ("0.5,1.1", False)],
)
def test_a_body_that_is_wider_than_long_gets_a_remark_unless_it_may_be_a_person(
    size: str, is_told: bool, in_tmp: Path
) -> None:
    Path("walk.csv").write_text(rows_of_walker(1.5708, size=size))
    remarks = RecordedTracks(file="walk.csv").remarks()
    assert ["walker is 1.8 m long and 4.6 m wide" in remark for remark in remarks] == (
        [True] * is_told
    )
