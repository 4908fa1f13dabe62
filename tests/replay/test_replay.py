"""Solutions of a results directory are simulated again with the same results, seen from above, and
animated.
"""

from __future__ import annotations

import os
import re
import subprocess
from base64 import b64decode
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, ImageSequence

from safevar_sumo.api.simulation import simulate
from safevar_sumo.questions.case import Results
from safevar_sumo.replay import animation, gui
from safevar_sumo.replay.animation import (
    FRAME_DPI,
    IMPACT_COLOUR,
    PANEL_HEIGHT,
    animate,
    draw_scene,
    lay_out,
    player_of,
)
from safevar_sumo.replay.comparison import (
    COLOURS,
    Comparison,
    comparison_of,
    list_differences,
)
from safevar_sumo.replay.figure import draw_comparison, find_divergence
from safevar_sumo.replay.gui import show_in_gui
from tests.support.in_process import SLOW
from tests.support.needs import need_program


def test_a_replay_that_differs_from_its_row_is_reported(case: Results) -> None:
    comparison = comparison_of(simulate(case.study))
    result = list_differences(
        comparison.evaluations,
        {"safety_degree": 1.0, "tet": np.nan, "outcome": "collision"},
    )
    assert [one.split(" was ")[0] for one in result] == [
        "the outcome",
        "safety_degree",
        "tet",
    ]


@pytest.fixture(scope="module")
def comparison(case: Results) -> Comparison:
    settings = case.solutions[list(case.characteristics.names)]
    return comparison_of(simulate(case.study, settings.iloc[0]))


def test_moments_of_a_drive(comparison: Comparison) -> None:
    runs = comparison.runs
    trace, (original, hit) = runs.trace, comparison.moments
    assert original.braking_start is not None
    assert trace.brake[original.braking_start, 0] > 0
    assert not trace.brake[trace.time < trace.time[original.braking_start], 0].any()
    assert trace.gap[original.nearest, 0] == comparison.evaluations.f_safe[0]
    assert hit.nearest == hit.end
    assert (
        comparison.verdict(0)
        == f"stops with {comparison.evaluations.f_safe[0]:.2f} m to spare"
    )
    assert (
        comparison.verdict(1)
        == f"collides at {-comparison.evaluations.f_safe[1]:.1f} m/s"
    )
    apart = trace.time.tolist().index(find_divergence(runs))
    assert abs(trace.speed[apart, 0] - trace.speed[apart, 1]) > 0.1
    assert np.all(np.abs(trace.speed[:apart, 0] - trace.speed[:apart, 1]) <= 0.1)


def test_the_figure_draws_both_drives_until_their_ends(comparison: Comparison) -> None:
    figure = draw_comparison(comparison)
    trace = comparison.runs.trace
    for axis, values in zip(
        figure.axes,
        (trace.speed, trace.gap, trace.throttle - trace.brake),
        strict=False,
    ):
        drives = [
            line.get_xydata().tolist()
            for line in axis.lines
            if len(line.get_xdata()) > 9
        ]
        for row in comparison.rows:
            end = comparison.moments[row].end + 1
            assert (
                np.column_stack([trace.time, values[:, row]])[:end].tolist() in drives
            )
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert all(any(comparison.verdict(row) in text for text in words) for row in (0, 1))
    assert all(change in figure.get_suptitle() for change in comparison.changes)


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A separate virtual screen."""
    program = need_program("Xvfb")
    reading, writing = os.pipe()
    server = subprocess.Popen(
        [
            program,
            "-displayfd",
            str(writing),
            "-screen",
            "0",
            "1280x800x24",
            "-nolisten",
            "tcp",
        ],
        pass_fds=[writing],
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    with os.fdopen(reading) as result:
        monkeypatch.setenv("DISPLAY", f":{result.readline().strip()}")
    yield
    server.terminate()
    server.wait()


def of_colour(picture: np.ndarray, colour: str) -> np.ndarray:
    """Rows and columns of pixels of about that colour, #RRGGBB, shape (2, M)."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return np.array(np.nonzero(np.abs(picture.astype(int) - wanted).max(axis=2) < 26))


@SLOW
@pytest.mark.usefixtures("screen")
def test_both_vehicles_are_in_the_window_at_the_nearest_moment(
    comparison: Comparison, tmp_path: Path
) -> None:
    show_in_gui(comparison, tmp_path)
    first, second = comparison.moments
    assert {path.stem for path in tmp_path.iterdir()} == {
        f"{sample:04d}" for sample in (first.nearest, second.nearest, first.end)
    }
    with Image.open(tmp_path / f"{second.nearest:04d}.png") as image:
        picture = np.asarray(image.convert("RGB"))
    original, changed = (of_colour(picture, colour) for colour in COLOURS.values())
    assert min(original.shape[1], changed.shape[1]) > 100
    assert np.ptp([original[0].min(), changed[0].min()]) <= 2, "one upon the other"
    assert original[1].max() < changed[1].max(), "the original keeps its distance"
    assert of_colour(picture, "#ff3300").shape[1] > 20, (
        "the changed vehicle's brake lights"
    )


def test_the_window_plays_from_the_moment_that_it_is_there(
    comparison: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long it takes to open."""
    now = 0.0
    waits = []

    def sleep(seconds: float) -> None:
        nonlocal now
        waits.append(seconds)
        now += seconds

    def drive_again(
        system: object,
        settings: object,
        runs: object,
        watch: Callable[[Any], None],
        start: object,
    ) -> None:
        nonlocal now
        now += 5.0
        for _ in range(3):
            watch(MagicMock(vehicle_positions=lambda name: np.zeros((2, 2))))

    monkeypatch.setattr(gui, "drive_again", drive_again)
    monkeypatch.setattr(
        gui, "time", SimpleNamespace(monotonic=lambda: now, sleep=sleep)
    )
    show_in_gui(comparison)
    assert waits == pytest.approx([comparison.runs.trace.step] * 3)


def frame(comparison: Comparison, sample: int) -> tuple[np.ndarray, float, float]:
    """The picture of a sample below the words, shape (height, width, 3), its left end [m], and
    pixels per metre.
    """
    figure, show = draw_scene(comparison)
    show(sample)
    figure.set_dpi(FRAME_DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[int(PANEL_HEIGHT * FRAME_DPI) :, :, :3]
    left, right = figure.axes[0].get_xlim()
    return picture, left, picture.shape[1] / (right - left)


def test_both_vehicles_are_drawn_at_their_positions_to_scale(
    comparison: Comparison,
) -> None:
    # The changed vehicle stands on the original's place.
    picture, left, scale = frame(comparison, 0)
    vuts = [body for body in lay_out(comparison)[0] if body.is_vut]
    rows, columns = of_colour(picture, COLOURS[0])
    assert np.ptp(columns) == pytest.approx(vuts[0].length * scale, abs=4)
    assert np.ptp(rows) == pytest.approx(vuts[0].width * scale, abs=4)
    picture, left, scale = frame(comparison, len(vuts[0].x) - 1)
    for row, body in enumerate(vuts):
        _, columns = of_colour(picture, COLOURS[row])
        assert columns.max() == pytest.approx((body.x[-1] - left) * scale, abs=4)


def test_an_impact_is_marked_from_its_moment_on_at_the_bumper_of_the_vehicle_that_collides(
    comparison: Comparison,
) -> None:
    changed = [body for body in lay_out(comparison)[0] if body.is_vut][1]
    impact = comparison.moments[1].decided
    assert of_colour(frame(comparison, impact - 1)[0], IMPACT_COLOUR).size == 0
    for sample in (impact, len(changed.x) - 1):
        picture, left, scale = frame(comparison, sample)
        marked = of_colour(picture, IMPACT_COLOUR)[1]
        front = (changed.x[sample] - left) * scale
        assert marked.min() <= front + 4
        assert marked.max() == pytest.approx(front, abs=1.2 * scale)


@SLOW
def test_a_gif_lasts_as_long_as_the_drive_and_has_the_same_bytes_twice(
    comparison: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of few frames."""
    monkeypatch.setattr(animation, "SECONDS_PER_FRAME", 0.25)
    first = tmp_path / "a.gif"
    again = tmp_path / "b.gif"
    for path in (first, again):
        animate(comparison, path)
    assert first.read_bytes() == again.read_bytes()
    assert first.stat().st_size < 1_000_000
    last = max(moments.end for moments in comparison.moments)
    seconds = last * comparison.runs.trace.step
    with Image.open(first) as image:
        durations = [one.info["duration"] for one in ImageSequence.Iterator(image)]
    assert durations[0] == 250
    assert sum(durations) == pytest.approx(1000 * (seconds + 2), abs=500)


def test_a_player_needs_nothing_else_and_has_its_own_names(
    comparison: Comparison,
) -> None:
    first, again, other = (player_of(comparison, number, 3, 20) for number in (1, 1, 2))
    assert first == again
    assert "http" not in first
    names = [set(re.findall(r'id="(\w+)"', player)) for player in (first, other)]
    assert not set.intersection(*names)
    pictures = re.findall('"data:image/png;base64,([^"]*)"', first)
    sizes = {Image.open(BytesIO(b64decode(picture))).size for picture in pictures}
    assert len(sizes) == 1
    assert len(pictures) == pytest.approx(5, abs=1), "of which one is a still"
    assert pictures[0] == pictures[-1]
    assert f"changed {comparison.verdict(1)}" in first
