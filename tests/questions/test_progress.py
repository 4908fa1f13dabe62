"""Progress of questions: a phase never comes back, and no count falls."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import groupby, pairwise
from typing import Any

import pytest
from hypothesis import given, strategies as st

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.evaluator import Evaluator
from tests.in_process import InlinePool

SMOKE = load_study("smoke")
FAST: list[tuple[Callable[..., Any], Mapping[str, Any]]] = [
    (sv.explain, {"limit": 2000, "fits": 2, "unsafe": "below=2.7"}),
    (sv.risk, {"samples": 200}),
    (sv.rules, {"samples": 200}),
]
SLOW: list[tuple[Callable[..., Any], Mapping[str, Any]]] = [
    (sv.tolerance, {"attack": 1000, "fits": 1}),
    (sv.repair, {"promise": ("mass <= 2450",), "change": ("brake_gap",), "fits": 1}),
]


def check_order(shown: list[tuple[str, int, int]]) -> None:
    """Each phase is shown once, and its count rises."""
    in_order = [phase for phase, _ in groupby(phase for phase, _, _ in shown)]
    assert len(in_order) == len(set(in_order))
    for (before, earlier, _), (phase, done, total) in pairwise(shown):
        assert phase != before or done >= earlier
        assert not total or done <= total


@pytest.mark.parametrize(
    ("ask", "options"), [*FAST, *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOW)]
)
def test_phases_come_in_order_and_counts_rise(
    ask: Callable[..., Any], options: Mapping[str, Any]
) -> None:
    shown = list[tuple[str, int, int]]()
    ask("smoke", jobs=1, progress=lambda *one: shown.append(one), **options)
    check_order(shown)


PARTS = st.lists(
    st.tuples(st.sampled_from(["first", "second", "other", "more"]), st.integers(1, 50)), min_size=1
)


@given(PARTS)
def test_any_order_of_parts_is_shown_without_a_way_back(parts: list[tuple[str, int]]) -> None:
    """Each part counts from 0 to its total; planned parts are named as planned."""
    shown = list[tuple[str, int, int]]()
    evaluator = Evaluator(SMOKE, InlinePool(), lambda *one: shown.append(one))
    evaluator.plan("first", "second")
    begun = False
    for name, total in parts:
        begun = begun or name in ("first", "second")
        for done in (0, total // 2, total):
            evaluator.progress(name, done, total)
    numbered = [one for one in shown if " of 2, " in one[0]]
    assert bool(numbered) == begun
    check_order(numbered)
