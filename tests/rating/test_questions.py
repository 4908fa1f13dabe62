"""Tolerance, explain, report and the summary of a rated study, in a protocol of two matrices,
computed in this process.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace as replace_in

from safevar_sumo.api.simulation import load_study
from safevar_sumo.api.study import _verdict
from safevar_sumo.check import check_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol import EURO_NCAP_2026, protocol_of, rater
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import explain
from safevar_sumo.questions.explain.failures import compare_at_cells
from safevar_sumo.questions.tolerance import tolerance
from safevar_sumo.questions.tolerance.scans import scan
from safevar_sumo.sumo.system import assemble
from tests.in_process import InlinePool, json_of
from tests.made_up import case_of, original_of
from tests.sumo.test_recording import still as still

SLOW = pytest.mark.slow

STUDY = load_study("euro_ncap_rating")
WHOLE = protocol_of(EURO_NCAP_2026)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """CCRs at 10, 50 and 80 km/h, and CPNA by day and night at 50 km/h."""
    matrices = []
    for matrix in WHOLE.matrices:
        speeds = {"CCRs": (10, 50, 80), "CPNA": (50,)}.get(matrix.test_name, ())
        rows = tuple(row for row in matrix.rows if row.vut_speed in speeds)
        if rows:
            matrices.append(replace_in(matrix, rows=rows))
    layers = tuple(
        layer
        for layer in WHOLE.layers
        if layer.test_name in ("CCRs", "CPNA") and layer.name not in ("Trajectory/Heading",)
    )
    protocol = replace_in(WHOLE, matrices=tuple(matrices), layers=layers)
    monkeypatch.setattr(rater, "protocol_of", lambda name: protocol)


@SLOW
def test_what_is_shipped_passes_the_check() -> None:
    assert not check_study(load_study("euro_ncap_rating"))


@SLOW
def test_brakes_cost_points_one_by_one_and_the_first_loss_is_named() -> None:
    evaluator = Evaluator(STUDY, InlinePool(2))
    answer = tolerance.compute(
        STUDY, evaluator, characteristics=("brakeTorque",), unsafe=Unsafe.parse("points=4")
    )
    column = list(evaluator.characteristics.names).index("brakeTorque")
    (alone,) = scan(evaluator, [column], Unsafe.parse("points=4"))
    points = alone.profile.set_index("value")["rating_points"]
    assert points[1.0] == points.max() > points[0.5]
    first = alone.first_loss()
    assert points[first] < points[1.0]
    assert (points[points.index > first] == points[1.0]).all()
    (lost,) = answer.tables["points"].to_dict("records")
    assert (lost["any_lost"], lost["least_points"]) == (first, points.min())
    assert lost["first_point_lost"] <= first
    (row,) = answer.tables["limits"].to_dict("records")
    assert (row["sentence"], row["together_low"]) == (None, None)
    assert answer.figure().get_axes()


@SLOW
def test_explain_names_the_cells_of_a_worse_colour_and_a_study_the_points_kept() -> None:
    evaluator = Evaluator(STUDY, InlinePool(2))
    members = evaluator.characteristics
    settings = np.array(
        [members.setting({"brakeTorque": value, "payload": 200.0}) for value in (0.5, 0.6)]
    )
    original, evaluations = evaluator.evaluate_original(), evaluator.evaluate(settings, "it")
    case = case_of(STUDY, original, evaluations)
    points = float(original.column("rating_points")[0])
    assert points > evaluations.column("rating_points")[1]
    unsafe = Unsafe.parse(f"points={points - 1e-3!r}")
    answer = explain.compute(case, evaluator, solution=("nsga2:0:0",), unsafe=unsafe)
    (failure,) = answer.tables["solutions"].to_dict("records")
    assert failure["points"]
    assert all(name.startswith(("CCRs", "CPNA")) for name in failure["points"])
    assert [sorted(changes) for changes in answer.tables["causes"]["changes"]] == [["brakeTorque"]]
    assert [answer.numbers[name] for name in ("collisions", "avoidable", "unavoidable")] == [
        None
    ] * 3
    results = SimpleNamespace(case=case, study=case.study, directory="results")
    verdict, _ = _verdict(results, replace(case, stated=unsafe), None)
    assert "With 1 change, the fewest that were found, the vehicle earns " in verdict
    assert "brakeTorque 1 -> 0." in verdict


def test_only_cells_of_a_worse_colour_explain_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither cells of a better colour nor cells of an unknown colour, of either vehicle, count as
    worse.
    """
    evaluator, matrix = Evaluator(STUDY, InlinePool(2)), assemble(STUDY).matrix
    colours = np.zeros((2, len(matrix)), dtype=np.int8)
    colours[:, :5] = [
        [0, 2, -1, 1, 0],
        [1, 0, 4, -1, 3],
    ]  # worse, better, unknown before, unknown after, worst
    monkeypatch.setattr(Evaluator, "at_each_point", lambda self, settings, stage: None)
    monkeypatch.setattr(rater.Rater, "points", lambda self, cells: SimpleNamespace(colours=colours))
    ((endings, worse_cells),) = compare_at_cells(evaluator, original_of(evaluator))
    assert worse_cells == (matrix[0].name, matrix[4].name)
    assert endings.startswith(f"At {matrix[4].name}: ")


@SLOW
def test_a_rating_begins_with_the_reason_and_a_robot_drives_who_does_nothing(still: str) -> None:
    rated = json_of("rating", still)
    assert rated["numbers"]["driven"] is (
        rated["numbers"]["points"] == 0
    )  # 0 points: everything collides
