"""Intervals, planes, joint factors and rules against regions that are known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings, strategies as st

from safevar_sumo import risk, rules, tolerance
from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.rules.compute import Rule, Rules
from safevar_sumo.analysis.tolerance import ToleranceOptions, boxes, compute
from safevar_sumo.analysis.tolerance.answer import Tolerance
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.analysis.tolerance.joint import JointLimits, find_joint_limits
from safevar_sumo.analysis.tolerance.scans import scan
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Limit, load_study
from tests.analysis.known_regions import Plant, Region, box, everywhere, made_up_study, nowhere, two_islands
from tests.in_process import run
from tests.made_up import case_of


def of(
    n: int,
    region: Region,
    pairs: bool = False,
    unsafe: str | None = "collision",
    failing: Region = nowhere,
    characteristics: Sequence[str] | None = None,
) -> Tolerance:
    study = made_up_study(n)
    return tolerance(
        study,
        unsafe=unsafe,
        pairs=pairs,
        characteristics=characteristics,
        pool=Plant(study, region, lambda rows: 8 - np.abs(rows[:, 0] - 5), failing),
    )


def test_islands_and_the_safe_interval_around_the_original() -> None:
    first, second = of(2, two_islands).alone
    assert first.safe == (0.0, pytest.approx(6.5, abs=1e-4))
    assert first.safe[1] <= 6.5
    assert first.unsafe[0][0] - first.safe[1] <= 1.001 * 0.05 / 4096, "a 4096th of the distance of two values"
    assert [pytest.approx(interval, abs=1e-4) for interval in [(6.5, 7.0), (9.0, 10.0)]] == first.unsafe
    assert first.margins == [pytest.approx(3.0), pytest.approx(6.5, abs=1e-3)]
    assert (second.safe, second.unsafe) == ((0.0, 10.0), [])
    assert len(first.profile) > 201


@pytest.mark.slow
@settings(max_examples=30)
@given(ends=st.lists(st.floats(0, 10), min_size=2, max_size=2).map(sorted))
def test_any_interval_is_found_that_is_as_wide_as_two_values_are_apart(ends: list[float]) -> None:
    low, high = ends
    (alone,) = of(1, lambda rows: (rows[:, 0] >= low) & (rows[:, 0] <= high)).alone
    if high - low > 0.05:
        assert alone.unsafe == [(pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))]
    if low <= 5 <= high:
        assert alone.safe is None
    elif high - low > 0.05:
        assert alone.safe == ((0.0, pytest.approx(low, abs=1e-4)) if low > 5 else (pytest.approx(high, abs=1e-4), 10.0))


def test_a_plane_with_a_box_in_its_corner() -> None:
    result = of(3, box, pairs=True)
    assert result.pairs is not None
    shares = {tuple(pair.characteristics): pair.unsafe_share for pair in result.pairs}
    assert shares == {("a", "b"): pytest.approx(0.09, abs=0.02), ("a", "c"): 0, ("b", "c"): 0}
    first = result.pairs[0]
    assert first.nearest == {"a": pytest.approx(7, abs=0.5), "b": pytest.approx(3, abs=0.5)}
    assert box(np.array([list(first.nearest.values())]))[0]
    assert result.pairs[1].nearest is None
    assert result.verdict == "No single characteristic makes it unsafe, but 1 of 3 pairs: a with b."


@pytest.mark.parametrize(
    ("region", "n", "factor"),
    [
        (box, 2, 0.4),
        (two_islands, 3, 0.3),
        (nowhere, 4, 1.0),
        (everywhere, 2, 0.0),
        (lambda rows: np.sum(rows - 5, axis=1) > 12, 4, 0.6),  # a corner of all four, which no pair reaches
    ],
)
def test_the_joint_factor_ends_before_what_is_unsafe(region: Region, n: int, factor: float) -> None:
    result = of(n, region).joint
    assert result.factor == pytest.approx(factor, rel=0.02)
    assert result.factor <= factor
    if factor:
        error = 0.05 / 2**result.attempts
        assert result.unsafe_at_most == pytest.approx(1 - error ** (1 / result.samples))
        assert result.unsafe_at_most <= 0.003


def test_what_cannot_be_simulated_is_neither_safe_nor_unsafe() -> None:
    result = of(2, two_islands, pairs=True, failing=lambda rows: (rows[:, 0] > 5.75) & (rows[:, 0] < 6.75))
    first = result.alone[0]
    assert first.safe == (0.0, pytest.approx(5.75, abs=1e-4))
    assert first.intervals("not_simulated") == [(pytest.approx(5.75, abs=1e-4), pytest.approx(6.75, abs=1e-4))]
    assert first.unsafe == [
        (pytest.approx(6.75, abs=1e-4), pytest.approx(7, abs=1e-4)),
        (pytest.approx(9, abs=1e-4), 10.0),
    ]
    assert result.pairs is not None
    assert result.pairs[0].not_simulated_share == pytest.approx(0.1, abs=0.026)
    assert result.pairs[0].unsafe_share == pytest.approx(1.25 / 9, abs=0.06)
    box = result.joint
    assert box.factor == pytest.approx(0.35, rel=0.02), "3.25 to 6.75, of which 1 could not be simulated"
    assert box.failed / box.samples == pytest.approx(1 / 3.5, abs=0.03)
    exact = scipy.stats.binomtest(box.failed, box.samples, alternative="less").proportion_ci(
        1 - 0.05 / 2**box.attempts, method="exact"
    )
    assert box.unsafe_at_most == pytest.approx(exact.high)


def test_the_box_holds_no_unsafe_solution_of_a_search() -> None:
    """A sliver that begins half of the way to the domain's end; no scan, no random setting and no corner of the domain
    hits it.
    """

    def sliver(rows: FloatArray) -> BoolArray:
        return np.asarray(
            (np.abs(rows[:, 0] - rows[:, 1]) < 0.001) & (rows[:, 0] > 7) & (np.abs(rows[:, 2:] - 2).max(axis=1) < 0.5)
        )

    study = made_up_study(4)
    pool = Plant(study, sliver)
    found = pool.evaluate(np.array([[8.5, 8.5, 2.0, 2.2], [5.0, 5.0, 5.0, 5.0]]))
    case = case_of(study, found.take([1]), found)
    bare, known, two = (
        find_tolerances(subject, ToleranceOptions(unsafe=unsafe, characteristics=names), Evaluator(study, pool))
        for subject, unsafe, names in ((study, "collision", None), (case, None, None), (case, None, ("a", "b")))
    )
    assert bare.joint.factor == pytest.approx(1, abs=0.01)
    assert str(known.unsafe) == "collision", "as the solutions do, and as `explain` takes it"
    assert 0.49 < known.joint.factor < 0.5
    assert two.joint.factor == 1, "the solution changes others as well"


@pytest.mark.slow
def test_the_bound_of_the_box_holds_where_every_box_is_as_unsafe(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unsafe: where digits of the logarithm of a change are below q. The share is q in every box: any box with a bound
    below q is wrong.

    Boxes that are drawn anew until a sample of one has no unsafe setting would all be wrong. The search is switched
    off: it would find that out before the tests do.
    """
    for name, value in (
        ("FIRST_SEARCH_POINTS", 1),
        ("SECOND_SEARCH_POINTS", 1),
        ("MIN_FACTOR", 1e-3),
        ("MAX_UNSAFE_SHARE", 0.03),
    ):
        monkeypatch.setattr(boxes, name, value)
    q, wrong, seeds, study = 0.031, 0, 100, made_up_study(2)
    for seed in range(seeds):
        seeded = load_study(study, search={"seed": seed})
        evaluator = Evaluator(seeded, Plant(seeded, lambda rows: np.log(np.abs(rows[:, 0] - 5) + 1e-99) * 1e6 % 1 < q))
        result = boxes.find_safe_box(evaluator, [0, 1], Unsafe(), np.zeros((0, 2)), np.zeros((0, 2)))
        wrong += result.unsafe_at_most < q
    assert 0 < wrong <= 0.05 * seeds


def test_the_promised_record() -> None:
    record = json.loads(json.dumps(of(2, two_islands, pairs=True).to_dict(), allow_nan=False))
    assert list(record) == ["study", "unsafe", "alone", "pairs", "joint"]
    keys = ["characteristic", "unit", "original", "safe", "unsafe", "not_simulated", "across_fits"]
    assert list(record["alone"][0]) == keys
    assert list(record["pairs"][0]) == ["characteristics", "unsafe_share", "not_simulated_share", "nearest"]
    assert list(record["pairs"][0]["nearest"]) == ["a", "b"]
    assert list(record["joint"]) == [
        "factor",
        "confidence",
        "samples",
        "failed",
        "attempts",
        "unsafe_at_most",
        "characteristics",
    ]


def rules_of(region: Region, n: int = 4, **options: Any) -> Rules:
    study = made_up_study(n)
    return rules(study, unsafe="collision", pool=Plant(study, region), **options)


def test_a_box_is_one_rule_of_its_two_conditions() -> None:
    result = rules_of(box)
    (rule,) = result.rules
    assert rule.limits == {"a": (pytest.approx(7, abs=0.02), None), "b": (None, pytest.approx(3, abs=0.02))}
    assert rule.density == pytest.approx(1, abs=0.02)
    assert rule.coverage == pytest.approx(1, abs=0.02)
    assert result.unsafe_share == pytest.approx(0.09, abs=0.005)
    assert rule.density_interval is not None
    assert rule.density_interval[0] <= rule.density <= rule.density_interval[1]


def test_nothing_everything_and_too_little() -> None:
    assert rules_of(nowhere).to_dict() == []
    (rule,) = rules_of(everywhere).rules
    assert (dict(rule.limits), rule.density, rule.coverage) == ({}, 1.0, 1.0)
    few = rules_of(lambda settings: (settings > 9.5).all(axis=1), n=2, samples=400)
    assert few.rules == []
    assert "the command rules --samples N" in few.remark


def test_a_rule_is_denser_than_a_share_below_its_interval() -> None:
    """8 of 10: Clopper and Pearson have 44.4 to 97.5 %."""
    rule = Rule({"a": (7.0, None)}, 0.8, 0.4, clopper_pearson(8, 10), clopper_pearson(8, 20))
    assert rule.density_interval == pytest.approx((0.444, 0.975), abs=5e-4)
    assert [rule.is_denser_than(share) for share in (0.4, 0.5, 0.9)] == [True, False, False]


def test_the_promised_record_and_the_same_again() -> None:
    first, again = (rules_of(box), rules_of(box))
    assert json.dumps(first.to_dict(), allow_nan=False) == json.dumps(again.to_dict(), allow_nan=False)
    (record,) = first.to_dict()
    assert list(record) == ["conditions", "density", "coverage", "density_interval", "coverage_interval"]
    assert list(record["conditions"][0]) == ["characteristic", "at_least", "at_most"]


@pytest.mark.parametrize("constraint", [None, {"sum": {"a": 1.0, "b": 1.0}, "at_most": 12.0}])
def test_the_share_of_unsafe_vehicles_is_that_of_risk(constraint: dict[str, Any] | None) -> None:
    """The same vehicles in both, the first ones of a longer sequence in a shorter one: each estimate lies in the
    other's interval.
    """
    study = made_up_study(2)
    study = load_study(study, constraints=[constraint]) if constraint else study
    asked = {number: Plant(study, box) for number in (400, 1000)}
    shares = {number: rules(study, unsafe="collision", pool=pool, samples=number) for number, pool in asked.items()}
    estimate = risk(study, unsafe="collision", pool=(plant := Plant(study, box)), samples=1000, method="monte_carlo")
    assert asked[400].seen < asked[1000].seen <= plant.seen
    assert (shares[1000].unsafe_share, shares[1000].unsafe_interval) == (
        estimate.probability,
        pytest.approx(estimate.interval),
    )
    for one, other in ((400, 1000), (1000, 400)):
        low, high = shares[one].unsafe_interval
        assert low < shares[other].unsafe_share < high


LINEAR = np.array([1.0, 2.0, 3.0])
"""Weights of a region whose largest box has sides at 10, 7.5 and 5."""


def box_of(n: int, region: Region, limits: dict[str, Limit], known: Sequence[Sequence[float]] = ()) -> JointLimits:
    study = made_up_study(n)
    evaluator = Evaluator(study, Plant(study, region))
    columns, criterion = list(range(n)), Unsafe()
    scans = scan(evaluator, columns, criterion)
    ends = [{one.characteristic.name: end} for one in scans for interval in one.unsafe for end in interval]
    unsafe_settings = compute.settings_of(evaluator.characteristics, ends)
    rows = np.array(known, dtype=float).reshape(-1, n)
    return find_joint_limits(evaluator, columns, criterion, limits, scans, unsafe_settings, rows)


def relative_volume(box: JointLimits) -> float:
    return float(np.prod([(high - low) / 10 for low, high in box.box.values()]))


@pytest.mark.parametrize(("limits", "largest"), [({}, 0.375), ({"c": Limit(at_most=7)}, 0.315)])
def test_the_box_with_limits_is_nearly_the_largest(limits: dict[str, Limit], largest: float) -> None:
    box = box_of(3, lambda rows: (rows - 5) @ LINEAR > 10, limits)
    assert box.kept
    assert 0.97 * largest < relative_volume(box) <= largest
    assert (np.array([high for _, high in box.box.values()]) - 5) @ LINEAR <= 10
    assert box.at_most == pytest.approx(1 - (0.05 / 2) ** (1 / box.samples))
    assert all(box.box[name][1] == limit.at_most for name, limit in limits.items())


def test_limits_that_a_region_breaks_are_not_kept_and_are_counted() -> None:
    box = box_of(2, lambda rows: rows[:, 0] > 7, {"a": Limit(at_most=9)})
    assert not box.kept
    assert box.box == {"a": (5.0, 9.0), "b": (5.0, 5.0)}
    assert box.unsafe / box.samples == pytest.approx(0.5, abs=0.05)
    assert box.at_most > box.unsafe / box.samples


def test_the_box_with_limits_holds_no_known_solution() -> None:
    box = box_of(3, nowhere, {"a": Limit(at_most=8)}, known=[[7.0, 8.0, 9.0]])
    assert box.known_unsafe_inside == 0
    assert any(high < value for (_, high), value in zip(box.box.values(), (7.0, 8.0, 9.0), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "code"), [("5", 0), ("4.6", 3)])
def test_a_limit_that_is_not_kept_ends_with_code_3(tmp_path: Path, limit: str, code: int) -> None:
    study = tmp_path / "mine.toml"
    study.write_text(f'extends = "native"\n[limits]\ndecel = {{ at_least = {limit}, source = "workshop" }}\n')
    flags = ("--characteristics", "decel,brakeGain", "--jobs", "1", "--json")
    done = run("tolerance", str(study), *flags, expect=code)
    _, decel, gain, joint = json.loads(done.stdout)
    keys = "characteristic unit original alone together specified kept margin first_failure"
    specified, low = decel["limit"], float(limit)
    assert list(specified) == keys.split()
    assert specified["specified"] == {"low": low, "high": None, "source": "workshop"}
    assert specified["margin"] == pytest.approx(low - specified["alone"][0])
    assert [specified["kept"], joint["joint"]["kept"], gain["limit"]["kept"]] == [code == 0, code == 0, True]
    keys = "fixed box samples unsafe at_most known_unsafe_inside kept"
    assert list(joint["joint"]) == keys.split()
    assert joint["joint"]["box"]["decel"][0] == low
    assert ("failed: limit of decel: outside by" in done.stderr) == (code == 3)


def test_a_trade_follows_the_line_between_safe_and_unsafe() -> None:
    """Unsafe: (a - 5) + 2 (b - 5) + 3 (c - 5) > 6; c up to 6 takes 3 of the 6."""
    study = made_up_study(3)

    def answer(**options: Any) -> Tolerance:
        pool = Plant(study, lambda rows: (rows - 5) @ LINEAR > 6)
        return tolerance(study, unsafe="collision", pool=pool, **options)

    plain, free, held = answer(), answer(trade=["b", "a"]), answer(trade=["b", "a"], limits=["c <= 6", "a <= 5.5"])
    for result, room, last in ((free, 6.0, 8.0), (held, 3.0, 6.5)):
        assert result.trade is not None
        values = list(result.trade.curve)
        assert (values[0], values[-1], len(values)) == (0.0, pytest.approx(last, abs=1e-4), 11)
        assert 5.0 in values
        for value, ends in result.trade.curve.items():
            assert ends == (0.0, pytest.approx(min(10.0, 5 + room - 2 * (value - 5)), abs=1e-4))
    record = free.to_dict()
    assert list(record.pop("trade")) == ["characteristics", "units", "fixed", "curve"]
    assert json.dumps(record, allow_nan=False) == json.dumps(plain.to_dict()), "all else stays"
    assert held.trade is not None
    assert held.trade.to_dict()["fixed"] == {"c": [None, 6.0]}
    assert [str([*column.cells][-1]) for column in held.trade.table().columns] == ["6.5", "0.0*", "5.0"]
    assert held.figure().axes[0].get_xlabel() == "b [N m]"


@pytest.mark.parametrize("names", ["a", "a,b,c", "a,a", "a,wheel", ""])
def test_a_trade_needs_two_characteristics(names: str) -> None:
    with pytest.raises(InputError, match=r"^trade: "):
        tolerance(made_up_study(3), trade=names.split(","), pool=Plant(made_up_study(3), nowhere))
