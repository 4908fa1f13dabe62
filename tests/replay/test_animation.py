"""Animations: actors are drawn at their positions to scale; files are small and reproducible, and text is escaped."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.errors import InputError
from safevar_sumo.replay.animation import PANEL_HEIGHT, WIDTH, animate, draw_scene, find_ffmpeg
from safevar_sumo.replay.comparison import COLOURS, Comparison, compare_setting
from safevar_sumo.replay.page import animation_page
from safevar_sumo.replay.scene import FlatScene, lay_out_scene
from safevar_sumo.sumo.system import assemble
from tests.in_process import refused


@pytest.fixture(scope="module")
def crash(slippery: Path) -> Comparison:
    (case,) = load_cases([slippery])
    return compare_setting(
        case.study, assemble(case.study), case.solutions[list(case.characteristics.names)].to_numpy()[0]
    )


def frame(scene: FlatScene, sample: int) -> np.ndarray:
    """The picture of a sample, shape (height, width, 3)."""
    figure, show = draw_scene(scene)
    show(sample)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3]


def where(picture: np.ndarray, colour: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of a colour, below the words."""
    pixels = picture.astype(int)[PANEL_HEIGHT:]
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return np.nonzero(np.abs(pixels - wanted).max(axis=2) < 26)


def test_both_vehicles_are_drawn_at_their_positions_to_scale(crash: Comparison) -> None:
    scene = lay_out_scene(crash)
    picture = frame(scene, 0)  # the changed vehicle stands on the original's place
    scale = WIDTH / scene.view.width
    rows, columns = where(picture, COLOURS[0])
    vut = next(body for body in scene.bodies if body.is_vut)
    assert columns.max() - columns.min() == pytest.approx(vut.length * scale, abs=4)
    assert rows.max() - rows.min() == pytest.approx(vut.width * scale, abs=4)
    end = frame(scene, scene.sample_count - 1)
    for row, body in enumerate(one for one in scene.bodies if one.is_vut):
        _, columns = where(end, COLOURS[row])
        assert columns.max() == pytest.approx((body.x[-1] - scene.view.left_ends[-1]) * scale, abs=4)


@pytest.mark.parametrize("angle", [37.0, 180.0, 271.0])
def test_a_road_in_any_direction_looks_the_same(angle: float, crash: Comparison) -> None:
    turn = np.deg2rad(angle)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])  # clockwise, as SUMO's headings

    def turned(track):  # type: ignore[no-untyped-def]
        x, y = rotation @ np.stack([track.x.ravel(), track.y.ravel()]) + [[100.0], [-7.0]]
        return track._replace(x=x.reshape(track.x.shape), y=y.reshape(track.y.shape), angle=track.angle + angle)

    film = dataclasses.replace(crash.film, tracks={name: turned(track) for name, track in crash.film.tracks.items()})
    straight, rotated = lay_out_scene(crash), lay_out_scene(dataclasses.replace(crash, film=film))
    for one, other in zip(straight.bodies, rotated.bodies, strict=True):
        assert np.allclose(one.x, other.x)
        assert np.allclose(one.y, other.y)
        assert np.allclose(np.cos(one.heading - other.heading), 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gif", "html", pytest.param("mp4", marks=pytest.mark.slow)])
def test_the_same_bytes_twice(kind: str, crash: Comparison, tmp_path: Path) -> None:
    for name in ("a", "b"):
        animate(crash, tmp_path / f"{name}.{kind}")
    assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    assert (tmp_path / f"a.{kind}").stat().st_size < 1_000_000
    if kind == "gif":
        with Image.open(tmp_path / "a.gif") as image:
            durations = []
            for frame in range(image.n_frames):
                image.seek(frame)
                durations.append(image.info["duration"])
        seconds = lay_out_scene(crash).sample_count * crash.film.runs.trace.step
        assert sum(durations[:-1]) / 1000 == pytest.approx(seconds, abs=0.3), "it lasts as long as the drive"
    if kind == "mp4":
        assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"


def test_the_page_holds_every_place_to_the_centimetre(crash: Comparison) -> None:
    page, scene = animation_page(lay_out_scene(crash)), lay_out_scene(crash)
    script = re.search(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)
    data = json.loads(script[1])  # type: ignore[index]
    assert data["step"] == scene.step
    vuts = [body for body in data["bodies"] if body["drive"] is not None]
    for shown, body in zip(vuts, [one for one in scene.bodies if one.is_vut], strict=True):
        assert np.allclose(shown["x"], body.x, atol=0.0051)
    assert [drive["end"] for drive in data["drives"]] == crash.film.last_samples.tolist()


def test_text_of_a_study_stays_text(crash: Comparison) -> None:
    page = animation_page(lay_out_scene(dataclasses.replace(crash, title="<script>alert(1)</script></title>")))
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "http" not in page.replace("http-equiv", ""), "nothing is fetched from elsewhere"


def test_without_ffmpeg_a_film_is_refused_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match="ffmpeg"):
        find_ffmpeg()
    refused("simulate", "sun", "--animate", str(tmp_path / "it.mp4"), message=("--animate", "ffmpeg"))
