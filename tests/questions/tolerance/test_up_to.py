"""Limits up to one value of a parameter: what the study that is cut drives, and how its limits lie
between those of others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.part import UpperEnd, names_left_out, study_up_to
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, InlinePool, write

AHEAD = """
extends = "wear"
name = "ahead"
title = "A pedestrian ahead on a wet road"
[[matrix.tests]]
name = "slow"
model = "along"
parameters = { vut_length = 4.7, vut_width = 1.85 }
over = { speed = [30, 60] }
[[matrix.tests]]
name = "fast"
model = "along"
parameters = { vut_length = 4.7, vut_width = 1.85 }
over = { speed = [50, 60] }
"""


@pytest.fixture
def slow_and_fast(in_tmp: Path) -> Study:
    write("ahead.toml", AHEAD)
    return load_study("ahead.toml")


def up_to(study: Study, speed: float) -> Study:
    return study_up_to(study, UpperEnd("speed", speed))


def test_a_matrix_is_cut_at_the_value_itself_where_its_scenario_can_move(
    slow_and_fast: Study,
) -> None:
    def over(study: Study) -> list[Any]:
        return [study.lists_of(test)["speed"] for test in study.matrix.tests]

    wear, stop = load_study("wear"), load_study("stop")
    assert over(up_to(wear, 45)) == [[10, 20, 30, 40]] * 3 + [[10, 20, 30, 40, 45]]
    assert over(up_to(stop, 75)) == [[30, 50]], "a fixed way to stop has its own speeds"
    assert up_to(wear, 60) == wear
    assert over(up_to(slow_and_fast, 40)) == [[30, 40]]
    left_out = [
        names_left_out(slow_and_fast, up_to(slow_and_fast, speed)) for speed in (40, 50)
    ]
    assert left_out == [["fast"], []]
    placed = study_up_to(wear, UpperEnd("impact_location", 30))
    assert over(placed) == over(wear), "tests without such an axis count unchanged"


def test_a_searched_original_above_the_value_becomes_it() -> None:
    joint = load_study("wear", encounters="ranges")
    low, high = (up_to(joint, value).ranges["speed"] for value in (25, 50))
    assert (low.original, low.upper) == (25, 25)
    assert (high.original, high.upper) == (40, 50)
    assert up_to(joint, 60) == joint


@SLOW
def test_limits_up_to_a_value_between_two_tests_hold_there_and_lie_between_theirs(
    slow_and_fast: Study,
) -> None:
    """At a brake torque that is safe at 40 km/h and not at 50, the cut at 45 decides."""
    answers = [
        tolerance(
            slow_and_fast,
            up_to=f"speed={value}",
            characteristics=("brakeTorque",),
            quick=True,
            pool=InlinePool(),
        )
        for value in (40, 45, 50)
    ]
    least = [answer.values("limits.alone_low")[0] for answer in answers]
    assert least[0] < least[1] < least[2]
    between = answers[1]
    assert "speed=45: fast" in between.verdict
    assert "test slow (scenario along) at 30 to 45 km/h" in between.numbers["scope"]
    assert between.numbers["up_to"] == 45
    cut = assemble(up_to(slow_and_fast, 45))
    settings = np.array(
        [
            cut.characteristics.setting({"brakeTorque": value})
            for value in (least[1], least[0])
        ]
    )
    is_kept = drive_and_score(cut, settings).f_safe >= between.numbers["margin"]
    assert is_kept.tolist() == [True, False]
