"""A vehicle from outside the package whose brakes fail in a known region, asked all questions through SUMO and the commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safevar_sumo.cli.program import commands

VEHICLE = '''
import numpy as np
from safevar_sumo.vehicles import SumoVehicle

ORIGINAL = {"mass": 1500.0, "accel": 2.6, "decel": 9.0, "maxSpeed": 55.0, "tau": 0.2, "sensorRange": 80.0, "reactionTime": 0.3,
            "brakeDelay": 0.1, "brakeGain": 1.0}


class Greasy:
    """SUMO's vehicle, whose brakes fail where there is much grease and little dust."""

    UNITS = {"grease": "g", "dust": "g"}

    def __init__(self):
        self.inner = SumoVehicle()

    def prepare(self, characteristics, road_friction, step):
        grease, dust = characteristics["grease"], characteristics["dust"]
        plain = {name: np.full_like(grease, value) for name, value in ORIGINAL.items()}
        plain["brakeGain"] = np.where((grease > 7) & (dust < 3), 0.02, 1.0)
        return self.inner.prepare(plain, road_friction, step)

    def sumo_type(self, prepared):
        return self.inner.sumo_type(prepared)

    def at_rest(self, prepared):
        return self.inner.at_rest(prepared)

    def at_speed(self, prepared, speed):
        return self.inner.at_speed(prepared, speed)

    def sense(self, prepared, state, seen):
        return self.inner.sense(prepared, state, seen)

    def advance(self, prepared, state, command):
        return self.inner.advance(prepared, state, command)
'''
STUDY = """
extends = "native"
name = "greasy"
title = "Brakes that fail where there is much grease and little dust"
[vehicle]
model = "greasy:Greasy"
[vehicle.characteristics]
grease = { unit = "g", original = 5, lower = 0, upper = 10 }
dust = { unit = "g", original = 5, lower = 0, upper = 10 }
"""


@pytest.fixture
def study(in_tmp: Path) -> str:
    Path("greasy.py").write_text(VEHICLE)
    Path("greasy.toml").write_text(STUDY)
    return "greasy.toml"


def asked(*arguments: str) -> Any:
    done = CliRunner().invoke(commands, [*arguments, "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    return json.loads(done.stdout)


@pytest.mark.slow
def test_every_question_is_answered_as_it_is_known(study: str) -> None:
    *failures, last = asked("explain", study)
    assert [last["summary"][name] for name in ("necessary", "changed")] == [{"grease": 1.0, "dust": 1.0}] * 2
    for one in failures:
        assert (one["algorithm"], one["run"], one["index"]) == (None, None, None)
        (cause,) = one["minimal_causes"]
        assert cause["changes"] == one["setting"]
        assert cause["boundary"]["grease"] >= 7 - 1e-9
        assert cause["boundary"]["dust"] <= 3 + 1e-9
        assert min(cause["boundary"]["grease"] - 7, 3 - cause["boundary"]["dust"]) < 0.01
    told = asked("tolerance", study, "--pairs")
    assert [one["unsafe"] for one in told["alone"]] == [[], []]
    assert told["pairs"][0]["unsafe_share"] == pytest.approx(0.09, abs=0.02)
    assert told["joint"]["factor"] == pytest.approx(0.4, rel=0.02)
    told = asked("risk", study, "--samples", "2000", "--confidence", "0.999")
    assert told["interval"][0] <= 0.09 <= told["interval"][1]
    (rule,) = asked("rules", study, "--samples", "4096")
    assert rule["conditions"] == [
        {"characteristic": "grease", "at_least": pytest.approx(7, abs=0.03), "at_most": None},
        {"characteristic": "dust", "at_least": None, "at_most": pytest.approx(3, abs=0.03)}]


@pytest.mark.slow
def test_the_same_bytes_whatever_the_number_of_workers(slippery: Path) -> None:
    commanded = (["explain", str(slippery)], ["tolerance", str(slippery), "--characteristics", "mass,tireFric", "--pairs"],
                 ["risk", str(slippery), "--samples", "300"], ["rules", str(slippery), "--samples", "1000"])
    for arguments in commanded:
        one, two, again = (CliRunner().invoke(commands, [*arguments, "--json", "--jobs", jobs]).stdout for jobs in ("1", "2", "2"))
        assert one == two == again
        assert one
