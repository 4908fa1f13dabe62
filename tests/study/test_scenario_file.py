# ruff: noqa: E501 (lines of XML)
"""Studies whose scenario is a file of OpenSCENARIO: what the file says takes the place of model,
network and matrix.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.scenarios import OpenScenario
from safevar_sumo.study import Study, data_files
from safevar_sumo.study.schema import tables_of
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble
from tests.in_process import json_of, run, verify_everywhere
from tests.made_up import original_of
from tests.openscenario.writing import (
    AT_ONCE,
    PARAMETER,
    at,
    event,
    lane_change,
    logical,
    speed,
    teleport,
    trigger,
    watching,
    write,
)
from tests.scenarios.holding import Hold, driven

FILES = Path(__file__).parents[1] / "openscenario" / "files"
LOGICAL = str(FILES / "cut_in_logical.xosc")


def study_of(file: str, **scenario: Any) -> Study:
    encounters = "ranges" if "over" in scenario else "tests"
    return load_study("wear", scenario={"file": file, **scenario}, encounters=encounters)


def runs_of(study: Study) -> list[SimulationRuns]:
    system = assemble(study)
    return [result.runs for result in simulate_all_points(system, original_of(system))]


def test_a_concrete_file_is_one_scenario_and_drops_what_is_inherited() -> None:
    study = study_of(str(FILES / "cut_in.xosc"), values={"ego_kmh": 60})
    assert study.matrix is None
    assert study.scenario.parameters == {"file": str(FILES / "cut_in.xosc"), "ego_kmh": 60}
    assert {Path(path).name for path in data_files(study)} == {
        "cut_in.xosc",
        "bodies.xosc",
        "three_lanes.xodr",
    }
    assert tables_of(load_study(tables_of(study))) == tables_of(study)
    (point,) = assemble(study).points
    assert point.scenario.test_speed == pytest.approx(60 / 3.6)


def test_a_path_counts_from_the_study(tmp_path: Path) -> None:
    write(tmp_path)
    path = tmp_path / "near.toml"
    path.write_text('extends = "wear"\n[scenario]\nfile = "scenario.xosc"\n')
    study = load_study(path)
    assert study.scenario.parameters["file"] == "scenario.xosc"
    assert {Path(file) for file in data_files(study).values()} == {
        tmp_path / "scenario.xosc",
        tmp_path / "road.xodr",
    }
    assert assemble(study).points[0].scenario.duration == pytest.approx(14)


@pytest.mark.slow
def test_the_files_of_a_study_are_all_that_were_read(tmp_path: Path) -> None:
    """A logical file and the concrete one; and, if a parameter chooses the catalog, all
    catalogs.
    """
    names = {"cut_in_logical.xosc", "cut_in.xosc", "bodies.xosc", "three_lanes.xodr"}
    study = study_of(LOGICAL, values={"ego_kmh": 80, "body": "lorry"}, over={"gap_m": {}})
    assert {Path(path).name for path in data_files(study).values()} == names
    assert tables_of(load_study(tables_of(study))) == tables_of(study)
    copytree(FILES, tmp_path / "files")
    (tmp_path / "files/catalogs/other.xosc").write_text(
        "<OpenSCENARIO><Catalog name='other'/></OpenSCENARIO>"
    )
    concrete = tmp_path / "files/cut_in.xosc"
    concrete.write_text(
        concrete.read_text()
        .replace('catalogName="bodies"', 'catalogName="$catalog"')
        .replace(
            "<ParameterDeclarations>",
            '<ParameterDeclarations><ParameterDeclaration name="catalog" parameterType="string" value="bodies"/>',
            1,
        )
    )
    study = study_of(
        str(tmp_path / "files/cut_in_logical.xosc"),
        values={"ego_kmh": 80, "body": "lorry"},
        over={"gap_m": {}},
    )
    assert {Path(path).name for path in data_files(study).values()} == {*names, "other.xosc"}
    (tmp_path / "base.toml").write_text(
        'extends = "wear"\n[scenario]\nfile = "files/cut_in_logical.xosc"\nvalues = { ego_kmh = 80, body = "lorry" }\n'
    )
    (tmp_path / "next.toml").write_text(
        'extends = "base.toml"\n[scenario]\nfile = "files/crossing_pedestrian.xosc"\n'
    )
    assert "files/cut_in_logical.xosc" in data_files(load_study(tmp_path / "base.toml"))
    assert not any("cut_in" in path for path in data_files(load_study(tmp_path / "next.toml")))


def test_what_is_not_searched_becomes_points_and_ranges_become_domains() -> None:
    study = study_of(
        LOGICAL,
        values={"ego_kmh": 80},
        over={"gap_m": {}, "slower_kmh": {"upper": 25, "unit": "km/h"}},
    )
    gap = study.ranges["gap_m"]
    slower = study.ranges["slower_kmh"]
    assert (gap.lower, gap.upper, gap.original) == (5, 45, 20)
    assert (slower.lower, slower.upper, slower.original, slower.unit) == (10, 25, 25, "km/h")
    assert len(study.matrix.tests) == 5 * 2
    names = {point.name for point in assemble(study).points}
    assert "cut_in_logical, sideways_mps 0.5, side 1, body lorry, wet" in names


def test_constraints_of_a_file_hold_in_the_search() -> None:
    """slower_kmh < ego_kmh - 10 excludes a corner of the two domains."""
    values = {"gap_m": 20, "sideways_mps": 1.5, "side": -1, "body": "hatchback"}
    study = study_of(LOGICAL, values=values, over={"ego_kmh": {}, "slower_kmh": {}})
    (constraint,) = study.constraints
    assert constraint.sum == pytest.approx({"ego_kmh": -1, "slower_kmh": 1})
    assert constraint.at_most == pytest.approx(-10, abs=1e-3)
    region = assemble(study).region
    settings = np.tile(region.characteristics.original, (2, 1))
    settings[:, [*region.characteristics.names].index("ego_kmh")] = 40
    settings[:, [*region.characteristics.names].index("slower_kmh")] = 29.9, 30.0
    assert region.feasible(settings).tolist() == [True, False]


def test_encounters_of_a_search_are_those_of_single_files() -> None:
    values = {"sideways_mps": 1.5, "side": -1, "body": "hatchback", "ego_kmh": 80}
    study = study_of(LOGICAL, values=values, over={"gap_m": {}, "slower_kmh": {}})
    (point,) = assemble(study).points
    gaps = np.array([8.0, 20.0, 33.5])
    slower = np.array([12.0, 25.0, 30.0])
    searched = encounter(point, {"gap_m": gaps, "slower_kmh": slower}).scenario
    assert isinstance(searched, OpenScenario)
    times = (np.arange(200) * 0.05)[:, np.newaxis]
    (together,) = searched.tracks(times)
    for k in range(3):
        (alone,) = encounter(point, {"gap_m": gaps[k], "slower_kmh": slower[k]}).scenario.tracks(
            times
        )  # type: ignore[attr-defined]
        assert np.array_equal(alone.x[:, 0], together.x[:, k])
        assert np.array_equal(alone.y[:, 0], together.y[:, k])


@pytest.mark.slow
def test_sumo_repeats_a_run() -> None:
    system = assemble(study_of(str(FILES / "crossing_pedestrian.xosc")))
    settings = original_of(system)
    (result,) = simulate_all_points(system, settings)
    assert result.runs.outcome[0] != Outcome.INVALID_TEST
    (point,) = system.points
    verify_everywhere(system, settings)
    assert point.scenario.vut_length == 4.2  # type: ignore[attr-defined]


def test_a_run_in_which_the_system_acts_while_others_depend_on_ego_is_invalid(
    tmp_path: Path,
) -> None:
    """A slower car ahead changes the lane when Ego is 1 m behind; no system waits for that."""
    close = '<RelativeDistanceCondition entityRef="Car" relativeDistanceType="longitudinal" freespace="true" rule="lessThan" value="1"/>'
    change = event(lane_change(-2, "linear", "time", 1), watching("Ego", close))
    (runs,) = runs_of(study_of(write(tmp_path, change, car=(teleport(at(-1, 120)), speed(10)))))
    assert runs.outcome[0] == Outcome.INVALID_TEST
    assert 0 < runs.acted_early[0] < (120 - 50 + 1.5 - 2.5 - 3.5 - 1) / 10
    (runs,) = runs_of(study_of(write(tmp_path, car=(teleport(at(-1, 120)), speed(10)))))
    assert runs.outcome[0] != Outcome.INVALID_TEST
    assert np.isnan(runs.acted_early[0])


@pytest.mark.parametrize(
    ("car", "expected"),
    [
        ((teleport(at(-1, 90)), speed(10)), ""),  # Ego follows it at its own speed
        ((teleport(at(-2, 90)), speed(10)), ""),  # nobody is in the lane
        ((teleport(at(-1, 300)), speed(0)), "never reaches the encounter (it gets "),
    ],
)
def test_who_keeps_its_speed_has_driven_unless_the_file_ends_before_somebody_who_stands(
    tmp_path: Path, car: tuple[str, ...], expected: str
) -> None:
    study = study_of(write(tmp_path, car=car, stop=trigger(AT_ONCE.format(8), "")))
    reason = why_no_verdict(assemble(study))
    assert reason == expected or (expected and expected in reason)


def test_who_is_deleted_is_not_hit(tmp_path: Path) -> None:
    """A standing car in the lane, which is deleted 1 s before Ego would be there."""
    delete = '<EntityAction entityRef="Car"><DeleteEntityAction/></EntityAction>'
    action = f'<Action name="a"><GlobalAction>{delete}</GlobalAction></Action>'
    gone = f'<Event name="Gone" priority="parallel">{action}{trigger(AT_ONCE.format(4))}</Event>'
    car = (teleport(at(-1, 50 + 100 + 3.5 + 1)), speed(0))
    assert driven(OpenScenario(write(tmp_path, gone, car=car)), Hold()).outcome[0] == Outcome.PASSED
    assert driven(OpenScenario(write(tmp_path, car=car)), Hold()).outcome[0] == Outcome.COLLISION


def test_combinations_that_nobody_can_play_are_left_out_with_a_warning(tmp_path: Path) -> None:
    write(tmp_path, car=(teleport(at(-2, 100)), speed("$v")), parameters=PARAMETER)
    with pytest.warns(match=r"1 of 3 combinations .* the first is v = -5: Car drives backwards"):
        study = study_of(logical(tmp_path, 5, -5, 10))
    assert [test.over for test in study.matrix.tests] == [{"v": [5]}, {"v": [10]}]


SEARCHED = """
file = "files/cut_in_logical.xosc"
values = { ego_kmh = 80, sideways_mps = 1.5, body = "hatchback", side = -1 }
over = { gap_m = {}, slower_kmh = { upper = 25 } }
"""


@pytest.mark.slow
def test_a_pack_of_a_search_over_a_file_has_all_files(in_tmp: Path) -> None:
    copytree(FILES, "files")
    Path("scene.toml").write_text(
        f'extends = "wear"\nencounters = "ranges"\n[scenario]\n{SEARCHED}'
    )
    budget = ["--runs", "1", "--evaluations", "50", "--algorithms", "rs", "--jobs", "1"]
    run("study", "scene.toml", *budget, "--out", "results")
    run("evidence", "results", "--out", "pack.zip", "--ask", "risk --samples 50", "--jobs", "1")
    with zipfile.ZipFile("pack.zip") as pack:
        names = {Path(name).name for name in pack.namelist()}
    assert {Path(path).name for path in data_files(load_study("scene.toml"))} <= names
    assert json_of("verify", "pack.zip", "--jobs", "1")["numbers"]["passed"] is True
