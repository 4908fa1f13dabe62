"""A report on one point of a matrix: all that it tells is of that point."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.report import make_report
from safevar_sumo.report.page import gather
from safevar_sumo.study import load_study
from tests.in_process import searched

DAY, RAIN = "crossing, clear", "crossing, hard_rain"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crossing in the clear, where less collides, and in hard_rain."""
    matrix = {"aggregate": "worst", "tests": [{"name": "crossing", "weathers": ["clear", "hard_rain"]}]}
    study = load_study("smoke", matrix=matrix, search={"runs": 1, "population": 10, "evaluations": 40, "algorithms": ["rs"]})
    return searched(study, tmp_path_factory.mktemp("matrix") / "results")


def test_all_of_it_is_of_the_point(results: Path) -> None:
    (whole,), (there,) = gather([results]), gather([results], DAY)
    assert [point.name for point in whole.system.points] == [DAY, RAIN]  # type: ignore[union-attr]
    assert [point.name for point in there.system.points] == [DAY]  # type: ignore[union-attr]
    assert (there.case.solutions["f_safe"] >= whole.case.solutions["f_safe"]).all(), "elsewhere is the worst"
    assert (there.case.solutions["f_safe"] > whole.case.solutions["f_safe"]).any()
    page = make_report([results], ["tested", "verdict", "reproduce"], jobs=1, point=DAY)
    worst = there.case.solutions["f_safe"].min()
    assert (f"hits at {-worst:.1f} m/s" if worst < 0 else f"with {worst:.2f} m to spare") in page
    assert f"at the point {DAY} of its matrix alone" in page


def test_its_commands_ask_about_the_point_and_a_wrong_one_is_refused(results: Path) -> None:
    page = make_report([results], ["reproduce"], jobs=1, point=DAY)
    assert all("simulate" not in command and "tables" not in command for command in re.findall("<code>(.*?)</code>", page))
    with pytest.raises(InputError, match="--point"):
        make_report([results], ["verdict"], jobs=1, point="crossing, snow")
    with pytest.raises(InputError, match="whole studies"):
        make_report([results], ["questions"], jobs=1, point=DAY)
