"""Questions about a part of a study: the commands that they print ask about the same part."""

from __future__ import annotations

import json
import shlex
from typing import Any

import pytest

import safevar_sumo as sv
from safevar_sumo.questions.part import at_point, scope_of
from safevar_sumo.questions.worlds import moving_tests
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, InlinePool, json_of, numbers_of
from tests.support.made_up_studies import model_of
from tools.manual import PROGRAM

pytestmark = pytest.mark.usefixtures("made_up_studies")


@SLOW
def test_a_question_about_a_part_prints_commands_about_it() -> None:
    part: dict[str, Any] = {"ranges": True, "point": "CPLA", "up_to": "speed=40"}
    answer = sv.rules("wear", samples=32, pool=InlinePool(), **part)
    typed = answer.command.removeprefix(PROGRAM)
    assert json_of(f"{typed} --jobs 1") == json.loads(answer.render("json"))
    following = shlex.split(answer.next)[4:]
    assert following == ["wear", "--ranges", "--point", "CPLA", "--up-to", "speed=40"]


@SLOW
def test_limits_are_attacked_in_the_ranges_of_their_study_by_a_car_that_can_be_simulated() -> (
    None
):
    part = {"characteristics": ("brakeTorque",), "point": "CPNCO"}
    answer = sv.tolerance("wear", fits=0, pool=InlinePool(), **part)
    (row,) = answer.tables["ranges"].to_dict("records")
    assert not row["kept"]
    command = row["simulate"]
    assert {"--ranges", "CPNCO", f"speed={row['fails_at']['speed']}"} <= {
        *command.split()
    }
    assert numbers_of(command)["f_safe"] < 0.1


@pytest.mark.parametrize(
    ("point", "scope"),
    [
        (
            "CPNA, speed 40, impact_location 25, wet",
            "the test CPNA (scenario crossing) at 40 km/h, impact location",
        ),
        (
            "CPLA, speed 60, wet",
            "the test CPLA (scenario along) at 60 km/h; weather wet",
        ),
    ],
)
def test_limits_at_one_point_of_a_matrix_claim_nothing_beyond_it(
    point: str, scope: str
) -> None:
    study = at_point(sv.load_study("wear"), point)
    assert scope_of(study).startswith(scope)
    assert moving_tests(model_of(study)) == []


def test_a_study_at_one_of_its_points_has_no_constraint_of_its_ranges() -> None:
    study = at_point(sv.load_study("alks"), "cut_out, speed 60, wet")
    assert len(assemble(study).matrix) == 1
