"""No question reads another one's words: with every word replaced, all numbers stay."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions import words
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
TYPED = (
    ("risk", "tiny.toml", "--samples", "256"),
    ("rules", "tiny.toml", "--samples", "512"),
    ("explain", "tiny.toml", "--fits", "2", "--top", "2"),
    ("explain", "results", "--fits", "2", "--top", "2"),
    ("compare", "rain", "tiny.toml", "--samples", "64"),
    ("tolerance", "tiny.toml", *FEW),
    ("tolerance", "tiny.toml", *FEW, "--limits", "tireFric >= 3"),
    ("repair", "tiny.toml", "--fits", "0", "--margin", "1"),
    ("simulate", "results", "--solution", "most-severe"),
)


def numbers_of(answer: Any) -> Any:
    """An answer without its texts."""
    if isinstance(answer, dict):
        return {key: numbers_of(value) for key, value in answer.items()}
    if isinstance(answer, list):
        return list(map(numbers_of, answer))
    return "" if isinstance(answer, str) else answer


def silence(patch: pytest.MonkeyPatch) -> int:
    """Replace what every function of words says by X; the number of replaced functions."""
    replaced = 0
    for name, module in list(sys.modules.items()):
        for attribute, value in (
            list(vars(module).items()) if name.startswith("safevar_sumo.") else ()
        ):
            if inspect.isfunction(value) and (
                attribute.endswith("_in_words") or value.__module__ == words.__name__
            ):
                said = ["X"] if "list" in str(inspect.signature(value).return_annotation) else "X"
                patch.setattr(module, attribute, lambda *_, said=said, **__: said)
                replaced += 1
    for attribute in ("description", "in_words"):
        patch.setattr(Unsafe, attribute, "X")
    patch.setattr(Unsafe, "value_in_words", lambda *_: "X")
    return replaced


@SLOW
@pytest.mark.parametrize("typed", TYPED, ids=" ".join)
@pytest.mark.usefixtures("few_simulations")
def test_without_words_every_number_stays(
    typed: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    decides = 4 if typed[0] == "compare" else 0  # its two studies differ in what they cover
    said = json_of(*typed, expect=decides)
    assert silence(monkeypatch) > 20
    silent = json_of(*typed, expect=decides)
    assert numbers_of(silent["numbers"]) == numbers_of(said["numbers"])
    tables = [
        {name: table["rows"] for name, table in answer["tables"].items()}
        for answer in (said, silent)
    ]
    for table in tables:
        table.pop("remarks", None)
    assert numbers_of(tables[0]) == numbers_of(tables[1])
    assert said["verdict"] != silent["verdict"]


@SLOW
def test_half_of_the_originals_is_said_by_every_question(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by one that asks another question first: nothing collides among the solutions of a short
    search.
    """
    (tmp_path / "tiny.toml").write_text(STUDY.replace("evaluations = 100", "evaluations = 60"))
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
    brakes = next(item for item in CharacteristicSet.of(load_study("wear")) if item.precision)
    assert (brakes.original, brakes.lower, brakes.upper) == (1, 0.5, 1)
    assert brakes.is_decidable(low, high) is is_decidable
    assert "relative brake torque (measured to within 0.05)" in undecidable_in_words([brakes])
