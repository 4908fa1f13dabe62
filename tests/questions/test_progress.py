"""Progress of questions: the simulations of the whole command, and the time left."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Callable, Mapping
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies as st

import safevar_sumo as sv
from safevar_sumo.questions.progress import Phases
from safevar_sumo.terminal import Pace, Parts
from tests.support.in_process import SLOW, InlinePool

RECORDED = Path(__file__).with_name("progress.csv")
"""What `benchmarks/progress.py` recorded: command, time [s], done, total; the last row of a command
is its end.
"""
LEAST_RIGHT = {"repair wear": 0.85, "tolerance wear": 0.85}
"""The least share of the seconds in which the time left is right, where it is below 1."""
Shown = list[tuple[str, int, int]]
QUESTIONS: list[Any] = [
    (sv.explain, {"quick": True, "fits": 2, "unsafe": "below=2.7"}),
    (lambda study, **options: sv.compare(study, "smoke", **options), {"samples": 100}),
    (sv.risk, {"samples": 200}),
    (sv.rules, {"samples": 200}),
    pytest.param(sv.tolerance, {"quick": True}, marks=SLOW),
    pytest.param(
        sv.repair,
        {"promise": ("mass <= 2450",), "change": ("brake_gap",), "fits": 1},
        marks=SLOW,
    ),
]


def assert_counts(shown: Shown) -> None:
    """Every phase comes once, and no more is done than in all."""
    in_order = [phase for phase, _ in groupby(phase for phase, _, _ in shown)]
    assert len(in_order) == len(set(in_order))
    assert all(done <= total for _, done, total in shown)


@SLOW
@pytest.mark.usefixtures("few_simulations")
@pytest.mark.parametrize(("ask", "options"), QUESTIONS)
def test_phases_come_in_order_and_all_that_is_done_is_in_the_total(
    ask: Callable[..., Any], options: Mapping[str, Any]
) -> None:
    shown = Shown()
    ask("smoke", pool=InlinePool(), progress=lambda *one: shown.append(one), **options)
    assert_counts(shown)
    assert all(earlier[1] <= later[1] for earlier, later in pairwise(shown))
    assert shown[-1][1] > 0


@given(
    st.lists(
        st.tuples(st.sampled_from(["first", "second", "other"]), st.integers(1, 50)),
        min_size=1,
    )
)
def test_any_order_of_parts_is_counted_without_a_way_back(
    parts: list[tuple[str, int]],
) -> None:
    shown = Shown()
    phases = Phases(lambda *one: shown.append(one))
    phases.plan({"first": 10, "second": 30})
    for name, number in parts:
        phases.begin_part(name, number)
        phases.add(number)
    assert shown[-1][1] == sum(number for _, number in parts)
    assert_counts(shown)


def test_a_shorter_phase_shortens_the_total_and_rounds_are_foreseen() -> None:
    """At 2 points, phases of 10, 20 and 60 settings are planned: the first takes 5. As much as a
    stage exceeds its plan follows, or 18 % before an unknown round. Each of 3 known rounds takes
    the mean of the rounds so far and of one as planned.
    """
    shown = Shown()
    phases = Phases(lambda *one: shown.append(one))
    phases.plan({"first": 10, "open": 20, "sets": 60}, points=2)
    phases.begin_part("first", 10)
    phases.add(10)
    with phases.stage("open"):
        assert shown[-1] == ("open", 10, 10 + 40 + 120)
        phases.begin_part("a part of it", 80)
        phases.add(80)
        assert shown[-1] == ("open", 90, 90 + 40 + 120)
        phases.begin_round(2, 150)
        assert shown[-1] == ("open, round 2 of at most 150", 90, 90 + 14 + 120)
    with phases.stage("sets"):
        phases.begin_round(1, 3, is_known=True)
        phases.begin_part("first", 10)
        phases.add(10)
        phases.begin_round(2, 3, is_known=True)
        assert shown[-1] == ("sets, round 2 of 3", 100, 100 + 2 * 25)


def test_a_stage_of_more_settings_than_planned_has_those_of_all_points() -> None:
    shown = Shown()
    phases = Phases(lambda *one: shown.append(one))
    phases.plan({"first": 10}, points=2)
    with phases.stage("first", 30):
        phases.begin_part("a part of it", 10)
    assert shown[-1] == ("first", 0, 2 * 30)


def test_parts_weigh_what_is_expected_of_them() -> None:
    shown = Shown()
    parts = Parts(lambda *one: shown.append(one), [100, 50])
    first = parts.begin("question 1")
    first("a", 5, 10)
    first("b", 100, 200)
    parts.begin()("c", 1, 2)
    assert shown == [
        ("question 1: a", 50, 150),
        ("question 1: b", 50, 150),
        ("c", 125, 150),
    ]


def recorded() -> dict[str, list[list[float]]]:
    rows = defaultdict[str, list[list[float]]](list)
    for command, *numbers in csv.reader(RECORDED.read_text("utf-8").splitlines()):
        rows[command].append([*map(float, numbers)])
    return rows


@pytest.mark.parametrize("command", recorded())
def test_the_time_left_is_right_within_a_factor_of_two(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the second half of a recorded command the time left that is displayed at each second is
    within a factor of two, or 5 seconds, of what was left; none is missing after the first tenth.
    `repair` does not know how often its changes fail, nor `tolerance` how often the last parameter
    set makes the limits narrower.
    """
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    rows = recorded()[command]
    end = rows[-1][0]
    pace = Pace()
    are_right = list[bool]()
    for second in range(1, int(end)):
        for now, done, total in rows:
            if second - 1 < now <= second:
                pace.update(done, total)
        now = float(second)
        left = pace.seconds_left()
        if second > 0.1 * end:
            assert left is not None, f"none at {second} s of {end:.0f} s"
        if second > 0.5 * end:
            is_near = abs(left - (end - second)) <= 5
            are_right.append(is_near or 0.5 <= left / (end - second) <= 2)
    assert sum(are_right) >= LEAST_RIGHT.get(command, 1.0) * len(are_right)


def test_no_total_exceeds_the_simulations_that_are_allowed() -> None:
    totals = list[int]()
    phases = Phases(lambda name, done, total: totals.append(total))
    phases.plan({"first": 10, "second": 2800}, most=3000)
    phases.begin_part("first", 2400)
    phases.add(2400)
    assert max(totals) == 3000
