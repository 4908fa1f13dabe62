"""The whole page about a study, for the tests of its text and those in a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.campaign import local
from safevar_sumo.questions.case import Results
from tests.support.made_up_studies import Plant
from tests.support.report_pages import ASK, page_of


@pytest.fixture(scope="session")
def page(slippery: Path, case: Results) -> str:
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
