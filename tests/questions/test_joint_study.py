"""Every question about a study that searches its scenario: a setting is a vehicle and an encounter,
and the original vehicle drives in the same one.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions import evaluator
from safevar_sumo.questions.bench import bench_of
from safevar_sumo.questions.case import Results, load_cases
from safevar_sumo.questions.cases import SearchPlan, search_scope
from safevar_sumo.questions.evaluator import open_evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.tolerance import asked
from safevar_sumo.results.identity import identity_digest, manifest_of
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import (
    SLOW,
    InlinePool,
    json_of,
    refused,
    rows_of,
    run,
    searched,
)

STUDY = """
extends = "rain"
name = "tiny"
title = "Which vehicle, at which gap?"
encounters = "ranges"
[scenario]
margin = 0.4
[scenario.over]
distance = { unit = "m", original = 12.129, lower = 8, upper = 18, meaning = "gap at the start" }
walking_speed = false
[search]
algorithms = ["nsga2", "rs"]
population = 10
evaluations = 80
runs = 1
"""
LEFT_OUT = (
    r"own values of distance\. An encounter counts only if the original vehicle keeps at least 0\.4"
    r" m of clearance in it \(scenario\.margin\)\. {} encounters do not count and were left out\."
)
DEMANDED = (
    r"An encounter counts only if the original vehicle keeps at least 0\.4 m of clearance in it"
    r" \(scenario\.margin\)\."
)
COUNTED = LEFT_OUT.format(r"[\d,]+")
CAUSE = "The original vehicle is safe in the same encounter, which has"
QUESTIONS = {
    "risk tiny.toml --samples 300": f"{DEMANDED}.*left out",
    "risk results --samples 300": COUNTED,
    "rules tiny.toml --samples 300": COUNTED,
    "explain tiny.toml --quick": (
        rf"encounters in which the original vehicle is least safe\..* {DEMANDED}"
        r" [\d,]+ encounters do not count and were left out\."
    ),
    "explain results --quick --top 2": CAUSE,
    "tables results": (
        rf"are less safe than the original vehicle in the same encounter\. {DEMANDED}"
    ),
    "simulate results --solution fewest": "The original vehicle stops, with a safety",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the study and its results are."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "tiny.toml").write_text(STUDY)
    searched(load_study(str(folder / "tiny.toml")), folder / "results")
    return folder


@pytest.fixture
def case(folder: Path) -> Results:
    return load_cases([folder / "results"])[0]


@pytest.fixture(autouse=True)
def _few_encounters(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(asked, "USUAL", asked.USUAL._replace(values=10, alone=256))
    monkeypatch.setattr(evaluator, "ENCOUNTERS", 4)
    monkeypatch.setattr(evaluator, "CANDIDATES", 64)


@pytest.mark.parametrize(
    "typed",
    [
        pytest.param(typed, marks=SLOW if "tiny" in typed or "explain" in typed else ())
        for typed in QUESTIONS
    ],
)
def test_a_question_says_which_encounters_count(typed: str) -> None:
    assert re.search(QUESTIONS[typed], json_of(typed)["verdict"])


def test_results_are_asked_about_in_the_encounters_of_their_study() -> None:
    told = "--ranges: of results, whose encounters are those of their study"
    refused("risk results --ranges", told)


def test_simulate_and_the_summary_of_a_search_compare_with_the_original_in_the_same_encounter(
    case: Results,
) -> None:
    drawn = case.evaluations
    limit = case.scoring.safe_original
    row = drawn[drawn["original_safety_degree"] < limit].iloc[0]
    values = [
        f"--set={name}={float(row[name])!r}" for name in case.characteristics.names
    ]
    answer = json_of("simulate results", *values)
    degrees = next(
        one for one in rows_of(answer, "results") if one["result"] == "safety_degree"
    )
    assert (degrees["original"], degrees["simulated"]) == (
        row["original_safety_degree"],
        row["safety_degree"],
    )
    assert "A search would leave this encounter out: the" in answer["verdict"]
    rows = rows_of(json_of("study tiny.toml --status --out results"), "algorithms")
    safe = drawn[drawn["original_safety_degree"] >= limit]
    expected = [
        ((safe["outcome"] == "collision") & (safe["algorithm"] == name)).sum()
        for name in ("nsga2", "rs")
    ]
    assert [one["collisions"] for one in rows] == expected
    assert sum(expected) < (drawn["outcome"] == "collision").sum()


def test_the_margin_of_the_original_is_a_key_and_says_which_evaluations_are_feasible(
    case: Results,
) -> None:
    assert case.scoring.safe_original == 0.4
    frame = case.evaluations
    assert (frame["feasible"] == (frame["original_safety_degree"] >= 0.4)).all()
    assert 0 < frame["feasible"].mean() < 1
    evaluated = sv.evaluate(
        case.study,
        frame[[*case.characteristics.names]].head(8),
        filtered=False,
        pool=InlinePool(),
    )
    assert (evaluated["feasible"] == frame["feasible"].head(8)).all()
    assert "feasible" not in sv.evaluate("smoke", [{}], pool=InlinePool())
    strict = load_study(case.study, scenario={"margin": 2.0})
    assert assemble(strict).measuring.scoring.safe_original == 2
    assert identity_digest(manifest_of(strict, {})) != identity_digest(
        manifest_of(case.study, {})
    )


TAKES_ALL = """
class TakesAll:
    def search(self, problem, rng):
        return (yield problem.characteristics.filter(problem.uniform(problem.evaluations, rng)))
"""


@SLOW
def test_a_study_counts_what_an_own_algorithm_returns_and_is_no_solution(
    folder: Path,
) -> None:
    (folder / "takes.py").write_text(TAKES_ALL)
    own = (
        'extends = "tiny.toml"\nname = "own"\nsearch.algorithms = ["takes:TakesAll"]\n'
    )
    (folder / "own.toml").write_text(own)
    study = load_study("own.toml")
    with pytest.warns(UserWarning, match="TakesAll") as warned:
        searched(study, folder / "own")
    case = load_cases([folder / "own"])[0]
    infeasible = (~case.evaluations["feasible"]).sum()
    assert 0 < infeasible < 80 == len(case.solutions) + infeasible
    (warning,) = (text for text in map(str, warned) if "TakesAll" in text)
    assert f"{infeasible} settings that TakesAll returned are no solutions" in warning


def test_a_search_without_a_solution_says_why_and_suggests_nothing_that_is_refused(
    folder: Path,
) -> None:
    (folder / "far.toml").write_text(
        'extends = "tiny.toml"\nname = "far"\nscenario.margin = 40\nsearch.evaluations = 10\n'
    )
    text = run("study far.toml --out far").stdout
    assert "The search returned no vehicle: the original vehicle keeps at least" in text
    assert "Next: a smaller scenario.margin" in text
    assert "explain" not in text
    assert "Remarks" not in text, "a table without a remark"


WORN = {
    "wear": {
        "treadDepth": 5.58,
        "brakeTorque": 0.88,
        "brakeResponse": 0.112,
        "payload": 242,
        "payloadCentre": 2.2,
        "sensorRange": 23.8,
    },
    "sun": {
        "max_rpm": 6404,
        "dampRateFullT": 0.141,
        "dampRateZeroT_CE": 1.83,
        "dampRateZeroT_CD": 0.278,
        "clutchStrength": 10.42,
        "mass": 2367.6,
        "dragCoeff": 0.2,
        "tireFric": 3.833,
        "dampRate": 0.215,
        "radius": 35.39,
        "maxBrakeTorque": 1466,
    },
}
"""Vehicles within limits that version 0.3 printed, which no corner broke, though each collides in a
small pocket of the encounters, such as 0.15 km/h by 4 % of the path.
"""


@SLOW
@pytest.mark.parametrize("name", WORN)
def test_an_attack_finds_the_pockets_that_corners_miss(name: str) -> None:
    with open_evaluator(
        load_study(name, encounters="ranges"), InlinePool(2)
    ) as judging:
        bench = bench_of([Model(0, judging, Unsafe())], Unsafe(), between=False)
        original = bench.vehicle.original
        worn = np.array(
            [WORN[name].get(item.name, item.original) for item in bench.vehicle.members]
        )
        ends = np.sort([original, worn], axis=0)
        scope = bench.scope(0, *ends)
        rng = np.random.default_rng(0)
        met = search_scope(bench.drive, scope, scope.nothing, SearchPlan(5000), rng)
    assert len(met.unsafe)
    assert met.simulated <= 5000


def test_changes_are_those_of_the_vehicle(case: Results) -> None:
    tables = json_of("tables results")["tables"]
    solutions = case.solutions[case.solutions["algorithm"] == "nsga2"]
    critical = solutions[
        solutions["safety_degree"] < solutions["original_safety_degree"]
    ]
    counts = {
        int(one["j"]): one["count"] for one in tables["rq3.1"]["rows"] if one["count"]
    }
    assert counts == critical["f_num_diff"].astype(int).value_counts().to_dict()
    assert "distance" not in {one["characteristic"] for one in tables["rq3.2"]["rows"]}


@SLOW
def test_two_studies_are_compared_in_the_encounters_that_both_search(
    folder: Path,
) -> None:
    (folder / "wider.toml").write_text(
        STUDY.replace("lower = 8, upper = 18", "lower = 10, upper = 20")
    )
    answer = json_of("compare results wider.toml --samples 64", expect=4)
    assert re.search(LEFT_OUT.format(r"[\d,]+"), answer["verdict"])
    assert "were not tested in the same way" in answer["verdict"]
    assert answer["numbers"]["margin"] == 0.1, "as in tolerance"
    assert answer["numbers"]["only_a_unsafe"] == answer["numbers"]["only_b_unsafe"] == 0
    frame = rows_of(answer, "settings")
    assert all(10 <= one["distance"] <= 18 for one in frame)
    assert "distance" not in {
        one["characteristic"] for one in rows_of(answer, "limits")
    }


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_the_page_replays_causes_in_their_encounters() -> None:
    run("report results --out page.html --ask 'explain --quick --top 2' --jobs 1")
    page = Path("page.html").read_text()
    replays = re.findall(r"<summary>(Only [^<]*)</summary>", page)
    assert replays
    assert all("in its encounter: collides" in one for one in replays), replays
    assert "meets an encounter of its own, with its own values of distance" in page
