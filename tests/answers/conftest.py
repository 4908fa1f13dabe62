"""Made-up studies name no vehicle model that has their characteristics: they travel to their pool by name alone."""

from __future__ import annotations

import pytest

from safevar_sumo.computing import many


@pytest.fixture(autouse=True)
def _made_up_studies_travel_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    pack = many.packed
    monkeypatch.setattr(many, "packed", lambda study: study.name.encode() if study.name == "made-up" else pack(study))
