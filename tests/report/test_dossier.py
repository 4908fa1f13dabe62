"""The dossier: validation measures against closed forms, the user's thresholds, and the command of every number."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.analysis.tolerance import scans
from safevar_sumo.records import JsonObject
from safevar_sumo.report.dossier import FIRST_SENTENCE, MEASURES, _Dossier, value_at
from safevar_sumo.report.measurements import check_study, count_constants, measure_validation
from safevar_sumo.report.pack import read_pack
from safevar_sumo.results import handles_of, read_manifest
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble
from tests.in_process import InlinePool, json_of, run

HERE, THERE = np.array([2.0, 4.0, 6.0, 9.0]), np.array([1.0, 4.0, 8.0, 8.0])
"""Errors 1, 0, -2, 1; means 5.25 and 5.25."""


def test_measures_of_a_case_computed_by_hand() -> None:
    measures = measure_validation(HERE, THERE)
    squares, product = (4 + 16 + 36 + 81, 1 + 16 + 64 + 64), 2 + 16 + 48 + 72
    magnitude = math.sqrt(squares[0] / squares[1]) - 1
    phase = math.acos(product / math.sqrt(squares[0] * squares[1])) / math.pi
    covariance = (-3.25 * -4.25) + (-1.25 * -1.25) + (0.75 * 2.75) + (3.75 * 2.75)
    spread = (3.25**2 + 1.25**2 + 0.75**2 + 3.75**2, 4.25**2 + 1.25**2 + 2.75**2 + 2.75**2)
    expected = {
        "relative_error": 1.0 / 5.25,
        "mean_absolute_error": 1.0,
        "rmse": math.sqrt(6 / 4),
        "largest_error": 2.0,
        "sprague_geers_magnitude": magnitude,
        "sprague_geers_phase": phase,
        "sprague_geers": math.hypot(magnitude, phase),
        "pearson": covariance / math.sqrt(spread[0] * spread[1]),
        "t_test": 1.0,  # the errors' mean is 0
        "anova": 1.0,  # equal means
        "kolmogorov_smirnov": 0.25,  # at 1 and from 6 to 8
        "spearman": 0.9486832980505138,  # ranks 1 2 3 4 and 1 2 3.5 3.5: 4.5 / sqrt(5 * 4.5)
    }
    assert {name: measures[name] for name in expected} == pytest.approx(expected)


def test_tests_of_means_have_their_closed_forms() -> None:
    here, there = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0])
    measures = measure_validation(here, there)
    # errors -1, -2, -3: t = -2 / (1 / sqrt 3) with 2 degrees of freedom, whose distribution has a closed form
    t = 2 * math.sqrt(3)
    assert measures["t_test"] == pytest.approx(1 - t / math.sqrt(2 + t * t))
    # between 2 * 3 * 1, within 2 + 8: F = 6 / 2.5 = t^2 with 4 degrees of freedom
    t = math.sqrt(2.4)
    x = t / math.sqrt(4 + t * t)
    assert measures["anova"] == pytest.approx(1 - x * (3 - x * x) / 2)
    assert measures["kolmogorov_smirnov"] == pytest.approx(2 / 3)
    doubled = measure_validation(2 * there, there)
    assert doubled["sprague_geers_magnitude"] == pytest.approx(1.0)
    assert doubled["sprague_geers_phase"] == pytest.approx(0.0, abs=1e-7)
    assert measure_validation(there, there)["rmse"] == 0


def test_undefined_measures_are_none() -> None:
    measures = measure_validation(np.zeros(3), np.zeros(3))
    assert measures["relative_error"] is measures["pearson"] is measures["t_test"] is None
    assert measures["sprague_geers"] is None


def test_thresholds_have_the_names_of_measures() -> None:
    study = load_study("smoke", evidence={"threshold": dict.fromkeys(MEASURES, 0.5)})
    assert set(study.evidence.threshold) == set(MEASURES)


def test_a_threshold_is_kept_up_to_its_value_and_by_no_undefined_measure() -> None:
    study = load_study("smoke", evidence={"threshold": {"rmse": 0.5, "pearson": 0.5}})
    dossier = _Dossier(study, {}, [], [], 0)
    for name, side, kept, other in (("rmse", "at most", 0.5, 0.6), ("pearson", "at least", 0.5, 0.4)):
        said = [dossier._beside_threshold(name, value, side) for value in (kept, other, None)]
        assert [text.endswith(f"user: {side} 0.5, which it keeps.") for text in said] == [True, False, False]


def test_constants_are_counted_by_origin() -> None:
    rain = load_study("rain")
    counts = count_constants(rain)
    assert counts["published"] == 3 * 12 + len(rain.published) + len(rain.repeatability)
    assert counts["fitted"] == len(rain.spread) > 5
    assert count_constants(load_study("native"))["fitted"] == 0


def test_the_original_vehicle_is_simulated_with_half_and_with_double_the_time_step() -> None:
    system = assemble(load_study("native"))
    setting = system.characteristics.original[np.newaxis]
    checks = check_study(load_study("native"), setting, InlinePool())
    for name, step in (("half_step", 0.05), ("double_step", 0.2)):
        expected = evaluate(assemble(load_study("native", step_length=step)), setting).f_safe[0]
        assert checks[name]["original"] == expected != checks["original"]["safety_degree"]


def test_tolerances_of_a_study_with_limits_are_stated_too() -> None:
    alone = {"characteristic": "decel", "unit": "m/s^2", "safe": [4.80012, 9.49999]}
    record = {"driven": False, "alone": [alone], "samples": 1228, "failures": 0, "at_most": 0.003}
    stated = []
    for answer in (record, {**record, "samples": None}):
        sources = {"status": ("", {"simulated": 9}), "tolerance": ("", answer)}
        made = _Dossier(load_study("native"), sources, ["tolerance"], [], 29)
        statements = [one for one in made.results() if one.numbers and "simulated" not in one.numbers]
        assert all(value_at(answer, path) == value for one in statements for path, value in one.numbers.items())
        points = [one.text for one in made.open_points()]
        assert any("the original vehicle never reaches" in one for one in points)
        assert "The search is not finished: 29 of 30 runs." in points
        stated.append([one.text for one in statements])
    assert stated[1][0].endswith("from 4.801 to 9.499 m/s^2."), "rounded to the safe side"
    assert len(stated[1]) == 1
    assert stated[0] == [*stated[1], "All together: 0 of 1228 settings unsafe, at most 0.30% of all."]


Packed = tuple[JsonObject, Path, str]


@pytest.fixture(scope="module", autouse=True)
def _coarse_scans() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scans, "SCAN_VALUES", 21)
        yield


@pytest.fixture(scope="module")
def packed(slippery: Path, tmp_path_factory: pytest.TempPathFactory) -> Packed:
    """A dossier with all sections, the working directory of its commands, and its page."""
    folder = tmp_path_factory.mktemp("dossier")
    shutil.copytree(slippery, folder / "results" / "slippery")
    frame = pd.read_csv(slippery / "solutions.csv").head(12)
    manifest = read_manifest(slippery)
    names = list(manifest["study"]["vehicle"]["characteristics"])
    rows = frame[names].assign(SaftyDegree=frame["safety_degree"] * 1.1, TET=0.5, TIT=0.1, Dece=3.0)
    rows.to_csv(folder / "rows.csv", index=False)
    manifest["study"]["evidence"] = {"threshold": {"rmse": 100.0, "pearson": 1.1}}
    (folder / "results" / "slippery" / "manifest.json").write_text(json.dumps(manifest))
    pack = folder / "pack.zip"
    flags = ("--explain", "--tolerance", "--risk", "--reference", str(folder / "rows.csv"))
    run("evidence", str(folder / "results" / "slippery"), "--out", str(pack), *flags)
    _, files = read_pack(pack)
    return json.loads(files["1-slippery/dossier.json"]), folder, files["1-slippery/dossier.html"].decode()


@pytest.mark.slow
def test_every_number_is_made_by_its_command(packed: Packed, monkeypatch: pytest.MonkeyPatch) -> None:
    dossier, folder, _ = packed
    monkeypatch.chdir(folder)
    assert dossier["first"] == FIRST_SENTENCE
    outputs: JsonObject = {}
    statements = [statement for section in dossier["sections"] for statement in section["statements"]]
    for statement in statements:
        if statement["numbers"]:
            command = statement["command"]
            if command not in outputs:
                _, *words = shlex.split(command)
                if words[:2] == ["-m", "safevar_sumo"]:
                    output = run(*words[2:]).stdout
                else:
                    output = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout
                outputs[command] = json.loads(output)
            for path, number in statement["numbers"].items():
                assert value_at(outputs[command], path) == number, (command, path)
    assert len(outputs) == 7, "manifest, checks, rows, explain, tolerance, risk, status"


@pytest.mark.slow
def test_the_dossier_has_its_sections_and_never_a_verdict(packed: Packed) -> None:
    dossier, _, page = packed
    assert [section["title"].split(". ")[0] for section in dossier["sections"]] == [
        str(number) for number in range(1, 9)
    ]
    assert all(section["statements"] for section in dossier["sections"])
    text = json.dumps(dossier)
    assert "at most 100, which it keeps" in text
    assert "at least 1.1, which it does not keep" in text
    assert page.index(FIRST_SENTENCE) < page.index("<h2>")
    assert not re.search("compliant|https?://|<script|src=", page)


@pytest.mark.slow
def test_the_pack_with_all_sections_verifies(packed: Packed, in_tmp: Path) -> None:
    _, folder, _ = packed
    result = json_of("verify", str(folder / "pack.zip"))
    assert result["same"] == result["claims"]
    names = {claim["claim"] for claim in result["table"]}
    solutions = {f"solution {handle}" for handle in handles_of(pd.read_csv(folder / "results/slippery/solutions.csv"))}
    answers = {"answer explain", "answer tolerance", "answer risk"}
    assert {"checks", "dossier", "validation rows", *answers, *solutions} <= names
    assert any(name.startswith("setting explain.") for name in names)
