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
from safevar_sumo.terminal import Phase
from tests.in_process import InlinePool

SMOKE = load_study("smoke")
FAST: list[tuple[Callable[..., Any], Mapping[str, Any]]] = [
    (sv.explain, {"limit": 2000, "fits": 2, "unsafe": "below=2.7"}),
    (lambda study, **options: sv.compare(study, "smoke", **options), {"samples": 100}),
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
    shares = [phase.share for phase, _, _ in shown if isinstance(phase, Phase)]
    assert len(shares) == len(shown)
    assert all(earlier <= share <= 1 for earlier, share in pairwise([0.0, *shares]))


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
    evaluator.plan({"first": 1, "second": 3}, "second")
    begun = False
    for name, total in parts:
        begun = begun or name in ("first", "second")
        for done in (0, total // 2, total):
            evaluator.phases.show_part(name, done, total)
    numbered = [one for one in shown if " of 2, " in one[0]]
    assert bool(numbered) == begun
    check_order(numbered)


def test_shares_of_planned_phases_follow_their_weights_and_rounds_fill_no_bar() -> None:
    """Of 1 + 3 parts the first takes a quarter; of the rest a first round half, two two thirds."""
    shown = list[tuple[str, int, int]]()
    evaluator = Evaluator(SMOKE, InlinePool(), lambda *one: shown.append(one))
    evaluator.plan({"first": 1, "second": 3}, "second")
    ends = list[tuple[str, float]]()
    for name in ("before", "first", "second", "first", "second"):
        with evaluator.stage(name, 10):
            for done in (0, 5, 10):
                evaluator.phases.show_part("a part", done, 10)
        phase = shown[-1][0]
        assert isinstance(phase, Phase)
        ends.append((phase, phase.share))
    assert ends == [
        ("before", 0.0),
        ("1 of 2, first", 0.25),
        ("2 of 2, second, round 1", 0.25 + 0.75 / 2),
        ("2 of 2, second, round 1", 0.25 + 0.75 / 2),
        ("2 of 2, second, round 2", 0.25 + 0.75 * 2 / 3),
    ]
    assert [one[1:] for one in shown if "round 2" in one[0]][-1] == (30, 30)
