"""An answer is worded after all is found: from plain values, and without any simulation."""

from __future__ import annotations

import pickle
from dataclasses import replace
from importlib import import_module
from typing import Any

import pytest

from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import find_question
from safevar_sumo.sumo import matrix
from tests.support.in_process import InlinePool

WORN = {"a": {"brakeTorque": 0.9}, "b": {"treadDepth": 3}}
ASKED: list[tuple[str, str, dict[str, Any]]] = [
    ("tolerance", "smoke", {"simulations": 2000}),
    ("repair", "native", {"promise": ["all"]}),
    ("permit", "wear", {"cars": WORN, "others": "new", "fits": 1, "point": "CPLA"}),
]
"""Questions with a function `tell`, each with a study and with options that make it cheap."""


@pytest.mark.usefixtures("few_simulations", "quick_repairs")
@pytest.mark.parametrize(("question", "study", "options"), ASKED)
def test_nothing_is_simulated_while_an_answer_is_worded(
    question: str,
    study: str,
    options: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module = import_module(f"safevar_sumo.questions.{question}")
    tell = module.tell

    def tell_without_simulations(found: Any) -> Answer:
        """Word a copy of the facts, which has no process and no pool."""
        copy = pickle.loads(pickle.dumps(found))
        with monkeypatch.context() as patch:
            patch.setattr(matrix, "drive_all", lambda *_: pytest.fail("a simulation"))
            answer: Answer = tell(copy)
        return replace(answer, next="told")

    monkeypatch.setattr(module, "tell", tell_without_simulations)
    answer = find_question(question)(study, pool=InlinePool(), **options)
    assert answer.next == "told"
