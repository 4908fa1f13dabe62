"""Fixtures of questions: made-up studies, and a study of one test."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import batches
from safevar_sumo.campaign.batches import Batches
from safevar_sumo.questions import by_criterion, evaluator, part, worlds
from safevar_sumo.questions.repair import problem
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import write


@pytest.fixture
def made_up_studies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made-up studies have no vehicle model whose batches could be measured, and no vehicle has
    their characteristics: their failures are described as of the study smoke.
    """
    smoke = assemble(load_study("smoke"))

    def replace_for_made_up_studies(
        module: ModuleType, name: str, made_up: Any
    ) -> None:
        usual = getattr(module, name)

        def either(study: Study, *others: Any) -> Any:
            return made_up if study.name == "made-up" else usual(study, *others)

        monkeypatch.setattr(module, name, either)

    replace_for_made_up_studies(batches, "choose_batches", Batches(100, True, False))
    for module in (evaluator, by_criterion, worlds, part, problem):
        replace_for_made_up_studies(module, "assemble", smoke)
    for module in (evaluator, batches):
        replace_for_made_up_studies(module, "system_of", smoke)


AHEAD = """
extends = "wear"
name = "ahead"
title = "A pedestrian ahead on a wet road"
[[matrix.tests]]
name = "CPLA"
model = "along"
parameters = { vut_length = 4.7, vut_width = 1.85 }
over = { speed = [50, 60] }
"""


@pytest.fixture
def ahead(in_tmp: Path) -> Study:
    """A study of one test at two speeds."""
    write("ahead.toml", AHEAD)
    return load_study("ahead.toml")
