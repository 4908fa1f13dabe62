"""Rough answers: at once, and never more than they are."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

import safevar_sumo as sv
from safevar_sumo.questions import model_spread
from safevar_sumo.report.page import report
from tests.support.in_process import SLOW, InlinePool, rows_of, run


@SLOW
def test_a_rough_tolerance_calls_no_limit_kept() -> None:
    """It says what was tested, and ends with code 3: a gate must not pass by it."""
    asked = "tolerance smoke --quick --limits 'mass <= 2500' --unsafe collision --json"
    done = run(asked, expect=3)
    answer = json.loads(done.stdout)
    assert answer["verdict"].startswith("Rough answer (--quick")
    assert [answer["numbers"][name] for name in ("rough", "kept", "fits_tried")] == [
        True,
        None,
        1,
    ]
    assert {row["kept"] for row in rows_of(answer, "limits")} == {None}
    assert "confirms no limit" in done.stderr


WORN = {"one": {"brakeTorque": 0.7}, "two": {"brakeTorque": 0.9}}


@SLOW
def test_a_rough_list_says_its_price_and_drives_the_own_parameter_set_alone(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """No study with another parameter set is even made."""
    monkeypatch.setattr(
        model_spread, "with_values", lambda *_: pytest.fail("another set")
    )
    sv.permit("wear", cars=WORN, others="new", quick=True, pool=InlinePool())
    price = (
        r"about [\d,]+ simulations, about 0:\d\d:\d\d; cars that fail early take fewer"
    )
    assert re.fullmatch(price, capfd.readouterr().err.strip())


@SLOW
@pytest.mark.usefixtures("pools_in_this_process", "few_frames")
def test_a_rough_page_has_no_line_to_sign_and_no_other_parameter_set(
    slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even in its part about trust, and in questions that have no `--quick`."""
    monkeypatch.setattr(
        model_spread, "with_values", lambda *_: pytest.fail("another set")
    )
    page = report(slippery, out=tmp_path / "page.html", quick=True, jobs=1).read_text()
    assert "Do not use this sheet: its limits are rough" in page
    assert "Rough answer (--quick" in page
    assert 'class="signature"' not in page


@SLOW
def test_on_a_terminal_the_rough_answer_comes_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Elsewhere nothing is computed twice."""
    for is_terminal in (False, True):
        monkeypatch.setattr(
            sys.stderr, "isatty", lambda answer=is_terminal: answer, raising=False
        )
        answer = sv.explain("smoke", fits=0, progress=True, pool=InlinePool())
        assert answer.numbers["rough"] is False
        assert ("Rough answer (--quick" in capsys.readouterr().err) == is_terminal


def test_rough_means_the_same_everywhere() -> None:
    for command in ("tolerance", "repair", "explain", "report"):
        said = " ".join(run(f"{command} --help-all").stdout.split())
        assert "with at most an eighth of the usual simulations." in said
