"""What a results directory holds is simulated again as it was found, and seen from above."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.replay.comparison import compare_setting, differences, divergence, moments
from safevar_sumo.results import handles
from safevar_sumo.study import load_study
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.film import film
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import System, assemble


@pytest.fixture
def case(slippery: Path) -> Case:
    return load_cases([slippery])[0]


def simulated(*arguments: str) -> Result:
    return CliRunner().invoke(commands, ["simulate", *arguments])


def test_every_solution_replays_to_the_bit(case: Case) -> None:
    system = assemble(case.study)
    settings = case.solutions[list(case.characteristics.names)].to_numpy()
    for setting, (_, row) in zip(settings, case.solutions.iterrows(), strict=True):
        comparison = compare_setting(case.study, system, setting)
        here = comparison.evaluations.take([1])
        assert differences(here, row.to_dict()) == []
        assert here.f_safe[0] == row["f_safe"]
    assert len(set(case.solutions["outcome"])) > 1


def test_the_command_replays_every_solution_of_solutions_csv(slippery: Path) -> None:
    frame = pd.read_csv(slippery / "solutions.csv")
    for handle, (_, row) in list(zip(handles(frame), frame.iterrows(), strict=True))[::4]:
        done = simulated(str(slippery), "--solution", str(handle), "--json")
        told = json.loads(done.stdout)
        assert done.stderr == ""
        assert told["solution"] == str(handle)
        assert told["outcome"] == row["outcome"]
        assert [told[name] for name in METRICS] == [None if np.isnan(row[name]) else row[name] for name in METRICS]


@pytest.mark.parametrize(("flag", "column"), [("--most-severe", "f_safe"), ("--smallest", "f_diff"), ("--fewest", "f_num_diff")])
def test_the_most_severe_the_smallest_and_the_fewest(flag: str, column: str, slippery: Path) -> None:
    frame = pd.read_csv(slippery / "solutions.csv")
    told = json.loads(simulated(str(slippery), flag, "--json").stdout)
    assert told[column] == frame[frame["outcome"] == "collision"][column].min()


def test_what_set_says_comes_over_the_solution(slippery: Path) -> None:
    severe = json.loads(simulated(str(slippery), "--most-severe", "--json").stdout)["vcs"]
    back = json.loads(simulated(str(slippery), "--most-severe", "--set", "tireFric=3.5", "--json").stdout)["vcs"]
    assert severe["tireFric"] < 3.5
    assert back == severe | {"tireFric": 3.5}


def test_a_row_that_was_not_found_here_is_told(slippery: Path, case: Case) -> None:
    comparison = compare_setting(case.study, assemble(case.study), case.characteristics.original)
    told = differences(comparison.evaluations, {"safety_degree": 1.0, "tet": np.nan, "outcome": "collision"})
    assert [one.split(" is ")[0] for one in told] == ["the outcome", "safety_degree", "tet"]


@pytest.mark.parametrize(("arguments", "legal"), [
    (["rain", "--fewest"], "a directory"), (["DIR", "--solution", "nsga2:0:99"], "N from 0 to"),
    (["DIR", "--solution", "x"], "ALGORITHM:RUN:N"),
    (["DIR", "--solution", "nsga2:0:0", "--fewest"], "one of them"), (["DIR", "--plot", "x.bmp"], ".png")])
def test_what_cannot_be_replayed_is_refused(arguments: list[str], legal: str, slippery: Path) -> None:
    done = simulated(*(str(slippery) if one == "DIR" else one for one in arguments))
    assert isinstance(done.exception, InputError)
    assert legal in str(done.exception)


@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
def test_a_film_shows_what_is_simulated(study: str) -> None:
    system = assemble(load_study(study))
    settings = np.stack([system.characteristics.original, system.characteristics.lower])
    taken, plain = film(system, settings), simulate(system, settings)
    for name, values in score(system, settings, plain).metrics.items():
        assert np.array_equal(values, score(system, settings, taken.drives).metrics[name], equal_nan=True)
    vut = taken.tracks["vut"]
    assert np.array_equal(vut.x, taken.drives.trace.position)
    assert vut.length == taken.drives.trace.vehicle_length
    assert not np.isnan(vut.y).any()
    for row, end in enumerate(taken.last):
        assert taken.drives.trace.active[end, row]
        assert not taken.drives.trace.active[end + 1:, row].any()


def test_a_film_of_the_crossing_has_its_pedestrian_and_its_crossing(sun: System) -> None:
    taken = film(sun, sun.characteristics.original[np.newaxis])
    pedestrian = taken.tracks["pedestrian"]
    assert pedestrian.is_person
    assert np.allclose(pedestrian.y[:, 0] - taken.tracks["vut"].y[:, 0], taken.drives.trace.lateral[:, 0])
    (crossing,) = [lane for lane in taken.road if lane.kind == "crossing"]
    assert np.allclose(crossing.line[:, 0], pedestrian.x[0, 0], atol=0.01)
    assert {lane.kind for lane in taken.road} == {"road", "path", "crossing", "area"}


def test_moments_of_a_drive(case: Case) -> None:
    comparison = compare_setting(case.study, assemble(case.study), case.solutions[list(case.characteristics.names)].to_numpy()[0])
    drives = comparison.film.drives
    trace, original, hit = drives.trace, moments(drives, 0), moments(drives, 1)
    assert original.brake is not None
    assert trace.brake[original.brake, 0] > 0
    assert not trace.brake[trace.time < trace.time[original.brake], 0].any()
    assert trace.gap[original.nearest, 0] == comparison.evaluations.f_safe[0]
    assert hit.nearest == hit.end
    assert comparison.verdict(0) == f"stops with {comparison.evaluations.f_safe[0]:.2f} m to spare"
    assert comparison.verdict(1) == f"hits at {-comparison.evaluations.f_safe[1]:.1f} m/s"
    apart = divergence(drives)
    assert apart is not None
    assert abs(trace.speed[apart, 0] - trace.speed[apart, 1]) > 0.1
    assert np.all(np.abs(trace.speed[:apart, 0] - trace.speed[:apart, 1]) <= 0.1)
