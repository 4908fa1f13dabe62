"""SUMO's own window on a virtual screen: both vehicles are in it, in their colours, each on its road."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.errors import InputError
from safevar_sumo.replay.comparison import compare_setting, moments
from safevar_sumo.replay.gui import show_in_gui
from safevar_sumo.sumo.system import assemble


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A virtual screen of its own; `SAFEVAR_BROWSER` says that one must be there."""
    if shutil.which("Xvfb") is None and not os.environ.get("SAFEVAR_BROWSER"):
        pytest.skip("Xvfb is not installed")
    reading, writing = os.pipe()
    server = subprocess.Popen(["Xvfb", "-displayfd", str(writing), "-screen", "0", "1280x800x24", "-nolisten", "tcp"],
                              pass_fds=[writing], stderr=subprocess.DEVNULL)
    os.close(writing)
    with os.fdopen(reading) as told:
        monkeypatch.setenv("DISPLAY", f":{told.readline().strip()}")
    yield
    server.terminate()
    server.wait()


def of_colour(picture: np.ndarray, red: int, green: int, blue: int) -> np.ndarray:
    """Rows and columns of pixels of about that colour, shape (M, 2)."""
    return np.argwhere(np.abs(picture.astype(int) - [red, green, blue]).max(axis=2) < 30)


@pytest.mark.usefixtures("screen")
def test_both_vehicles_are_in_the_window_at_the_nearest_moment(slippery: Path, tmp_path: Path) -> None:
    (case,) = load_cases([slippery])
    system = assemble(case.study)
    comparison = compare_setting(case.study, system, case.solutions[list(case.characteristics.names)].to_numpy()[0])
    show_in_gui(comparison, system.scenario.network, slower=0.01, rest=0.0, pictures=tmp_path)
    told = [moments(comparison.film.drives, row) for row in comparison.rows]
    assert {path.stem for path in tmp_path.iterdir()} == {f"{sample:04d}" for sample in (told[0].nearest, told[1].nearest, told[0].end)}
    with Image.open(tmp_path / f"{told[1].nearest:04d}.png") as image:
        picture = np.asarray(image.convert("RGB"))
    original, changed = of_colour(picture, 0x00, 0x72, 0xb2), of_colour(picture, 0xd5, 0x5e, 0x00)
    assert len(original) > 100
    assert len(changed) > 100
    assert original[:, 0].max() < changed[:, 0].min(), "the original's road is above"
    assert original[:, 1].max() < changed[:, 1].max(), "the original keeps its distance"
    assert len(of_colour(picture, 255, 51, 0)) > 20, "the changed vehicle's brake lights"


def test_without_a_display_it_is_refused(slippery: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (case,) = load_cases([slippery])
    system = assemble(case.study)
    comparison = compare_setting(case.study, system, case.characteristics.original)
    with pytest.raises(InputError, match="no display"):
        show_in_gui(comparison, system.scenario.network)
