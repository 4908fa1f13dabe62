"""ReplayOutputs: solutions of a results directory are simulated again with the same results, and seen from above."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from safevar_sumo.analysis.figures import save
from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.replay.comparison import Comparison, compare_setting, find_divergence, find_moments, list_differences
from safevar_sumo.replay.figure import draw_comparison
from safevar_sumo.replay.film import record_film
from safevar_sumo.replay.gui import show_in_gui
from safevar_sumo.results import handles_of
from safevar_sumo.study import load_study
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.matrix import simulate, study_at
from safevar_sumo.sumo.system import System, assemble


@pytest.fixture
def case(slippery: Path) -> Case:
    return load_cases([slippery])[0]


def simulated(*arguments: str) -> Result:
    return CliRunner().invoke(commands, ["simulate", *arguments])


@pytest.mark.slow
def test_the_command_replays_every_solution_of_solutions_csv(slippery: Path) -> None:
    frame = pd.read_csv(slippery / "solutions.csv")
    for handle, (_, row) in list(zip(handles_of(frame), frame.iterrows(), strict=True))[::4]:
        done = simulated(str(slippery), "--solution", str(handle), "--json")
        output = json.loads(done.stdout)
        assert done.stderr == ""
        assert output["solution"] == str(handle)
        assert output["outcome"] == row["outcome"]
        assert [output[name] for name in METRICS] == [None if np.isnan(row[name]) else row[name] for name in METRICS]


@pytest.mark.parametrize(
    ("flag", "column"), [("--most-severe", "f_safe"), ("--smallest", "f_diff"), ("--fewest", "f_num_diff")]
)
def test_the_most_severe_the_smallest_and_the_fewest(flag: str, column: str, slippery: Path) -> None:
    frame = pd.read_csv(slippery / "solutions.csv")
    output = json.loads(simulated(str(slippery), flag, "--json").stdout)
    assert output[column] == frame[frame["outcome"] == "collision"][column].min()


def test_a_replay_that_differs_from_its_row_is_reported(slippery: Path, case: Case) -> None:
    comparison = compare_setting(case.study, assemble(case.study), case.characteristics.original)
    result = list_differences(comparison.evaluations, {"safety_degree": 1.0, "tet": np.nan, "outcome": "collision"})
    rated = dataclasses.replace(
        comparison.evaluations, metrics={**comparison.evaluations.metrics, "rating_points": np.array([np.nan])}
    )
    assert list_differences(rated, {"rating_points": 3.0, "outcome": "stopped"}) == [], "a single cell has no points"
    assert [one.split(" was ")[0] for one in result] == ["the outcome", "safety_degree", "tet"]


@pytest.mark.parametrize(
    ("arguments", "legal"),
    [
        (["rain", "--fewest"], "a directory"),
        (["DIR", "--solution", "nsga2:0:99"], "N from 0 to"),
        (["DIR", "--solution", "x"], "ALGORITHM:RUN:N"),
        (["DIR", "--solution", "nsga2:0:0", "--fewest"], "one of them"),
        (["DIR", "--plot", "x.bmp"], ".png"),
    ],
)
def test_what_cannot_be_replayed_is_refused(arguments: list[str], legal: str, slippery: Path) -> None:
    done = simulated(*(str(slippery) if one == "DIR" else one for one in arguments))
    assert isinstance(done.exception, InputError)
    assert legal in str(done.exception)


@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
def test_a_film_shows_what_is_simulated(study: str) -> None:
    system = assemble(load_study(study))
    settings = np.stack([system.characteristics.original, system.characteristics.lower])
    result, plain = record_film(system, settings), simulate(system, settings)
    for name, values in score(system, settings, plain).metrics.items():
        assert np.array_equal(values, score(system, settings, result.runs).metrics[name], equal_nan=True)
    vut = result.tracks["vut"]
    assert np.array_equal(vut.x, result.runs.trace.position)
    assert vut.length == result.runs.trace.vehicle_length
    assert not np.isnan(vut.y).any()
    for row, end in enumerate(result.last_samples):
        assert result.runs.trace.active[end, row]
        assert not result.runs.trace.active[end + 1 :, row].any()


def test_a_film_of_the_crossing_has_its_pedestrian_and_its_crossing(sun: System) -> None:
    result = record_film(sun, sun.characteristics.original[np.newaxis])
    pedestrian = result.tracks["pedestrian"]
    assert pedestrian.is_person
    assert np.allclose(pedestrian.y[:, 0] - result.tracks["vut"].y[:, 0], result.runs.trace.lateral[:, 0])
    (crossing,) = [lane for lane in result.road if lane.kind == "crossing"]
    assert np.allclose(crossing.line[:, 0], pedestrian.x[0, 0], atol=0.01)
    assert {lane.kind for lane in result.road} == {"road", "path", "crossing", "area"}


def test_moments_of_a_drive(case: Case) -> None:
    comparison = compare_setting(
        case.study, assemble(case.study), case.solutions[list(case.characteristics.names)].to_numpy()[0]
    )
    runs = comparison.film.runs
    trace, original, hit = runs.trace, find_moments(runs, 0), find_moments(runs, 1)
    assert original.braking_start is not None
    assert trace.brake[original.braking_start, 0] > 0
    assert not trace.brake[trace.time < trace.time[original.braking_start], 0].any()
    assert trace.gap[original.nearest, 0] == comparison.evaluations.f_safe[0]
    assert hit.nearest == hit.end
    assert comparison.verdict(0) == f"stops with {comparison.evaluations.f_safe[0]:.2f} m to spare"
    assert comparison.verdict(1) == f"collides at {-comparison.evaluations.f_safe[1]:.1f} m/s"
    apart = find_divergence(runs)
    assert apart is not None
    assert abs(trace.speed[apart, 0] - trace.speed[apart, 1]) > 0.1
    assert np.all(np.abs(trace.speed[:apart, 0] - trace.speed[:apart, 1]) <= 0.1)


@pytest.fixture(scope="module")
def comparison(slippery: Path) -> Comparison:
    (case,) = load_cases([slippery])
    return compare_setting(
        case.study, assemble(case.study), case.solutions[list(case.characteristics.names)].to_numpy()[0]
    )


def test_the_figure_draws_both_drives_until_their_ends(comparison: Comparison) -> None:
    figure = draw_comparison(comparison)
    trace = comparison.film.runs.trace
    for axis, values in zip(figure.axes, (trace.speed, trace.gap, trace.throttle - trace.brake), strict=False):
        for row, line in zip(
            comparison.rows, axis.lines[:1] + [one for one in axis.lines[1:] if len(one.get_xdata()) > 9], strict=False
        ):
            end = comparison.film.last_samples[row] + 1
            assert list(line.get_xdata()) == list(trace.time[:end])
            assert list(line.get_ydata()) == list(values[:end, row])
    assert [axis.get_ylabel() for axis in figure.axes] == [
        "speed [m/s]",
        "gap to the obstacle [m]",
        "brake     |     throttle",
        "time to collision [s]",
    ]
    words = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert comparison.verdict(0) in words
    assert comparison.verdict(1) in words
    heading = figure.get_suptitle()
    for change in comparison.changes:
        assert change in heading


def test_the_words_of_the_figure_lie_within_their_axes_and_overlap_nothing(comparison: Comparison) -> None:
    figure = draw_comparison(comparison)
    figure.canvas.draw()
    for axis in figure.axes[:2]:
        words = [text.get_window_extent() for text in axis.texts if text.get_text()]
        assert words
        assert not any(one.overlaps(other) for one, other in combinations(words, 2))
        for box in words:
            assert axis.bbox.x0 < box.x0 < box.x1 < axis.bbox.x1
            assert axis.bbox.y0 < box.y0 < box.y1 < axis.bbox.y1
    impact = next(text for text in figure.axes[1].texts if text.get_text() == "impact").get_window_extent()
    assert impact.y1 < figure.axes[1].transData.transform((0, 0))[1], "below the ground, where no line is"


def test_the_figure_of_one_vehicle_has_no_line_or_entry_of_another() -> None:
    study = load_study("smoke")
    system = assemble(study)
    figure = draw_comparison(compare_setting(study, system, system.characteristics.original))
    assert not any("diverge" in text.get_text() for text in figure.legends[0].get_texts())
    figure.canvas.draw()
    for text in figure.axes[1].texts:
        assert text.get_bbox_patch().get_facecolor() == (1.0, 1.0, 1.0, 1.0), (
            "the ground's line does not strike the number through"
        )


@pytest.mark.parametrize("friction", [1.1, 1.9])
def test_the_larger_gap_has_its_number_above(friction: float) -> None:
    study = load_study("smoke")
    system = assemble(study)
    setting = system.characteristics.original.copy()
    setting[system.characteristics.names.index("tireFric")] = friction
    shown = compare_setting(study, system, setting)
    degrees = shown.evaluations.metrics["safety_degree"]
    assert (degrees[1] > degrees[0]) == (friction == 1.9), (
        "of the two one is safer than the original, or the test tells nothing"
    )
    heights = {text.get_text(): text.xyann[1] for text in draw_comparison(shown).axes[1].texts}
    assert heights[f"{degrees.max():.2f} m"] > 0 > heights[f"{degrees.min():.2f} m"]


def test_at_an_impact_the_pedals_are_those_that_were_in_force() -> None:
    """AEB releases the brake once there is no gap, which is after the collision."""
    study = study_at(load_study("euro_ncap_pedestrian"), "CPLA, speed 60, clear", "point")
    system = assemble(study)
    setting = system.characteristics.original.copy()
    for name, value in (("tireFric", 1.0), ("mass", 2600.0)):
        setting[system.characteristics.names.index(name)] = value
    shown, runs = compare_setting(study, system, setting), simulate(system, setting[np.newaxis])
    trace, end = shown.film.runs.trace, shown.film.last_samples[-1]
    assert shown.verdict(1).startswith("collides")
    assert runs.trace.brake[end, 0] == 0
    assert trace.brake[end, 1] == trace.brake[end - 1, 1] == runs.trace.brake[end - 1, 0] == 1
    assert shown.evaluations.metrics["safety_degree"][1] == -runs.collision_speed[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_same_bytes_twice(kind: str, comparison: Comparison, tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(draw_comparison(comparison), tmp_path / f"{name}.{kind}")
    assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A separate virtual screen; `SAFEVAR_BROWSER` demands that there is one."""
    if shutil.which("Xvfb") is None and not os.environ.get("SAFEVAR_BROWSER"):
        pytest.skip("Xvfb is not installed")
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1280x800x24", "-nolisten", "tcp"],
        pass_fds=[writing],
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    with os.fdopen(reading) as result:
        monkeypatch.setenv("DISPLAY", f":{result.readline().strip()}")
    yield
    server.terminate()
    server.wait()


def of_colour(picture: np.ndarray, red: int, green: int, blue: int) -> np.ndarray:
    """Rows and columns of pixels of about that colour, shape (M, 2)."""
    return np.argwhere(np.abs(picture.astype(int) - [red, green, blue]).max(axis=2) < 30)


@pytest.mark.slow
@pytest.mark.usefixtures("screen")
def test_both_vehicles_are_in_the_window_at_the_nearest_moment(slippery: Path, tmp_path: Path) -> None:
    (case,) = load_cases([slippery])
    comparison = compare_setting(
        case.study, assemble(case.study), case.solutions[list(case.characteristics.names)].to_numpy()[0]
    )
    show_in_gui(comparison, slower=0.01, rest=0.0, pictures=tmp_path)
    first, second = (find_moments(comparison.film.runs, row) for row in comparison.rows)
    assert {path.stem for path in tmp_path.iterdir()} == {
        f"{sample:04d}" for sample in (first.nearest, second.nearest, first.end)
    }
    with Image.open(tmp_path / f"{second.nearest:04d}.png") as image:
        picture = np.asarray(image.convert("RGB"))
    original, changed = of_colour(picture, 0x00, 0x72, 0xB2), of_colour(picture, 0xD5, 0x5E, 0x00)
    assert len(original) > 100
    assert len(changed) > 100
    assert original[:, 0].max() < changed[:, 0].min(), "the original's road is above"
    assert original[:, 1].max() < changed[:, 1].max(), "the original keeps its distance"
    assert len(of_colour(picture, 255, 51, 0)) > 20, "the changed vehicle's brake lights"


def test_without_a_display_it_is_refused(slippery: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (case,) = load_cases([slippery])
    comparison = compare_setting(case.study, assemble(case.study), case.characteristics.original)
    with pytest.raises(InputError, match="needs a display"):
        show_in_gui(comparison)


def test_a_verdict_names_the_comfort_that_the_study_optimises() -> None:
    study = load_study("comfort")
    system = assemble(study)
    comparison = compare_setting(
        study, system, system.characteristics.setting({"mass": 2105.0, "maxBrakeTorque": 1360.0}, "it")
    )
    for row in comparison.rows:
        jerk = comparison.evaluations.metrics["max_jerk"][row]
        assert comparison.verdict(row).endswith(f" m to spare, jerk {jerk:.1f} m/s^3")
