"""Colours and points against the protocol's tables; a worse vehicle never earns more; equal
losses.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from safevar_sumo.api.simulation import load_study
from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, protocol_of
from safevar_sumo.protocol.rater import Points, Rater, colours_of, darken
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.rating import rate
from safevar_sumo.records import CellResults
from safevar_sumo.scenarios import WEATHERS
from safevar_sumo.vehicles import CharacteristicSet

STUDY = load_study("euro_ncap_rating")
PROTOCOL = protocol_of(EURO_NCAP_2026)
CELLS = PROTOCOL.cells
N = len(CELLS)
BANDS = {
    10: [0.01],
    20: [0.01],
    30: [None, None, 0.01, 10],
    40: [None, 0.01, 10, 20],
    50: [0.01, 10, 20, 30],
    130: [0.01, 10, 20, 30],
}
"""From which relative speed on a cell is yellow, orange, brown, red, by the speed of the vehicle
(protocol 5.2); one number: red alone.
"""


def results(impact: Any = np.nan, warning: Any = 2.0, vehicles: int = 1) -> CellResults:
    return CellResults(
        np.broadcast_to(impact, (vehicles, N)).astype(float),
        np.broadcast_to(warning, (vehicles, N)).astype(float),
        np.ones((vehicles, N), dtype=bool),
    )


def numbers(test: str, kind: str = "", light: str | None = None) -> list[int]:
    return [
        number
        for number, cell in enumerate(CELLS)
        if cell.matrix.test_name == test
        and (not kind or cell.range_or_layer == kind)
        and (light is None or cell.matrix.light == light)
    ]


def points_of(cells: CellResults, claims: dict[str, list[str]] | None = None) -> Points:
    return Rater(protocol=PROTOCOL, claims=claims or {}).points(cells)


@pytest.mark.parametrize("vut", BANDS)
def test_a_bound_belongs_to_the_worse_colour(vut: int) -> None:
    number = next(k for k in numbers("CCRb" if vut > 20 else "CCRs") if CELLS[k].vut_speed == vut)
    bounds = BANDS[vut] if len(BANDS[vut]) > 1 else [None, None, None, BANDS[vut][0]]
    for colour, bound in zip(COLOURS[1:], bounds, strict=True):
        if bound is not None:
            assert COLOURS[colours_of(PROTOCOL, results(bound))[0, number]] == colour
            assert COLOURS[colours_of(PROTOCOL, results(bound - 0.006))[0, number]] != colour


def test_a_warning_is_green_from_1_7_s_and_measured_values_have_two_decimals() -> None:
    (row,) = {
        CELLS[k].row
        for k in numbers("CBLA")
        if CELLS[k].judged_by == "warning" and CELLS[k].vut_speed == 70
    }
    number = next(k for k in numbers("CBLA", "standard") if CELLS[k].row == row)
    shown = [
        COLOURS[colours_of(PROTOCOL, results(50.0, warning))[0, number]]
        for warning in (1.7, 1.695, 1.694, np.nan)
    ]
    assert shown == ["green", "green", "red", "red"]


def test_avoiding_every_impact_earns_all_simulated_points_and_never_braking_none() -> None:
    whole = points_of(
        results(vehicles=2),
        {
            test: [one.name for one in PROTOCOL.layers_of(test) if not one.simulated_conditions]
            for test in PROTOCOL.tests
        },
    )
    assert whole.total.tolist() == [40.0, 40.0]
    assert sum(PROTOCOL.points_not_simulated.values()) + whole.total[0] == 100
    assert points_of(results(60.0, np.nan)).total.tolist() == [0.0]


@pytest.mark.parametrize(
    ("good", "share"), [(16, 1), (15, 0.75), (12, 0.75), (11, 0.5), (8, 0.5), (7, 0)]
)
def test_the_extended_range_is_stepped(good: int, share: float) -> None:
    impact, extended = np.full(N, np.nan), numbers("CMRs", "extended")
    assert len(extended) == 16
    impact[extended[good:]] = 50.0
    assert points_of(results(impact)).tests["CMRs"][0, 1] == pytest.approx(0.15 * share)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0.5, 40))
def test_faster_impacts_never_gain_points_in_a_matrix(seed: int, share: float, more: float) -> None:
    """Where a layer asks for the colour of its cell or better, a cell that turns worse lowers what
    the layer must reach.
    """
    rng = np.random.default_rng(seed)
    impact = np.where(rng.random(N) < share, rng.uniform(0, 45, N), np.nan)
    worse = np.where(rng.random(N) < 0.3, np.nan_to_num(impact, nan=0.0) + more, impact)
    before, after = points_of(results(impact)), points_of(results(worse))
    for name in before.tests:
        assert (
            after.tests[name][0, :2] <= before.tests[name][0, :2] + 1e-12
        ).all() or before.fails[0]
        assert not after.fails[0] or (after.tests[name] == 0).all()


def test_a_weather_by_night_keeps_its_road_and_multiplies_both_visibilities() -> None:
    """Hard rain leaves 68 % of the visibility; low beams leave 75 % of these 68 %."""
    dark = darken(WEATHERS["hard_rain"])
    assert (dark.road_friction, dark.water, dark.light) == (0.59, 2.0, "night")
    assert dark.visibility == pytest.approx(0.68 * 0.75)
    assert darken(dark) == dark
    assert darken(WEATHERS["clear"]) == WEATHERS["night"]


def answer_about(*impacts: Any, claims: dict[str, list[str]] | None = None) -> Answer:
    """The answer about the original and a variant with worn tyres, from the impacts of both."""
    characteristics = CharacteristicSet.of(STUDY)
    vehicles = {
        "original": characteristics.original,
        "variant": characteristics.setting({"treadDepth": 3.0}),
    }
    cells = CellResults(
        *(np.concatenate(values) for values in zip(*map(results, impacts), strict=True))
    )
    return rate(
        STUDY,
        Rater(protocol=PROTOCOL, claims=claims or {}),
        dict([*vehicles.items()][: len(impacts)]),
        cells,
    )


def hits(cells: list[int], speed: float) -> Any:
    impact = np.full(N, np.nan)
    impact[cells] = speed
    return impact


def test_a_claim_is_shown_as_a_claim() -> None:
    table = answer_about(np.nan, claims={"CPNA": ["Type"]}).tables["tests"]
    assert table.set_index("test")["claimed_layers"].dropna().to_dict() == {
        "CPNA day": "Type",
        "CPNA night": "Type",
    }


def test_the_verdict_names_what_is_lost_and_where() -> None:
    answer = answer_about(np.nan, hits(numbers("CPNCO", "standard", "night"), 40.0))
    assert answer.verdict.startswith("With tread depth at 3 mm, the vehicle loses 1.")
    assert re.search(
        r"It loses most in CPNCO night: [\d.]+ points, from 10 km/h on\. Not comparable with an",
        answer.verdict,
    )
    equal = answer_about(np.nan, hits(numbers("CBNA") + numbers("CBFA"), 60.0))
    assert "It loses most in each of CBNA and CBFA: " in equal.verdict


def test_numbers_and_tables_say_the_same() -> None:
    answer = answer_about(np.nan, hits(numbers("CPNCO"), 40.0), claims={"CPNCO": ["Type"]})
    points, tests = answer.numbers, answer.tables["tests"]
    sums = tests.groupby("variant")[["points", "possible", "lost"]].sum()
    assert sums.loc["original"].tolist() == pytest.approx([points["points"], points["possible"], 0])
    assert sums["lost"]["variant"] == pytest.approx(points["lost"])
    assert answer.tables["vehicles"]["changes"].tolist() == [{}, {"treadDepth": 3.0}]
    assert points["possible"] + points["not_simulated"] == 100
    assert points["points"] + points["layers_not_simulated"] == pytest.approx(points["possible"])
    cells = answer.tables["cells"].query("variant == 'variant' and colour == 'red'")
    assert set(cells["test"]) == {"CPNCO day", "CPNCO night"}
    assert len(cells) == len(numbers("CPNCO"))
    failing = tests.set_index(["variant", "test"])["failing_layers"].dropna()
    assert set(failing.index) == {("variant", "CPNCO day"), ("variant", "CPNCO night")}
    json.dumps(answer.to_dict(), allow_nan=False)


def test_what_costs_everything_and_what_the_calculator_does_not_check_is_remarked() -> None:
    answer = answer_about(
        hits(numbers("CCRs", "standard"), 9.0), hits(numbers("CPNA", "standard"), 9.0)
    )
    remarks = answer.tables["vehicles"]["remark"]
    assert "earns nothing" in remarks[0]
    assert "does not check this" in remarks[1]
