"""Two systems with the same settings: counted one by one, against itself, run by run, and
refused.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import scipy
import tomli_w
from msgspec import to_builtins

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.compare import differences
from safevar_sumo.questions.compare.coverage import missing_in_words
from safevar_sumo.questions.evaluator import Evaluator, open_evaluator
from safevar_sumo.questions.research_questions.statistics import compare_samples
from safevar_sumo.questions.tolerance import asked
from tests.support.in_process import (
    SLOW,
    InlinePool,
    refused,
    run,
    searched,
    write,
)
from tests.support.made_up_studies import ONE_TEST

pytestmark = pytest.mark.usefixtures("made_up_studies")

POOL = InlinePool()
NEEDLESS_BRAKING = differences._needless_braking


@pytest.fixture(autouse=True)
def _coarse_scans_and_no_benign_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asked, "USUAL", asked.USUAL._replace(values=10, alone=256))
    nothing = {
        "a_needless_braking": None,
        "b_needless_braking": None,
        "benign_scenes": 0,
    }
    monkeypatch.setattr(differences, "_needless_braking", lambda a, b: nothing)


CUT_OUT_SLOWER = [to_builtins(test) for test in load_study("alks").tests]
CUT_OUT_SLOWER[1]["over"]["speed"] |= {"at": [20, 40], "upper": 40}
LISTED = {"name": "CCRs", "model": "car_to_car", "parameters": {"test": "CCRs"}}
WEAR = {test.name: to_builtins(test) for test in load_study("wear").tests}
WEAR["CPNCO"]["over"]["impact_location"] = {"lower": 50, "upper": 75, "original": 50}
ALLOWS = [
    {**to_builtins(test), "allowed_impact_speed": 20.0}
    for test in load_study("autoware_july").tests
]
IMPACTS = {
    "matrix": {"aggregate": "impact_excess >", "tests": ALLOWS},
    "metrics": {"also": ["impact_excess"]},
}
FEWER_SETS = {name: sets[:3] for name, sets in load_study("wear").spread.items()}
OTHERS = {
    "a test with one speed less": (
        "autoware_july",
        {"matrix": {"tests": [{**LISTED, "over": {"speed": [30, 40, 60]}}]}},
        "Version B lacks the test case (CCRs, speed 50, clear), which A has.",
    ),
    "another name of the same test": (
        "autoware_july",
        {
            "matrix": {
                "tests": [
                    {**LISTED, "name": "rear", "over": {"speed": [30, 40, 50, 60]}}
                ]
            }
        },
        "",
    ),
    "another scenario": (
        "autoware_july",
        {"scenario": {"parameters": {"grade": -0.05}}},
        "Version B lacks the test case (CCRs, speed 30, clear), the test case (CCRs, speed 40,",
    ),
    "the first test alone": (
        "wear",
        ONE_TEST,
        "speed 30, wet), the test CPNA and 2 more, which A has. Version B leaves out",
    ),
    "another weather": (
        "sun",
        {"weather": "carla_hard_rain"},
        "Version B lacks the weather clear, which A has.",
    ),
    "fewer parameter sets": (
        "wear",
        {"spread": FEWER_SETS},
        "Version B lacks 9 parameter sets, which A has.",
    ),
    "a narrower range": (
        "sun",
        {"scenario": {"over": {"distance": {"lower": 9.0}}}},
        "Version B leaves out values in the ranges of A: distance from 8 to 9 m.",
    ),
    "a narrower range in use": (
        "sun",
        {"encounters": "ranges", "scenario": {"over": {"distance": {"lower": 9.0}}}},
        "Version B leaves out values in the ranges of A: distance from 8 to 9 m.",
    ),
    "lists and a range of one of two tests": (
        "alks",
        {"encounters": "ranges", "matrix": {"tests": CUT_OUT_SLOWER}},
        "which A has. Version B leaves out values in the ranges of A: speed from 40 to 130 km/h",
    ),
    "a range of one of four listed tests": (
        "wear",
        {"matrix": {"tests": [*WEAR.values()]}},
        "Version B leaves out values in the ranges of A: impact_location from 25 to 50 % in the"
        " test CPNCO.",
    ),
    "a narrower domain": (
        "wear",
        {"vehicle": {"characteristics": {"treadDepth": {"lower": 4.0}}}},
        "Version B leaves out values in the ranges of A: treadDepth from 1.6 to 4 mm.",
    ),
    "the same changes of another original vehicle": (
        "wear",
        {
            "vehicle": {
                "characteristics": {
                    "brakeResponse": {"original": 0.15, "lower": 0.1, "upper": 0.45}
                }
            }
        },
        "",
    ),
    "a margin": (
        "sun",
        {"scenario": {"margin": 2.0}},
        "the encounters in which its original vehicle keeps less than 2 m, which A has.",
    ),
    "a constraint": (
        "sun",
        {"constraints": [{"sum": {"mass": 1.0}, "at_most": 2500.0}]},
        "the vehicles that its constraint on mass excludes",
    ),
    "an allowed impact": (
        "autoware_july",
        IMPACTS,
        "The tests of B allow an impact of 20 km/h, those of A none (CCRs).",
    ),
    "another criterion": (
        "sun",
        {"unsafe": {"criterion": "ttc_min < 0.5", "source": "a rule"}},
        "The study B calls a vehicle unsafe by the criterion `ttc_min < 0.5`, and A by"
        " `collision`.",
    ),
}
"""A study, what version B changes in it, and the beginning of what B then asks less of."""


@pytest.mark.parametrize("changed", OTHERS)
def test_what_a_version_asks_less_of_is_named_on_its_side_alone(changed: str) -> None:
    name, changes, expected = OTHERS[changed]
    ranges = {"encounters": changes["encounters"]} if "encounters" in changes else {}

    def told(a: Evaluator, b: Evaluator, *titles: str) -> str:
        named = dict(zip("ab", titles, strict=True))
        return " ".join(text for _, text in missing_in_words(a, b, named))

    with (
        open_evaluator(load_study(name, **ranges), POOL) as a,
        open_evaluator(load_study(name, **changes), POOL) as b,
    ):
        text = told(a, b, "A", "B")
        assert expected in text
        assert bool(text) == bool(expected)
        assert not told(b, b, "A", "B")
        is_mutual = changed in ("another scenario", "another weather")
        assert ("Version A" in text) == is_mutual
        if "another" not in changed:
            assert expected.partition(". The worst")[0] in told(b, a, "B", "A")


LATE = """
from safevar_sumo.ads.aeb import Aeb


class Late(Aeb, frozen=True, kw_only=True):
    def start(self, n, nominal, step):
        return Aeb.start(self, n, nominal, step), (None,) * round(0.15 / step)

    def drive(self, seen, memory):
        command, inner = Aeb.drive(self, seen, memory[0])
        past = (*memory[1], command)
        return past[0] or command, (inner, past[1:])

    def warns(self, memory):
        return Aeb.warns(self, memory[0])
"""
VERSIONS = {
    "later": (
        {"ads": {"model": "late:Late"}},
        "do not release",
        r"although it brakes less often without need\. Version later lacks 12 parameter sets, which"
        r" wear has\. The original vehicle of later collides at ([\d.]+) m/s \(test CPFA, driven at"
        r" 40 km/h\)\. The original vehicle of wear does not",
    ),
    "needless": (
        {"ads": {"parameters": {"braking_share": 0.1}}},
        "decide",
        r"needlessly in \d+ of \d+ benign scenes .*, and version wear in \d+\. All \d+ changed",
    ),
}


@SLOW
@pytest.mark.parametrize("version", VERSIONS)
def test_neither_of_two_worse_versions_is_released(
    version: str, in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One decides 0.15 s later, one brakes for nearly everybody."""
    changes, decision, words = VERSIONS[version]
    monkeypatch.setattr(differences, "_needless_braking", NEEDLESS_BRAKING)
    write("late.py", LATE)
    study = {"extends": "wear", "name": version, **ONE_TEST, **changes}
    write("version.toml", tomli_w.dumps(study))
    answer = sv.compare(
        load_study("wear", **ONE_TEST), "version.toml", samples=40, pool=POOL
    )
    assert answer.numbers["decision"] == decision
    assert answer.verdict.startswith(f"{decision.upper()}: {version} ")
    assert bool(answer.failures) == (decision == "do not release")
    said = re.search(words, answer.verdict)
    assert said is not None, answer.verdict
    for speed in said.groups():
        assert float(speed) == pytest.approx(-answer.numbers["b_degree"], abs=0.005)


@SLOW
def test_the_gap_stands_beside_a_degree_from_centre_to_centre() -> None:
    """The vehicle is 4.7 m long."""
    later = load_study(
        "native", name="later", ads={"parameters": {"braking_share": 0.5}}
    )
    numbers = sv.compare("native", later, samples=8, pool=POOL).numbers
    assert numbers["metres_earlier"] > 0 == numbers["metres_later"]
    assert [
        numbers[f"{side}_degree"] - numbers[f"{side}_gap"] for side in "ab"
    ] == pytest.approx([4.7, 4.7])


@pytest.fixture(scope="module")
def weathers(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Results in two weathers, with enough runs for the test."""
    folder = tmp_path_factory.mktemp("weathers")
    search = {
        "algorithms": ["nsga2"],
        "population": 10,
        "evaluations": 40,
        "runs": 5,
        "seed": 1,
    }
    return [
        searched(
            load_study("smoke", weather=weather, name=name, search=search),
            folder / name,
        )
        for name, weather in (("dry", "clear"), ("wet", "wet"))
    ]


@SLOW
def test_solutions_of_both_run_by_run(weathers: list[Path]) -> None:
    wet, dry = (sv.load(path) for path in reversed(weathers))
    answer = sv.compare(wet, dry, samples=20, pool=POOL)
    frame = answer.tables["settings"].sort_index()
    sizes = {"a": len(wet.solutions), "b": len(dry.solutions), "sample": 20}
    assert frame["source"].value_counts().to_dict() == sizes
    np.testing.assert_array_equal(
        frame["a_degree"][frame["source"] == "a"], wet.solutions["f_safe"]
    )
    solutions = frame[frame["source"] != "sample"]
    runs = [solutions["source"], solutions["solution"].str.rpartition(":")[0]]
    means = solutions.groupby(runs)[["a_degree", "b_degree"]].mean()
    assert len(means) == 10
    a, b = means.to_numpy().T
    assert answer.numbers["p"] == pytest.approx(scipy.stats.wilcoxon(a, b).pvalue)
    assert answer.numbers["a12"] == compare_samples(a, b).effect_size
    assert "over 10 groups of vehicles (the solutions of one run)" in answer.tested
    pairs = answer.tables["pairs"]
    assert pairs["pair"].tolist() == [
        f"nsga2-{run:02d} of {side}" for side in "AB" for run in range(5)
    ]
    assert pairs["a"].tolist() == pytest.approx(a)


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_a_report_of_two_results_compares_them(
    weathers: list[Path], in_tmp: Path
) -> None:
    dry, wet = map(str, weathers)
    run(f"report {dry} {wet} --ask compare --out it.html")
    page = Path("it.html").read_text()
    assert sv.compare(dry, wet, pool=POOL).render("html").replace("^2", "²") in page
    assert "<h3>Compare</h3>" in page.partition('class="front')[0], "it stands first"
    assert f"python -m safevar_sumo compare {dry} {wet}" in page
    refused(
        f"report {dry} --ask compare --out it.html",
        "--ask: compare cannot be asked about 1",
    )
    refused(f"report {dry} {dry} --out it.html", "twice")
