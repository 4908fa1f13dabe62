"""How long a scene is played, and whether something happens in it to an Ego that keeps its
speed.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import play
from safevar_sumo.scenarios import OpenScenario
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.matrix import MAX_VEHICLES, drive_and_score, largest_batch
from safevar_sumo.sumo.system import assemble
from tests.in_process import json_of
from tests.openscenario import writing
from tests.openscenario.writing import (
    AT_ONCE,
    at,
    event,
    private,
    speed,
    staged,
    teleport,
    trigger,
    world,
)
from tests.scenarios.holding import driven

LONG = {
    "geometry": writing.STRAIGHT.replace("2000", "20000"),
    "length": 20_000.0,
    "parameters": writing.PARAMETER,
}
AT_V = AT_ONCE.format("$v")


def car(s: float, its_speed: float, lane: float = -1) -> tuple[str, str]:
    return teleport(at(round(lane), s)), speed(its_speed)


def brakes(folder: Path, begin: object, stop: str) -> str:
    """50 m before Ego a Car drives at its speed, and brakes with 2 m/s^2 until it stands."""
    event_of = event(speed(0, "linear", "rate", 2.0), AT_ONCE.format(begin))
    return writing.write(folder, event_of, car=car(100, 20), stop=stop, **LONG)  # type: ignore[arg-type]


@pytest.mark.parametrize("stop", [10.0, 58.0, 90.0, 600.0])
def test_a_scene_lasts_to_its_stop_trigger_and_what_happens_late_happens(
    tmp_path: Path, stop: float
) -> None:
    played = play(brakes(tmp_path, stop - 6, trigger(AT_ONCE.format(stop), "")), {})
    (other,) = played.others
    assert (played.duration, played.remarks, played.uneventful) == (pytest.approx(stop + 4), [], "")
    assert other.place[-1].real == pytest.approx(10 + 100 + 1.5 + 20 * (stop - 6) + 20**2 / 4)


def test_who_brakes_late_is_hit_and_a_stop_trigger_that_comes_too_late_is_refused(
    tmp_path: Path,
) -> None:
    """Fewer vehicles are simulated at once in a long run; points beyond are left out by name."""
    file = brakes(tmp_path, 80, trigger(AT_V, ""))
    late = OpenScenario(file, v=116)
    assert driven(late).collision_speed == pytest.approx(np.array([20.0]), abs=1e-3)
    study = load_study("wear", scenario={"file": file, "values": {"v": 116}})
    assert largest_batch(assemble(study)) == MAX_VEHICLES / 2
    with pytest.raises(InputError, match="the StopTrigger does not hold within 600 s"):
        play(file, {"v": "601"})
    with pytest.warns(match=r"2 of 4 .* the first is v = 700: the StopTrigger .*; others: v = 800"):
        study = load_study("wear", scenario={"file": writing.logical(tmp_path, 20, 700, 90, 800)})
    assert [test.over for test in study.matrix.tests] == [{"v": [20]}, {"v": [90]}]  # type: ignore[union-attr]


def walker(x: float, y: float, walking: float) -> tuple[str, str]:
    """Faces to the left; Ego's lane is from y = 16 to 20, and its front starts at x = 63.5."""
    return teleport(world(x, y, math.pi / 2)), speed(walking)


PERSON = writing.body("Ego") + writing.person("Car", 0.5, 0.5)
SCENES = """
never | walker 200 15 0    | NO_EVENT: beside the lane
never | walker 200 16.5 0  | -: in it
never | walker 200 10 1.5  | -: walks across from the start on
never | car 100 10 -2      | NO_EVENT: in the next lane
never | car 150 0          | -: in Ego's lane
-     | walker 200 15 0    | -: nobody says that more should happen
short | car 100 0          | 0.3
back  | car 200 0          | 2.5
-     | car 20 20          | 14.0: behind Ego
-     | car 350 0          | 14.0: Ego gets 280 m
-     | car 320 0          | -
-     | car 500 20         | 14.0: followed from afar
-     | car 100 20         | -: followed
slows | car 120 20         | -: approached to 20 m
-     | walker 303.5 6 1.4 | -: leaves the lane 2 s before Ego is there
-     | walker 303.5 14.4 1.4 | 14.0: 8 s
"""
EVENTS = {
    "never": event(writing.lane_change(-1, "linear", "time", 2), AT_ONCE.format(99)),
    "slows": event(speed(17, "linear", "rate", 3)),
}
STARTS = {
    "short": at(-1, 1994),
    "back": at(-1, 50, 0, '<Orientation type="relative" h="3.141592653589793"/>'),
}
NO_EVENT = "no event begins that moves somebody, and nobody is in Ego's lane or crosses it"


@pytest.mark.parametrize("scene", SCENES.strip().splitlines())
def test_what_happens_to_an_ego_that_keeps_its_speed(tmp_path: Path, scene: str) -> None:
    first, second, third = (part.split(":")[0].strip() for part in scene.split("|"))
    kind, *numbers = second.split()
    other = {"car": car, "walker": walker}[kind](*map(float, numbers))
    ego = private("Ego", teleport(STARTS.get(first, at(-1, 50))), speed(20))
    entities = {"entities": PERSON} if kind == "walker" else {}
    found = staged(tmp_path, EVENTS.get(first, ""), car=other, ego=ego, **entities).uneventful
    nobody = f"the scene ends at {third} s, before Ego has come near anybody"
    assert found == {"-": "", "NO_EVENT": NO_EVENT}.get(third, nobody)


def walks_after_v(folder: Path) -> str:
    """The file of a pedestrian who walks after v seconds."""
    return writing.write(
        folder,
        event(speed(1.5), AT_V),
        car=walker(200, 15, 0),
        entities=PERSON,
        parameters=writing.PARAMETER,
    )


def test_where_nobody_walks_there_is_no_verdict_and_points_are_left_out_by_name(
    tmp_path: Path,
) -> None:
    """A pedestrian is passed at 0.75 m, by any vehicle; in a search the original's encounter
    decides on a verdict.
    """
    file = walks_after_v(tmp_path)
    for when in (99, 3):
        table = f'extends = "wear"\nname = "mine"\n[scenario]\nfile = "{file}"\nvalues.v = {when}'
        (tmp_path / "mine.toml").write_text(table)
        answer = json_of("simulate", str(tmp_path / "mine.toml"))
        search = {"v": {"lower": 0.0, "upper": 99.0, "original": when}}
        searched = why_no_verdict(
            assemble(
                load_study("wear", scenario={"file": file, "over": search}, encounters="ranges")
            )
        )
        assert [answer["numbers"]["driven"], searched == "", NO_EVENT not in answer["verdict"]] == [
            when == 3
        ] * 3
    with pytest.warns(match=r"2 of 3 .* the first is v = 50: no event begins .*; others: v = 60"):
        study = load_study("wear", scenario={"file": writing.logical(tmp_path, 50, 4, 60)})
    assert (study.scenario.parameters["v"], why_no_verdict(assemble(study))) == (4, "")
    nowhere = load_study("wear", scenario={"file": writing.logical(tmp_path, 50, 60)})
    assert "at 2 of 2 points" in why_no_verdict(assemble(nowhere))


def test_searched_encounters_in_which_nothing_happens_do_not_count(tmp_path: Path) -> None:
    """The pedestrian walks after v seconds: at 3 s in time, at 50 s never, and vehicles of that
    encounter are left out whatever they do.
    """
    file = walks_after_v(tmp_path)
    search = {"v": {"lower": 0.0, "upper": 99.0, "original": 3.0}}
    system = assemble(
        load_study("wear", scenario={"file": file, "over": search}, encounters="ranges")
    )
    members = system.characteristics
    settings = np.tile(members.original, (4, 1))
    settings[:, members.names.index("v")] = 3.0, 50.0, 99.0, 3.0
    settings[2:, members.names.index("treadDepth")] = 1.6
    runs = drive_and_score(system, settings)
    assert (runs.outcome == "invalid-test").tolist() == [False, True, True, False]
    assert np.isnan(runs.f_safe[1:3]).all()
    assert (system.measuring.scoring.violation(runs) > 0).tolist() == [False, True, True, False]


BENT = """<geometry s="0" x="10" y="20" hdg="0" length="300"><line/></geometry>
<geometry s="300" x="310" y="20" hdg="0" length="1700"><arc curvature="{}"/></geometry>"""


@pytest.mark.parametrize(
    ("curvature", "stop", "end"),
    [
        (0.001, 12.3, 13.0),  # after the StopTrigger at 298 m
        (0.001, 8.0, 12.0),  # not reached
        (0.001, 13.5, None),  # refused: 0.2 m aside by then
        (1e-6, 13.5, 17.5),  # 1 mm aside
    ],
)
def test_ego_drives_straight_on_where_it_leaves_its_line_by_less_than_5_cm(
    tmp_path: Path, curvature: float, stop: float, end: float | None
) -> None:
    """Ego is in the bend at 20 m/s after 12.5 s, and 0.05 m aside after 10 m more."""
    slope = "<elevation s='0' a='0' b='0.01' c='0' d='0'/>"
    elevation = f"<elevationProfile>{slope}</elevationProfile>"
    file = writing.write(
        tmp_path, geometry=BENT.format(curvature), stop=trigger(AT_ONCE.format(stop), "")
    )
    road = tmp_path / "road.xodr"
    road.write_text(road.read_text().replace("<lanes>", f"{elevation}<lanes>"))
    if end is None:
        with pytest.raises(InputError, match=r"not drive straight on: it turns by 5\.7 deg"):
            play(file, {})
        return
    played = play(file, {})
    assert played.duration == pytest.approx(end, abs=0.02)
    assert "without effect here: the road's elevation" in played.remarks
    bends = [remark for remark in played.remarks if "Ego's way bends" in remark]
    assert len(bends) == (end == 13.0)
