"""What a command prints by default is one screen that a person reads to its end: every question,
asked about every kind of study with the smallest effort, has such an answer, or a reason to act on.
"""

from __future__ import annotations

import re
import shlex
import textwrap
from pathlib import Path
from zipfile import ZipFile

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.study import study_names
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, run, write
from tests.support.wall import MODELS, STUDY
from tools.manual import files_of

WIDTH, MAX_LINES = 100, 30
NO_NUMBER = re.compile(r"(?<![\w./-])-?(nan|inf)\b|\d[eE]\+\d")
FEW = "--simulations {}"
SMALL = {
    "study": "--algorithms rs --runs 1 --evaluations 10 --out next",
    "explain": "--quick --top 1",
    "tolerance": "--simulations 500",
    "report": '--ask "rules --samples 16" --out next.html',
}
"""The options with which a command that comes next takes little time."""
STUDIES = (
    "autoware_december",
    "lgsvl",
    "native",
    "r13h",
    "r152_laden",
    "rain_realistic",
    "wear --ranges --point CPLA",
)
"""An original vehicle that collides, two more vehicle models, a metric as the criterion, impacts
that are allowed, constraints, and a test in ranges. `KINDS` has other studies.
"""
WORN = {"worn": "brakeTorque=0.55", "carla": "tireFric=1", "lgsvl": "tire_friction=0.5"}
"""A car of each vehicle model that may not drive."""


def answered(typed: str, *, must: bool = False) -> str:
    """The screen that a command prints; empty if the question is refused with a reason."""
    output = run(typed, expect=None)
    text = output.stdout
    assert "Traceback" not in output.stderr, output.stderr
    if not text:
        reason = [
            line
            for line in output.stderr.splitlines()
            if line.startswith("safevar-sumo: ")
        ]
        assert not must, output.stderr
        assert len(reason) == 1, output.stderr
        assert "\nexpected: " in output.stderr, output.stderr
        assert not NO_NUMBER.search(reason[0])
        return ""
    lines = [
        part
        for line in text.splitlines()
        for part in textwrap.wrap(line, WIDTH) or [""]
    ]
    assert len(lines) <= MAX_LINES, text
    assert max(map(len, lines)) <= WIDTH, text
    assert not NO_NUMBER.search(text), text
    return text


def assert_one_screen(text: str) -> None:
    """One table, in which no column says the same in each row, and no pairs `key: value`."""
    rows = [
        re.split("[│┃]", line)[1:-1] for line in re.findall("^│.*", text, re.MULTILINE)
    ]
    assert text.count("Valid for: ") <= 1
    assert not re.search(r"^\w+: [^;]*; \w+: [^;]*; \w+: ", text, re.MULTILINE), "pairs"
    assert "More: --details" in text
    assert text.count("┏") <= 1
    whole = [row for row in rows if row[0].strip()]
    for cells in list(zip(*whole, strict=True))[1:] if len(whole) > 1 else []:
        assert len({*map(str.strip, cells)}) > 1, cells


def assert_next_answers(*screens: str) -> None:
    """Each command that comes next has an answer."""
    following = "".join(text.partition(" Next: ")[2] for text in screens)
    for command in {*re.findall(r"python -m safevar_sumo (\w+ [^,\n]+)", following)}:
        assert answered(f"{command} {SMALL[command.split()[0]]}", must=True)


@SLOW
@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize("words", STUDIES)
def test_a_shipped_study_has_answers_or_reasons(words: str) -> None:
    name, *flags = words.split()
    study = load_study(name)
    points = () if flags else assemble(study).matrix
    at = f" --point {shlex.quote(points[0].name)}" if len(points) > 4 else ""
    pairs = 1 + bool(flags)
    item, row = next(iter(study.vehicle.characteristics.items()))
    drives = f"permit {words} --quick --fits 0 --others new --set"
    for typed in (
        f"simulate {words}",
        f"rules {words} --samples 32{at}",
        f"explain {words} --simulations {260 * pairs}{at}",
        f"tolerance {words} --simulations {120 * pairs}{at}",
        f"{drives} {item}={row.original!r}",
        f"{drives} {WORN.get(study.vehicle.model, 'decel=3')}",
    ):
        if text := answered(typed):
            assert_one_screen(text)


@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (
            "permit autoware_july --quick --set brakeTorque=0.55 --others new",
            "may not drive",
        ),
        ("risk autoware_july --simulations 9", None),
        *(
            pytest.param(*row, marks=SLOW)
            for row in (
                (
                    "permit autoware_july --quick --set brakeTorque=0.9 --others new",
                    "may drive from 30 up to",
                ),
                (
                    "permit autoware_july --quick --limits 'brakeTorque >= 0.5' --others new",
                    "may not drive",
                ),
                (
                    "permit fmvss127 --quick --fits 0 --set brakeTorque=0.55 --others new",
                    "In a test with a speed of its own, the vehicle hits",
                ),
                ("tolerance smoke --simulations 200", ""),
                ("explain smoke --simulations 60", ""),
                ("risk smoke --simulations 90", ""),
                ("repair autoware_july --promise brakeTorque>=0.9 --quick", "smallest"),
            )
        ),
    ],
)
def test_the_fastest_questions_answer(typed: str, told: str | None) -> None:
    text = answered(typed, must=told is not None)
    assert bool(text) == (told is not None)
    assert (told or "") in text
    if text:
        assert_one_screen(text)
        assert_next_answers(text)


KINDS = ("smoke", "two_speeds", "any_gap", "stop", "rig", "walk")
"""A published study, one with a matrix, one in ranges, full braking, and studies of a
simulator and of a table.
"""
TWO_SPEEDS = """
extends = "autoware_july"
name = "two_speeds"
[[matrix.tests]]
name = "CCRs"
parameters = { test = "CCRs" }
over = { speed = [30, 60] }
"""
ANY_GAP = 'extends = "sun"\nname = "any_gap"\nencounters = "ranges"\n'
KIND = """
extends = "{}"
name = "kind"
[search]
algorithms = ["rs"]
population = 4
evaluations = 8
runs = 1
"""
QUESTIONS = (
    "simulate {0}",
    "explain {0} {few}",
    "tolerance {0} {few}",
    "risk {0} --samples 64 {few}",
    "rules {0} --samples 16 {few}",
    "compare {0} {0} --samples 16 {few}",
    "permit {0} --quick --fits 0 --others new --set {1}",
    "permit {0} --quick --fits 0 --others new --set {2}",
    "tables {0}",
    "check kind.toml",
    "export {0} --solution rs:0:0 --to openscenario --out exported",
)
"""What is asked; `report` comes next, and a pack has a page, too."""


@SLOW
@pytest.mark.usefixtures("in_tmp", "few_frames")
@pytest.mark.parametrize("name", KINDS)
def test_every_question_about_each_kind_of_study_has_an_answer_or_a_reason(
    name: str,
) -> None:
    write("models.py", MODELS)
    write("rig.toml", STUDY.replace("models:Wall", "models:Rig"))
    write("two_speeds.toml", TWO_SPEEDS)
    write("any_gap.toml", ANY_GAP)
    for file, text in files_of("docs/recorded_tracks.md").items():
        write(file, text)
    write("kind.toml", KIND.format(name if name in study_names() else f"{name}.toml"))
    study = load_study("kind.toml")
    answered("study kind.toml --out results", must=True)
    few = FEW.format(260 * (4 if study.ranges or study.matrix else 1))
    first, row = next(iter(study.vehicle.characteristics.items()))
    values = (
        f"{first}={row.original!r}",
        WORN.get(study.vehicle.model, f"{first}={row.lower!r}"),
    )
    assert_next_answers(
        *(answered(each.format("results", *values, few=few)) for each in QUESTIONS)
    )
    # The usual questions where they take little time, as none has an answer.
    ask = "" if name == "stop" else '--ask "rules --samples 16"'
    answered(f"evidence results {ask} --out it.zip", must=True)
    for file in ("kind.toml", "walk.toml", "walk.csv"):  # which a pack holds
        Path(file).unlink()
    run(f"verify it.zip {'--run-code' if name == 'rig' else ''}")


@SLOW
@pytest.mark.usefixtures("in_tmp", "coarse", "few_frames")
def test_the_speed_of_a_packed_sheet_is_that_of_its_own_limits() -> None:
    search = "--algorithms rs --runs 1 --evaluations 50 --out results"
    brakes = 'brakeTorque.precision = { value = 0.001, source = "assumption" }'
    write(
        "july.toml",
        f'extends = "autoware_july"\nname = "july"\n[vehicle.characteristics]\n{brakes}\n',
    )
    answered(f"study july.toml {search}", must=True)
    limits = "tolerance --quick --at-tests --characteristics brakeTorque"
    asked = (
        f'--ask "{limits}" --ask "permit --quick --set brakeTorque=0.55 --others new"'
    )
    answered(f"evidence results {asked} --out it.zip", must=True)
    with ZipFile("it.zip") as pack:
        # It is about brakes at the limit, not about those of the car, which fail.
        assert (
            b"<dt>Greatest speed</dt><dd>The car is safe from 30 up to 60 km/h, the highest"
            in pack.read("1-july/report.html")
        )
    run("verify it.zip")
