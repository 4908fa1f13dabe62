"""An encounter may begin between two decisions of a driving system; claims meet the worst phase."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as replace_in
from numpy.testing import assert_allclose, assert_array_equal

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.between import COUNTS_STEPS, DOMAIN, in_phases
from safevar_sumo.questions.cases import SearchPlan, search_scope
from safevar_sumo.questions.drives import Drives, Judged, Scope
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import Track, TrackScenario
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import Study
from safevar_sumo.sumo.batch import drive_all, score
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System, assemble
from tests.support.in_process import (
    EVERY_STUDY,
    SLOW,
    InlinePool,
    json_of,
    numbers_of,
    rows_of,
    write,
)
from tests.support.made_up import drawn

STEP = 0.05


def at_phase(system: System, phase: float | FloatArray) -> System:
    points = tuple(point._replace(phase=phase) for point in system.points)
    return replace(system, points=points)


def degrees(system: System, settings: FloatArray) -> FloatArray:
    """Safety degrees at each point, shape (K, N)."""
    found = simulate_all_points(system, settings)
    return np.stack([result.evaluations.f_safe for result in found])


@pytest.mark.parametrize("name", EVERY_STUDY)
def test_an_encounter_that_begins_a_whole_step_later_is_the_same(name: str) -> None:
    study = load_study(name)
    system = assemble(study)
    if in_phases(study, system) == study:
        pytest.skip("its actors do not move on tracks")
    settings = drawn(system, 4, 1)
    now, later = (degrees(at_phase(system, phase), settings) for phase in (0.0, 1.0))
    assert np.isfinite(now).any()
    # Sensors lose frames by their number, and IDM acts from the first step on.
    if name in ("sensing", "wear_idm"):
        assert not np.allclose(later, now, atol=1e-6, equal_nan=True)
    else:
        assert_allclose(later, now, atol=1e-6)


def test_the_phase_of_a_pedestrian_is_a_later_impact() -> None:
    study = load_study(
        "wear", matrix={"tests": [{"name": "CPFA", "parameters": {"test": "CPFA"}}]}
    )
    system = assemble(study)
    settings = drawn(system, 6, 2)
    for phase in (0.25, 0.8, 1.0):
        scenario = system.points[0].scenario.at({"time_to_impact": 6 + phase * STEP})
        later = system.points[0]._replace(scenario=scenario)
        expected = degrees(replace(system, points=(later,)), settings)
        assert_allclose(degrees(at_phase(system, phase), settings), expected, atol=1e-9)


def test_vehicles_at_several_points_each_have_their_own_phase() -> None:
    study = load_study("autoware_july")
    system = assemble(study)
    phased = assemble(in_phases(study, system))
    settings = drawn(system, 5, 3)
    phases = np.array([0.0, 0.4, 0.4, 0.9131, 0.2])
    rows = np.column_stack([settings, phases])
    found = degrees(phased, rows)
    for row, phase in enumerate(phases.tolist()):
        assert_array_equal(
            found[:, [row]], degrees(at_phase(system, phase), settings[[row]])
        )
    test, *others = phased.points
    test = test._replace(ranges={"phase": replace_in(DOMAIN, upper=0.5)})
    found[0, 3] = np.nan  # the test excludes the phase
    assert_array_equal(degrees(replace(phased, points=(test, *others)), rows), found)


def test_sumo_repeats_a_phase_to_the_bit() -> None:
    system = assemble(at_point(load_study("autoware_july"), "CCRs, speed 60, clear"))
    system = at_phase(system, 0.3712)
    settings = drawn(system, 3, 4)
    runs = [drive_all(replace(system, in_sumo=one), settings) for one in (False, True)]
    here, there = (score(system, settings, one).f_safe for one in runs)
    assert_array_equal(here, there)


def ahead(**over: object) -> Study:
    """A standing car at 60 km/h, or at the speeds that are searched."""
    study = load_study("autoware_july", matrix=False, scenario={"over": over})
    return with_ranges(study)


def test_the_worst_phase_on_a_standing_car_is_the_line_through_the_tips_over_the_speed() -> (
    None
):
    speed = {
        "unit": "km/h",
        "original": 45,
        "lower": 40,
        "upper": 50,
        "meaning": "speed",
    }
    evaluator = Evaluator(ahead(speed=speed), InlinePool())
    model = Model(0, evaluator, Unsafe(below=0.0))
    original = evaluator.characteristics.original

    # The tips at phase 0, where the distance ends to brake just one step later.
    speeds = np.linspace(43, 47, 1601)
    settings = np.tile(original, (len(speeds), 1))
    settings[:, evaluator.characteristics.names.index("speed")] = speeds
    left = model.unsafe.robustness(model.evaluate(settings, "speeds"))
    tips = np.flatnonzero((np.abs(np.diff(left)) > 0.3)[:-1])
    lower = np.where(left[tips] < left[tips + 1], tips, tips + 1)
    assert len(lower) > 3
    some = np.arange(lower[0], lower[-1], 251)
    claim = model.in_phases
    assert claim is not None

    def judge(drives: Drives) -> Judged:
        settings = np.column_stack([drives.vehicle, drives.encounters.phase])
        runs = claim.evaluate(settings, "phases")
        return Judged.simulated(drives, claim.unsafe.robustness(runs))

    for row in some:
        setting = settings[row]
        scope = Scope(setting, setting, range(1), np.zeros(0), np.zeros(0))
        start = Drives(setting[np.newaxis], scope.first_encounter)
        rng = np.random.default_rng(0)
        result = search_scope(judge, scope, start, SearchPlan(512), rng)
        line = np.interp(speeds[row], speeds[lower], left[lower])
        assert_allclose(result.least, line, atol=0.01)


@SLOW
def test_a_car_may_not_drive_where_it_fails_at_another_phase() -> None:
    typed = "permit autoware_july --set brakeTorque=0.93 --others new --margin 0.3"
    (row,) = rows_of(json_of(typed), "cars")
    assert row["phase"] > 0

    # The failure of the worst brake torque that this may be is none at phase 0.
    assert "brakeTorque=0.88" in row["simulate"]
    at_0 = re.sub(r" --set phase=\S+", "", row["simulate"])
    assert numbers_of(row["simulate"])["f_safe"] < 0.3 <= numbers_of(at_0)["f_safe"]


def test_simulate_takes_a_phase() -> None:
    answer = json_of("simulate autoware_july --set phase=0.37124")
    assert "0.3712 steps" in answer["verdict"]


@dataclass(frozen=True)
class Careless(TrackScenario):
    """Reads the first column of the times alone."""

    speed: float = 40.0
    duration = 4.0
    is_user_code = True

    def tracks(self, times: FloatArray) -> list[Track]:
        return [Track.of("other", "car", 40 + 2 * times[:, :1], 0.0, 2.0)]


def test_tracks_that_ignore_the_phases_of_others_are_refused() -> None:
    times = np.arange(5)[:, np.newaxis] * STEP
    assert len(Careless().tracks_begun(times, 0.01)) == 1
    with pytest.raises(InputError, match="first of several times"):
        Careless().tracks_begun(times, np.array([0.0, 0.01]))


@SLOW
def test_an_answer_says_that_a_driving_system_counts_steps(in_tmp: Path) -> None:
    write(
        "slow_ads.py",
        "from safevar_sumo.ads import ScalarAds\n"
        "class Slow(ScalarAds):\n"
        "    def __init__(self, near=25.0):\n"
        "        self.near, self.calls, self.brake = near, 0, 0.0\n"
        "    def drive(self, seen):\n"
        "        if self.calls % 4 == 0 and seen.gap < self.near:\n"
        "            self.brake = 1.0\n"
        "        self.calls += 1\n"
        "        return 0.0, self.brake\n",
    )
    ads = {"model": "slow_ads:Slow", "parameters": {"near": 25.0}}
    answer = sv.permit(
        {"extends": "autoware_july", "name": "slow", "ads": ads},
        set=["brakeTorque=1"],
        others="new",
        step=30,
        quick=True,
        fits=0,
        unsafe="safety_degree < -30",
        pool=InlinePool(),
    )
    assert COUNTS_STEPS in f"{answer.verdict} {answer.tested}"
