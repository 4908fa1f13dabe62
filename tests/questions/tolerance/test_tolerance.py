"""Intervals and boxes against regions that are known; printed limits against simulations."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import scipy

from safevar_sumo import load_study, tolerance
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.bench import Bench
from safevar_sumo.questions.box import Box, prove
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.drives import Drives, Judged
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model, Models
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance import asked, boxes, words
from safevar_sumo.questions.tolerance.asked import (
    Asked,
    asked_of,
    effort_of,
    effort_of_few,
    usual_alone,
)
from safevar_sumo.questions.tolerance.boxes import Attack
from safevar_sumo.questions.tolerance.found import worst_of
from safevar_sumo.questions.tolerance.search import find_limits
from safevar_sumo.questions.words import bound_in_words
from safevar_sumo.questions.worlds import DrivenWorld
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import Limit, Study
from safevar_sumo.vehicles import region_of
from tests.support.in_process import SLOW, InlinePool, rows_of
from tests.support.made_up import case_of
from tests.support.made_up_studies import (
    Plant,
    Region,
    box as corner,
    drives_of,
    made_up_evaluator,
    made_up_model,
    made_up_study,
    nowhere,
    two_islands,
)

pytestmark = pytest.mark.usefixtures("made_up_studies")


def pair(rows: FloatArray) -> BoolArray:
    """a above 9 and b above 7."""
    return (rows[:, 0] > 9) & (rows[:, 1] > 7)


def degrees(rows: FloatArray) -> FloatArray:
    return 8 - np.abs(rows[:, 0] - 5)


def answer_of(
    n: int, region: Region, failing: Region = nowhere, **options: Any
) -> Answer:
    study = made_up_study(n)
    return tolerance(study, pool=Plant(study, region, degrees, failing), **options)


@SLOW
def test_limits_end_before_what_cannot_be_simulated_which_counts_in_the_bound() -> None:
    """In the box these are vehicles with b above 8 and a below 2: 7 % of the box."""

    def fails(rows: FloatArray) -> BoolArray:
        is_alone = (rows[:, 0] > 5.75) & (rows[:, 0] < 6.75)
        return is_alone | (rows[:, 1] > 8) & (rows[:, 0] < 2)

    answer = answer_of(2, two_islands, fails, unsafe="collision")
    first = answer.tables["limits"].set_index("characteristic").loc["a"]
    assert (first["alone_low"], first["alone_high"]) == (
        0,
        pytest.approx(5.75, abs=0.06),
    )
    assert first["together_high"] <= 5.75
    samples, failed = answer.numbers["samples"], answer.numbers["not_simulated"]
    assert failed / samples == pytest.approx(0.2 * 2 / 5.75, abs=0.03)
    test = scipy.stats.binomtest(failed, samples, alternative="less")
    high = test.proportion_ci(1 - 0.05 / 2, method="exact").high
    assert answer.numbers["at_most"] == pytest.approx(high)
    assert f"{failed} of these sampled vehicles could not" in answer.tested
    assert "a can make" not in answer.verdict, "nobody knows"


def test_a_search_that_gives_up_says_that_it_found_no_box(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(boxes, "MOST_CUTS", 0)
    answer = answer_of(2, pair, unsafe="collision", limits=("b <= 8",))
    assert answer.verdict.startswith(
        "The specified limits hold if all other characteristics are as in the original vehicle. No"
    )
    assert "Other joint limits may exist" in answer.verdict
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


def test_a_quick_answer_ends_limits_at_failures_and_keeps_to_what_its_bar_announced() -> (
    None
):
    """Smaller values of a and b are no worse, and c does nothing: these ends have no limit. A quick
    answer simulates at most an eighth of the usual 15,000 + 80,000.
    """
    shown = list[int]()
    answer = answer_of(
        3,
        lambda rows: np.maximum(rows - 5, 0) @ [1, 0.5, 0] > 4,
        unsafe="collision",
        quick=True,
        progress=lambda _, done, total: shown.extend((done, total)),
    )
    limits = answer.tables["limits"].set_index("characteristic")
    high = limits["together_high"]
    assert limits["together_low"].tolist() == [0, 0, 0]
    assert high["c"] == 10
    assert high["a"] - 5 + 0.5 * (high["b"] - 5) <= 4
    assert "C may have any value of its domain" in answer.verdict or high["b"] == 10
    _, announced, *_ = shown
    assert announced <= (3 * 5_000 + 80_000) / 8
    assert max(shown) == announced


def test_an_answer_says_that_not_all_corners_were_simulated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(asked, "USUAL", asked.USUAL._replace(corners=3))
    tested = answer_of(2, nowhere).tested
    assert "3 random corner cases were simulated" in tested
    assert "parameter set" not in tested, "the study has no other"


def test_of_two_failures_of_a_characteristic_the_nearer_one_is_told() -> None:
    """a below 1, and above 6."""
    answer = answer_of(2, lambda rows: (rows[:, 0] < 1) | (rows[:, 0] > 6))
    assert answer.tables["limits"]["fails_at"][0]["a"] == pytest.approx(6, abs=0.3)


def test_the_box_holds_no_unsafe_solution_of_a_search() -> None:
    """A sliver that begins half of the way to the domain's end; no scan, no random setting and no
    corner of the domain hits it.
    """

    def sliver(rows: FloatArray) -> BoolArray:
        return (
            (np.abs(rows[:, 0] - rows[:, 1] - 0.37) < 0.001)
            & (rows[:, 0] > 7)
            & (np.abs(rows[:, 2:] - 2).max(axis=1) < 0.5)
        )

    study = made_up_study(4)
    pool = Plant(study, sliver)
    found = pool.evaluate(np.array([[8.5, 8.13, 2.0, 2.2], [5.0, 5.0, 5.0, 5.0]]))
    case = case_of(study, found.take([1]), found)

    def asked_about(subject: Study | Results, **options: Any) -> Answer:
        return tolerance.compute(subject, Evaluator(study, pool), **options)

    bare, known = asked_about(study, unsafe=Unsafe()), asked_about(case)
    two = asked_about(case, characteristics=("a,b",))
    assert known.numbers["unsafe"] == "collision", (
        "as the solutions do, and as `explain` takes it"
    )
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

    def judge(settings: FloatArray) -> Judged:
        robustness = np.log(np.abs(settings[:, 0] - 5) + 1e-99) * 1e6 % 1 - q
        return Judged.simulated(drives_of(*settings.tolist()), robustness)

    for seed in range(seeds):
        for attempt in range(1, 12):
            box = Box(region, np.full(2, attempt / 3), np.full(2, 10 - attempt / 3))
            rng = np.random.default_rng((seed, attempt))
            proof = prove(
                lambda number, box=box, rng=rng: box.draw(number, rng),
                judge,
                0.03,
                attempt,
            )
            if not proof.failures:
                wrong += proof.at_most < q
                break
    assert 0 < wrong <= 0.05 * seeds


def test_the_bound_of_a_first_test_without_failure_is_one_sided() -> None:
    safe = Judged.simulated(drives_of(*[[0.0]] * 1228), np.zeros(1228))
    proof = prove(lambda number: np.zeros((number, 2)), lambda _: safe, 0.003, 1)
    assert (1 - proof.at_most) ** 1228 == pytest.approx(0.05)
    assert bound_in_words(proof.at_most) == "with 95 % confidence at most 0.244 %"


def share_of_domain(answer: Answer) -> float:
    """The volume of the box as a share of the domain's."""
    limits = answer.tables["limits"]
    return float(((limits["together_high"] - limits["together_low"]) / 10).prod())


def task_of(
    *models: Model,
    varied: Sequence[int] = (0, 1),
    specified: Mapping[str, Limit] | None = None,
) -> Asked:
    """The question about limits of these columns, in these parameter sets."""
    return asked_of(
        Models(models, ()), Unsafe(), varied, specified or {}, at_tests=True
    )


def test_sets_that_break_or_cut_limits_are_told() -> None:
    """Of four sets one breaks the specified limit, and one makes another limit narrower."""
    regions = [pair, lambda rows: rows[:, 0] > 8, lambda rows: rows[:, 1] > 7, nowhere]
    models = [made_up_model(2, region, fit) for fit, region in enumerate(regions)]
    limits = {"a": Limit(at_most=9.0)}
    own, two, all_sets = (
        find_limits(task_of(*models[:number], specified=limits)) for number in (1, 2, 4)
    )
    assert [*all_sets.broken] == [1]
    assert {*all_sets.attacks} == {0, 2, 3}
    assert two.sides.tolist() == own.sides.tolist()
    assert own.sides[1].tolist() == [4, 5], "up to 9, and all"
    assert all_sets.sides[1].tolist() == [4, pytest.approx(2, abs=0.1)]
    assert all_sets.sides[1, 1] <= 2
    assert all_sets.alone.upper.tolist() == pytest.approx([8, 7], abs=0.1)
    assert all_sets.proofs == 2, "the smaller box is proved anew"
    # All its corners are driven anew.
    ends = np.stack(all_sets.boxes.ends(all_sets.sides))
    corners = {np.array(values).tobytes() for values in product(*ends.T)}
    assert corners <= models[0].evaluator._pool.seen


class Sliver(Bench[DrivenWorld]):
    """Encounters in which the first axis is beyond 0.7 of its range do not count. In 0.5 % of the
    range before, vehicles collide in which all 8 values are above 9.9. All others keep 1 m.
    """

    def drive(self, drives: Drives, stage: str = "") -> Judged:
        share = drives.encounters.place[:, 0]
        collides = (drives.vehicle > 9.9).all(axis=1) & (share > 0.695)
        judged = Judged.simulated(drives, 1 - 2.0 * collides)
        return replace(judged, counts=share <= 0.7)


def test_a_search_begins_where_encounters_only_just_count() -> None:
    """Where vehicles fail there is no slope towards these encounters, and hardly any is drawn."""
    own = made_up_model(8, nowhere)
    bench = Sliver(own, [DrivenWorld(own)])
    bench.places = 3
    edges = bench.edges(0, 64, np.random.default_rng(1)).place
    assert ((edges[:, 0] > 0.69) & (edges[:, 0] <= 0.7)).all()
    assert len(np.unique(edges[:, 1:], axis=0)) > 4, "lines between several places"
    task = task_of(own, varied=range(8))
    for lines in (0, 64):
        effort = task.effort._replace(lines=lines)
        question = task._replace(bench=bench, effort=effort)
        search = question.search(Stream.VALIDATION, 0)
        scope = bench.scope(0, task.lower, task.upper)
        assert bool(len(search(scope, scope.nothing).unsafe)) == bool(lines)


def test_the_case_beyond_a_joint_limit_is_a_step_away_and_all_else_within() -> None:
    """a above 7 with b below 3: the largest box ends at the one or the other."""
    limits = find_limits(task_of(made_up_model(3, corner)))
    assert limits.sides is not None
    ends = np.stack(limits.boxes.ends(limits.sides))
    assert ends[:, 2].tolist() == [5, 5], "it does not vary"
    assert sorted([ends[1, 0], -ends[0, 1]]) in (
        [0, pytest.approx(7, abs=0.15)],
        [pytest.approx(-3, abs=0.15), 10],
    )
    ((side, column),) = limits.breaches
    vehicles = limits.breaches[side, column].vehicle
    assert corner(vehicles)[0]
    (vehicle,) = vehicles
    is_within = (vehicle >= ends[0]) & (vehicle <= ends[1])
    assert is_within.tolist() == [number != column for number in range(3)]
    assert 0 < abs(vehicle[column] - ends[side, column]) <= 10 / 50 + 1e-9
    assert limits.attacks[0].simulated == 4 * 5000
    assert limits.attacks[0].least == 2, "what is left in all of the box"
    assert limits.proofs == 1
    assert limits.alone.upper.tolist() == [10, 10, 5]


def test_the_worst_clearance_is_what_is_left_beside_the_margin_of_its_set() -> None:
    attacks = {0: Attack(least=0.2), 2: Attack(least=0.4), 3: Attack(least=None)}
    assert worst_of(Unsafe(keep=0.3), attacks) == 0.4


def test_few_simulations_claim_nothing_of_a_set_that_they_do_not_reach() -> None:
    own = made_up_model(8, nowhere)
    own.evaluator.budget.limit = 600
    limits = find_limits(task_of(own, own._replace(fit=1), varied=range(8)))
    assert [*limits.attacks] == [0]
    assert limits.sides is None
    assert bytes(64) in own.evaluator._pool.seen, "a corner, with all values 0"


def test_few_simulations_are_shared_between_limits_alone_and_the_box() -> None:
    effort = effort_of_few(3000, 4)
    assert (effort.values, effort.alone, effort.cases) == (8, 0, 300)
    on_lines = effort.encounters * (effort.values + sum(effort.box.parts))
    assert 300 < 8 * on_lines <= 0.15 * 3000
    assert (effort.corners, effort.confirmations, effort.share) == (1, 2, 1)
    assert effort.box.retreat == pytest.approx(0.5 + 200 / 3000)
    assert effort_of_few(200, 4).values == 3
    evaluator = made_up_evaluator(4, nowhere)
    assert usual_alone(evaluator) == 4 * usual_alone(evaluator, 1) == 4 * 5000
    # In ranges, a vehicle drives at all 6 points in 16 critical encounters, for 960 s. So the
    # effort is 25 / 960. Fewer than 8 values show no limit.
    evaluator = Evaluator(with_ranges(load_study("r152")), InlinePool())
    evaluator.allow(None, 1, quick=True)
    quick = effort_of(evaluator)
    assert (quick.values, quick.cases, quick.box.explored) == (8, 130, 0)
    assert (quick.cases_of_set, usual_alone(evaluator, 1)) == (26, 130)


@pytest.mark.parametrize(("limit", "kept"), [("a <= 6", None), ("a <= 7.5", False)])
def test_a_rough_answer_breaks_only_limits_within_which_a_vehicle_is_unsafe(
    limit: str, kept: bool | None
) -> None:
    """a above 7, by the few simulations that are allowed."""
    answer = answer_of(
        2,
        lambda rows: rows[:, 0] > 7,
        unsafe="collision",
        limits=(limit,),
        simulations=800,
    )
    first, second = answer.tables["limits"].to_dict("records")
    assert answer.numbers["rough"]
    assert [answer.numbers["kept"], first["kept"], second["kept"]] == [kept, kept, None]
    assert answer.numbers["samples"] is None
    assert answer.failures[0].startswith("the " if kept is False else "a rough")
    assert first["alone_high"] is second["alone_high"] is None, "not scanned"


def test_a_box_stays_within_that_of_a_smaller_unsafe_region() -> None:
    """The largest box without the larger region has b up to 7, and needs no limit of a."""

    def both(rows: FloatArray) -> BoolArray:
        return pair(rows) | (rows[:, 1] > 7) & (rows[:, 2] > 5.5)

    asked, wider = (
        task_of(made_up_model(3, region), varied=range(3)) for region in (both, pair)
    )
    outer = find_limits(wider)
    alone, inner = find_limits(asked), find_limits(asked, outer)
    assert (alone.sides > outer.sides).any()
    assert (inner.sides <= outer.sides).all()
    assert find_limits(wider, outer).sides.tolist() == outer.sides.tolist()
    assert find_limits(wider, outer._replace(sides=None)).sides is None


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        (
            "a <= 6.812",
            (
                "With a at 6.812 N m, the vehicle hits a crossing pedestrian (impact at 3.6 km/h)."
                " The specified limit is 0.312 N m beyond the last safe value."
            ),
        ),
        ("a <= 8", "With a at 6.6 N m, the vehicle hits"),
        (
            "a <= 6",
            ("No vehicle that was tested within these limits is unsafe (collision)."),
        ),
    ],
)
def test_the_verdict_decides_on_the_limits(limit: str, said: str) -> None:
    """Unsafe: from 6.5 to 7, and from 9 on; a limit on the safe island between lets what is unsafe
    in, too.
    """
    answer = answer_of(2, two_islands, unsafe="collision", limits=(limit,))
    assert said in answer.verdict
    assert (
        answer.numbers["kept"]
        != answer.verdict.startswith("DO NOT")
        == bool(answer.failures)
    )


def test_a_refusal_says_which_limits_would_hold() -> None:
    answer = answer_of(
        2,
        lambda rows: rows[:, 0] + rows[:, 1] > 15,
        unsafe="collision",
        limits=("a <= 9", "b <= 8"),
    )
    first, second = rows_of(answer.to_dict(), "nearest")
    assert [first["nearest"], second["nearest"]] == [
        pytest.approx(6.95, abs=0.06),
        pytest.approx(5.95, abs=0.06),
    ]
    assert answer.numbers["kept"] is False
    assert re.search(
        r"One such limit would hold instead, if all other specified limits stay: a [67][.\d]* N m"
        r" or b [56][.\d]* N m",
        answer.verdict,
    )


@SLOW
def test_the_margin_is_added_to_a_collision_alone() -> None:
    """Safety degrees are 8 - |a - 5|, and 1 m less than 5 m is left from a = 8 on."""

    def ends(**options: Any) -> tuple[str, float, Any]:
        answer = answer_of(1, lambda rows: rows[:, 0] > 9, **options)
        (high,) = answer.values("limits.alone_high")
        return answer.numbers["unsafe"], answer.numbers["margin"], high

    assert ends() == ("collision", 0.446, 9.0), "the error of the study's model"
    assert ends(unsafe="collision") == ("collision", 0, 9.0), "as it stands"
    assert ends(unsafe="collision", margin=5) == ("collision", 5, 8.0)
    assert ends(unsafe="below=4.5") == ("below=4.5", 0, 8.5)
    with pytest.raises(InputError, match=r"5 m beside 'below=4\.5'"):
        ends(unsafe="below=4.5", margin=5)


def test_an_unsafe_original_keeps_no_limit_and_says_what_it_has() -> None:
    study = made_up_study(2)
    for limits in ((), ("a <= 6",)):
        plant = Plant(study, nowhere, degrees)
        answer = tolerance(
            study, pool=plant, unsafe="safety_degree < 8.5", limits=limits
        )
        assert len(plant.seen) == 1, "nothing else is simulated"
        assert answer.lead == ("limits" if limits else None), "no table without content"
        assert "simulate" in answer.next
        (refusal,) = answer.failures
        assert "is already unsafe: it has a" in refusal, "a limit is not blamed"
        told = f"{refusal} Therefore no limit can be given. Ask again with a weaker"
        assert told in answer.verdict
        assert answer.numbers["kept"] is False
        assert answer.tables["limits"]["kept"].tolist() == (
            [False, None] if limits else [None, None]
        )


@pytest.mark.usefixtures("coarse", "few_simulations")
@pytest.mark.parametrize(
    ("region", "is_unlimited"),
    [
        (nowhere, True),
        (lambda settings: settings[:, 0] > 7, False),
        (lambda settings: np.abs(settings[:, 0] - 5) > 0.01, False),
    ],
    ids=["nowhere", "above 7", "any change"],
)
def test_no_limit_is_needed_only_where_no_value_is_unsafe(
    region: Region, is_unlimited: bool
) -> None:
    """Not where a value may change only a little or not at all, and the other one may be any."""
    evaluator = made_up_evaluator(2, region)
    answer = tolerance.compute(evaluator.study, evaluator, unsafe=Unsafe())
    assert (words.UNLIMITED.text in answer.verdict) == is_unlimited
    limits = answer.tables["limits"].set_index("characteristic")
    ends = limits.loc["b", ["together_low", "together_high"]]
    if answer.numbers["box"]:
        assert [*ends] == [0, 10]
