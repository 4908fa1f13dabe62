"""Agreement with published data travels as totals: from `validate` to the file that ships, and from there beside the verdict."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.reference import Agreement, keep_totals, published, quoted
from safevar_sumo.report.verdict import agreement
from safevar_sumo.study import load_study

MADE_UP = Agreement(
    rows=80, spearman={"safety_degree": 0.61234, "tet": None}, mean_absolute_error={"safety_degree": 0.25}, bias={},
    collisions={"reference": 40, "here": 20, "both": 10}, original={}, precision=0.5, recall=0.25, collision_speed={}, in_repeats={},
    undecided={}, by_predicted=[])


def page_of(study: Any) -> dict[str, Any]:
    material: Any = SimpleNamespace(case=SimpleNamespace(study=study))
    return agreement(material)


@pytest.fixture
def totals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only entry is made up: 10 of 40 published collisions collide here, which are half of the 20 here."""
    path = tmp_path / "totals.toml"
    keep_totals(path, load_study("rain"), "made_up.csv", MADE_UP)
    monkeypatch.setattr(published, "TOTALS", path)
    return path


@pytest.mark.usefixtures("totals")
def test_the_page_says_how_well_the_study_agrees() -> None:
    searched_otherwise = load_study("rain", title="Mine", search={"seed": 5, "evaluations": 100})
    told = page_of(searched_otherwise)
    for words in ("80 vehicles", "rank correlation of 0.61", "10 of the 40 published collisions", "recall 0.25", "precision 0.50"):
        assert words in told["sentence"]
    assert told["rows"] == [{"file": "made_up.csv", "vehicles": "80", "rho": "0.61", "error": "0.25", "reference": "40", "here": "20",
                             "both": "10", "recall": "0.25", "precision": "0.50"}]


@pytest.mark.usefixtures("totals")
def test_nobody_elses_agreement_is_claimed() -> None:
    """Another weather, or the same study with another parameter, simulates something else."""
    rain = load_study("rain")
    other = msgspec.structs.replace(rain, ads=msgspec.structs.replace(rain.ads, parameters={**rain.ads.parameters, "margin": 9.0}))
    for study in (load_study("sun"), other):
        assert quoted(study) == []
        assert "was not compared with published data" in page_of(study)["sentence"]


def test_an_entry_is_replaced_and_others_stay(totals: Path) -> None:
    keep_totals(totals, load_study("sun"), "made_up.csv", MADE_UP)
    keep_totals(totals, load_study("rain"), "made_up.csv", Agreement(**{**MADE_UP.to_dict(), "rows": 7}))
    assert [one.rows for one in (*quoted(load_study("rain")), *quoted(load_study("sun")))] == [7, 80]
    totals.write_text("[rain]\nrows = 3\n")
    with pytest.raises(InputError, match="holds no totals"):
        quoted(load_study("rain"))


def test_what_ships_is_what_the_trust_page_says() -> None:
    lines = (Path(__file__).parents[2] / "docs/trust.md").read_text()
    shown = re.findall(r"^\| \w+, [\w\- ]+ \| (\d+) \| (\d+) \| (\d+) \| [\d.]+ \| [\d.]+ \|", lines, re.MULTILINE)
    ships = [one for name in ("sun", "rain") for one in quoted(load_study(name))]
    assert len(shown) == 4
    assert set(shown) <= {(str(one.reference), str(one.here), str(one.both)) for one in ships}
