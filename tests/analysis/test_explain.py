"""Explanations of simulated failures, everything they say simulated afresh."""

from __future__ import annotations

import json
import re
from io import StringIO
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.causes import RESOLUTION
from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.explain.necessity import robustness
from safevar_sumo.analysis.explain.render import print_explained
from safevar_sumo.analysis.explain.result import Explained
from safevar_sumo.analysis.explain.summary import NUMBERS, lead
from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.results import handles
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import Here


@pytest.fixture(scope="module")
def case(slippery: Path) -> Case:
    return load_cases([slippery])[0]


@pytest.fixture(scope="module")
def told(case: Case) -> Explained:
    return explain_failures(case, ExplainOptions(top=3), pool=Here())


def collides(case: Case, settings: list[dict[str, float]]) -> list[bool]:
    members = case.characteristics
    rows = np.array([members.setting(values, "test") for values in settings])
    assert (members.filter(rows) == rows).all(), "a value that the filter takes for no change"
    return list(Bench(case.study, Here()).evaluate(rows, "afresh").collided)


def test_every_minimal_cause_is_unsafe_and_no_proper_subset_of_it_is(case: Case, told: Explained) -> None:
    assert str(told.unsafe) == "collision"
    causes = [cause.changes for one in told.explanations for cause in one.causes]
    assert causes
    assert all(collides(case, causes))
    proper = [dict(subset) for changes in causes for size in range(len(changes)) for subset in combinations(changes.items(), size)]
    assert not any(collides(case, proper))


def test_every_boundary_is_unsafe_and_just_below_it_is_safe(case: Case, told: Explained) -> None:
    causes = [cause for one in told.explanations for cause in one.causes]
    assert all(collides(case, [cause.boundary for cause in causes]))
    original = dict(zip(case.characteristics.names, case.characteristics.original, strict=True))
    below = [{name: original[name] + (cause.fraction - 2 * RESOLUTION) * (value - original[name]) for name, value in cause.changes.items()}
             for cause in causes]
    assert not any(collides(case, below))


def test_the_records_are_those_of_the_solutions(case: Case, told: Explained) -> None:
    assert repr(told).startswith(f"<Explained {case.study.name}, unsafe collision: {told.failures} of ")
    *records, last = json.loads(json.dumps(told.to_dict(), allow_nan=False))
    known = [str(handle) for handle in handles(case.solutions)]
    for one in records:
        assert list(one) == ["algorithm", "run", "index", "setting", "outcome", "safety_degree", "changed", "minimal_causes", "robustness",
                             "because", "reasons"]
        row = case.solutions.iloc[known.index(f"{one['algorithm']}:{one['run']}:{one['index']}")]
        assert one["setting"] == row[list(case.characteristics.names)].to_dict()
        assert (one["outcome"], one["safety_degree"]) == (row["outcome"], row["safety_degree"])
        for cause in one["minimal_causes"]:
            assert list(cause) == ["changes", "boundary", "fraction", "outcome", "safety_degree", "end"]
            assert set(cause["changes"]) <= set(one["changed"])
            assert all(one["setting"][name] == value for name, value in cause["changes"].items())
        assert 0 <= one["robustness"] <= 1
        assert one["because"].startswith("The original stops")
    assert list(last) == ["summary"]
    assert list(last["summary"]) == ["necessary", "changed", "necessary_interval", "preventable"]
    preventable = last["summary"]["preventable"]
    assert list(preventable) == ["competent_driver", "full_braking", "nobody", "looked_at", "interval_competent_driver"]
    assert sum(list(preventable.values())[:3]) == pytest.approx(1)
    assert preventable["looked_at"] == told.failures
    assert all(share <= last["summary"]["changed"][name] for name, share in last["summary"]["necessary"].items())


def test_the_failures_that_matter_come_first(case: Case, told: Explained) -> None:
    crashes = case.solutions[case.solutions["outcome"] == "collision"]
    reasons = {reason: one for one in told.explanations for reason in one.reasons}
    assert len(reasons["fewest changes"].changed) == crashes["f_num_diff"].min()
    assert reasons["most severe"].safety_degree == crashes["safety_degree"].min()
    assert told.failures == told.analysed == len(crashes[list(case.characteristics.names)].drop_duplicates())


def test_the_failure_to_lead_with_is_the_smallest_that_is_not_borderline(case: Case, told: Explained) -> None:
    """Every failure that is smaller, by number of changes and then by the largest, has less than 80 % of unsafe neighbours."""
    (robust,) = [one for one in told.explanations if "smallest robust" in one.reasons]
    assert told.explanations[0] == robust
    assert robust.robustness.share >= 0.8
    crashes = case.solutions[case.solutions["outcome"] == "collision"].sort_values(["f_num_diff", "f_diff", "f_safe"], kind="stable")
    settings = crashes[list(case.characteristics.names)].to_numpy()
    place = next(i for i, setting in enumerate(settings) if setting.tolist() == list(robust.setting.values()))
    if place:
        bench = Bench(case.study, Here())
        assert max(one.share for one in robustness(bench, settings[:place], 0.05, told.unsafe)) < 0.8


def test_a_named_solution_is_explained_whatever_it_is(case: Case) -> None:
    safe = case.solutions["f_safe"].idxmax()
    handle = str(handles(case.solutions)[safe])
    (one,) = explain_failures(case, ExplainOptions(solutions=(handle,), unsafe="collision"), pool=Here()).explanations
    assert (str(one.handle), one.causes, one.reasons) == (handle, (), ("asked for",))
    with pytest.raises(InputError, match="nsga2:7:0"):
        explain_failures(case, ExplainOptions(solutions=("nsga2:7:0",)), pool=Here())


def test_nothing_unsafe_is_an_answer(slippery: Path) -> None:
    done = CliRunner().invoke(commands, ["explain", str(slippery), "--unsafe", "below=-9", "--jobs", "1", "--json"])
    (only,) = json.loads(done.stdout)
    assert (done.exit_code, only["summary"]["necessary"], only["summary"]["changed"]) == (0, {}, {})


@pytest.mark.parametrize(("arguments", "says"), [
    (["--unsafe", "bad"], "below=X"), (["--unsafe", "below=nan"], "below=X"), (["--solution", "nsga2"], "ALGORITHM:RUN:N")])
def test_what_cannot_be_read_is_refused(slippery: Path, arguments: list[str], says: str) -> None:
    done = CliRunner().invoke(commands, ["explain", str(slippery), "--jobs", "1", *arguments])
    assert isinstance(done.exception, InputError)
    assert says in str(done.exception)


def printed(told: Explained, *, full: bool) -> str:
    console = Console(file=StringIO(), width=80, _environ={})
    print_explained(console, "here", told, full=full)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_the_answer_takes_ten_lines_and_the_rest_is_asked_for(told: Explained) -> None:
    """The vehicle covers v dt between two decisions: that is how high the sawtooth of a profile is."""
    short, full = printed(told, full=False).splitlines(), printed(told, full=True)
    assert len(short) <= 10
    assert short[:-1] == full.splitlines()[:len(short) - 1]
    assert short[-1].endswith("python -m safevar_sumo explain here --full")
    assert_tells_a_manager(short[2], told)
    braking = told.explanations[0].because.original.braking
    assert braking is not None
    assert f"frames of 0.05 s, in which the vehicle covers {braking.speed * 0.05:.2f} m at {braking.speed:.1f} m/s" in full
    assert re.search(r"max_rpm 5800 -> \d+ r/min", full), "28 r/min are no change at all: no decimals"
    assert not re.search(r"max_rpm 5800 -> \d+\.", full)


def assert_tells_a_manager(paragraph: str, told: Explained) -> None:
    """Conditions, original, what suffices for what, how robust, avoidable by whom: the numbers are those of `explain`."""
    by_reason = {reason: one for one in told.explanations for reason in one.reasons}
    fewest, robust = by_reason["fewest changes"], by_reason["smallest robust"]
    degree = float(told.original.f_safe[0])
    assert paragraph.startswith(f"In wet leaves, the original vehicle stops {degree:.2f} m short of the pedestrian. ")
    for one in (fewest, robust):
        word = "borderline: only" if one.robustness.borderline else "robust:"
        share = f"{word} {100 * one.robustness.share:.0f} % of its neighbours are unsafe too"
        needed, number = len(one.causes[0].changes), len(one.changed)
        collision = f"a collision at {-3.6 * (one.safety_degree or 0):.0f} km/h ({share})"
        if needed < number:
            assert re.search(rf"{re.escape(collision)} was found with {NUMBERS[number]} changes: [^;]*; {NUMBERS[needed]} of them suffice",
                             paragraph, re.IGNORECASE)
        else:
            assert f"for {collision}: " in paragraph
    assert f"The robust failure with the fewest changes, {robust.handle}: " in paragraph
    members = CharacteristicSet.of(told.study.vehicle.characteristics)
    largest = max((member for member in members if member.name in fewest.changed),
                  key=lambda member: abs(fewest.setting[member.name] / member.original - 1))
    assert f"{largest.short_name} {100 * (fewest.setting[largest.name] / largest.original - 1):+.0f} %" in paragraph
    share = told.preventability.to_dict()["competent_driver"]
    assert f"a competent driver avoids {100 * share:.0f} %" in paragraph


def test_the_summary_of_a_study_leads_with_the_answer(case: Case, told: Explained) -> None:
    original = Bench(case.study, Here()).original()
    paragraph, first, *others, more = lead(case.study, case.solutions, original, Here(), "my results")
    crashes = int((case.solutions["outcome"] == "collision").sum())
    assert_tells_a_manager(paragraph, told)
    assert first == f"{crashes} of {len(case.solutions)} vehicles found collide."
    assert [line.partition(":")[0] for line in others] == ["Fewest changes", "Smallest largest change", "Most severe"]
    assert all(" These changes alone cause it: " in line for line in others)
    safe = case.solutions[case.solutions["f_safe"] > 2]
    assert more == "Why, and how far: python -m safevar_sumo explain 'my results'"
    nothing, more = lead(case.study, safe, original, Here(), "out")
    assert nothing.startswith(f"Nothing unsafe found in {len(safe)} solutions")
    assert more == "How far each characteristic may go: python -m safevar_sumo tolerance out"
