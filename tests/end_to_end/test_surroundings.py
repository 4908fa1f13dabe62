"""What a user's surroundings state, such as a file matplotlibrc or a locale, changes no answer."""

from __future__ import annotations

import locale
import os
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest

from safevar_sumo import draw_comparison, simulate
from safevar_sumo.questions.figures import new_figure, own_style, save
from safevar_sumo.records import csv_text
from safevar_sumo.replay.comparison import comparison_of
from safevar_sumo.sumo.engine import _numbers_with_points
from tests.support.in_process import run_python

DRAW = """
from pathlib import Path
from safevar_sumo.questions.figures import new_figure, own_style, save
with own_style():
    figure, axes = new_figure("A title", 1, 1, (3, 2))
    axes[0, 0].plot([1, 2])
save(figure, Path("drawn.png"))
"""


def test_a_matplotlibrc_and_a_backend_change_no_picture(in_tmp: Path) -> None:
    exec(DRAW, {})
    expected = Path("drawn.png").read_bytes()
    Path("matplotlibrc").write_text("text.usetex: True\nfont.size: 40\n")
    environment = {**os.environ, "MPLBACKEND": "nonsense"}
    run_python("-c", DRAW, env=environment)
    assert Path("drawn.png").read_bytes() == expected


def test_settings_of_matplotlib_stay_the_users(in_tmp: Path) -> None:
    comparison = comparison_of(simulate("smoke"))
    save(draw_comparison(comparison), Path("default.png"))
    with matplotlib.rc_context({"font.size": 40, "axes.facecolor": "red"}):
        save(draw_comparison(comparison), Path("users.png"))
        with own_style():
            new_figure("", 1, 1, (3, 2))
            assert matplotlib.rcParams["font.size"] == 10
        assert matplotlib.rcParams["font.size"] == 40
    assert Path("users.png").read_bytes() == Path("default.png").read_bytes()


def test_sumo_reads_numbers_with_points_and_the_locale_stays_the_users() -> None:
    before = locale.setlocale(locale.LC_NUMERIC)
    try:
        locale.setlocale(locale.LC_NUMERIC, "de_DE.UTF-8")
    except locale.Error:
        pytest.skip("the locale de_DE.UTF-8 is not installed")
    try:
        with _numbers_with_points():
            assert locale.localeconv()["decimal_point"] == "."
        assert locale.localeconv()["decimal_point"] == ","
        assert simulate("smoke").outcome == "stopped"
    finally:
        locale.setlocale(locale.LC_NUMERIC, before)


def test_numbers_have_all_their_digits_in_csv_however_user_code_prints_numbers() -> (
    None
):
    frame = pd.DataFrame({"a": [0.1 + 0.2, 1 / 3], "b": ["x", "y"]})
    expected = "a,b\n0.30000000000000004,x\n0.3333333333333333,y\n"
    assert csv_text(frame) == expected
    with np.printoptions(legacy="1.13", precision=1):
        assert csv_text(frame) == expected
