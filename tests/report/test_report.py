"""The report: what it says is in the results, text of others stays text, the same results give the same page."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner

from safevar_sumo.ads.full_braking import FullBraking
from safevar_sumo.analysis.explain.result import Explained, FailureEntry, SummaryEntry, most_robust
from safevar_sumo.analysis.preventability import LaterReaction, PreventedShares
from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.replay.comparison import changes_in_words
from safevar_sumo.replay.page import template_environment
from safevar_sumo.report import SECTIONS, causes, make_report
from safevar_sumo.report import input as report_input
from safevar_sumo.report import verdict as what
from safevar_sumo.report.causes import Explanations
from safevar_sumo.report.domain import DOMAIN_SECTIONS, _estimate_text
from safevar_sumo.report.input import AVOIDED_TEXT, load_or_compute, tabulate_failing_points
from safevar_sumo.report.page import COMMAND_OF_SECTION, TEMPLATE_FOLDER, read_inputs
from safevar_sumo.report.svg import Dot, draw_scatter
from safevar_sumo.report.verdict import reach_verdict
from safevar_sumo.results import SolutionId
from safevar_sumo.results.manifest import write_manifest
from safevar_sumo.scenarios import Point, weather_of
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers import local
from tests.analysis.known_regions import Plant
from tests.in_process import InlinePool


class Outline(HTMLParser):
    """Headings in order, tags that are open, ids, links and pictures of a page."""

    VOID = ("meta", "img", "input", "br", "link", "hr")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.headings: list[int] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.alternatives: list[str | None] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        group = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        self.ids += [str(group["id"])] if "id" in group else []
        self.links += [str(group["href"])] if tag == "a" else []
        self.fetched += [str(group[name]) for name in ("src", "srcset", "data", "poster") if name in group]
        if tag == "img":
            self.alternatives.append(group.get("alt"))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_input, "SAMPLED_VEHICLES", 400)


@pytest.fixture(scope="module")
def page(slippery: Path, explained: Explained) -> str:
    """The whole page; of the domain it asks a formula: tyre frictions from 1 to 1.5 collide, of 1 to 3.9."""
    study = load_cases([slippery])[0].study
    friction = list(study.vehicle.characteristics).index("tireFric")
    shutil.rmtree(slippery / "answers", ignore_errors=True)  # of tests that simulated before
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(causes, "explain_failures", lambda *_, **__: explained)
        patch.setattr(report_input, "SAMPLED_VEHICLES", 400)
        patch.setattr(local, "LocalPool", lambda *_: Plant(study, lambda rows: rows[:, friction] < 1.5))
        shows: list[tuple[str, int, int]] = []
        page = make_report([slippery], jobs=1, progress=lambda *values: shows.append(values))
        assert shows[0][1] == 0
        assert shows[0][2] > 1000, "the page's simulations, not those of its first stage"
        assert [done for _, done, _ in shows[:-2]] == sorted(done for _, done, _ in shows[:-2])
        assert all(done <= total for _, done, total in shows)
        return page


@pytest.fixture
def never_again(few_samples: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def ask(*_: object, **__: object) -> None:
        raise AssertionError("asked twice")

    monkeypatch.setattr(causes, "explain_failures", ask)
    monkeypatch.setattr(InlinePool, "submit", ask)


@pytest.mark.slow
def test_the_page_is_sound_html_and_whole_in_itself(page: str) -> None:
    outline = Outline(page)
    assert outline.open == []
    assert outline.headings[0] == 1
    assert all(later - earlier <= 1 for earlier, later in pairwise(outline.headings)), "no heading is skipped"
    assert len(outline.ids) == len(set(outline.ids))
    assert all(link.startswith("#") and link[1:] in outline.ids for link in outline.links)
    assert all(source.startswith("data:") for source in outline.fetched)
    assert all(outline.alternatives)
    assert not re.search(r"@import|url\((?!#|%23)", page)
    assert len(page.encode()) < 3_000_000


@pytest.mark.slow
def test_the_sections_stand_in_their_order_and_tell_what_was_found(page: str, slippery: Path, explained: Explained) -> None:
    places = [page.index(f'<h2 id="{name}">') for name in SECTIONS]
    assert places == sorted(places)
    (case,) = load_cases([slippery])
    worst = case.solutions["f_safe"].min()
    assert f"collision at {-worst:.1f} m/s" in page
    assert f"{-3.6 * worst:.0f} km/h" in page
    assert f"stops with {case.original['safety_degree']:.2f} m to spare" in page
    by_reason = {reason: one for one in explained.explanations for reason in one.reasons}
    robust, fewest = (by_reason[reason] for reason in ("smallest robust", "fewest changes"))
    cause = most_robust(robust.causes)
    assert cause is not None
    alone = cause.neighbours
    assert alone is not None
    borderline = f", but borderline: only {100 * alone.share:.0f} % of the neighbours are unsafe too" if alone.borderline else ""
    assert re.search(rf"\d+ changes lead to a collision that is robust \(\d of them suffices? to be unsafe{borderline}\): "
                     r"the vehicle collides at", page)
    assert "^2" not in re.sub("<(style|script).*?</(style|script)>", "", page, flags=re.DOTALL)
    badge = f"{'borderline' if fewest.robustness.borderline else 'robust'}: {100 * fewest.robustness.share:.0f} % of its neighbours are"
    for words in (badge, f"robust: {100 * robust.robustness.share:.0f} % of the",
                  f"Scaling all changes to {100 * cause.fraction:.1f} % is still unsafe",
                  "Unsafe alone, all others as in the original: tireFric.", "within 80 % of the way", "the others anywhere: collides in ",
                  "A share of the domain, not a probability in the field", "NSGA-II (1 run)", "wet leaves", "RQ1: solutions", "RQ3.2",
                  "from seed 1"):
        assert words in page
    low, high = map(float, re.findall(r"95 % interval ([\d.]+) to ([\d.]+) %", re.sub("<.*?>", "", page))[0])
    assert low < 100 * 0.5 / 2.9 < high


@pytest.mark.slow
def test_bars_are_where_their_values_lie_in_the_domain(page: str) -> None:
    bar = r'<rect class="{}" x="([\d.]+)" y="[\d.]+" width="([\d.]+)"[^>]*><title>tireFric from {}'
    (start, safe), (left, unsafe) = (map(float, re.findall(bar.format(look, ends), page)[0])
                                     for look, ends in (("safe", "1.5"), ("unsafe", "1 to 1.5")))
    (track, width) = map(float, re.findall(r'<rect class="track" x="([\d.]+)" y="[\d.]+" width="([\d.]+)"', page)[0])
    assert (left, left + unsafe, start + safe) == pytest.approx((track, track + width * 0.5 / 2.9, track + width), abs=0.2)
    assert left + unsafe == pytest.approx(start, abs=0.2)


@pytest.mark.slow
def test_the_verdict_leads_with_the_robust_failure_and_calls_the_others_borderline(
        slippery: Path, tmp_path: Path, explained: Explained) -> None:
    """The values beside it are those of its solution: no number is another one further down."""
    (data,) = read_inputs([shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))])
    *entries, last = explained.to_dict()
    summary = msgspec.structs.replace(msgspec.convert(last["summary"], SummaryEntry), preventable=PreventedShares(
        competent_driver=0.14, full_braking=0.1, nobody=0.76, looked_at=40, interval_competent_driver=[0.05, 0.29],
        later=LaterReaction(reaction=1.15, competent_driver=0.05)))
    failing = [row for row in data.solutions.values() if row["outcome"] == "collision"]
    entry = msgspec.convert(entries[0], FailureEntry)
    fewest, robust = (msgspec.structs.replace(
        entry, reasons=[reason], robustness=share, **dict(zip(("algorithm", "run", "index"), SolutionId.parse(row["handle"]), strict=True)))
        for reason, share, row in zip(("fewest changes", "smallest robust"), (0.79, 0.81), failing, strict=False))
    result = reach_verdict(data, Explanations([fewest, robust], summary), {"joint": {"factor": 0.42, "samples": 1024}})
    assert [(one.title, one.borderline) for one in result.failures] == [("Robust with the fewest changes", False), ("Fewest changes", True)]
    first = result.failures[0]
    assert [one.text for one in first.changes] == changes_in_words(data.case.characteristics, data.setting_of(first.handle))
    number, needed = len(first.changes), len(robust.minimal_causes[0].changes)
    assert 0 < needed < number, "or the next line tells nothing"
    assert result.headline.startswith(f"{number} changes lead to a collision that is robust ({needed} of them suffice")
    for share, but in ((0.79, ", but borderline: only 79 % of the neighbours are unsafe too"), (0.81, ""), (None, "")):
        alone = msgspec.structs.replace(robust.minimal_causes[0], robustness=share)
        with_share = msgspec.structs.replace(robust, minimal_causes=[alone])
        assert f" to be unsafe{but}): " in reach_verdict(data, Explanations([fewest, with_share], summary), None).headline
    severe = msgspec.structs.replace(robust, reasons=["most severe"])
    assert reach_verdict(data, Explanations([fewest, severe], summary), None).headline.startswith(
        "The failures with the fewest changes are borderline. The one with the fewest changes: "), "the most severe one is not"
    assert reach_verdict(data, Explanations([fewest], summary), None).headline.startswith("Every failure analysed is borderline.")
    all_changes = msgspec.structs.replace(robust.minimal_causes[0], changes={one.text: 1.0 for one in first.changes})
    whole_cause = msgspec.structs.replace(robust, minimal_causes=[all_changes])
    every = reach_verdict(data, Explanations([fewest, whole_cause], summary), None).headline
    assert every.startswith(f"{number} changes suffice for a collision that is robust: the vehicle collides")
    assert [one.value for one in result.key_figures[2:]] == ["14 % of the collisions", "42.0 % of the way"]
    note = "5 % if he needs 0.4 s longer, in the same vehicle (95 % interval 5 % to 29 %; 40 "
    assert result.key_figures[2].note.startswith(note)
    for share, words in ((0.9996, "nearly all"), (0.9949, "99 %"), (1.0, "all"), (0.0002, "hardly any"), (0.0, "none")):
        nearly = msgspec.structs.replace(summary, preventable=msgspec.structs.replace(summary.preventable, competent_driver=share))
        assert reach_verdict(data, Explanations([fewest], nearly), None).key_figures[2].value == f"{words} of the collisions"
    assert result.key_figures[0].value.startswith(f"{number} changes")


@pytest.mark.slow
def test_every_replay_that_is_linked_is_there_and_hits_as_recorded(page: str, slippery: Path) -> None:
    (data,) = read_inputs([slippery])
    players = re.findall(r'<details class="replay" id="(.*?)".*?<script type="application/json">(.*?)</script>', page, re.DOTALL)
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
@pytest.mark.usefixtures("never_again")
@pytest.mark.parametrize("only", [["verdict", "causes", "trust"], ["tolerance", "risk", "rules"],
                                  pytest.param(list(SECTIONS), marks=pytest.mark.slow)])
def test_the_same_results_give_the_same_bytes_and_what_was_explained_stays(only: list[str], page: str, slippery: Path) -> None:
    pages = {make_report([slippery], only=only, jobs=1) for _ in range(2)}
    assert len(pages) == 1
    assert only != list(SECTIONS) or pages == {page}


def test_a_kept_answer_belongs_to_its_options_and_to_the_code_that_computed_it(
        slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    computed: list[str] = []

    def ask(why: str) -> None:
        load_or_compute(read_inputs([place])[0], "risk", lambda: computed.append(why))

    for why in ("first", "again"):
        ask(why)
    file = place / "answers/risk.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "identity": "of something else"}))
    ask("other results")
    monkeypatch.setattr(report_input, "SAMPLED_VEHICLES", 33)
    ask("another sample size")
    monkeypatch.setattr(report_input, "_package_identity", lambda: "edited since")
    ask("other code")
    assert computed == ["first", "other results", "another sample size", "other code"]


@pytest.mark.slow
def test_what_is_not_as_the_results_say_any_more_is_told(page: str, slippery: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody's driving system was edited since: here another one drives."""
    assert "differs from the results" not in page
    monkeypatch.setattr(report_input, "assemble", lambda *study: replace(assemble(*study), ads=FullBraking()))
    with pytest.warns(UserWarning, match="simulated again with different results: "):
        other = make_report([slippery], only=["verdict", "causes"], jobs=1)
    assert re.search(r"the outcome was collision and is \w+ now", other)
    assert Outline(other).open == []


def test_only_some_sections(slippery: Path) -> None:
    page = make_report([slippery], only=["verdict", "tested"])
    assert re.findall(r'<h2 id="(.*?)">', page) == ["verdict", "tested"]
    with pytest.raises(InputError, match="no section 'risks'"):
        make_report([slippery], only=["risks"])


@pytest.mark.slow
@pytest.mark.parametrize("bad", ["<script>alert(1)</script>", "</script><b>\"'&{{ 7 * 7 }}"])
def test_text_of_a_study_stays_text(bad: str, slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "copy")
    manifest = json.loads((slippery / "manifest.json").read_text())
    manifest["study"]["title"] = bad
    write_manifest(tmp_path / "copy", manifest)
    page = make_report([tmp_path / "copy"], only=["tested", "verdict", "trust", "reproduce"])
    assert Outline(page).open == []
    assert "alert(1)</script>" not in page
    assert "49" not in re.findall(r"<strong>(.*?)</strong>", page)[0]


@pytest.mark.slow
def test_studies_stand_side_by_side(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "other", ignore=shutil.ignore_patterns("answers"))
    page = make_report([slippery, tmp_path / "other"], only=["tested", "verdict", "trust", "reproduce"])
    assert page.count('<div class="card verdict bad">') == 2
    assert len(Outline(page).ids) == len(set(Outline(page).ids))


@pytest.mark.slow
def test_results_without_a_solution_have_a_report(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "begun", ignore=shutil.ignore_patterns("answers", "nsga2*", "rs*", "solutions.csv"))
    page = make_report([tmp_path / "begun"], only=["tested", "verdict", "causes", "questions", "trust", "reproduce"], jobs=1)
    assert "No solution was found" in page
    assert Outline(page).open == []


def test_the_command_writes_the_page_and_refuses_what_it_cannot(slippery: Path, tmp_path: Path) -> None:
    def report(*arguments: str) -> object:
        return CliRunner().invoke(commands, ["report", *arguments]).exception

    assert report(str(slippery), "--only", "tested", "--out", str(tmp_path / "it.html")) is None
    assert (tmp_path / "it.html").read_text().startswith("<!DOCTYPE html>")
    for arguments in ([str(tmp_path)], [str(slippery), "--out", str(tmp_path / "it.pdf")], [str(slippery), str(slippery)],
                      [str(slippery), "--only", "x", "--out", str(tmp_path / "x.html")]):
        assert isinstance(report(*arguments), InputError)


def test_the_words_beside_the_line_of_a_chart_cover_no_point() -> None:
    dots = [Dot(x, y, "a", "hit") for x in range(40, 101, 2) for y in (0.1, 0.2, -0.1, -0.2, -3)]
    chart = str(draw_scatter("chart", dots, "x", "y", 0.0, "collision below"))
    right, base = map(float, re.search(r'on-paper" x="([\d.]+)" y="([\d.]+)"', chart).groups())  # type: ignore[union-attr]
    points = [tuple(map(float, result)) for result in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', chart)]
    assert right - 90 > 62
    assert not any(right - 90 < x < right and base - 10 < y < base for x, y in points)
    assert chart.index("<circle") < chart.index("collision below"), "drawn over what it cannot avoid"


def test_a_chart_puts_its_points_where_they_belong_and_escapes_their_words() -> None:
    chart = str(draw_scatter("chart", [Dot(0, 0, "a", "hit"), Dot(100, 2, "<b>", "miss", "x")], "x", "y", 0.0, "line"))
    dots = [tuple(map(float, result)) for result in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', chart)]
    level = float(re.search(r'class="level" d="M62 ([\d.]+)H', chart)[1])  # type: ignore[index]
    assert dots[0] == (62.0, level)
    assert dots[1][0] > 600
    assert dots[1][1] < level
    assert "&lt;b&gt;" in chart
    assert "<b>" not in chart


def test_an_empty_point_is_no_point(slippery: Path) -> None:
    with pytest.raises(InputError, match="point: ''"):
        make_report([slippery], only=["verdict"], point="")


def point(name: str, **place: Any) -> Point:
    return Point(None, None, name, tuple(place.items()))  # type: ignore[arg-type]


def test_tests_and_weathers_stand_down_and_speeds_across() -> None:
    matrix = [*(point(f"near {speed} {at}", test="near", speed=speed, impact_location=at, weather="night")
                for speed in (10, 20, 30) for at in (25, 50)),
              point("along 30", test="along", speed=30, weather="clear"), point("along 40", test="along", speed=40, weather="clear"),
              point("safe 10", test="safe", speed=10, weather="clear")]
    result = tabulate_failing_points(matrix, ("near 20 50", "near 30 25", "near 30 50", "along 40"))
    assert result.summary == "Fails at 4 of 9 points. Percentages are impact locations."
    assert result.heads == ["10 km/h", "20 km/h", "30 km/h", "40 km/h"]
    assert dict(result.rows) == {"near, night": [AVOIDED_TEXT, "50 %", "25 %, 50 %", ""], "along, clear": ["", "", AVOIDED_TEXT, "fails"]}


def test_a_matrix_of_something_else_than_speeds_has_a_table_too() -> None:
    result = tabulate_failing_points([point("a", test="a", weather="fog", slope=0.1), point("b", test="b", weather="fog")], ["a"])
    assert (result.heads, result.rows) == ([""], [("a, fog, slope 0.1", ["fails"])])
    assert tabulate_failing_points([point("b", test="b", weather="fog")], []).rows == []


def test_a_study_that_cannot_be_simulated_has_its_page(slippery: Path, tmp_path: Path) -> None:
    """Its network's folder is gone since."""
    shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    manifest = json.loads((slippery / "manifest.json").read_text())
    manifest["study"]["scenario"]["parameters"] = {"network": "/nowhere/gone"}
    write_manifest(tmp_path / "copy", manifest)
    with pytest.warns(UserWarning, match="copy: This study cannot be simulated here: .*gone"):
        page = make_report([tmp_path / "copy"], only=["tested", "verdict", *COMMAND_OF_SECTION, "trust", "reproduce"], jobs=1)
    result = re.findall(r"slippery: This study cannot be simulated here: .*gone", page)
    assert len(result) == 1 + len(DOMAIN_SECTIONS), "each section that would take simulations says so"
    assert '<details class="replay"' in page


@pytest.mark.slow
def test_of_an_original_that_collides_no_change_is_called_the_cause(
        slippery: Path, tmp_path: Path, explained: Explained, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    manifest = json.loads((slippery / "manifest.json").read_text())
    manifest["original"] |= {"outcome": "collision", "collision": True, "collision_speed": 3.9, "safety_degree": -3.9, "f_safe": -3.9}
    write_manifest(tmp_path / "copy", manifest)
    empty = {"changes": {}, "boundary": {}, "fraction": 0.0, "end": "safe", "outcome": "collision", "safety_degree": -3.9}
    failure, *_, summary = explained.to_dict()
    monkeypatch.setattr(causes, "explain_failures", lambda *_, **__: SimpleNamespace(
        to_dict=lambda: [failure | {"minimal_causes": [empty]}, summary]))
    page = make_report([tmp_path / "copy"], only=["verdict", "causes"], jobs=1)
    assert "No change is needed: the original vehicle itself collides." in page
    assert "No change is a cause" in page
    assert "Cause 1" not in page


def test_user_code_is_called_by_its_name_once(slippery: Path) -> None:
    (data,) = read_inputs([slippery])
    scenario = SimpleNamespace()
    study = msgspec.structs.replace(data.case.study, ads=msgspec.structs.replace(data.case.study.ads, model="my_controller:Pilot"))
    points = [Point(scenario, data.case.weather)]  # type: ignore[arg-type]
    others: Any = SimpleNamespace(case=dataclasses.replace(data.case, study=study), manifest=data.manifest, problem="", point="",
                                  system=SimpleNamespace(points=points, matrix=(), vehicle=None))
    result = what.describe_tested_system(others)
    assert "Driving system: my_controller:Pilot. Scenario: pedestrian_crossing (" in result.subject
    assert "NSGA-II (1 run)" in result.search
    assert not result.tags


def test_an_estimate_stands_beside_its_error_and_just_below_nothing_it_is_nothing() -> None:
    estimates = [(-0.002, (-0.01, 0.006)), (0.126, (0.106, 0.146)), (1.04, (0.94, 1.14)), (0.3, (None, None)), (None, (None, None))]
    assert [_estimate_text(share, interval) for share, interval in estimates] == ["0 % ± 1", "13 % ± 2", "104 % ± 10", "30 %", "-"]


@pytest.mark.parametrize(("weather", "has_effect"), [("carla_hard_rain", False), ("clear", True), ("hard_rain", True), ("night", True)])
def test_a_weather_without_effect_is_called_so(weather: str, has_effect: bool) -> None:
    material: Any = SimpleNamespace(system=None, point="", case=SimpleNamespace(weather=weather_of(weather, "weather")))
    assert what._describe_conditions(material).startswith(f"weather: {weather}")
    assert ("no effect on road and sensors" not in what._describe_conditions(material)) is has_effect
    points = (point("x clear", test="x")._replace(weather=weather_of("clear", "weather")),)
    matrix: Any = SimpleNamespace(system=SimpleNamespace(matrix=points), point="")
    assert what._describe_conditions(matrix).endswith("at all 1 points of a matrix: x (1, clear)")


def test_a_section_without_rules_promises_none() -> None:
    def section(**rules: object) -> str:
        template = template_environment(TEMPLATE_FOLDER).get_template("rules.html.j2")
        return template.render(studies=[{"name": "x", "rules": {"samples": 4000, "share": 0.003, "unsafe": "collision",
                                                           "note": "Shares of others.", **rules}}])

    assert "Shares of others." not in section(words=[], remark="")
    assert "<p>Too few.</p>" in section(words=[], remark="Too few.")
    assert "Shares of others." in section(words=["a rule"], remark="")
