"""Made-up studies reach their pool only by name, since no vehicle model has their characteristics."""

from __future__ import annotations

from typing import Any

import pytest

from safevar_sumo.campaign import batches as many
from safevar_sumo.study import Study


@pytest.fixture(autouse=True)
def _made_up_studies_travel_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    pack = many.pack_study

    def pack_study(study: Study, *inputs: Any, **options: Any) -> bytes:
        return study.name.encode() if study.name == "made-up" else pack(study, *inputs, **options)

    read, batches = many.inputs_of, many.choose_batch_size
    monkeypatch.setattr(
        many,
        "choose_batch_size",
        lambda study, *selection: (100, False) if study.name == "made-up" else batches(study, *selection),
    )
    monkeypatch.setattr(many, "pack_study", pack_study)
    monkeypatch.setattr(many, "inputs_of", lambda study, pool: {} if study.name == "made-up" else read(study, pool))
