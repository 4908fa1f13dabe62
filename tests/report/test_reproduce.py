"""The commands of a report's last section make the study again, whatever it came from."""

from __future__ import annotations

import html
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner

import safevar_sumo
from safevar_sumo.cli.program import commands
from safevar_sumo.report import input as report_input, make_report
from safevar_sumo.report.page import commands_to_reproduce, read_inputs
from safevar_sumo.study import Study, load_study
from tests.in_process import searched


def first_command(study: Study) -> list[str]:
    one: Any = SimpleNamespace(
        directory=Path("its results"), point="", later_changes=(), case=SimpleNamespace(study=study, has_runs=True)
    )
    return shlex.split(commands_to_reproduce([one], ["questions"])[0][1])


@pytest.mark.parametrize("changes", [{"name": "pilot"}, {"step_length": 0.02}])
def test_a_study_is_carried_out_from_what_its_results_record(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    study = msgspec.structs.replace(load_study("smoke"), **changes)
    python, option, script = first_command(study)
    assert (python, option) == ("python", "-c")
    asked: dict[str, Any] = {}
    monkeypatch.setattr(safevar_sumo, "load", lambda place: SimpleNamespace(study=(place, study)))
    monkeypatch.setattr(safevar_sumo, "run", lambda study, **others: asked.update(study=study, **others))
    exec(script, {})
    assert asked["study"] == ("its results", study)
    assert asked["out"] == "its results-again"


@pytest.mark.slow
def test_every_printed_command_gives_the_numbers_of_the_page(
    slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the printed commands print stands on the page, word for word; the tables' numbers are those of `tables`."""
    monkeypatch.setattr(report_input, "SAMPLED_VEHICLES", 300)
    place = tmp_path / "results"
    shutil.copytree(slippery, place, ignore=shutil.ignore_patterns("answers"))
    page = make_report([place], paper=True, jobs=2)
    commands_of_page = [shlex.split(html.unescape(line)) for line in re.findall("<code>(python -m .*?)</code>", page)]
    printed = {typed[3]: typed[3:] for typed in commands_of_page}
    assert {"explain", "tolerance", "risk", "rules", "simulate", "tables", "figures"} <= set(printed)

    text = " ".join(
        html.unescape(re.sub("<(style|script).*?</(style|script)>|<[^>]*>", "", page, flags=re.DOTALL)).split()
    )
    for question in ("explain", "tolerance", "risk", "rules"):
        lines = [line for line in output_of(printed[question]).splitlines() if re.match(r"[A-Z0-9-].*[.]$", line)]
        said = [line for line in lines if " ".join(line.replace("^2", "²").replace("^3", "³").split()) in text]
        assert len(said) >= 2, (question, lines)
        if question in (
            "tolerance",
            "rules",
        ):  # the page says the other lines in other words, beside what they belong to
            assert said == lines


def output_of(typed: list[str]) -> str:
    done = CliRunner().invoke(commands, typed, env={"COLUMNS": "400"})
    assert done.exit_code == 0, done.output
    return done.stdout


DAY, RAIN = "crossing, clear", "crossing, hard_rain"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crossing in the clear, where less collides, and in hard_rain."""
    matrix = {"aggregate": "worst", "tests": [{"name": "crossing", "weathers": ["clear", "hard_rain"]}]}
    study = load_study(
        "smoke", matrix=matrix, search={"runs": 1, "population": 10, "evaluations": 40, "algorithms": ["rs"]}
    )
    return searched(study, tmp_path_factory.mktemp("matrix") / "results")


@pytest.mark.slow
def test_all_of_it_is_of_the_point(results: Path) -> None:
    (whole,), (there,) = read_inputs([results]), read_inputs([results], DAY)
    assert [point.name for point in whole.system.points] == [DAY, RAIN]
    assert [point.name for point in there.system.points] == [DAY]
    assert (there.case.solutions["f_safe"] >= whole.case.solutions["f_safe"]).all(), "elsewhere is the worst"
    assert (there.case.solutions["f_safe"] > whole.case.solutions["f_safe"]).any()
    page = make_report([results], ["tested", "verdict", "reproduce"], jobs=1, point=DAY)
    worst = there.case.solutions["f_safe"].min()
    assert (f"a collision at {-worst:.1f} m/s" if worst < 0 else f"; the worst stops {worst:.2f} m short") in page
    assert f"only at the point {DAY} of its matrix" in page
