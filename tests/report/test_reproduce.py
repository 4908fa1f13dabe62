"""The commands of a report's last section make the study again, whatever it came from."""

from __future__ import annotations

import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

import safevar_sumo
from safevar_sumo.cli import study as command
from safevar_sumo.report.trust import reproduce
from safevar_sumo.study import Study, load_study


def first_command(study: Study) -> list[str]:
    material: Any = SimpleNamespace(place=Path("its results"), point="", changed=(), case=SimpleNamespace(study=study, has_runs=True))
    return shlex.split(reproduce([material], [])[0]["command"])


def test_of_a_shipped_study_the_command_asks_for_the_same() -> None:
    study = load_study("smoke", search={"seed": 7, "runs": 2, "algorithms": ["nsga2", "rs"]})
    python, _, package, *asked = first_command(study)
    assert (python, package, asked[0]) == ("python", "safevar_sumo", "study")
    given = command.study.make_context("study", asked[1:]).params
    options = {name: given[name] for name in ("algorithms", "seed", "runs", "evaluations")}
    assert command._with_options(load_study(given["study"]), **options) == study


@pytest.mark.parametrize("changes", [{"name": "pilot"}, {"step_length": 0.02}])
def test_any_other_study_is_carried_out_from_what_its_results_record(
        changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    study = msgspec.structs.replace(load_study("smoke"), **changes)
    python, option, script = first_command(study)
    assert (python, option) == ("python", "-c")
    asked: dict[str, Any] = {}
    monkeypatch.setattr(safevar_sumo, "load", lambda place: SimpleNamespace(study=(place, study)))
    monkeypatch.setattr(safevar_sumo, "run", lambda study, **others: asked.update(study=study, **others))
    exec(script, {})
    assert asked["study"] == ("its results", study)
    assert asked["out"] == "its results-again"
