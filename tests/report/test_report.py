"""The report: what it says is in the results, text of others stays text, the same results give the same page."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safevar_sumo.ads.full_braking import FullBraking
from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.replay.comparison import changes_in_words
from safevar_sumo.report import SECTIONS, findings, limits, make_report
from safevar_sumo.report import input as material
from safevar_sumo.report.input import stored
from safevar_sumo.report.limits import LIMITS
from safevar_sumo.report.page import gather
from safevar_sumo.report.svg import Dot, scatter
from safevar_sumo.report.verdict import verdict
from safevar_sumo.results import SolutionId
from safevar_sumo.results.manifest import write_manifest
from safevar_sumo.sumo.system import assemble


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


class Explained:
    """What `explain` gives for the most severe solution of `results`, every one of its changes being needed."""

    def __init__(self, case: Case) -> None:
        row = case.solutions.iloc[0]
        changes = {name: float(row[name]) for name, value in zip(case.characteristics.names, case.characteristics.original, strict=True)
                   if row[name] != value}
        cause = {"changes": changes, "boundary": changes, "fraction": 0.9968, "outcome": row["outcome"],
                 "safety_degree": row["f_safe"], "end": "safe"}
        self._records = [
            {"algorithm": row["algorithm"], "run": int(row["run"]), "index": 0, "setting": changes,
             "outcome": row["outcome"], "safety_degree": row["f_safe"], "changed": list(changes), "minimal_causes": [cause],
             "robustness": 0.5, "because": "<because>", "reasons": ["smallest robust", "fewest changes"]},
            {"summary": {**{name: dict.fromkeys(changes, 1.0) for name in ("necessary", "changed")},
                         "necessary_interval": {name: [0.8, 1.0] for name in changes}}}]

    def to_dict(self) -> list[dict[str, Any]]:
        return self._records


class Limit:
    """What `tolerance`, `risk` and `rules` give of a vehicle of which one characteristic matters."""

    rules = ()
    samples, unsafe_share, remark, unsafe, verdict = 32, 0.25, "", "collision", "Unsafe alone: tireFric."

    def __init__(self, name: str) -> None:
        self._name = name

    def to_dict(self) -> dict[str, Any]:
        if self._name == "risk":
            return {"study": "it", "unsafe": "collision", "samples": 32, "failures": 8, "probability": 0.25, "interval": [0.1, 0.4],
                    "confidence": 0.95, "sensitivity": [
                        {"characteristic": "tireFric", "first_order": 0.8, "total": 0.9, "first_order_interval": [0, 1],
                         "total_interval": [0, 1]}]}
        return {"study": "it", "unsafe": "collision", "pairs": [], "joint": {
            "factor": 0.5, "confidence": 0.95, "samples": 64, "failed": 0, "unsafe_at_most": 0.05}, "alone": [
            {"characteristic": "tireFric", "unit": "-", "original": 3.5, "safe": [1.5, 4.0], "unsafe": [[0.5, 1.5]],
             "not_simulated": []}]}


COMPUTED_BY = {"tolerance": "find_tolerances", "risk": "estimate_risk", "rules": "find_rules"}


@pytest.fixture(scope="module")
def page(slippery: Path) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(findings, "explain", lambda case, *_, **__: Explained(case))
        patch.setattr(material, "SAMPLES", 32)
        for name in LIMITS:
            patch.setattr(limits, COMPUTED_BY[name], lambda *_, name=name, **__: Limit(name))
        return make_report([slippery], jobs=1)


@pytest.fixture
def never_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def explain(*_: object, **__: object) -> None:
        raise AssertionError("explained twice")

    monkeypatch.setattr(findings, "explain", explain)
    monkeypatch.setattr(material, "SAMPLES", 32)
    for name in LIMITS:
        monkeypatch.setattr(limits, COMPUTED_BY[name], explain)


def test_the_page_is_sound_html_and_whole_in_itself(page: str) -> None:
    outline = Outline(page)
    assert outline.open == []
    assert outline.headings[0] == 1
    assert all(later - earlier <= 1 for earlier, later in pairwise(outline.headings)), "no heading is skipped"
    assert len(outline.ids) == len(set(outline.ids))
    assert all(link.startswith("#") and link[1:] in outline.ids for link in outline.links)
    assert all(source.startswith("data:") for source in outline.fetched)
    assert all(outline.alternatives)
    assert "&lt;because&gt;" in page
    assert not re.search(r"@import|url\((?!#|%23)", page)
    assert len(page.encode()) < 3_000_000


def test_the_sections_stand_in_their_order_and_tell_what_was_found(page: str, slippery: Path) -> None:
    places = [page.index(f'<h2 id="{name}">') for name in SECTIONS]
    assert places == sorted(places)
    (case,) = load_cases([slippery])
    worst = case.solutions["f_safe"].min()
    assert f"hits at {-worst:.1f} m/s" in page
    assert f"stops with {case.original['safety_degree']:.2f} m to spare" in page
    assert re.search(r"\d+ changes suffice for a collision that is robust: the vehicle hits at", page)
    assert "^2" not in re.sub("<(style|script).*?</(style|script)>", "", page, flags=re.DOTALL)
    for words in ("Unsafe alone: tireFric.", "within 50 % of the way", "<strong>25.00 %</strong>", "No rule was found",
                  "(borderline: only 50 % of its neighbours are unsafe)", "Scaling all changes to 99.7 % is still unsafe",
                  "A share of the domain, not a probability in the field",
                  "NSGA-II (1 run)", "wet leaves", "RQ1: solutions against", "RQ3.2", "from seed 1"):
        assert words in page


def test_the_verdict_leads_with_the_robust_failure_and_calls_the_others_borderline(
        slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The values beside it are those of its solution: no number is another one further down."""
    (material,) = gather([shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))])
    fewest, *_, robust = Explained(material.case).to_dict()[:1] * 2
    failing = [row for row in material.solutions.values() if row["outcome"] == "collision"]
    fewest = fewest | {"reasons": ["fewest changes"], "robustness": 0.79}
    robust = robust | {"reasons": ["smallest robust"], "robustness": 0.81}
    for record, row in zip((fewest, robust), failing, strict=False):
        algorithm, run, index = row["handle"].split(":")
        record |= {"algorithm": algorithm, "run": int(run), "index": int(index)}
    summary = {"summary": {"preventable": {"competent_driver": 0.14, "full_braking": 0.1, "nobody": 0.76, "looked_at": 40,
                                           "interval_competent_driver": [0.05, 0.29]}}}
    told = verdict(material, [fewest, robust, summary], {"joint": {"factor": 0.42, "samples": 1024}})
    assert [(one["title"], one["borderline"]) for one in told["findings"]] == [("Smallest robust failure", False), ("Fewest changes", True)]
    first = told["findings"][0]
    setting = material.setting_of(SolutionId.parse(first["handle"]))
    assert [one["text"] for one in first["changes"]] == changes_in_words(material.case.characteristics, setting)
    assert told["headline"].startswith(f"{len(first['changes'])} changes suffice for a collision that is robust")
    assert [one["value"] for one in told["figures"][2:]] == ["14% of the collisions", "42.0% of the way"]
    assert told["figures"][0]["value"].startswith(f"{len(first['changes'])} changes")


def test_every_replay_that_is_linked_is_there_and_hits_as_recorded(page: str, slippery: Path) -> None:
    (material,) = gather([slippery])
    players = re.findall(r'<details class="replay" id="(.*?)".*?<script type="application/json">(.*?)</script>', page, re.DOTALL)
    by_anchor = {material.anchor("replay", handle): row for handle, row in material.solutions.items()}
    assert len(players) >= 3
    for anchor, data in players:
        changed = json.loads(data)["drives"][1]
        row = by_anchor[anchor]
        if row["outcome"] == "collision":
            assert changed["verdict"] == f"hits at {-row['f_safe']:.1f} m/s"
        else:
            assert changed["gap"][changed["nearest"]] == pytest.approx(row["f_safe"], abs=0.006)


@pytest.mark.usefixtures("never_again")
@pytest.mark.parametrize("only", [["verdict", "causes", "trust"], ["tolerance", "risk", "rules"],
                                  pytest.param(list(SECTIONS), marks=pytest.mark.slow)])
def test_the_same_results_give_the_same_bytes_and_what_was_explained_stays(only: list[str], page: str, slippery: Path) -> None:
    pages = {make_report([slippery], only=only, jobs=1) for _ in range(2)}
    assert len(pages) == 1
    assert only != list(SECTIONS) or pages == {page}


def test_what_was_explained_of_other_results_is_not_taken(
        page: str, slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert page
    shutil.copytree(slippery, tmp_path / "copy")
    file = tmp_path / "copy/answers/explain.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "identity": "of something else"}))
    asked = []
    monkeypatch.setattr(findings, "explain", lambda case, *_, **__: asked.append(case) or Explained(case))
    make_report([tmp_path / "copy"], only=["causes"], jobs=1)
    assert len(asked) == 1


def test_a_kept_answer_belongs_to_its_options_and_to_the_code_that_computed_it(
        slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    computed: list[str] = []

    def ask(why: str) -> None:
        stored(gather([place])[0], "risk", lambda: computed.append(why))

    for why in ("first", "again"):
        ask(why)
    monkeypatch.setattr(material, "SAMPLES", 33)
    ask("another sample size")
    monkeypatch.setattr(material, "_package", lambda: "edited since")
    ask("other code")
    assert computed == ["first", "another sample size", "other code"]


def test_what_is_not_as_the_results_say_any_more_is_told(page: str, slippery: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody's driving system was edited since: here another one drives."""
    assert "not what the results say" not in page
    monkeypatch.setattr(material, "assemble", lambda *study: replace(assemble(*study), ads=FullBraking()))
    with pytest.warns(UserWarning, match="simulated again not what the results say"):
        other = make_report([slippery], only=["verdict", "causes"], jobs=1)
    assert re.search(r"the outcome is collision there and \w+ here", other)
    assert Outline(other).open == []


@pytest.mark.slow
def test_parts_are_computed_on_the_way(slippery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(material, "SAMPLES", 256)
    shutil.copytree(slippery, tmp_path / "copy", ignore=shutil.ignore_patterns("answers"))
    page = make_report([tmp_path / "copy"], only=["verdict", "causes", "tolerance", "risk", "rules"])
    assert "Cause 1: " in page
    assert page.count('<svg class="chart"') >= 4
    assert re.search(r"1? ?changes? suffices? for a collision", page)


def test_only_some_sections(slippery: Path) -> None:
    page = make_report([slippery], only=["verdict", "tested"])
    assert re.findall(r'<h2 id="(.*?)">', page) == ["verdict", "tested"]
    with pytest.raises(InputError, match="no section 'risks'"):
        make_report([slippery], only=["risks"])


@pytest.mark.parametrize("bad", ["<script>alert(1)</script>", "</script><b>\"'&", "{{ 7 * 7 }}", "$x$ \\N{DEGREE SIGN}"])
def test_text_of_a_study_stays_text(bad: str, slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "copy")
    manifest = json.loads((slippery / "manifest.json").read_text())
    manifest["study"]["title"] = bad
    write_manifest(tmp_path / "copy", manifest)
    page = make_report([tmp_path / "copy"], only=["tested", "verdict", "trust", "reproduce"])
    assert Outline(page).open == []
    assert "alert(1)</script>" not in page
    assert "49" not in re.findall(r"<strong>(.*?)</strong>", page)[0]


def test_studies_stand_side_by_side(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "other", ignore=shutil.ignore_patterns("answers"))
    page = make_report([slippery, tmp_path / "other"], only=["tested", "verdict", "trust", "reproduce"])
    assert page.count('<div class="card verdict bad">') == 2
    assert len(Outline(page).ids) == len(set(Outline(page).ids))


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


def test_a_chart_puts_its_points_where_they_belong_and_escapes_their_words() -> None:
    chart = str(scatter("told", [Dot(0, 0, "a", "hit"), Dot(100, 2, "<b>", "miss", "x")], "x", "y", 0.0, "line"))
    dots = [tuple(map(float, found)) for found in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', chart)]
    level = float(re.search(r'class="level" d="M62 ([\d.]+)H', chart)[1])  # type: ignore[index]
    assert dots[0] == (62.0, level)
    assert dots[1][0] > 600
    assert dots[1][1] < level
    assert "&lt;b&gt;" in chart
    assert "<b>" not in chart
