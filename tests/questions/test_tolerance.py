"""Intervals and boxes against regions that are known; printed limits against simulations."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy
from hypothesis import given, settings, strategies as st

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.box import Box, Judgement, prove
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.tables import reader_columns, tabulate
from safevar_sumo.questions.tolerance import together
from safevar_sumo.questions.tolerance.alone import AloneLimit
from safevar_sumo.questions.tolerance.rows import LIMITS, uncertainty_rows
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan, scan
from safevar_sumo.questions.tolerance.words import one_set_in_words
from safevar_sumo.questions.words import bound_in_words
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import CharacteristicSet, region_of
from tests.in_process import InlinePool, run
from tests.made_up import case_of
from tests.manual import ROOT
from tests.questions.conftest import Plant, Region, made_up_study, nowhere, two_islands

SLOW = pytest.mark.slow


def degrees(rows: FloatArray) -> FloatArray:
    return 8 - np.abs(rows[:, 0] - 5)


def scans_of(n: int, region: Region, failing: Region = nowhere) -> list[OneAtATimeScan]:
    study = made_up_study(n)
    return scan(Evaluator(study, Plant(study, region, degrees, failing)), range(n), Unsafe())


def answer_of(n: int, region: Region, failing: Region = nowhere, **options: Any) -> Answer:
    study = made_up_study(n)
    return tolerance(study, pool=Plant(study, region, degrees, failing), **options)


def test_islands_and_the_safe_interval_around_the_original() -> None:
    first, second = scans_of(2, two_islands)
    unsafe = first.of_state("unsafe")
    assert first.safe == (0.0, pytest.approx(6.5, abs=1e-4))
    assert first.safe[1] <= 6.5
    assert unsafe[0][0] - first.safe[1] <= 1.001 * 0.05 / 4096, (
        "a 4096th of the distance of two values"
    )
    assert [pytest.approx(interval, abs=1e-4) for interval in [(6.5, 7.0), (9.0, 10.0)]] == unsafe
    assert [first.degree(end) for end in first.safe] == [
        pytest.approx(3.0),
        pytest.approx(6.5, abs=1e-3),
    ]
    assert (second.safe, second.of_state("unsafe")) == ((0.0, 10.0), [])
    assert len(first.profile) > 201


@SLOW
@settings(max_examples=30)
@given(ends=st.lists(st.floats(0, 10), min_size=2, max_size=2).map(sorted))
def test_any_interval_is_found_that_is_as_wide_as_two_values_are_apart(ends: list[float]) -> None:
    low, high = ends
    (alone,) = scans_of(1, lambda rows: (rows[:, 0] >= low) & (rows[:, 0] <= high))
    if high - low > 0.05:
        assert alone.of_state("unsafe") == [
            (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))
        ]
    if low <= 5 <= high:
        assert alone.safe is None
    elif high - low > 0.05:
        assert alone.safe == (
            (0.0, pytest.approx(low, abs=1e-4))
            if low > 5
            else (pytest.approx(high, abs=1e-4), 10.0)
        )


@SLOW
def test_what_cannot_be_simulated_is_neither_safe_nor_unsafe() -> None:
    answer = answer_of(
        2, two_islands, lambda rows: (rows[:, 0] > 5.75) & (rows[:, 0] < 6.75), unsafe="collision"
    )
    frame = answer.tables["intervals"]
    first = frame[frame["characteristic"] == "a"].set_index("low")
    assert first["state"].tolist() == ["safe", "not_simulated", "unsafe", "safe", "unsafe"]
    assert first.index.tolist() == pytest.approx([0, 5.75, 6.75, 7, 9], abs=1e-4)
    assert first["high"].tolist() == pytest.approx([5.75, 6.75, 7, 9, 10], abs=1e-4)
    assert np.isnan(first["degree_low"].tolist()[1])
    samples, failed = answer.numbers["samples"], answer.numbers["not_simulated"]
    assert failed / samples > 0.05, "the box holds what could not be simulated"
    test = scipy.stats.binomtest(failed, samples, alternative="less")
    exact = [
        test.proportion_ci(1 - 0.05 / 2**number, method="exact").high for number in range(1, 14)
    ]  # of each test
    assert any(answer.numbers["at_most"] == pytest.approx(high) for high in exact)
    assert f"{failed} could not be simulated" in answer.tested


def test_a_search_that_gives_up_says_that_it_found_no_box(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(together, "MAX_BOXES", 1)
    answer = answer_of(2, two_islands, unsafe="collision", limits=("b <= 8",))
    assert answer.verdict.startswith(
        "The specified limits hold with all other characteristics as in the original. No joint"
    )
    assert "That is no proof that there are none." in answer.verdict
    assert answer.tables["limits"]["together_low"].isna().all()
    assert [answer.numbers[name] for name in ("box", "boxes", "kept", "attacked")] == [
        False,
        0,
        True,
        None,
    ]
    assert not answer.failures, "no limit is broken"
    assert answer.values("limits.sentence") == [
        "A: no joint limits were found.",
        "B: no joint limits were found.",
    ]


def test_the_box_holds_no_unsafe_solution_of_a_search() -> None:
    """A sliver that begins half of the way to the domain's end; no scan, no random setting and no
    corner of the domain hits it.
    """

    def sliver(rows: FloatArray) -> BoolArray:
        return (
            (np.abs(rows[:, 0] - rows[:, 1]) < 0.001)
            & (rows[:, 0] > 7)
            & (np.abs(rows[:, 2:] - 2).max(axis=1) < 0.5)
        )

    study = made_up_study(4)
    pool = Plant(study, sliver)
    found = pool.evaluate(np.array([[8.5, 8.5, 2.0, 2.2], [5.0, 5.0, 5.0, 5.0]]))
    case = case_of(study, found.take([1]), found)
    bare, known, two = (
        tolerance.compute(subject, Evaluator(study, pool), unsafe=unsafe, characteristics=names)
        for subject, unsafe, names in (
            (study, Unsafe(), ()),
            (case, None, ()),
            (case, None, ("a,b",)),
        )
    )
    assert known.numbers["unsafe"] == "collision", "as the solutions do, and as `explain` takes it"
    assert share_of_domain(bare) == pytest.approx(1, abs=0.02)
    assert 0.8 < share_of_domain(known) < 0.9, "the largest box ends before 8.5"
    assert share_of_domain(two) == 1, "the solution changes others as well"


@SLOW
def test_the_bound_of_the_box_holds_where_every_box_is_as_unsafe() -> None:
    """Unsafe: where digits of the logarithm of a change are below q. The share is q in every box:
    any box with a bound below q is wrong.

    Boxes that are drawn anew until a sample of one has no unsafe setting would all be wrong.
    """
    q, wrong, seeds, region = 0.031, 0, 100, region_of(made_up_study(2))

    def judge(settings: FloatArray) -> Judgement:
        is_unsafe = np.log(np.abs(settings[:, 0] - 5) + 1e-99) * 1e6 % 1 < q
        return Judgement(is_unsafe, np.zeros_like(is_unsafe), np.ones_like(is_unsafe))

    for seed in range(seeds):
        for attempt in range(1, 12):
            box = Box(region, np.full(2, attempt / 3), np.full(2, 10 - attempt / 3))
            rng = np.random.default_rng((seed, attempt))
            proof, found = prove(
                lambda number, box=box, rng=rng: box.draw(number, rng), judge, 0.03, attempt
            )
            if not len(found):
                wrong += proof.at_most < q
                break
    assert 0 < wrong <= 0.05 * seeds


def test_the_bound_of_a_first_test_without_failure_is_one_sided() -> None:
    none = np.zeros(1228, dtype=bool)
    proof, _ = prove(
        lambda number: np.zeros((number, 2)), lambda _: Judgement(none, none, ~none), 0.003, 1
    )
    assert (1 - proof.at_most) ** 1228 == pytest.approx(0.05)
    assert bound_in_words(proof.at_most) == "with 95 % confidence at most 0.244 %"


def share_of_domain(answer: Answer) -> float:
    """The volume of the box as a share of the domain's."""
    limits = answer.tables["limits"]
    return float(((limits["together_high"] - limits["together_low"]) / 10).prod())


def test_a_specified_limit_is_shown_and_every_limit_has_its_line_in_the_figure() -> None:
    answer = answer_of(2, two_islands, unsafe="collision", limits=("b <= 8",))
    assert "up to 8" in answer.render("text")
    (axis,) = answer.figure().get_axes()
    assert len(axis.get_yticks()) == len(answer.tables["limits"])


def test_limits_that_other_fits_move_are_uncertain() -> None:
    """Brake torque: from 0.5301, inwards 0.54, with the own fit, and from 0.58 with all; the
    tread's limit stays.
    """
    tread, torque, *_ = CharacteristicSet.of(load_study("wear"))
    scans: list[Any] = [
        SimpleNamespace(characteristic=tread, safe=(1.6, 8.0)),
        SimpleNamespace(characteristic=torque, safe=(0.5301, 1.0)),
    ]
    alone = [AloneLimit(scans[0], (1.6, 8.0)), AloneLimit(scans[1], (0.58, 1.0))]
    assert uncertainty_rows(alone) == [("brakeTorque", "-", 0.54, 1.0, 0.58, 1.0)]


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("a <= 6.8", "Do not release: a 6.8 N m: the car hits"),
        (
            "a <= 6.812",
            (
                "Do not release: a 6.812 N m: the car hits a crossing pedestrian at 3.6 km/h"
                " (outside by 0.312 N m)"
            ),
        ),
        ("a <= 8", "Do not release: a 6.6 N m: the car hits"),
        (
            "a <= 6",
            ("All limits hold: no vehicle that was tested within them is unsafe (collision)."),
        ),
    ],
)
def test_the_verdict_decides_on_the_limits(limit: str, said: str) -> None:
    """Unsafe: from 6.5 to 7, and from 9 on; a limit on the safe island between lets what is unsafe
    in, too.
    """
    answer = answer_of(2, two_islands, unsafe="collision", limits=(limit,))
    assert answer.verdict.startswith(said)
    assert bool(answer.failures) == (not answer.numbers["kept"]) == said.startswith("Do not")


@SLOW
def test_the_car_beyond_a_joint_limit_is_near_to_it_and_within_those_of_the_other_parts() -> None:
    """Of the response no such car is found; that of its limit alone is 0.1 s further."""
    names = ("brakeTorque", "brakeResponse")
    answer = tolerance("autoware_july", characteristics=names, pool=InlinePool())
    table = answer.tables["limits"].set_index("characteristic")
    members = answer.study.domains
    cars = table["fails_at"].dropna()
    assert len(cars)
    for name, car in cars.items():
        (other,) = {*names} - {name}
        assert table.loc[other, "together_low"] <= car[other] <= table.loc[other, "together_high"]
        low, high = table.loc[name, ["together_low", "together_high"]]
        beyond = max(low - car[name], car[name] - high) / (
            members[name].upper - members[name].lower
        )
        assert 0 < beyond < 0.05, name


def test_a_refusal_says_which_limits_would_hold() -> None:
    answer = answer_of(
        2,
        lambda rows: rows[:, 0] + rows[:, 1] > 15,
        unsafe="collision",
        limits=("a <= 9", "b <= 8"),
    )
    first, second = answer.to_dict()["tables"]["nearest"]["rows"]
    assert [first["nearest"], second["nearest"]] == [
        pytest.approx(6.95, abs=0.06),
        pytest.approx(5.95, abs=0.06),
    ]
    assert answer.numbers["kept"] is False
    assert re.search(
        r"A limit that would hold instead: a [67][.\d]* N m or b [56][.\d]* N m, if the other"
        r" specified limits stay",
        answer.verdict,
    )


@SLOW
@pytest.mark.parametrize(("limit", "code"), [("5", 0), ("4.6", 3)])
def test_a_limit_that_is_not_kept_ends_with_code_3(tmp_path: Path, limit: str, code: int) -> None:
    study = tmp_path / "mine.toml"
    study.write_text(
        f'extends = "native"\n[limits]\ndecel = {{ at_least = {limit}, source = "workshop" }}\n'
    )
    flags = ("--characteristics", "decel,brakeGain", "--margin", "0", "--jobs", "1", "--json")
    done = run("tolerance", str(study), *flags, expect=code)
    answer = json.loads(done.stdout)
    decel, gain = answer["tables"]["limits"]["rows"]
    assert (decel["specified_low"], decel["specified_high"]) == (float(limit), None)
    assert [decel["kept"], answer["numbers"]["kept"], gain["kept"]] == [code == 0, code == 0, None]
    fails = "Do not release: decel 4.6 m/s^2: the car hits a standing vehicle"
    assert (fails in answer["verdict"]) == (code == 3)
    assert "failed:" not in done.stderr, "what the verdict says"
    assert decel["together_low"] == (float(limit) if code == 0 else None)


@SLOW
def test_the_margin_is_added_to_a_collision_alone() -> None:
    """Safety degrees are 8 - |a - 5|, and 1 m less than 5 m is left from a = 8 on."""

    def ends(**options: Any) -> tuple[str, float, Any]:
        study = made_up_study(1)
        pool = Plant(study, lambda rows: rows[:, 0] > 9, lambda rows: 8 - np.abs(rows[:, 0] - 5))
        answer = tolerance(study, pool=pool, **options)
        return (
            answer.numbers["unsafe"],
            answer.numbers["margin"],
            answer.tables["limits"]["alone_high"][0],
        )

    assert ends() == ("collision", 0.446, 9.0), "the error of the study's model"
    assert ends(margin=5) == ("collision", 5, 8.0)
    assert ends(margin=0) == ("collision", 0, 9.0)
    assert ends(unsafe="collision") == ("collision", 0, 9.0), "as it stands"
    assert ends(unsafe="collision", margin=5) == ("collision", 5, 8.0)
    assert ends(unsafe="below=4.5") == ("below=4.5", 0, 8.5)
    assert ends(unsafe="safety_degree < 4.5") == ("safety_degree < 4.5", 0, 8.5)
    with pytest.raises(InputError, match=r"5 m beside 'below=4\.5'"):
        ends(unsafe="below=4.5", margin=5)


def test_an_unsafe_original_keeps_no_limit_and_says_what_it_has() -> None:
    for limits in ((), ("a <= 6",)):
        answer = answer_of(2, nowhere, unsafe="safety_degree < 8.5", limits=limits)
        refusal = (
            "he original vehicle itself has a safety degree of 8 m, below 8.5 m: no limit can be"
            " kept"
        )
        assert answer.failures == (f"t{refusal}",), "a limit is not blamed"
        assert answer.verdict.startswith(
            f"T{refusal}. Ask again with a weaker criterion (--unsafe)."
        )
        assert answer.numbers["kept"] is False
        assert answer.tables["limits"]["kept"].tolist() == (
            [False, None] if limits else [None, None]
        )


@pytest.mark.parametrize(
    ("study", "left_out", "is_said"),
    [("wear", (), True), ("native", (), False), ("wear", (3,), False)],
)
def test_a_verdict_says_that_other_parameter_sets_of_a_study_were_not_tried(
    study: str, left_out: tuple[int, ...], is_said: bool
) -> None:
    model: Any = SimpleNamespace(evaluator=SimpleNamespace(study=load_study(study)))
    assert [*one_set_in_words([model, model], left_out)] == []
    assert ("not tried" in " ".join(one_set_in_words([model], left_out))) is is_said


def test_the_manual_names_the_columns_of_limits_that_text_may_leave_out() -> None:
    """They are shown where they have a value, and no other column is ever left out."""
    values = {name: "any" for name in LIMITS}
    always = {name: values[name] for name in ("characteristic", "unit", "original")}
    shown, fewest = (
        {column.head for column in reader_columns(tabulate("", LIMITS, pd.DataFrame([row])))}
        for row in (values, dict.fromkeys(LIMITS) | always)
    )
    table = (ROOT / "docs/tolerance.md").read_text().partition("empty in every row where")[2]
    assert shown - fewest == {*re.findall("`([^`]+)`", table.partition("\n\n")[0])}
