"""Two systems with the same settings: counted one by one, against itself, run by run, and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy

import safevar_sumo as sv
from safevar_sumo.questions.compare import _needless_braking
from safevar_sumo.questions.evaluator import Evaluator, sobol_settings
from safevar_sumo.questions.research_questions.statistics import compare_samples
from safevar_sumo.questions.tolerance import scans
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import InlinePool, json_of, refused, run, searched

LONGER = {"ads": {"model": "aeb", "parameters": {"braking_share": 0.65, "response_time": 0.3}}, "name": "earlier"}
ONE_TEST = {"matrix": {"tests": [{"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [40]}}]}}
POOL = InlinePool()


@pytest.fixture(autouse=True)
def _coarse_scans_and_no_benign_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scans, "SCAN_VALUES", 21)
    monkeypatch.setattr("safevar_sumo.questions.compare._needless_braking", lambda a, b: {})


def counts_of(answer: sv.Answer) -> tuple[int, int, int]:
    return tuple(answer.numbers[name] for name in ("only_a_unsafe", "only_b_unsafe", "both"))  # type: ignore[return-value]


@pytest.mark.slow
def test_the_collisions_that_another_version_avoids_are_those_of_simulations() -> None:
    wear, earlier = sv.load_study("wear", **ONE_TEST), sv.load_study("wear", **ONE_TEST, **LONGER)
    answer = sv.compare(wear, earlier, samples=32, unsafe="collision", pool=POOL)
    names = list(wear.vehicle.characteristics)
    settings = sobol_settings(CharacteristicSet.of(wear), 32)
    a, b = (evaluate(assemble(study), settings).collided for study in (wear, earlier))
    frame = answer.tables["settings"].sort_index()  # rows are numbered as they were simulated
    np.testing.assert_array_equal(frame[names].to_numpy(), settings)
    assert frame["unsafe_in"].isin(["a", "both"]).tolist() == a.tolist()
    assert frame["unsafe_in"].isin(["b", "both"]).tolist() == b.tolist()
    only_a, only_b, both = counts_of(answer)
    assert (only_a, only_b, both) == (np.sum(a & ~b), np.sum(b & ~a), np.sum(a & b))
    assert f"earlier avoids {only_a} of {only_a + both} settings unsafe in wear" in answer.verdict
    assert answer.numbers["p"] == pytest.approx(scipy.stats.wilcoxon(frame["a_degree"], frame["b_degree"]).pvalue)
    assert only_a > 0
    alone = scans.scan(Evaluator(wear, POOL), range(len(names)), sv.Unsafe())
    np.testing.assert_array_equal(answer.tables["limits"][["a_low", "a_high"]], [one.safe for one in alone])


def test_needless_braking_is_counted_in_both() -> None:
    wear = sv.load_study("wear", **ONE_TEST)
    early = sv.load_study("wear", **ONE_TEST, ads={"model": "aeb", "parameters": {"braking_share": 0.05}})
    in_a, in_b, scenes = _needless_braking(wear, early).values()
    assert 0 <= in_a < in_b <= scenes
    assert [*_needless_braking(wear, wear).values()] == [in_a, in_a, scenes]


def test_a_system_does_not_differ_from_itself(in_tmp: Path) -> None:
    answer = json_of("compare", "smoke", "smoke", "--samples", "100")
    numbers, limits = answer["numbers"], answer["tables"]["limits"]["rows"]
    assert (numbers["only_a_unsafe"], numbers["only_b_unsafe"]) == (0, 0)
    assert (numbers["p"], numbers["a12"], numbers["settings"]) == (1.0, 0.5, 100)
    assert [one["a_low"] for one in limits] == [one["b_low"] for one in limits]
    assert "B avoids 0" in answer["verdict"]


@pytest.mark.slow
def test_original_values_that_differ(in_tmp: Path) -> None:
    Path("heavy.toml").write_text(
        'extends = "smoke"\nname = "heavy"\n[vehicle.characteristics]\nmass = { original = 2500.0, lower = 2450.0 }\n'
    )
    answer = sv.compare("smoke", "heavy.toml", samples=50, pool=POOL)
    assert answer.tables["settings"]["mass"].min() >= 2450
    assert answer.tables["limits"].set_index("characteristic").loc["mass", ["a", "b"]].tolist() == [2404, 2500]
    assert answer.numbers["a_degree"] > answer.numbers["b_degree"]
    assert answer.figure().axes


def test_the_gap_stands_beside_a_degree_from_centre_to_centre() -> None:
    """The vehicle is 4.7 m long."""
    later = sv.load_study("native", name="later", ads={"parameters": {"braking_share": 0.5}})
    numbers = sv.compare("native", later, samples=8, pool=POOL).numbers
    assert [numbers[f"{side}_degree"] - numbers[f"{side}_gap"] for side in "ab"] == pytest.approx([4.7, 4.7])


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
def test_solutions_of_both_run_by_run(weathers: list[Path]) -> None:
    wet, dry = (sv.load(path) for path in reversed(weathers))
    answer = sv.compare(wet, dry, samples=20, pool=POOL)
    frame = answer.tables["settings"].sort_index()
    sizes = {"a": len(wet.solutions), "b": len(dry.solutions), "sample": 20}
    assert frame["source"].value_counts().to_dict() == sizes
    np.testing.assert_array_equal(frame["a_degree"][frame["source"] == "a"], wet.solutions["f_safe"])
    solutions = frame[frame["source"] != "sample"]
    runs = [solutions["source"], solutions["solution"].str.rpartition(":")[0]]
    means = solutions.groupby(runs)[["a_degree", "b_degree"]].mean()
    assert len(means) == 10
    a, b = means.to_numpy().T
    assert answer.numbers["p"] == pytest.approx(scipy.stats.wilcoxon(a, b).pvalue)
    assert answer.numbers["a12"] == compare_samples(a, b).effect_size
    assert "10 runs" in answer.verdict


@pytest.mark.slow
def test_a_report_of_two_results_compares_them(weathers: list[Path], in_tmp: Path) -> None:
    dry, wet = map(str, weathers)
    page = run("report", dry, wet, "--ask", "compare", "--out", "it.html") and Path("it.html").read_text()
    assert sv.compare(dry, wet, pool=POOL).render("html").replace("^2", "²") in page
    assert f"python -m safevar_sumo compare {dry} {wet}" in page
    refused("report", dry, "--ask", "compare", "--out", "it.html", message=("--ask: compare cannot be asked about 1",))
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
