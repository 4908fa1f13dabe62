"""What a command prints by default is one screen that a person reads to its end: every question,
asked about every kind of study with the smallest effort, has such an answer, or a reason to act on.
"""

from __future__ import annotations

import re
import shlex
import textwrap
from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.subject import load
from safevar_sumo.study import study_names
from safevar_sumo.sumo.system import assemble
from tests.in_process import json_of, run
from tests.made_up import HAS_AD_RSS
from tests.manual import ROOT
from tests.scenarios.test_simulated import MODELS, STUDY

WIDTH, MAX_LINES = 100, 30
NO_NUMBER = re.compile(r"(?<![\w./-])-?(nan|inf)\b|\d[eE]\+\d")
FEW = "--simulations {}"
SMALL = {
    "study": "--algorithms rs --runs 1 --evaluations {population} --out next",
    "explain": FEW,
    "tolerance": FEW,
    "risk": FEW,
    "rules": "--samples 64",
    "report": '--ask "rules --samples 16" --out next.html',
}
"""The options with which a command that comes next takes little time."""
NEEDS_MORE = {"metadrive_expert", *(() if HAS_AD_RSS else ("wear_rss",))}
"""Studies that need an extra."""
RATED = "euro_ncap_rating"
WORN = {"worn": "brakeTorque=0.5", "carla": "tireFric=1", "lgsvl": "tire_friction=0.5"}
"""A car of each vehicle model that may not drive."""


def answered(typed: str, *, must: bool = False) -> str:
    """The screen that a command prints; empty if the question is refused with a reason."""
    output = run(*shlex.split(typed), expect=None)
    text = output.stdout
    assert "Traceback" not in output.stderr, output.stderr
    if not text:
        reason = [line for line in output.stderr.splitlines() if line.startswith("safevar-sumo: ")]
        assert not must, output.stderr
        assert len(reason) == 1, output.stderr
        assert "\nexpected: " in output.stderr, output.stderr
        assert not NO_NUMBER.search(reason[0])
        return ""
    lines = [part for line in text.splitlines() for part in textwrap.wrap(line, WIDTH) or [""]]
    assert len(lines) <= MAX_LINES, text
    assert not NO_NUMBER.search(text), text
    return text


def assert_one_screen(text: str) -> None:
    """One table, in which no column says the same in each row, and no pairs `key: value`."""
    lines = text.splitlines()
    rows = [re.split("[│┃]", line)[1:-1] for line in lines if line.startswith("│")]
    assert max(len(line) for line in lines if line[:1] in "│┃┏└") <= WIDTH if rows else True
    assert text.count("Valid for: ") <= 1
    assert "Scope: " not in text
    assert not re.search(r"^\w+: [^;]*; \w+: [^;]*; \w+: ", text, re.MULTILINE), "pairs"
    assert "More: --details" in text
    assert text.count("┏") <= 1
    whole = [row for row in rows if row[0].strip()]
    for cells in list(zip(*whole, strict=True))[1:] if len(whole) > 1 else []:
        assert len({*map(str.strip, cells)}) > 1, cells


def assert_next_answers(text: str, simulations: int, population: int) -> None:
    """Each command that comes next has an answer."""
    _, _, following = text.partition(" Next: ")
    for command in re.findall(r"python -m safevar_sumo (\w+) ([^,\n]+)", following):
        name, subject = command
        small = SMALL[name].format(simulations, population=population)
        assert answered(f"{name} {subject} {small}", must=True)


def asked(study: str) -> list[str]:
    """The questions about a shipped study, at the first point of a long matrix."""
    if study == RATED:
        return [f"rating {study} --set treadDepth=3", f"tolerance {study} --simulations 9"]
    loaded = load_study(study)
    system = assemble(loaded)
    points = system.matrix
    at = f" --point {shlex.quote(points[0].name)}" if len(points) > 4 and points[0].name else ""
    few = FEW.format(300 * (1 + bool(loaded.scenario.search)))
    worn = WORN.get(loaded.vehicle.model, "decel=3")
    name, row = next(iter(loaded.vehicle.characteristics.items()))
    return [
        f"simulate {study}",
        f"rules {study} --samples 64",
        f"explain {study} {few}{at}",
        f"tolerance {study} {few}{at}",
        *(
            f"permit {study} --quick --fits 0 --others new --set {value}"
            for value in (f"{name}={row.original!r}", worn)
        ),
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize("study", [name for name in study_names() if name not in NEEDS_MORE])
def test_every_shipped_study_has_answers_or_reasons(study: str) -> None:
    for typed in asked(study):
        text = answered(typed)
        if text:
            assert_one_screen(text)


@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("permit autoware_july --quick --set brakeTorque=0.5 --others new", "may not drive"),
        ("permit autoware_july --quick --set brakeTorque=0.9 --others new", "may drive up to"),
        ("tolerance smoke --simulations 60", ""),
        ("explain smoke --simulations 60", ""),
        ("risk smoke --simulations 90", ""),
        ("risk autoware_july --simulations 9", None),
        ("tolerance stop --unsafe collision", None),
        ("permit stop --quick --set brakeTorque=0.9 --others new", None),
    ],
)
def test_the_fastest_questions_answer(typed: str, told: str | None) -> None:
    text = answered(typed, must=told is not None)
    assert bool(text) == (told is not None)
    assert (told or "") in text
    if text:
        assert_one_screen(text)
        assert_next_answers(text, 100, 10)


OF_KINDS = {
    "published": "smoke",
    "matrix": "autoware_july",
    "rated": RATED,
    "searched": "sun_joint",
    "stop": "stop",
    "simulator": "rig",
    "file": "played",
}
FILE = ROOT / "tests" / "openscenario" / "files" / "cut_in.xosc"
PLAYED = f'extends = "wear"\nname = "played"\n[scenario]\nfile = "{FILE}"\n'
QUESTIONS = (
    "simulate {0}",
    "explain {0} {few}",
    "tolerance {0} {few}",
    "risk {0} --samples 64 {few}",
    "rules {0} --samples 16 {few}",
    "compare {0} {0} --samples 16 {few}",
    "permit {0} --quick --fits 0 --others new --set {1}",
    "permit {0} --quick --fits 0 --others new --set {2}",
    "repair {0} --quick --promise {1} {few}",
    "tables {0}",
    "export {0} --solution rs:0:0 --to openscenario --out exported",
    'report {0} --ask "rules --samples 16 {unsafe}" --out it.html',
)


@pytest.mark.slow
@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize("kind", OF_KINDS)
def test_every_question_about_each_kind_of_study_has_an_answer_or_a_reason(kind: str) -> None:
    name = OF_KINDS[kind]
    Path("models.py").write_text(MODELS)
    Path("rig.toml").write_text(STUDY.replace("models:Wall", "models:Rig"))
    Path("played.toml").write_text(PLAYED)
    called = name if name in study_names() else f"{name}.toml"
    study = load_study(called)
    population = study.search.population
    few = FEW.format(60 * (4 if study.scenario.search or study.matrix else 1))
    text = answered(
        f"study {called} --algorithms rs --runs 1 --evaluations {population} --out results",
        must=True,
    )
    first, row = next(iter(study.vehicle.characteristics.items()))
    worn = WORN.get(study.vehicle.model, f"{first}={row.lower!r}")
    for subject in (called, "results"):
        for question in QUESTIONS:
            values = (subject, f"{first}={row.original!r}", worn)
            text = answered(question.format(*values, few=few, unsafe=""))
            if "Next: " in text:
                assert_next_answers(text, 2000, population)
    assert answered(f"check {called}")

    # The pack verifies; what nobody is asked of is said.
    criterion = '"stopping_distance > 100"' if kind == "stop" else ""
    ask = f"rules --samples 16{' --unsafe ' if criterion else ''}{criterion}"
    answered(f"evidence results --ask {shlex.quote(ask)} --out it.zip", must=True)
    assert json_of("verify", "it.zip", "--run-code")["numbers"]["passed"]
    assert len(load("results").solutions)


@pytest.mark.slow
@pytest.mark.usefixtures("in_tmp", "coarse")
def test_the_speed_of_a_packed_sheet_is_that_of_its_own_limits() -> None:
    answered(
        "study autoware_july --algorithms rs --runs 1 --evaluations 50 --out results", must=True
    )
    limits = "tolerance --quick --attack 0 --at-tests --characteristics brakeTorque"
    car = "permit --quick --set brakeTorque=0.5 --others new"
    asked = f"--ask {shlex.quote(limits)} --ask {shlex.quote(car)}"
    answered(f"report results {asked} --out it.html", must=True)
    answered(f"evidence results {asked} --out it.zip", must=True)
    assert json_of("verify", "it.zip")["numbers"]["passed"]
    page = Path("it.html").read_text()
    assert page.count("Greatest speed") or "its limits are rough" in page
    assert "All cars with brakeTorque" in page
