"""The whole page about a study, for the tests of its text and those in a browser."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo.campaign import local
from safevar_sumo.questions.case import Case
from safevar_sumo.report import report
from tests.questions.conftest import Plant

ASK = (
    "tolerance --fits 0 --characteristics tireFric,mass",
    "explain --quick --top 3",
    "risk --samples 400",
    "rules --samples 400",
)


def page_of(
    *directories: Path,
    ask: Any = ("rules --samples 20",),
    jobs: int = 1,
    **options: Any,
) -> str:
    """The page that `report` writes, with one quick answer unless others are asked for."""
    with tempfile.TemporaryDirectory() as folder:
        return report(
            *directories, out=Path(folder, "page.html"), ask=ask, jobs=jobs, **options
        ).read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def page(slippery: Path, case: Case) -> str:
    """The whole page; of the domain it asks a formula: tyre frictions from 1 to 1.5 collide, of 1
    to 3.9.
    """
    friction = list(case.study.vehicle.characteristics).index("tireFric")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            local,
            "ProcessWorker",
            lambda _: Plant(case.study, lambda rows: rows[:, friction] < 1.5),
        )
        shows = []
        page = page_of(slippery, ask=ASK, progress=lambda *values: shows.append(values))
        assert shows[0][1] == 0
        assert shows[-1][0] == "replays"
        announced = shows[0][2]
        assert all(done <= total == announced for _, done, total in shows)
        assert shows[-1][1] == announced
        return page
