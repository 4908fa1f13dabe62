"""Agreement with published data travels as totals: from `validate` to the file that ships, and from there beside the verdict."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.reference import Agreement, keep_totals, quoted, validation
from safevar_sumo.reference.validation import rank_correlation
from safevar_sumo.report.verdict import agreement
from safevar_sumo.study import load_study
from safevar_sumo.sumo import simulate
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.system import assemble

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
    monkeypatch.setattr(validation, "TOTALS", path)
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


PUBLISHED_EFFECTS = {"tireFric": 1.2, "mass": -0.8, "maxBrakeTorque": 0.6, "dampRateZeroT_CE": 0.4, "radius": 0.4, "max_rpm": 0.2,
                     "dampRateZeroT_CD": 0.2}
"""Linear effect on the safety degree over a whole domain in the published random search in sun [m]."""
NEAR = 0.05


@pytest.mark.parametrize(("study", "within"), [
    ("sun", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.05}),
    ("lgsvl", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.05}),
    ("rain", {"safety_degree": 0.40 / 2.2, "tet": 0.05, "tit": 0.15, "ave_dece": 0.05}),
])
def test_the_original_vehicle_is_as_near_to_the_published_one_as_is_said(study: str, within: dict[str, float]) -> None:
    """Rain's published vehicle is one simulation, 0.3 to 0.4 m above its own neighbours."""
    read = load_study(study)
    system = assemble(read)
    settings = system.characteristics.original[np.newaxis]
    here = score(system, settings, simulate(system, settings)).metrics
    for name, share in within.items():
        assert here[name][0] == pytest.approx(read.published[name], rel=share), name


@pytest.mark.parametrize(("study", "expected"), [("sun", 0.60), ("rain", 0.59)])
def test_vehicles_come_in_the_order_of_the_published_effects(study: str, expected: float) -> None:
    """Spearman's rho over 150 vehicles with the published linear effects, which know nothing of what saturates or comes together."""
    system = assemble(load_study(study))
    characteristics = system.characteristics
    width = characteristics.upper - characteristics.lower
    settings = np.random.default_rng(14).uniform(characteristics.lower, characteristics.upper, (150, len(width)))
    effects = np.array([PUBLISHED_EFFECTS.get(name, 0.0) for name in characteristics.names])
    here = score(system, settings, simulate(system, settings)).f_safe
    assert rank_correlation(((settings - characteristics.original) / width) @ effects, here) == pytest.approx(expected, abs=NEAR)
