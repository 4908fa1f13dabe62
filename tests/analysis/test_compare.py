"""Two systems with the same settings: counted one by one, against itself, by the tables' numbers, and refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy

import safevar_sumo as sv
from safevar_sumo.analysis.compare.compute import _needless_braking
from safevar_sumo.analysis.evaluator import sobol_settings
from safevar_sumo.analysis.research_questions.statistics import compare_samples
from safevar_sumo.analysis.tolerance import scans
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import InlinePool, json_of, refused, run, searched

KEYS = [
    "a",
    "b",
    "criterion",
    "settings",
    "only_a_unsafe",
    "only_b_unsafe",
    "both",
    "p",
    "a12",
    "limits",
    "needless_braking",
]
LONGER = {"ads": {"model": "aeb", "parameters": {"braking_share": 0.65, "response_time": 0.3}}, "name": "earlier"}
ONE_TEST = {"matrix": {"tests": [{"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [40]}}]}}
POOL = InlinePool()


@pytest.fixture(autouse=True)
def _coarse_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scans, "SCAN_VALUES", 21)


@pytest.mark.slow
def test_the_collisions_that_another_version_avoids_are_those_of_simulations() -> None:
    wear, earlier = sv.load_study("wear", **ONE_TEST), sv.load_study("wear", **ONE_TEST, **LONGER)
    answer = sv.compare(wear, earlier, samples=32, unsafe="collision", pool=POOL)
    settings = pd.DataFrame(sobol_settings(CharacteristicSet.of(wear), 32), columns=list(wear.vehicle.characteristics))
    a, b = (evaluate(assemble(study), settings.to_numpy()).collided for study in (wear, earlier))
    frame = answer.to_frame()
    pd.testing.assert_frame_equal(frame[list(settings)], settings)
    assert (frame["unsafe_a"].tolist(), frame["unsafe_b"].tolist()) == (a.tolist(), b.tolist())
    found = answer.to_dict()
    assert list(found) == [*KEYS, "originals"]
    counts = [int(found[name]) for name in ("only_a_unsafe", "only_b_unsafe", "both")]
    assert counts == [np.sum(a & ~b), np.sum(b & ~a), np.sum(a & b)]
    degrees = frame["safety_degree_a"], frame["safety_degree_b"]
    assert found["p"] == pytest.approx(scipy.stats.wilcoxon(*degrees).pvalue)
    assert counts[0] > 0
    alone = sv.tolerance(wear, unsafe="collision", pool=POOL).to_dict()["alone"]
    limits = [(one["characteristic"], one["a"]) for one in found["limits"]]
    assert limits == [(one["characteristic"], one["safe"]) for one in alone]
    assert "The original vehicles differ: passed, SD" in str([*answer.sentences()])


def test_needless_braking_is_counted_in_both() -> None:
    wear = sv.load_study("wear", **ONE_TEST)
    early = sv.load_study("wear", **ONE_TEST, ads={"model": "aeb", "parameters": {"braking_share": 0.05}})
    in_a, in_b, scenes = _needless_braking(wear, early)
    assert 0 <= in_a < in_b <= scenes
    assert _needless_braking(wear, wear) == (in_a, in_a, scenes)


def test_a_system_does_not_differ_from_itself(in_tmp: Path) -> None:
    answer = json_of("compare", "smoke", "smoke", "--samples", "100")
    assert list(answer) == KEYS
    assert (answer["only_a_unsafe"], answer["only_b_unsafe"]) == (0, 0)
    assert (answer["p"], answer["a12"], answer["settings"]) == (1.0, 0.5, 100)
    assert all(one["a"] == one["b"] for one in answer["limits"])


@pytest.mark.slow
def test_original_values_that_differ(in_tmp: Path) -> None:
    Path("heavy.toml").write_text(
        'extends = "smoke"\nname = "heavy"\n[vehicle.characteristics]\nmass = { original = 2500.0, lower = 2450.0 }\n'
    )
    heavy = json_of("compare", "smoke", "heavy.toml", "--samples", "50")
    assert heavy["originals"]["b"]["values"]["mass"] == 2500
    answer = sv.compare("smoke", "heavy.toml", samples=50, pool=POOL)
    assert answer.to_frame()["mass"].min() >= 2450
    assert "mass 2404 in A, 2500 kg in B" in str([*answer.sentences()])
    assert answer.figure().axes


@pytest.fixture(scope="module")
def weathers(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Results in two weathers, with enough runs for the test."""
    folder = tmp_path_factory.mktemp("weathers")
    search = {"algorithms": ["nsga2"], "population": 10, "evaluations": 40, "runs": 5, "seed": 1}
    return [
        searched(load_study("smoke", weather=weather, name=name, search=search), folder / name)
        for name, weather in (("dry", "clear"), ("wet", "wet"))
    ]


@pytest.mark.slow
def test_solutions_of_both_run_by_run_and_the_numbers_of_the_weather_table(weathers: list[Path]) -> None:
    dry, wet = map(str, weathers)
    answer = json_of("compare", wet, dry, "--samples", "20")
    assert answer["weather"] == json.loads(run("tables", dry, wet, "--rq", "weather", "--format", "json").stdout)
    frame = sv.compare(wet, dry, samples=20, pool=POOL).to_frame()
    solutions = [sv.load(path).solutions for path in (wet, dry)]
    assert frame["source"].value_counts().to_dict() == {"a": len(solutions[0]), "b": len(solutions[1]), "sample": 20}
    recorded = solutions[0]["f_safe"].to_numpy()
    np.testing.assert_array_equal(frame["safety_degree_a"][frame["source"] == "a"], recorded)
    means = frame[frame["source"] != "sample"].groupby(["source", "run"])[["safety_degree_a", "safety_degree_b"]].mean()
    assert len(means) == 10
    a, b = means.to_numpy().T
    assert answer["p"] == pytest.approx(scipy.stats.wilcoxon(a, b).pvalue)
    assert answer["a12"] == compare_samples(a, b).effect_size


@pytest.mark.slow
def test_a_report_of_two_results_compares_them(weathers: list[Path], in_tmp: Path) -> None:
    dry, wet = map(str, weathers)
    page = run("report", dry, wet, "--only", "compare,reproduce", "--out", "it.html") and Path("it.html").read_text()
    counts = sv.compare(dry, wet, pool=POOL).counts()
    assert f"{counts['only_b_unsafe']} in B only and {counts['both']} in both." in page
    assert f"python -m safevar_sumo compare {dry} {wet}" in page
    refused("report", dry, "--only", "compare", "--out", "it.html", message=("--only: compare needs two results",))
    refused("report", dry, dry, "--out", "it.html", message=("twice",))


def test_systems_that_cannot_be_compared_are_refused(in_tmp: Path) -> None:
    refused("compare", "wear", "rain", message=("study 'rain': cannot be compared", "treadDepth [mm]", "same units"))
    refused("compare", "smoke", "smok", message=("smok", "did you mean 'smoke'"))
    refused("compare", "euro_ncap_rating", "wear", "--unsafe", "points=3", message=("--unsafe", "'wear' is not rated"))
    Path("far.toml").write_text(
        'extends = "smoke"\nname = "far"\n[vehicle.characteristics]\n'
        "mass = { original = 9e3, lower = 8e3, upper = 1e4 }\n"
    )
    refused("compare", "smoke", "far.toml", message=("far.toml: mass: the domains of the two studies do not overlap",))
    run("compare", "smoke", "--json", expect=2)
