"""Any metric of a study as the criterion of every question, a user's own, too; in a matrix its
worst point counts.
"""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.by_criterion import SOLUTIONS_STAGE, study_by
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import Evaluations, FloatArray
from tests.support.in_process import (
    SLOW,
    InlinePool,
    json_of,
    numbers_of,
    run,
    searched,
    write,
)
from tests.support.made_up import HARDEST_BRAKING

STUDY = """
extends = "rain"
name = "tiny"
title = "Who brakes hardest?"
[metrics]
also = ["hardest_braking:HARDEST"]
[search]
algorithms = ["nsga2"]
population = 10
evaluations = 80
runs = 1
"""


@pytest.fixture
def folder(in_tmp: Path, coarse: None) -> Path:
    write("hardest_braking.py", HARDEST_BRAKING)
    write("tiny.toml", STUDY)
    return in_tmp


@pytest.mark.parametrize(
    "text",
    [
        "collision",
        "below=0.3",
        "safety_degree < 4.75",
        "safety_degree < -1.5",
        "hardest >= 9",
    ],
)
def test_the_text_of_a_criterion_is_the_criterion(text: str) -> None:
    assert str(Unsafe.parse(text)) == text
    assert Unsafe.parse(str(Unsafe.parse(text))) == Unsafe.parse(text)


@SLOW
def test_in_a_matrix_the_point_counts_that_is_worst_by_the_measure() -> None:
    """The worn car stops nearest to a pedestrian at another point than where it had to brake
    hardest.
    """
    study, worn = load_study("wear"), {"brakeTorque": 0.7}
    by_drac = sv.evaluate(
        study_by(study, Unsafe.parse("drac > 5.7")),
        [worn],
        filtered=False,
        pool=InlinePool(),
    )
    by_degree = sv.evaluate(
        load_study("wear", metrics={"also": ["drac"]}),
        [worn],
        filtered=False,
        pool=InlinePool(),
    )
    assert by_drac["drac"][0] == pytest.approx(5.87, abs=0.005)
    assert by_degree["drac"][0] == pytest.approx(2.14, abs=0.005)
    assert by_degree["f_safe"][0] < by_drac["f_safe"][0]


@SLOW
def test_every_question_takes_an_own_metric(folder: Path) -> None:
    searched(load_study("tiny.toml"), folder / "results")
    for typed in (
        "risk tiny.toml --samples 256",
        "rules tiny.toml --samples 256",
        "explain results --fits 0 --top 1",
        "compare tiny.toml tiny.toml --samples 64",
        "tolerance tiny.toml --quick --characteristics tireFric,maxBrakeTorque",
        "repair tiny.toml --fits 0 --promise 'tireFric >= 3'",
    ):
        answer = json_of(f"{typed} --unsafe 'hardest > 6.8'")
        assert answer["numbers"]["unsafe"] == "hardest > 6.8", typed
        assert "hardest > 6.8" in answer["verdict"], typed


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_a_study_its_page_and_its_pack_take_an_own_metric(folder: Path) -> None:
    criterion = "--unsafe 'hardest > 6.8'"
    studied = json_of(f"study tiny.toml --out results --quiet {criterion}")
    counts = re.search(
        r"(\d+) of the ([\d,]+) different vehicles .* are unsafe\. .*hardest > 6.8, or a col",
        studied["verdict"],
    )
    results = sv.load("results")
    solutions = results.solutions.drop_duplicates([*results.characteristics.names])
    assert (
        0
        < int(counts[1])
        == ((solutions["hardest"] > 6.8) | (solutions["outcome"] == "collision")).sum()
    )
    assert re.search(r"The changed vehicle has hardest [\d.]+", studied["verdict"])
    ask = f"--ask 'risk --samples 64' {criterion}"
    run(f"report results --out page.html {ask}")
    assert "--unsafe &#39;hardest &gt; 6.8&#39;" in (folder / "page.html").read_text()
    run(f"evidence results --out pack.zip {ask}")
    verified = json_of("verify pack.zip --run-code")
    assert verified["numbers"]["passed"], verified["tables"]["claims"]


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_a_pack_simulates_solutions_once_by_its_criterion_and_a_question_keeps_its_own(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By `drac` another point of the matrix is the worst one than by the safety degree, of which
    one question asks.
    """
    search = {"algorithms": ["rs"], "population": 10, "evaluations": 40, "runs": 1}
    test = {
        "name": "CPFA",
        "parameters": {"test": "CPFA"},
        "over": {"speed": [10, 20, 40]},
    }
    matrix = {"aggregate": "worst", "tests": [test]}
    searched(load_study("wear", search=search, matrix=matrix), in_tmp / "results")
    stages = []
    evaluate = Evaluator.evaluate

    def noted(
        evaluator: Evaluator, settings: FloatArray, stage: str, **options: bool
    ) -> Evaluations:
        stages.append(stage)
        return evaluate(evaluator, settings, stage, **options)

    monkeypatch.setattr(Evaluator, "evaluate", noted)
    own = "rules --samples 64 --unsafe below=0.9"
    run(
        "evidence results --out pack.zip --unsafe 'drac > 5' --ask 'rules --samples 64' "
        f"--ask 'rules --samples 32' --ask '{own}'"
    )
    assert stages.count(SOLUTIONS_STAGE) == 2, (
        "to choose questions, and for all answers and the page"
    )
    with zipfile.ZipFile("pack.zip") as pack:
        (name,) = (name for name in pack.namelist() if name.endswith("answers.json"))
        packed = json.loads(pack.read(name))[-1]
    assert packed["numbers"] == numbers_of(own.replace("rules", "rules results"))
    run("verify pack.zip")


def test_a_clearance_is_between_bumpers_where_the_degree_is_between_middles() -> None:
    """A vehicle that brakes by 4.7 m/s^2 stops 4.75 m between middles before one as long as
    itself: nothing of the results but the criterion is between bumpers.
    """
    evaluator = Evaluator(load_study("native"), InlinePool(), verified=0)
    weak = evaluator.characteristics.setting({"decel": 4.7})
    runs = evaluator.evaluate(weak[np.newaxis], "weak brakes")
    below = evaluator.checked(Unsafe.parse("below=0.5"))
    clearance = runs.gaps(evaluator.system.contact)[0]
    assert 0 < clearance < 0.3 < 0.5 < runs.f_safe[0]
    assert below.of(runs)[0]
    assert below.robustness(runs)[0] == pytest.approx(clearance - 0.5)
    assert below.value(below.robustness(runs)[0]) == pytest.approx(clearance)
    assert evaluator.checked(Unsafe.parse("safety_degree < 0.5")).of(runs).tolist() == [
        False
    ]
