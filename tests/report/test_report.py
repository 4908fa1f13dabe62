"""The page: what it says is in the results and in the answers, text of others stays text, and its
commands make the study and every answer again.
"""

from __future__ import annotations

import html
import re
import shlex
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

import safevar_sumo
from safevar_sumo.ads import ADS
from safevar_sumo.ads.reference_drivers import FullBraking
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.questions.case import Results, load_cases
from safevar_sumo.questions.figures import new_figure
from safevar_sumo.report import replays, sections
from safevar_sumo.report.page import _picture, usual_questions
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.report.texts import answer_about, parse_question
from safevar_sumo.results import handles_of
from safevar_sumo.results.manifest import read_manifest, write_manifest
from safevar_sumo.scenarios import SCENARIOS
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import show_no_progress
from safevar_sumo.vehicles import VEHICLES
from tests.support.in_process import SLOW, run, searched
from tests.support.report_pages import ASK, page_of, words_of
from tools.manual import PROGRAM

pytestmark = pytest.mark.usefixtures("pools_in_this_process")


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


@SLOW
def test_the_page_is_sound_html_and_whole_in_itself(page: str) -> None:
    outline = Outline(page)
    assert outline.open == []
    headings = [int(tag[1]) for tag, _ in outline.tags if re.fullmatch("h[1-6]", tag)]
    assert headings[0] == 1
    assert all(later - earlier <= 1 for earlier, later in pairwise(headings)), (
        "no heading is skipped"
    )
    ids = [group["id"] for _, group in outline.tags if "id" in group]
    assert len(ids) == len(set(ids))
    assert {group["href"] for tag, group in outline.tags if tag == "a"} <= {
        f"#{one}" for one in ids
    }
    fetched = [
        group[name]
        for _, group in outline.tags
        for name in ("src", "srcset", "data", "poster")
        if name in group
    ]
    assert all(str(source).startswith("data:") for source in fetched)
    assert all(group.get("alt") for tag, group in outline.tags if tag == "img")
    assert not re.search(r"@import|url\((?!#|%23)", page)
    assert len(page.encode()) < 3_000_000


@SLOW
def test_what_decides_leads_with_a_replay_and_the_rest_is_folded(page: str) -> None:
    front, _, details = page.partition('aria-label="Details of')
    verdict = r'<div class="first">\s*<p>(.*?)</p>\s*<div class="wide".*?<caption>(.*?)</caption>'
    assert len(re.findall(verdict, front)) == 1
    assert front.count('class="replay" open') == 1
    assert 'class="replay" open' not in details
    assert "^2" not in words_of(page)
    order = [
        "Explain",
        "Risk",
        "Rules",
        "What was tested",
        "Limits and trust",
        "How to reproduce",
    ]
    places = [details.index(f">{name}") for name in order]
    assert places == sorted(places)
    low, high = re.findall(r"95 % confidence interval ([\d.]+) to ([\d.]+) %", details)[
        0
    ]
    assert float(low) < 100 * 0.5 / 2.9 < float(high)

    # What nobody has unfolded has few numbers.
    shown = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)
    folded = re.compile(
        r"<details(?![^>]* open)[^>]*>(?:(?!<details).)*?</details>", re.DOTALL
    )
    while folded.search(shown):
        shown = folded.sub("", shown)
    assert (
        20
        < len(re.findall(r"(?<![\w.])-?\d[\d,.]*", re.sub("<[^>]*>", " ", shown)))
        <= 400
    )


@SLOW
def test_chosen_solutions_and_causes_have_replays_that_end_as_recorded(
    page: str, case: Results
) -> None:
    shown = r'<details class="replay".*?<summary>(.*?)</summary>.*?<img alt="(.*?)"'
    players = re.findall(shown, page, re.DOTALL)
    rows = dict(
        zip(
            map(str, handles_of(case.solutions)),
            case.solutions.to_dict("records"),
            strict=True,
        )
    )
    solutions = {
        title.partition(" (")[0]: words for title, words in players if " (" in title
    }
    assert 1 <= len(solutions) <= 3
    for handle, words in solutions.items():
        row = rows[handle]
        ending = f"stops with {row['f_safe']:.2f} m to spare"
        if row["outcome"] == "collision":
            ending = f"collides at {-row['f_safe']:.1f} m/s"
        assert words.endswith(f"changed {ending}")
    assert sum(title.startswith("Only ") for title, _ in players) >= 1, (
        "a replay of a minimal cause"
    )


@SLOW
def test_settings_that_answers_name_are_replayed_once_for_each_set_of_changes(
    case: Results, slippery: Path
) -> None:
    changes = [
        {"tireFric": 1.2},
        {"tireFric": 1.3},
        {"mass": 2600.0, "tireFric": 1.4},
        {},
    ]
    answer = SimpleNamespace(
        tables={"causes": pd.DataFrame({"changes": changes}), "others": pd.DataFrame()}
    )
    study = ReportedStudy(directory=slippery, case=case, versions={}, answers=[answer])  # type: ignore[list-item]
    played = list(replays.replays(study, show_no_progress))
    names = [
        entry["title"].partition(":")[0]
        for entry in played
        if entry["title"].startswith("Only ")
    ]
    assert names == ["Only tireFric", "Only mass, tireFric"]
    assert played[0]["title"].startswith("Fewest changes: ")
    assert played[1 + len(study.choices)]["changes"][0].startswith(
        "tyre friction from 3.5 to 1.20 "
    ), "the first of them"


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_what_is_not_as_the_results_say_any_more_is_told(
    page: str, slippery: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody's driving system was edited since: here another one drives."""
    assert "differs from the results" not in page
    monkeypatch.setattr(
        sections,
        "assemble",
        lambda *study: replace(assemble(*study), ads=FullBraking()),
    )
    with pytest.warns(UserWarning, match="simulated again with different results: "):
        other = page_of(slippery)
    assert re.search(r"the outcome was collision and is \w+ now", other)
    assert Outline(other).open == []


@pytest.mark.parametrize(
    "text",
    ["repair --margin 0.5", "explain --solution nsga2:0:1 --solution rs:0:0", "rules"],
)
def test_a_question_is_read_as_its_command_is_printed(text: str) -> None:
    question, values = parse_question(text)
    assert question.command_line([], {}, values) == f"python -m safevar_sumo {text}"


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_the_staircase_is_on_the_page_as_a_table_and_as_steps_with_names(
    slippery: Path,
) -> None:
    asked = "explain --of-study --simulations 600"
    page = page_of(slippery, ask=("rules --samples 20", asked))
    section = page.partition(">Smallest changes<")[2].partition("</section>")[0]
    first = r'How many changes are enough[^\n]*\n[^\n]*>1\.0</td>[^\n]*class="label"[^>]*>(\w+)'
    part = re.findall(first, section)[0]
    assert f">{part}</text>" in unquote(section.partition("data:image/svg+xml,")[2])


def test_a_question_without_an_answer_has_the_reason(
    case: Results, slippery: Path
) -> None:
    arguments = *parse_question("repair"), [case], [slippery], None, 1, show_no_progress
    assert answer_about(*arguments, is_asked=False).verdict.startswith("No answer: ")
    with pytest.raises(InputError):
        answer_about(*arguments, is_asked=True)


def test_the_sentence_about_a_model_is_whole() -> None:
    for models in (ADS, VEHICLES, SCENARIOS):
        for name in models:
            text = sections.name_and_sentence(models, name)
            assert text.count("(") == text.count(")"), text
            assert not text.endswith((" its)", " the)", ",)")), text
    assert sections.name_and_sentence(ADS, "aeb").endswith(
        "falls below its braking distances)"
    )


def test_the_usual_questions_are_those_that_a_study_can_answer(case: Results) -> None:
    usual = usual_questions(case)
    assert usual.pop(1) == "explain --of-study"
    assert [text.partition(" ")[0] for text in usual] == [
        one.partition(" ")[0] for one in ASK
    ]
    limited = replace(
        case, study=load_study("wear", limits={"treadDepth": {"at_least": 3.0}})
    )
    assert usual_questions(limited)[-1] == "repair"


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_each_of_two_studies_is_headed_by_its_name_and_its_title_stays_text(
    slippery: Path, tmp_path: Path
) -> None:
    bad = "<script>alert(1)</script></script><b>\"'&{{ 7 * 7 }}"
    copy = tmp_path / "copy"
    shutil.copytree(slippery, copy)
    manifest = read_manifest(slippery)
    title = manifest["study"]["title"]
    manifest["study"]["title"] = bad
    write_manifest(copy, manifest)
    page = page_of(slippery, copy)
    assert Outline(page).open == []
    assert "alert(1)</script>" not in page
    heads = re.findall(r'<h2 id="study-\d">([^<]*)</h2>', page)
    assert [html.unescape(head) for head in heads] == [
        f"slippery ({slippery}): {title}",
        f"slippery ({copy}): {bad}",
    ]


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_results_without_a_solution_have_a_report(
    slippery: Path, tmp_path: Path
) -> None:
    shutil.copytree(
        slippery,
        tmp_path / "begun",
        ignore=shutil.ignore_patterns("answers", "nsga2*", "rs*", "solutions.csv"),
    )
    page = page_of(tmp_path / "begun")
    assert "There is no solution to replay" in page
    assert "The results of slippery are incomplete: 0 of " in page
    assert '<section class="front" ' in page, "nothing is unsafe"
    assert Outline(page).open == []


def test_a_study_is_carried_out_from_what_its_results_record(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study = load_study("smoke", name="pilot", step_length=0.02)
    case: Any = SimpleNamespace(study=study, has_runs=True, solutions=np.empty(0))
    one = ReportedStudy(
        directory=Path("its results"), case=case, versions={}, answers=[]
    )
    monkeypatch.setattr(ReportedStudy, "choices", {})
    ((_, command),) = replays.page_commands(one)
    python, option, script = shlex.split(command)
    assert (python, option) == ("python", "-c")
    asked: dict[str, Any] = {}
    monkeypatch.setattr(
        safevar_sumo, "load", lambda place: SimpleNamespace(study=(place, study))
    )
    monkeypatch.setattr(
        safevar_sumo, "run", lambda study, **others: asked.update(study=study, **others)
    )
    exec(script, {})
    assert asked["study"] == ("its results", study)
    assert asked["out"] == "its results-again"


def test_a_picture_on_a_page_has_all_digits_of_its_texts() -> None:
    figure, ((axis,),) = new_figure("rules", 1, 1, (3, 2))
    axis.set_yticks([0.123456], ["brakeResponse above 0.226 s"])
    svg = unquote(_picture(figure)["source"])
    assert ">brakeResponse above 0.226 s<" in svg
    assert not re.search(r'="[^"]*\d\.\d{3}', svg)


def test_an_answer_that_cannot_be_given_has_no_command() -> None:
    case: Any = SimpleNamespace(study=load_study("smoke"), has_runs=False)
    missing: Any = [
        SimpleNamespace(question="risk", command=""),
        SimpleNamespace(question="rules", command="rules it"),
    ]
    one = ReportedStudy(directory=Path("it"), case=case, versions={}, answers=missing)
    vars(one)["choices"] = {}
    assert [*replays.page_commands(one)] == [("The answer rules", "rules it")]


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_every_printed_command_gives_the_answer_of_the_page(
    slippery: Path, tmp_path: Path
) -> None:
    place = tmp_path / "results"
    shutil.copytree(slippery, place, ignore=shutil.ignore_patterns("answers"))
    questions = "tolerance --simulations 300", "rules --samples 64"
    page = html.unescape(page_of(place, ask=questions, jobs=2))
    printed = commands_of(page)
    asked = f"tolerance rules {'simulate ' * 3}".split()
    assert [typed.split()[0] for typed in printed] == asked[: len(printed)]
    for typed in printed[: len(questions)]:
        answer = html.unescape(run(f"{typed} --format html").stdout).strip()
        assert answer.replace("^2", "²").replace("^3", "³") in page, typed
    assert run(printed[-1].replace("it.", f"{tmp_path}/it.")).stdout


def commands_of(page: str) -> list[str]:
    """The commands that a page prints, without the words that start the program."""
    return re.findall(f"<code>{PROGRAM}(.*?)</code>", page)


DAY = "crossing, clear"


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_all_of_it_is_of_the_point(tmp_path: Path) -> None:
    """A crossing in the clear, where less collides, and in hard_rain."""
    matrix = {
        "aggregate": "worst",
        "tests": [{"name": "crossing", "weathers": ["clear", "hard_rain"]}],
    }
    study = load_study(
        "smoke",
        matrix=matrix,
        search={"runs": 1, "population": 10, "evaluations": 40, "algorithms": ["rs"]},
    )
    results = searched(study, tmp_path / "results")
    page = page_of(results, point=DAY)
    assert f"the test case {DAY} alone" in page
    (whole,) = load_cases([results])
    assert f" --point &#39;{DAY}&#39;" in page
    worst = re.findall(
        r"\(.*lowest safety degree\): (?:collides at ([\d.]+) m/s|\w+ with ([\d.]+) m to spare)",
        page,
    )
    speed, gap = worst[0]
    assert (-float(speed) if speed else float(gap)) > whole.solutions["f_safe"].min(), (
        "elsewhere is the worst"
    )
