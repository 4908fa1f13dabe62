"""Sentences that several questions say."""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.case import load_cases
from safevar_sumo.questions.words import undecidable_in_words
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import SLOW, json_of, searched

STUDY = """
extends = "sun"
name = "tiny"
title = "Which words are read?"
[repair.promise]
tireFric = { at_least = 3.0 }
[search]
algorithms = ["nsga2"]
population = 10
evaluations = 100
runs = 1
"""
FEW = ("--characteristics", "tireFric,maxBrakeTorque", "--fits", "0")


@SLOW
def test_half_of_the_originals_is_said_by_every_question(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by one that asks another question first: nothing collides among the solutions of a short
    search.
    """
    (tmp_path / "tiny.toml").write_text(
        STUDY.replace("evaluations = 100", "evaluations = 60")
    )
    searched(load_study(str(tmp_path / "tiny.toml")), tmp_path / "results")
    monkeypatch.chdir(tmp_path)
    assert load_cases(["results"])[0].unsafe.is_half
    for typed in (
        ("explain", "results", "--quick", "--top", "1"),
        ("risk", "results", "--samples", "64"),
        ("rules", "results", "--samples", "64"),
        ("tolerance", "results", "--quick", *FEW),
    ):
        answer = json_of(*typed)
        assert answer["numbers"]["unsafe"].startswith("safety_degree < "), typed
        assert "half of the original's" in answer["verdict"], typed
        assert "--unsafe collision counts collisions alone." in answer["verdict"], typed


@pytest.mark.parametrize(
    ("low", "high", "is_decidable"),
    [(0.9, 1.0, True), (0.96, 1.0, False), (0.5, 1.0, True), (1.0, 1.0, True)],
)
def test_a_limit_nearer_to_the_original_than_its_measurement_is_not_decidable(
    low: float, high: float, *, is_decidable: bool
) -> None:
    brakes = next(
        item for item in CharacteristicSet.of(load_study("wear")) if item.precision
    )
    assert (brakes.original, brakes.lower, brakes.upper) == (1, 0.5, 1)
    assert brakes.is_decidable(low, high) is is_decidable
    assert "relative brake torque (measured to within 0.05)" in undecidable_in_words(
        [brakes]
    )
