"""Made-up studies have no vehicle model whose batches could be measured."""

from __future__ import annotations

import pytest

from safevar_sumo.campaign import questions
from safevar_sumo.campaign.evaluation import Selection
from safevar_sumo.study import Study


@pytest.fixture(autouse=True)
def _batches_of_made_up_studies(monkeypatch: pytest.MonkeyPatch) -> None:
    choose = questions.choose_batch_size

    def choose_batch_size(study: Study, selection: Selection) -> tuple[int, bool]:
        return (100, False) if study.name == "made-up" else choose(study, selection)

    monkeypatch.setattr(questions, "choose_batch_size", choose_batch_size)
