"""A user's own scenario: its parameters are searched where they are declared, and what cannot be is
refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from safevar_sumo.scenarios import SCENARIOS
from safevar_sumo.sumo import reason_against_scenes
from safevar_sumo.sumo.matrix import drive_and_score
from tests.support.in_process import json_of, rows_of, run, write
from tests.support.made_up import drawn, system_of

MINE = """
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.scenarios import Track, travelled
from safevar_sumo.study import searched


class Mine(Struct, frozen=True, kw_only=True):
    '''A scooter comes out of a row past a parked van.'''

    speed: float = 40.0
    scooter: Annotated[
        float, Meta(ge=5, le=30, description="speed of the scooter", extra={"unit": "km/h"})
    ] = 15.0
    gap: Annotated[float, searched(20.0, 60.0, "m", "gap to the scooter when it moves out")] = 30.0
    duration: float = 9.0

    def tracks(self, times):
        v = self.scooter / 3.6 + 0.0 * times
        moves = (times > 1.0) & (times < 3.0)
        y = -2.5 + np.clip(times - 1.0, 0.0, 2.0)
        x = self.gap + travelled(v, times)
        scooter = Track.of("scooter", "scooter", x, y, v, 1.0 * moves, size=(1.8, 0.6))
        return [scooter, Track.of("van", "van", self.gap + 20.0, -3.2, size=(5.5, 2.0))]
"""


TRAFFIC = """
from typing import Annotated

from msgspec import Struct

from safevar_sumo.scenarios.published import LeadVehicleStopped
from safevar_sumo.study import searched


class Mine(Struct, frozen=True, kw_only=True):
    distance: Annotated[float, searched(20.0, 60.0, "m", "gap to the parked vehicle")] = 50.0
    network: str = "lead_vehicle_stopped"
    duration: float = 16.0
    reactive_actors = False

    def actors(self, roads):
        return {"vehicle[@id='vut']": {"departPos": str(80.3 - self.distance)}}
"""


def test_a_users_class_whose_traffic_sumo_moves_is_searched_in_sumo(
    in_tmp: Path,
) -> None:
    methods = "".join(
        f"\n    def {name}(self, *arguments):\n        return"
        f" LeadVehicleStopped().{name}(*arguments)\n"
        for name in ("begin", "observe", "encounter")
    )
    write("own.py", TRAFFIC + methods)
    search = {"distance": {"unit": "m", "original": 50, "lower": 30, "upper": 60}}
    system = system_of(
        "native",
        scenario={"model": "own:Mine", "over": search},
        encounters="ranges",
    )
    assert "by distance" in reason_against_scenes(system)
    settings = drawn(system, 3, 4)
    found = drive_and_score(system, settings)
    for row, setting in enumerate(settings):
        parameters = {"distance": float(setting[-1])}
        alone = system_of(
            "native",
            scenario={"model": "lead_vehicle_stopped", "parameters": parameters},
        )
        assert (
            drive_and_score(alone, setting[:-1][np.newaxis]).outcome[0]
            == found.outcome[row]
        )


def test_a_list_of_ones_own_scenario_names_it_and_claims_no_check(in_tmp: Path) -> None:
    write("own.py", MINE)
    printed = run("list own:Mine").stdout
    assert printed.startswith("A study can name own:Mine.\n")
    assert "passed" not in printed


def test_the_list_of_scenarios_has_what_their_classes_declare() -> None:
    answer = json_of("list scenarios --json")
    assert answer["numbers"] == {"passed": True}
    rows = {row["name"]: row for row in rows_of(answer, "scenarios")}
    assert {*rows} == {*SCENARIOS}
    assert "target_deceleration 0.5 to 10 m/s^2" in str(rows["car_to_car"])
