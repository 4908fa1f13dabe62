"""Questions with few simulations: they keep to the number, say that they are rough, and agree with
the closed form.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import safevar_sumo as sv
from safevar_sumo.errors import InputError
from safevar_sumo.questions import budget
from safevar_sumo.questions.between import AT_ONE_PHASE
from safevar_sumo.questions.budget import Budget, round_down
from tests.support.in_process import SLOW, InlinePool, refused, run, write
from tests.support.wall import MODELS, STUDY

CLEARANCE = 40 - 15 * 0.5
"""What is left for braking [m]."""


@pytest.fixture
def rig(in_tmp: Path) -> str:
    write("models.py", MODELS)
    write("rig.toml", STUDY.replace("models:Wall", "models:Rig"))
    return "rig.toml"


def keeps(decel: float, delay: float, clearance: float = 0.0) -> bool:
    return CLEARANCE - 15 * delay - 15**2 / 2 / decel >= clearance


def test_joint_limits_of_few_simulations_are_safe_by_the_formula(rig: str) -> None:
    answer = sv.tolerance(rig, simulations=400, pool=InlinePool())
    limits = answer.tables["limits"].set_index("characteristic")
    decel = limits.loc["decel", "together_low"]
    delay = limits.loc["delay", "together_high"]
    assert keeps(decel, delay, 0.3)
    assert not keeps(decel - 1.5, delay, 0.3)
    assert limits[["alone_low", "alone_high"]].isna().all(axis=None), (
        "no line was scanned"
    )
    assert answer.numbers["kept"] is None
    assert AT_ONE_PHASE in answer.tested


def test_few_simulations_state_no_limits_that_leave_a_part_no_room(rig: str) -> None:
    """The new vehicle keeps just this clearance, so that no delay is safe beside its braking."""
    unsafe = f"below={CLEARANCE - 15**2 / 2 / 8}"
    answer = sv.tolerance(rig, unsafe=unsafe, simulations=400, pool=InlinePool())
    assert (
        "no joint limits of use, because no safe change of delay was found"
        in answer.verdict
    )
    assert (
        answer.tables["limits"][["together_low", "together_high"]].isna().all(axis=None)
    )


@pytest.mark.parametrize(
    ("question", "least"),
    [("risk", 5), ("rules", 5), ("explain", 5), ("tolerance", 35)],
)
def test_the_least_number_is_told_before_anything_is_simulated(
    rig: str, question: str, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert getattr(sv, question)(rig, simulations=least, pool=InlinePool()).verdict
    monkeypatch.setattr(budget, "carry_out", lambda *_: pytest.fail("it was simulated"))
    with pytest.raises(InputError, match=f"an answer takes at least {least}"):
        getattr(sv, question)(rig, simulations=least - 1, pool=InlinePool())


@SLOW
def test_a_rough_comparison_keeps_to_its_number_in_a_matrix() -> None:
    answer = sv.compare("wear", "wear", simulations=1000, pool=InlinePool())
    assert answer.numbers["simulations"] <= 1000
    assert "Rough answer (--simulations 1000): " in answer.verdict


CURVE = """
class Rig:
    UNITS, OPTIONAL = {"decel": "m/s^2", "delay": "s"}, ("delay",)

    def simulate(self, setting):
        a, b = (setting["decel"] - 3) / 6, setting["delay"]
        return {"outcome": "stopped", "safety_degree": 2 + FORMULA}
"""


@pytest.mark.parametrize(
    ("formula", "shares", "said"),
    [
        ("1.8 * a + 1.2 * b", (0.692, 0.308), " has the largest influence: it causes "),
        ("(a - 0.5) * (b - 0.5)", (0, 0), "The largest influence is uncertain. "),
    ],
)
@pytest.mark.filterwarnings("error")
def test_shares_of_few_simulations_are_of_the_first_order(
    formula: str, shares: tuple[float, float], said: str, rig: str
) -> None:
    """By the variances of sums and products of uniform numbers."""
    write("models.py", CURVE.replace("FORMULA", formula))
    answer = sv.risk(rig, simulations=300, unsafe="below=1", pool=InlinePool())
    assert said in answer.verdict
    table = answer.tables["sensitivity"].set_index("characteristic")
    assert table["degree_total"].isna().all()
    assert table["degree_first"].loc[["decel", "delay"]].tolist() == pytest.approx(
        shares, abs=0.1
    )


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(("simulations", "has_total"), [(550, False), (650, True)])
def test_few_simulations_are_for_a_design_that_takes_half_of_them(
    simulations: int, has_total: bool, rig: str
) -> None:
    answer = sv.risk(rig, simulations=simulations, pool=InlinePool())
    assert answer.tables["sensitivity"]["degree_total"].notna().all() == has_total
    assert answer.numbers["simulations"] <= simulations
    assert answer.numbers["samples"] > 250


def test_no_limit_alone_is_stated_that_was_tried_in_one_encounter_only(
    rig: str,
) -> None:
    searched = "[scenario.over]\ngap = { lower = 38.0 }\n\n[vehicle.ch"
    write(
        "searched.toml",
        'encounters = "ranges"' + STUDY.replace("[vehicle.ch", searched),
    )
    answer = sv.tolerance("searched.toml", simulations=800, pool=InlinePool())
    assert answer.tables["limits"][["alone_low", "alone_high"]].isna().all(axis=None)
    assert answer.tables["limits"]["together_low"].notna().all()


def test_a_quick_explanation_announces_an_eighth_of_a_whole_one(
    rig: str, capsys: pytest.CaptureFixture[str]
) -> None:
    sv.explain(rig, quick=True, pool=InlinePool())
    announced = re.search(r"about ([\d,]+) simulations", capsys.readouterr().err)
    assert announced
    assert int(announced[1].replace(",", "")) <= 35_096 / 8


def test_more_simulations_than_are_planned_are_a_bound_too() -> None:
    allowed = Budget(stated=120)
    allowed.open(100, None)
    allowed.spend(120)
    with pytest.raises(InputError, match="120 do not suffice: 121"):
        allowed.spend(1)


def test_many_more_simulations_search_more_and_not_roughly() -> None:
    for stated, effort in ((120, 1.0), (1000, 5.0), (10**9, 8.0)):
        allowed = Budget(stated=stated)
        allowed.open(100, None)
        assert (allowed.limit, allowed.effort) == (None, effort)


COUNTED = """
from models import Rig


class Counted(Rig):
    def simulate(self, setting):
        open("count", "a").write("x")
        return super().simulate(setting)
"""


@pytest.mark.parametrize(
    ("number", "jobs"), [(10, 1), (40, 1), pytest.param(300, 2, marks=SLOW)]
)
@pytest.mark.parametrize(
    "question",
    ["risk {}", "rules {}", "tolerance {} --limits 'decel>=5'", "explain {}"],
)
def test_a_number_is_that_of_all_simulations_of_an_edited_class(
    rig: str, question: str, number: int, jobs: int, request: pytest.FixtureRequest
) -> None:
    """With the check of the class, which is shorter, and what is repeated."""
    if jobs > 1:
        request.getfixturevalue("worker_processes")
    write("counted.py", f"{COUNTED}# {question} {number} {jobs}")
    write(rig, STUDY.replace("models:Wall", "counted:Counted"))
    command = f"{question.format(rig)} --simulations {number} --jobs {jobs} --fresh"
    output = run(command, expect=None)
    if "do not suffice: an answer takes at least" in output.stderr:
        assert number < 100
        assert not Path("count").exists()
        return
    assert number / 3 <= Path("count").stat().st_size <= number, output.stderr
    if number == 300:
        assert "30 for a check of the class, which is shorter" in output.stderr or (
            re.search(
                r"with 2\d for a check of the class, which is shorter", output.stderr
            )
        )
        assert run(command, expect=None).stdout == output.stdout


SUM = """
from pathlib import Path

class Sum:
    UNITS = {f"c{number}": "-" for number in range(300)}

    def simulate(self, setting):
        with Path("count").open("a") as count:
            count.write(".")
        rest = 180 - sum(setting.values())
        return {"outcome": "stopped" if rest > 0 else "collision", "safety_degree": rest}
"""


@pytest.mark.parametrize("question", [sv.risk, sv.rules])
def test_a_number_holds_with_300_characteristics(question: Any, in_tmp: Path) -> None:
    write("sums.py", SUM)
    domain = '= { unit = "-", original = 0.5, lower = 0, upper = 1 }\n'
    domains = "".join(f"c{number} {domain}" for number in range(300))
    head, table, rest = STUDY.partition("[vehicle.characteristics]\n")
    _, metrics, rest = rest.partition("[metrics]")
    study = head + table + domains + metrics + rest
    write("sum.toml", study.replace("models:Wall", "sums:Sum"))
    most = 0

    def show(phase: str, done: int, total: int) -> None:
        nonlocal most
        most = max(most, done, total)

    question("sum.toml", simulations=250, pool=InlinePool(), progress=show)
    assert 100 <= Path("count").stat().st_size <= 250
    assert 100 <= most <= 250


def test_what_decides_is_said_from_enough_vehicles(rig: str) -> None:
    for number in (5, 230, 270):
        answer = sv.risk(rig, simulations=number, pool=InlinePool())
        is_enough = answer.numbers["samples"] >= 200
        assert is_enough == (number == 270)
        said = (
            "influence are unknown: at least 200 sampled vehicles are needed"
            in answer.verdict
        )
        shares = answer.tables["sensitivity"].drop(columns="characteristic")
        assert said == shares.isna().all(axis=None) == (not is_enough)
        assert not re.search(r"\b(nan|inf)\b", answer.render("text", details=True))


def test_what_takes_long_by_default_is_limited_and_said_first(
    capsys: pytest.CaptureFixture[str],
) -> None:
    allowed = Budget(minimum=2201)
    with pytest.raises(InputError, match="an answer takes at least 2,201"):
        allowed.open(10_000, 0.4)
    assert allowed.limit == 2200
    assert (
        "at most 2,200 simulations, about 0:14:40, of about 10,000"
        in capsys.readouterr().err
    )
    other = Budget()
    other.open(1000, 0.4)
    assert other.limit is None
    assert "about 1,000 simulations, about 0:06:40" in capsys.readouterr().err
    assert round_down(0.2) == 1


@pytest.mark.parametrize(
    ("at_once", "told"), [(1, "takes 0.15 s)"), (2, "takes 0.3 s, 2 at the same time)")]
)
def test_the_time_of_one_simulation_is_that_of_one(
    at_once: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """100 simulations take 15 s with any number at the same time: the mean is 0.15 s."""
    Budget().open(100, 0.15, at_once=at_once)
    text = capsys.readouterr().err
    assert "about 100 simulations, about 0:00:15" in text
    assert told in text


def test_a_slow_simulator_gets_a_rough_answer(
    rig: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budget, "LONGEST_QUESTION", 0.5)
    monkeypatch.setattr(
        "safevar_sumo.questions.evaluator.seconds_of_simulation", lambda *_: 0.001
    )
    output = run(f"rules {rig}")
    assert "at most 500 simulations" in output.stderr
    assert output.stdout.startswith("Rough answer (--simulations 500)")


@SLOW
@pytest.mark.usefixtures("few_frames")
@pytest.mark.parametrize(("number", "cache"), [(400, "folder"), (1000, "off")])
def test_a_page_and_a_pack_share_one_number(
    rig: str, number: int, cache: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one question has simulated serves the others: rules has the sample of risk."""
    monkeypatch.setenv("SAFEVAR_CACHE", cache)
    write(rig, STUDY.replace("models:Wall", "counted:Counted"))
    for command, out in (("report", "page.html"), ("evidence", "pack.zip")):
        write("counted.py", f"{COUNTED}# {command}")
        run(f"study {rig} --out {command}")
        Path("count").unlink()
        run(f"{command} {command} --simulations {number} --out {out} --jobs 1")
        assert number / 3 <= Path("count").stat().st_size <= number
    stated = re.findall(
        r"(\w+) report (?:--samples 4000 )?--simulations (\d+)",
        Path("page.html").read_text(),
    )
    assert {name for name, _ in stated} == {"tolerance", "explain", "risk", "rules"}
    assert {3 * int(part) > 0.7 * number for _, part in stated} == {True}
    run("verify pack.zip --run-code")
    refused("evidence evidence --simulations 3 --out 3.zip", "not suffice")
