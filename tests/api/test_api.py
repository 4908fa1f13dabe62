"""The library as users call it: `import safevar_sumo as sv`."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pandas.testing import assert_frame_equal

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.part import at_point
from safevar_sumo.study import tables_of
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import SLOW, run_python, write

pytestmark = pytest.mark.usefixtures("pools_in_this_process")


def test_every_public_name_is_there_and_nothing_else() -> None:
    for name in sv.__all__:
        assert getattr(sv, name) is not None
    assert dir(sv) == sorted(sv.__all__)
    assert sv.__version__ == version("safevar_sumo")
    with pytest.raises(AttributeError, match="optimize"):
        sv.optimize  # type: ignore[attr-defined]  # noqa: B018


def test_changes_override_a_study_as_a_file_that_extends_it_would(in_tmp: Path) -> None:
    changed = sv.load_study(
        "rain", weather="fog", search={"runs": 2}, ads={"parameters": {"corridor": 3.0}}
    )
    write(
        "mine.toml",
        'extends = "rain"\nname = "rain"\nweather = "fog"\n[search]\nruns ='
        " 2\n[ads.parameters]\ncorridor = 3.0\n",
    )
    same = sv.load_study("mine.toml")
    assert (changed.weather, changed.search, changed.ads) == (
        same.weather,
        same.search,
        same.ads,
    )
    assert sv.load_study(changed, search={"seed": 7}).search.runs == 2


def test_values_of_numpy_and_pandas_are_those_of_python() -> None:
    weather = {
        "name": "wet",
        "road_friction": 0.5,
        "visibility": 1.0,
        "recognition_delay": 0.0,
    }
    search = {"runs": np.int64(2), "seed": np.array(7)}
    plain = {"runs": 2, "seed": 7}
    theirs = {**weather, "road_friction": np.float64(0.5), "visibility": np.array(1.0)}
    assert sv.load_study("smoke", weather=theirs, search=search) == sv.load_study(
        "smoke", weather=weather, search=plain
    )
    assert sv.load_study("smoke", weather=pd.Series(theirs)) == sv.load_study(
        "smoke", weather=weather
    )
    plain_setting = {"tireFric": 1.1, "mass": 2600.0}
    expected = sv.simulate("smoke", plain_setting).to_dict()
    for changes in (
        pd.Series(plain_setting),
        {name: np.array(value) for name, value in plain_setting.items()},
    ):
        assert sv.simulate("smoke", changes).to_dict() == expected
    settings = [pd.Series(plain_setting), {"tireFric": np.array(1.1)}]
    frame = sv.evaluate("smoke", [plain_setting, {"tireFric": 1.1}], jobs=1)
    assert_frame_equal(sv.evaluate("smoke", settings, jobs=1), frame)


def test_simulate_returns_the_setting_and_the_original_beside_it() -> None:
    result = sv.simulate("rain", {"tireFric": 1.5, "mass": 2410.0})
    assert (result.setting["tireFric"], result.setting["mass"]) == (1.5, 2410.0)
    assert result.reset_values == {"mass": 2410.0}
    assert result.objectives["f_num_diff"] == 1
    assert result.objectives["f_diff"] == pytest.approx(2 / 3.5)
    assert result.metrics["safety_degree"] == result.objectives["f_safe"]
    assert result.original.setting == {
        one.name: one.original for one in CharacteristicSet.of(result.study)
    }
    assert result.original.original is result.original
    assert result.original.metrics != result.metrics
    assert "<p>&lt;Simulation of rain" in result._repr_html_()
    assert result.to_dict()["vcs"] == result.setting
    assert (
        sv.simulate("rain", {"mass": 2410.0}, filtered=True).setting["mass"] == 2404.0
    )


def test_a_safety_degree_has_the_digits_by_which_both_vehicles_differ() -> None:
    mass = sv.simulate("rain").setting["mass"]
    for change in (1e-9, 0.1):
        changed = sv.simulate("rain", {"mass": mass * (1 + change)})
        texts = [one.verdict.split()[-2] for one in (changed.original, changed)]
        assert changed.metrics != changed.original.metrics
        assert len({*texts}) == 2
        assert (len(texts[0].partition(".")[2]) > 2) is (change < 0.1)


def test_evaluate_is_simulate_row_by_row() -> None:
    asked = pd.DataFrame(
        {"tireFric": [1.2, 3.45, 1.2], "mass": [2500.0, 2404.0, 2500.0]},
        index=list("abc"),
    )
    frame = sv.evaluate("sun", asked, jobs=1)
    assert list(frame.index) == list("abc")
    assert frame.loc["b", "tireFric"] == 3.45, "a setting is simulated as it is given"
    assert frame.loc["b", ["f_diff", "f_num_diff"]].tolist() == [0, 0], (
        "as in the paper"
    )
    filtered = sv.evaluate("sun", asked, filtered=True, jobs=1)
    assert filtered.loc["b", ["tireFric", "mass"]].tolist() == [3.5, 2404.0]
    assert frame.loc["a"].equals(frame.loc["c"])
    one = sv.simulate("sun", {"tireFric": 1.2, "mass": 2500.0})
    for name, value in {**one.metrics, **one.objectives}.items():
        assert frame.loc["a", name] == value
    again = sv.evaluate("sun", frame[list(one.setting)].to_numpy(), jobs=1)
    assert_frame_equal(again, frame.reset_index(drop=True))


def test_a_value_that_is_missing_is_the_originals() -> None:
    """Mappings name only what is changed; an empty mapping is the original vehicle."""
    frame = sv.evaluate(
        "sun", [{"tireFric": 1.2}, {}, {"mass": 2500.0, "tireFric": None}], jobs=1
    )
    assert frame["tireFric"].tolist() == [1.2, 3.5, 3.5]
    assert frame["mass"].tolist() == [2404.0, 2404.0, 2500.0]


def test_a_collision_with_a_moving_car_has_its_closing_speed_and_the_cars_own() -> None:
    study = at_point(
        sv.load_study("euro_ncap_car_to_car"),
        "CCRm, speed 80, impact_location 50, clear",
    )
    one = sv.simulate(study, {"tireFric": 1.0})
    closing, own = -one.metrics["safety_degree"], one.collision_speed
    assert own == pytest.approx(closing + 20 / 3.6, abs=1e-6)
    speeds = f"a closing speed of {closing:.2f} m/s (own speed {own:.2f} m/s)"
    assert one.verdict == f"collides at {speeds}"


@SLOW
def test_in_a_matrix_the_original_drives_at_the_worst_point_of_the_changed_vehicle() -> (
    None
):
    """A table, a trace, and a picture show the same two drives."""
    one = sv.simulate("wear", {"brakeTorque": 0.6})
    comparison = sv.comparison_of(one)
    name = comparison.point.name
    assert sv.simulate("wear").pair.point.name != name, (
        "the original's own worst point is another one"
    )
    for row, vehicle in enumerate((one.original, one)):
        assert vehicle.metrics["safety_degree"] == comparison.evaluations.f_safe[row]
        assert vehicle.trace["speed [m/s]"].to_numpy() == pytest.approx(
            comparison.runs.trace.speed[: comparison.moments[row].end + 1, row], abs=0
        )
    alone = sv.simulate(at_point(sv.load_study("wear"), name), {"brakeTorque": 0.6})
    assert (alone.original.numbers, alone.numbers) == (
        one.original.numbers,
        one.numbers,
    )
    assert_frame_equal(alone.trace, one.trace)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (pd.DataFrame({"weight": [1.0]}), "weight"),
        (
            pd.DataFrame({"mass": ["heavy"]}),
            "row 0: mass = 'heavy'\nexpected: a number",
        ),
        (pd.DataFrame({"mass": [2404.0, 9999.0]}), "row 1: mass = 9999"),
        (np.full((1, 17), np.nan), "shape|= nan"),
    ],
)
def test_unusable_frames_are_reported_before_any_simulation(
    settings: object, expected: str
) -> None:
    with pytest.raises(sv.InputError, match=expected):
        sv.evaluate("sun", settings)  # type: ignore[arg-type]


def test_load_reads_the_results_of_run(tmp_path: Path) -> None:
    results = sv.run("smoke", tmp_path / "out", jobs=1)
    again = sv.load(results.directory)
    assert_frame_equal(again.solutions, results.solutions)
    assert tables_of(again.study) == tables_of(load_study("smoke"))
    assert len(again.evaluations) > 300
    assert_frame_equal(
        again.solutions,
        pd.read_csv(results.directory / "solutions.csv"),
        check_dtype=False,
    )


@SLOW
def test_a_script_needs_no_main_guard(in_tmp: Path) -> None:
    write(
        "script.py",
        "import safevar_sumo as sv\nprint('begun')\nresults = sv.run(sv.load_study('smoke',"
        " search={'evaluations': 20}), 'out', jobs=2,"
        " progress=True)\nprint(len(sv.evaluate('smoke', results.solutions[['mass']], jobs=2)) =="
        " len(results.solutions))\n",
    )
    assert run_python("script.py").stdout.split() == ["begun", "True"]


@SLOW
def test_the_title_of_an_own_algorithm_stands_in_tables(in_tmp: Path) -> None:
    write(
        "mine.py",
        "class Mine:\n    title = 'My own search'\n\n    def search(self, problem, rng):\n"
        "        settings = problem.uniform(4, rng)\n"
        "        return (yield problem.characteristics.filter(settings))\n",
    )
    write(
        "mine.toml",
        'extends = "smoke"\n[search]\nalgorithms = ["mine:Mine"]\nruns = 1\nevaluations ='
        " 4\npopulation = 4\n",
    )
    results = sv.run("mine.toml", jobs=1)
    assert "My own search" in sv.tables(results).render("text", "rq1")
    for option, error in (
        ("table", "'rq9'.*\n.*rq3.1"),
        ("alpha", "expected: .* between 0 and 1"),
    ):
        with pytest.raises(sv.InputError, match=f"(?s)^{option}: .*{error}"):
            sv.tables(results, **{option: "rq9"})
    with pytest.raises(
        sv.InputError, match=r"^compare\(\): takes exactly source and other$"
    ):
        sv.compare("smoke")
