"""Reports of results about which there is less to tell: the study cannot be simulated here, or its original vehicle collides."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.evaluator import silent
from safevar_sumo.analysis.rules.compute import Rule
from safevar_sumo.report import findings, limits, make_report
from safevar_sumo.report import verdict as what
from safevar_sumo.report.limits import LIMITS, _percent
from safevar_sumo.report.page import PARTS, gather
from safevar_sumo.results.manifest import write_manifest
from safevar_sumo.scenarios import Point


def test_a_study_that_cannot_be_simulated_has_its_page(slippery: Path, tmp_path: Path) -> None:
    """Its network's folder is gone since."""
    shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    manifest = json.loads((slippery / "manifest.json").read_text())
    manifest["study"]["scenario"]["parameters"] = {"network": "/nowhere/gone"}
    write_manifest(tmp_path / "copy", manifest)
    page = make_report([tmp_path / "copy"], only=["tested", "verdict", *PARTS, "trust", "reproduce"], jobs=1)
    told = re.findall(r"slippery: What this study is about cannot be simulated here: .*gone", page)
    assert len(told) == 1 + len(LIMITS), "each section that would take simulations says so"
    assert '<details class="replay"' in page


def test_of_an_original_that_collides_no_change_is_called_the_cause(
        slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    manifest = json.loads((slippery / "manifest.json").read_text())
    manifest["original"] |= {"outcome": "collision", "collision": True, "collision_speed": 3.9, "safety_degree": -3.9, "f_safe": -3.9}
    write_manifest(tmp_path / "copy", manifest)
    empty = {"changes": {}, "boundary": {}, "fraction": 0.0, "end": "safe", "outcome": "collision", "safety_degree": -3.9}
    failure = {"algorithm": "nsga2", "run": 0, "index": 0, "minimal_causes": [empty], "robustness": 1.0, "because": "it collides anyhow"}
    monkeypatch.setattr(findings, "explain", lambda *_, **__: SimpleNamespace(to_dict=lambda: [failure]))
    page = make_report([tmp_path / "copy"], only=["verdict", "causes"], jobs=1)
    assert "No change is needed: the original vehicle itself collides." in page
    assert "No change is a cause" in page
    assert "Cause 1" not in page


def test_what_comes_from_outside_is_called_by_its_name_once(slippery: Path) -> None:
    (material,) = gather([slippery])
    scenario = SimpleNamespace()
    study = replace(material.case.study, ads=replace(material.case.study.ads, model="my_controller:Pilot"))
    points = [Point(scenario, material.case.weather)]  # type: ignore[arg-type]
    others: Any = SimpleNamespace(case=dataclasses.replace(material.case, study=study), manifest=material.manifest, lacking="", point="",
                                  system=SimpleNamespace(points=points, matrix=(), vehicle=None))
    told = what.tested(others)
    assert "Driving system: my_controller:Pilot. Scenario: pedestrian_crossing (" in told["who"]
    assert "NSGA-II (1 run)" in told["how"]
    assert not told["tags"]


def test_an_estimate_just_below_nothing_is_nothing() -> None:
    assert [_percent(share) for share in (-0.002, 0.0, 0.126)] == ["0%", "0%", "13%"]


def test_a_rule_that_may_be_chance_is_no_finding(slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 6 vehicles inside 1 is unsafe, as of all; of 300 inside 290."""
    (material,) = gather([shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))])
    chance = Rule({"tireFric": (None, 1.01)}, 6, 1, 290, 0.95)
    sure = Rule({"tireFric": (None, 1.2)}, 300, 290, 290, 0.95)
    everywhere = Rule({}, 300, 300, 300, 0.95)
    told = SimpleNamespace(rules=[sure, chance, everywhere], samples=4000, unsafe_share=0.15, remark="", unsafe=Unsafe())
    monkeypatch.setattr(limits, "find_rules", lambda *_, **__: told)
    found = LIMITS["rules"](material, 1, silent)
    assert [words.partition(":")[0] for words in found["words"]] == ["tireFric below 1.2", "everywhere"]
    assert found["remark"].startswith("Left out: 1 rule that so few vehicles do not tell from chance")
