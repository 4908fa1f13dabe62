"""Repairs against a closed form, and their price where a driving system always brakes."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace as replace_in
from numpy.random import default_rng
from numpy.testing import assert_array_equal

import safevar_sumo as sv
from safevar_sumo.ads import ADS
from safevar_sumo.ads.varied import CHANGEABLE, VariedAds
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions import cases, repair as question
from safevar_sumo.questions.drives import Drives, Judged
from safevar_sumo.questions.evaluator import open_evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.repair import (
    smallest,
    survivors,
    write_repair,
)
from safevar_sumo.questions.repair.price import benign_scenes
from safevar_sumo.questions.repair.problem import (
    Parameter,
    Promise,
    RepairProblem,
    parameters_of,
)
from safevar_sumo.questions.tables import AnswerTable
from safevar_sumo.records import BoolArray, FloatArray, differences
from safevar_sumo.study import FreeParameter
from safevar_sumo.sumo.matrix import drive_and_score, simulate_all_points
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, InlinePool, rows_of
from tests.support.made_up_studies import places
from tests.support.planted_sled import GAP_TODAY, MARGIN, SPEED, STUDY

pytestmark = pytest.mark.usefixtures("made_up_studies")


def gap_for(grip: float) -> float:
    """The gap at which a sled has to brake so that it stops `MARGIN` before the obstacle."""
    return MARGIN + SPEED**2 / (2 * grip)


@SLOW
def test_repair_and_price_of_a_planted_system_equal_the_closed_form(
    planted: Path,
) -> None:
    found = sv.repair(planted, change=["gap", "colour"], pool=InlinePool(2))
    (repair,) = rows_of(found.to_dict(), "repairs")
    needed = max(
        gap_for(5), gap_for(5 * 0.9) - MARGIN
    )  # another fit than the study's own needs not to collide
    assert repair["parameters"] == {"gap": pytest.approx(needed, rel=0.01)}
    assert repair["fits"] == found.numbers["fits"] == found.numbers["fits_tried"] == 3
    assert "answer holds in 3 of 3 parameter sets of the vehicle model" in found.tested
    assert [repair["metres_earlier"]] == found.values("repairs.metres_earlier_mean")
    assert repair["metres_earlier"] == pytest.approx(needed - GAP_TODAY, rel=0.01)
    assert (
        len(str(repair["parameters"]["gap"])) <= 5
    )  # four digits: what is printed is what was tried
    assert repair["proof_failures"] == 0
    assert repair["at_most"] <= 0.01
    table = found.render("text").split("Repairs\n")[1].split("Tested: ")[0]
    assert max(map(len, table.splitlines())) <= 100


@SLOW
def test_a_promise_over_encounters_counts_those_that_a_new_vehicle_survives(
    planted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gap of today decides the fastest of them; from there the worst promised sled needs a
    longer one.
    """
    monkeypatch.setattr(cases, "USUAL_BUDGET", 2000)
    search = 'over.speed = { unit = "km/h", original = 40, lower = 30, upper = 72 }'
    planted.write_text(
        'encounters = "ranges"'
        + STUDY.replace("speed = 72.0, ", "").replace(
            'model = "car_to_car"', f'model = "car_to_car"\n{search}'
        )
    )
    found = sv.repair(planted, change=["gap"], fits=0, pool=InlinePool())
    (repair,) = rows_of(found.to_dict(), "repairs")
    fastest = 2 * 8 * (GAP_TODAY - MARGIN)  # squared, with grip 8
    assert repair["parameters"]["gap"] == pytest.approx(
        MARGIN + fastest / (2 * 5), rel=0.02
    )
    assert repair["proof_failures"] == 0
    assert (
        "in the encounters with speed 30 to 72 km/h that a new vehicle survives"
        in found.verdict
    )


@SLOW
def test_always_braking_has_its_price_for_any_number_of_workers(planted: Path) -> None:
    answers = [
        sv.repair(planted, change=["always"], pool=pool).to_dict()
        for pool in (InlinePool(), InlinePool(2))
    ]
    assert answers[0] == answers[1]
    (repair,) = rows_of(answers[0], "repairs")
    assert repair["needless_braking"] == repair["benign_scenes"] >= 6
    assert repair["needless_braking_today"] == 0


class Adding:
    """A problem without simulations: the changes of the parameters, up to 0.85 each, add up to what
    a vehicle needs.
    """

    drives_arrays = True

    def __init__(self, parameters: int, need: float) -> None:
        self.today, self._need = np.full(parameters, 0.1), need

    def survive(self, shares: FloatArray, drives: Drives, stage: str) -> BoolArray:
        judged = [self.outcomes(change, drives, stage) for change in shares]
        return np.array([not of_change.is_unsafe.any() for of_change in judged])

    def outcomes(self, change: FloatArray, drives: Drives, stage: str) -> Judged:
        gain = np.clip(change - self.today, 0, 0.85).sum()
        return Judged.simulated(drives, gain - self._need * drives.vehicle[:, 0])


@pytest.mark.parametrize(
    ("parameters", "need", "changed"),
    [
        (2, 0.0, {0: 0.0}),
        (2, 0.4, {1: 0.4, 2: 0.2}),
        (1, 0.4, {1: 0.4}),
        (2, 1.2, {2: 0.6}),
        (5, 1.0, {2: 0.5}),
        (4, 3.0, {}),
    ],
)
def test_the_smallest_changes_are_those_of_the_closed_form(
    parameters: int, need: float, changed: dict[int, float]
) -> None:
    problem: Any = Adding(parameters, need)
    encounters = places(*np.zeros(20))
    easy, hard = np.linspace([0.5, 1], [0, 0.5], 20).T[..., np.newaxis]
    search = smallest.Search(problem, Drives(easy, encounters))
    search.smallest_changes()
    # What was found before becomes a lower bound.
    search.add(Drives(hard, encounters))
    changes = [change - problem.today for change in search.smallest_changes()]
    found = {
        int(np.count_nonzero(change)): float(np.max(np.abs(change)))
        for change in changes
    }
    assert found == pytest.approx(changed, abs=0.005)


@pytest.mark.parametrize("name", [pytest.param("wear", marks=SLOW), "rain"])
def test_cases_leave_what_vehicles_leave_unless_nobody_saves_them(name: str) -> None:
    """Full braking has no parameters of the driving system, of which `rain` fits one."""
    unsafe = Unsafe(keep=0.3)
    with open_evaluator(sv.load_study(name), InlinePool()) as evaluator:
        problem = RepairProblem(
            models=[Model(0, evaluator, unsafe)],
            between=True,
            promise=Promise.of(evaluator.study, evaluator.region, ["all"]),
            parameters=parameters_of(evaluator.study, ()),
            budget=100,
        )
        vehicles = problem.promise.draw(6, default_rng(1))
        drives = Drives.product(vehicles, problem.encounters)
        left = problem.outcomes(problem.today, drives, "").robustness
        expected = unsafe.robustness(evaluator.evaluate(vehicles, ""))
        assert left.reshape(6, -1).min(axis=1) == pytest.approx(expected)
        is_saved = problem.repairable(drives)
        assert is_saved.all() == (name == "rain")
        judged = problem.judge(problem.today, drives, "")
        assert_array_equal(judged.robustness, left)
        assert_array_equal(judged.counts, is_saved | (left >= 0))

        # Between the tests only encounters count that a new vehicle survives today.
        drives.encounters.place[:] = 0.37
        drives.encounters.phase[:] = 0.37
        originals = problem.bench.originals_in(drives.encounters)
        today = problem.outcomes(problem.today, originals, "")
        is_promised = problem.is_promised(drives.encounters)
        assert_array_equal(is_promised, ~today.is_not_safe)


def test_a_changed_value_is_rounded_as_finely_as_its_range_needs() -> None:
    row = FreeParameter(lower=1000.0, upper=1001.0, unit="m", meaning="")
    assert Parameter("a", row, 1000.0).values(np.array([0.45678])).item() == 1000.457


def test_the_verdict_names_the_worst_vehicle_of_a_kept_promise(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without attacks and fresh wear: of the worst brakes promised, those in between and the
    best.
    """
    monkeypatch.setattr(question, "SOBOL_VEHICLES", 3)
    monkeypatch.setattr(survivors, "find_failures", lambda *_: [])
    monkeypatch.setattr(
        survivors, "prove_change", lambda *_: (survivors.Proof(5, 0, 0.45, 0), [])
    )
    out = tmp_path / "it.toml"
    kept = sv.repair("native", promise=["decel>=7"], out=str(out), pool=InlinePool())
    assert not out.exists(), "there is no repair to write"
    worst = kept.numbers["worst_today"]
    assert worst == sv.simulate("native", {"decel": 7.0}).objectives["f_safe"] > 6
    words = f"{worst:.2f} m from centre to centre (gap {worst - 4.7:.2f} m)"
    assert f"The worst vehicle has a safety degree of {words}." in kept.verdict
    assert (
        "None of 5 worn vehicles that were sampled afterwards is unsafe" in kept.tested
    )
    table = AnswerTable(pd.DataFrame({"parameters": [{"standing_gap": 3.25}]}))
    # A study that results alone hold has no file to extend.
    for study in (kept.study, replace_in(kept.study, name="lost")):
        write_repair(out, replace(kept, study=study, tables={"repairs": table}))
        assert sv.load_study(out).ads.parameters["standing_gap"] == 3.25


@pytest.mark.parametrize(
    ("old", "new", "change", "message"),
    [
        ("lower = 4.0", "lower = 14.0", "gap", "bounds that hold the value of today"),
        (
            "lower = 4.0",
            "log = true, lower = 0.0",
            "gap",
            "expected: 0 < lower < upper",
        ),
        ("always = {", "alway = {", "alway", "ads.parameters.alway = None"),
        ("", "", "gape", "did you mean 'gap'?"),
        ("at_least = 5", "at_least = 3", "gap", "outside its domain"),
        (
            "gap = 12.0, always",
            "gap = 'x', always",
            "gap",
            "bounds that hold the value of today",
        ),
    ],
)
def test_what_cannot_be_repaired_is_refused(
    planted: Path, old: str, new: str, change: str, message: str
) -> None:
    planted.write_text(STUDY.replace(old, new))
    with pytest.raises(sv.InputError, match=re.escape(message)):
        sv.repair(planted, change=[change], pool=InlinePool())


@pytest.mark.parametrize(
    "model",
    [pytest.param(name, marks=SLOW if name[0] in "aik" else ()) for name in CHANGEABLE],
)
def test_one_driving_system_drives_vehicles_with_different_parameters(
    model: str,
) -> None:
    shipped = {"world_on_rails": "sun", "apollo": "lgsvl"}
    parameters = (
        sv.load_study(shipped[model]).ads.parameters if model in shipped else {}
    )
    study = sv.load_study("wear", ads={"model": model, "parameters": parameters})
    names = tuple(CHANGEABLE[model])
    system = assemble(study)
    system = replace(system, points=system.points[-1:])
    ends = np.array([(row.lower, row.upper) for row in CHANGEABLE[model].values()])
    low, high = (0.98 * ends + 0.02 * ends[:, ::-1]).T
    values = default_rng(1).uniform(low, high, (3, len(names)))
    settings = np.tile(system.characteristics.original, (3, 1))
    together = drive_and_score(
        replace(system, ads=VariedAds(system.ads, names, values)), settings
    )
    for row, one in enumerate(values.tolist()):
        own = dict(zip(names, one, strict=True))
        ads = ADS[model](**{**parameters, **own})
        alone = drive_and_score(replace(system, ads=ads), settings[:1])
        different = differences(together.take([row]).results, alone.results)
        assert not list(different), own


@SLOW
@pytest.mark.parametrize("name", ["wear", "rain", "native", "euro_ncap_car_to_car"])
def test_nobody_needs_to_brake_in_any_of_forty_benign_scenes(name: str) -> None:
    system = assemble(
        sv.load_study(name, ads={"model": "aeb", "parameters": {"reach": 0.001}})
    )
    benign = replace(system, points=tuple(benign_scenes(sv.load_study(name), system)))
    assert len({scene.name for scene in benign.matrix}) == len(benign.matrix) >= 40
    for result in simulate_all_points(benign, system.characteristics.original[None]):
        assert not result.evaluations.collided[0], result.point.name
