"""Made-up studies reach their pool only by name, since no vehicle model has their characteristics."""

from __future__ import annotations

import msgspec
import pytest

from safevar_sumo.analysis import evaluator
from safevar_sumo.campaign import batches, evaluation, identity
from safevar_sumo.study import Study


@pytest.fixture(autouse=True)
def _made_up_studies_travel_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def packed(task: evaluation.Task) -> bytes:
        return b"made-up" if task.study.name == "made-up" else msgspec.msgpack.encode(task)

    def choose_batch_size(study: Study, *selection: evaluation.Selection) -> tuple[int, bool]:
        return (100, False) if study.name == "made-up" else choose(study, *selection)

    choose, read = batches.choose_batch_size, identity.files_of
    monkeypatch.setattr(evaluation.Task, "packed", property(packed))
    monkeypatch.setattr(batches, "choose_batch_size", choose_batch_size)
    for module in (batches, evaluator):
        monkeypatch.setattr(module, "files_of", lambda study: {} if study.name == "made-up" else read(study))
