"""The report: what it says is in the results, text of others stays text, the same results give the same page, and the
commands of its last section make the study again.
"""

from __future__ import annotations

import html
import json
import re
import shlex
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

import safevar_sumo
from safevar_sumo.ads.reference_drivers import FullBraking
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import find_question
from safevar_sumo.questions.case import Case
from safevar_sumo.replay.comparison import format_number
from safevar_sumo.report import SECTIONS, input as report_input, report
from safevar_sumo.report.page import commands_to_reproduce, read_inputs
from safevar_sumo.results.manifest import read_manifest, write_manifest
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from tests.in_process import searched


def words_of(page: str) -> str:
    """The text of a page, between single blanks."""
    return " ".join(
        html.unescape(re.sub("<(style|script).*?</(style|script)>|<[^>]*>", "", page, flags=re.DOTALL)).split()
    )


class Outline(HTMLParser):
    """All tags of a page with their attributes, and those that are open at its end."""

    VOID = ("meta", "img", "input", "br", "link", "hr")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)
        if tag in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert tag in self.VOID or self.open.pop() == tag


@pytest.mark.slow
def test_the_page_is_sound_html_and_whole_in_itself(page: str) -> None:
    outline = Outline(page)
    assert outline.open == []
    headings = [int(tag[1]) for tag, _ in outline.tags if re.fullmatch("h[1-6]", tag)]
    assert headings[0] == 1
    assert all(later - earlier <= 1 for earlier, later in pairwise(headings)), "no heading is skipped"
    ids = [group["id"] for _, group in outline.tags if "id" in group]
    assert len(ids) == len(set(ids))
    assert {group["href"] for tag, group in outline.tags if tag == "a"} <= {f"#{one}" for one in ids}
    fetched = [
        group[name] for _, group in outline.tags for name in ("src", "srcset", "data", "poster") if name in group
    ]
    assert all(str(source).startswith("data:") for source in fetched)
    assert all(group.get("alt") for tag, group in outline.tags if tag == "img")
    assert not re.search(r"@import|url\((?!#|%23)", page)
    assert len(page.encode()) < 3_000_000


@pytest.mark.slow
def test_the_sections_stand_in_their_order_and_say_what_the_commands_say(
    page: str, case: Case, explained: Answer
) -> None:
    places = [page.index(f'<h2 id="{name}">') for name in SECTIONS if name not in ("compare", "repair")]
    assert places == sorted(places)
    worst = case.solutions["f_safe"].min()
    words = words_of(page)
    assert "^2" not in words
    assert '<div class="card verdict bad">' in page
    for expected in (
        f"collision at {-worst:.1f} m/s",
        f"{-3.6 * worst:.0f} km/h",
        f"stops with {case.original['safety_degree']:.2f} m to spare",
        "Unsafe alone, all others as in the original: tireFric.",
        "beyond, with the other characteristics at their limits, the ",
        "NSGA-II (1 run)",
        "RQ3.2",
    ):
        assert expected in words
    low, high, unsafe = re.findall(r"from ([\d.]+) to ([\d.]+) % with 95 % confidence, (\d+) of 400 vehicles", words)[0]
    assert float(low) < 100 * 0.5 / 2.9 < float(high)
    assert f"{int(unsafe) / 4:.2f} % of 400 vehicles" in words, "the share of unsafe vehicles is one"


@pytest.mark.slow
def test_every_figure_has_its_values_beside_it(page: str, explained: Answer) -> None:
    tables = re.findall("<summary>Values of the figure</summary>(.*?)</details>", page, re.DOTALL)
    cells = [[re.sub("<.*?>", "", cell) for cell in re.findall("<td.*?>(.*?)</td>", table)] for table in tables]
    assert len(cells) == 2
    necessity = explained.tables["characteristics"].iloc[0]
    assert cells[0][:3] == [
        necessity["characteristic"],
        format_number(necessity["changed"]),
        format_number(necessity["needed"]),
    ]
    row = cells[1][cells[1].index("tireFric") :][:8]
    assert row[:4] == ["tireFric", "-", "3.5", "1.5"]
    assert row[-1] == "1 to 1.5"
    assert page.count('<figure class="picture">') == 4, "the failure has its replay, the limits their sheet"


@pytest.mark.slow
def test_every_replay_that_is_linked_is_there_and_hits_as_recorded(page: str, slippery: Path) -> None:
    (data,) = read_inputs([slippery])
    players = re.findall(
        r'<details class="replay" id="(.*?)".*?<script type="application/json">(.*?)</script>', page, re.DOTALL
    )
    by_anchor = {data.anchor("replay", handle): row for handle, row in data.solutions.items()}
    assert len(players) >= 3
    for anchor, data in players:
        changed = json.loads(data)["drives"][1]
        row = by_anchor[anchor]
        if row["outcome"] == "collision":
            assert changed["verdict"] == f"collides at {-row['f_safe']:.1f} m/s"
        else:
            assert changed["gap"][changed["nearest"]] == pytest.approx(row["f_safe"], abs=0.006)


@pytest.mark.slow
def test_what_is_not_as_the_results_say_any_more_is_told(
    page: str, slippery: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody's driving system was edited since: here another one drives."""
    assert "differs from the results" not in page
    monkeypatch.setattr(report_input, "assemble", lambda *study: replace(assemble(*study), ads=FullBraking()))
    with pytest.warns(UserWarning, match="simulated again with different results: "):
        other = report(slippery, only=["verdict", "causes"], jobs=1)
    assert re.search(r"the outcome was collision and is \w+ now", other)
    assert Outline(other).open == []


def test_only_some_sections(slippery: Path) -> None:
    page = report(slippery, only=["reproduce", "tested"])
    assert re.findall(r'<h2 id="(.*?)">', page) == ["tested", "reproduce"]
    assert '<th class="span"' not in page, "its table has one level of headings"
    with pytest.raises(InputError, match="no section 'risks'"):
        report(slippery, only=["risks"])


def test_the_answers_of_risk_and_rules_stand_on_the_page_as_they_are(slippery: Path) -> None:
    page = report(slippery, only=["risk", "rules"])
    for name in ("risk", "rules"):
        answer = find_question(name)(str(slippery), **report_input.SAMPLES[name])
        assert answer.render("html") in page.replace("²", "^2").replace("³", "^3")


@pytest.mark.slow
@pytest.mark.parametrize("bad", ["<script>alert(1)</script>", "</script><b>\"'&{{ 7 * 7 }}"])
def test_text_of_a_study_stays_text(bad: str, slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "copy")
    manifest = read_manifest(slippery)
    manifest["study"]["title"] = bad
    write_manifest(tmp_path / "copy", manifest)
    page = report(tmp_path / "copy", only=["tested", "trust", "reproduce"])
    assert Outline(page).open == []
    assert "alert(1)</script>" not in page
    assert "49" not in re.findall(r"<strong>(.*?)</strong>", page)[0]


@pytest.mark.slow
def test_results_without_a_solution_have_a_report(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(
        slippery, tmp_path / "begun", ignore=shutil.ignore_patterns("answers", "nsga2*", "rs*", "solutions.csv")
    )
    page = report(tmp_path / "begun", only=["tested", "verdict", "causes", "questions", "trust", "reproduce"], jobs=1)
    assert "No solution was found" in page
    assert '<div class="card verdict">' in page, "nothing is unsafe"
    assert Outline(page).open == []


def test_a_study_is_carried_out_from_what_its_results_record(monkeypatch: pytest.MonkeyPatch) -> None:
    study = load_study("smoke", name="pilot", step_length=0.02)
    case: Any = SimpleNamespace(study=study, has_runs=True)
    one = report_input.ReportInput(
        study_number=1, directory=Path("its results"), case=case, system=assemble(study), versions={}, margin=0.5
    )
    python, option, script = shlex.split(commands_to_reproduce([one], ["questions"])[0][1])
    assert (python, option) == ("python", "-c")
    asked: dict[str, Any] = {}
    monkeypatch.setattr(safevar_sumo, "load", lambda place: SimpleNamespace(study=(place, study)))
    monkeypatch.setattr(safevar_sumo, "run", lambda study, **others: asked.update(study=study, **others))
    exec(script, {})
    assert asked["study"] == ("its results", study)
    assert asked["out"] == "its results-again"
    _, *others, _ = commands_to_reproduce([one], ["tolerance", "repair"])
    questions = [f"python -m safevar_sumo {name} 'its results' --margin 0.5" for name in ("tolerance", "repair")]
    assert [command for _, command in others] == questions


@pytest.mark.slow
def test_every_printed_command_gives_the_numbers_of_the_page(
    slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the printed commands print stands on the page, word for word; the tables' numbers are those of `tables`."""
    monkeypatch.setattr(report_input, "SAMPLES", {key: {"samples": 300} for key in ("risk", "rules")})
    place = tmp_path / "results"
    shutil.copytree(slippery, place, ignore=shutil.ignore_patterns("answers"))
    page = report(place, paper=True, jobs=2)
    commands_of_page = [shlex.split(html.unescape(line)) for line in re.findall("<code>(python -m .*?)</code>", page)]
    printed = {typed[3]: typed[3:] for typed in commands_of_page}
    assert {"explain", "tolerance", "risk", "rules", "simulate", "tables"} <= set(printed)

    text = words_of(page)
    for question in ("explain", "tolerance", "risk", "rules"):
        lines = [line for line in output_of(printed[question]).splitlines() if re.match(r"[A-Z0-9-].*[.]$", line)]
        said = [line for line in lines if " ".join(line.replace("^2", "²").replace("^3", "³").split()) in text]
        assert said, (question, lines)
        if question in (
            "tolerance",
            "rules",
        ):  # the page says the other lines in other words, beside what they belong to
            assert said == lines


def output_of(typed: list[str]) -> str:
    done = CliRunner().invoke(commands, typed, env={"COLUMNS": "400"})
    assert done.exit_code == 0, done.output
    return done.stdout


DAY, RAIN = "crossing, clear", "crossing, hard_rain"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crossing in the clear, where less collides, and in hard_rain."""
    matrix = {"aggregate": "worst", "tests": [{"name": "crossing", "weathers": ["clear", "hard_rain"]}]}
    study = load_study(
        "smoke", matrix=matrix, search={"runs": 1, "population": 10, "evaluations": 40, "algorithms": ["rs"]}
    )
    return searched(study, tmp_path_factory.mktemp("matrix") / "results")


@pytest.mark.slow
def test_all_of_it_is_of_the_point(results: Path) -> None:
    (whole,), (there,) = read_inputs([results]), read_inputs([results], DAY)
    assert [point.name for point in there.system.points] == [DAY]
    assert (there.case.solutions["f_safe"] >= whole.case.solutions["f_safe"]).all(), "elsewhere is the worst"
    assert (there.case.solutions["f_safe"] > whole.case.solutions["f_safe"]).any()
    page = report(results, only=["tested", "verdict", "reproduce"], jobs=1, point=DAY)
    worst = there.case.solutions["f_safe"].min()
    assert (f"a collision at {-worst:.1f} m/s" if worst < 0 else f"; the worst stops {worst:.2f} m short") in page
    assert f"only at the point {DAY} of its matrix" in page
