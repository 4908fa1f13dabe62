"""The whole page about a study, for the tests of its text and those in a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.campaign import local
from safevar_sumo.questions.case import Case
from safevar_sumo.report import input as report_input, report
from tests.questions.conftest import Plant


@pytest.fixture(scope="session")
def page(slippery: Path, case: Case) -> str:
    """The whole page; of the domain it asks a formula: tyre frictions from 1 to 1.5 collide, of 1 to 3.9."""
    friction = list(case.study.vehicle.characteristics).index("tireFric")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_input, "SAMPLES", {key: {"samples": 400} for key in ("risk", "rules")})
        patch.setattr(local, "ProcessWorker", lambda _: Plant(case.study, lambda rows: rows[:, friction] < 1.5))
        shows: list[tuple[str, int, int]] = []
        page = report(slippery, paper=True, jobs=1, progress=lambda *values: shows.append(values))
        assert shows[0][1] == 0
        assert shows[-1] == ("tables and figures", 0, 1)
        assert all(done <= total for _, done, total in shows)
        return page
