"""A whole study beside a published one: matched, cell beside cell, concluded by rule, and looked for in published rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.reference.conclusions import DIFFERS, DIRECTION, HOLDS, OPEN, conclusions, grade, paired, tables_beside
from safevar_sumo.reference.replication import nearness
from safevar_sumo.reference.rows import read_reference
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet

SUN = CharacteristicSet.of(load_study("sun").vehicle.characteristics)


def typed(*arguments: object) -> Result:
    return CliRunner().invoke(commands, [str(argument) for argument in arguments])


def rows(path: Path, changed: tuple[str, ...], safety: float, collisions: int, number: int = 40) -> Path:
    """Solutions that change the first of these characteristics always, the second in half of the cases, the third in a quarter ..."""
    settings = np.repeat(SUN.original[np.newaxis], number, axis=0)
    for place, name in enumerate(changed):
        i = SUN.names.index(name)
        settings[::2 ** place, i] = SUN.lower[i] + 0.01 * np.arange(0, number, 2 ** place) / number
    frame = pd.DataFrame(settings, columns=list(SUN.names))
    values = safety + 0.001 * np.arange(number)
    values[:collisions] = -1.0
    crash = values <= 0
    frame.assign(SaftyDegree=values, TET=np.where(crash, 0, 1.5), TIT=np.where(crash, 0, 0.7), Dece=5.0).to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def sides(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Imported results "one" and "other" of the study sun that agree in RS and differ in NSGA-II, and "rain"."""
    place = tmp_path_factory.mktemp("sides")
    rs = rows(place / "rs.csv", ("mass", "radius"), 2.0, 0)
    here = rows(place / "here.csv", ("mass", "tireFric", "radius", "max_rpm"), 1.0, 20)
    there = rows(place / "there.csv", ("maxBrakeTorque", "dragCoeff", "dampRate"), 1.5, 0)
    for name, study, nsga2 in (("one", "sun", here), ("same", "sun", here), ("other", "sun", there), ("rain", "rain", here),
                               ("wet", "rain", there)):
        assert typed("import", study, "--out", place / name, "--nsga2", nsga2, "--rs", rs).exit_code == 0
    return place


def told(sides: Path, here: str, there: str) -> dict[tuple[str, str], str]:
    tables = tables_beside(paired(load_cases([sides / here]), load_cases([sides / there])))
    return {(one.question, one.words.split(":")[0]): one.verdict for one in conclusions(tables)}


@pytest.mark.parametrize(("here", "published", "verdict"), [
    ((0.00, 1e-9), (0.42, 1e-9), DIRECTION),  # large here, small there: only the sign agrees
    ((0.05, 1e-9), (0.20, 1e-9), HOLDS),
    ((0.80, 1e-9), (0.20, 1e-9), DIFFERS),
    ((0.53, 0.3), (0.48, 0.4), HOLDS),  # negligible on both sides, wherever they lie
    ((0.53, 0.3), (0.60, 0.4), DIRECTION),
    ((0.40, 0.3), (0.60, 0.4), HOLDS),  # no difference on either side
    ((0.60, 1e-9), (0.60, 0.4), DIRECTION),
    ((0.40, 1e-9), (0.60, 0.4), DIFFERS)])
def test_a_test_holds_in_direction_magnitude_and_significance(
        here: tuple[float, float], published: tuple[float, float], verdict: str) -> None:
    assert grade(*here, *published) == verdict


def test_what_is_the_same_holds(sides: Path) -> None:
    verdicts = told(sides, "one", "same")
    assert set(verdicts.values()) <= {HOLDS, OPEN}
    assert {question for question, _ in verdicts} == {"RQ1", "RQ2", "RQ3.1", "RQ3.2", "RQ3.3", "collisions", "combinations"}


def test_what_differs_is_marked_by_the_rules(sides: Path) -> None:
    verdicts = told(sides, "one", "other")
    assert verdicts["RQ1", "RS, safety_degree"] == HOLDS
    assert verdicts["RQ1", "NSGA-II, safety_degree"] == HOLDS, "more unsafe than the original on both sides"
    assert verdicts["collisions", "NSGA-II"] == DIFFERS, "20 here, none there"
    assert verdicts["collisions", "RS"] == HOLDS, "none on either side"
    assert verdicts["RQ3.1", "most critical solutions change 1 characteristics"] == HOLDS
    assert verdicts["RQ3.2", "changed most often"] == DIFFERS
    assert verdicts["RQ3.3", "avgSD_cS"] == OPEN, "nothing collides there"
    assert verdicts["RQ3.3", "avgSD_mD"] in (HOLDS, DIRECTION)


def test_the_page_has_both_sides_and_says_what_is_missing(sides: Path) -> None:
    done = typed("replicate", sides / "one", sides / "rain", "--published", sides / "other", "--out", sides / "page.md",
                 "--reference", f"sun={sides / 'there.csv'}", f"sun={sides / 'rs.csv'}")
    assert done.exit_code == 0, done.output
    page = (sides / "page.md").read_text(encoding="utf-8")
    assert "rain: results here, none published given" in page
    assert "| sun | nsga2 | 0.5 / 0 |" in page.replace("40 / 40 | 20 / 0 | ", "")
    for heading in ("RQ1", "RQ2", "RQ3.1", "RQ3.2", "RQ3.3", "Collisions", "Four changed together", "One weather against another"):
        assert f"### {heading}" in page
    assert typed("replicate", sides / "one", "--published", sides / "other").output == typed(
        "replicate", "--published", sides / "other", "--reference", "--", sides / "one").output


def test_the_nearest_published_rows_are_told(sides: Path) -> None:
    """Solutions of `here.csv` looked for among themselves: the five nearest to each of 40 rows are those of its own kind."""
    case = load_cases([sides / "one"])[0]
    found = {one.algorithm: one for one in nearness(case, [read_reference(sides / "rs.csv", SUN)])}
    assert found["rs"].distance < 0.001
    assert found["rs"].safety_there == pytest.approx(found["rs"].safety_here, abs=0.01)
    assert found["nsga2"].collisions == 20
    assert found["nsga2"].also_collide == 0.0
    assert found["nsga2"].safety_there > 1.9


@pytest.mark.parametrize(("arguments", "problem"), [
    (("one", "--published", "rain"), "none of sun"),
    (("one", "same", "--published", "other"), "two results of the study"),
    (("one", "rain", "--published", "other", "wet", "--reference", "rs.csv"), "may belong to each of sun, rain"),
    (("one", "--published", "other", "--reference", "nonsense=rs.csv"), "belongs to none of"),
    (("one", "--published", "other", "--reference", "nowhere.csv"), "cannot be read"),
])
def test_what_cannot_be_held_against_each_other_is_refused(sides: Path, arguments: tuple[str, ...], problem: str,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(sides)
    done = typed("replicate", *arguments)
    assert problem in str(done.exception)
