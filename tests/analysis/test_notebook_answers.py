"""Answers as a notebook shows them: the sentences and tables of the terminal, escaped."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

import msgspec

from safevar_sumo import Opinion, Opinions, Rule, Unsafe, risk, rules
from safevar_sumo.analysis.opinion.compute import RunEnd
from safevar_sumo.terminal import WholeTable, answer_as_html
from tests.analysis.known_regions import Plant, box, made_up_study


class Cells(HTMLParser):
    """The texts of a page by the tag that holds them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.texts: list[tuple[str, str]] = []
        self._tag = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self._tag = tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.texts.append((self._tag, data))


def test_a_notebook_shows_the_sentences_and_tables_of_the_terminal() -> None:
    study = msgspec.structs.replace(made_up_study(2), title="a < b & <script>")
    result = risk(study, unsafe="collision", samples=2000, pool=Plant(study, box))
    texts = Cells(answer_as_html(result)).texts
    assert result._repr_html_() == answer_as_html(result)
    assert "<script>" not in result._repr_html_()
    assert ("h4", "a < b & <script>") in texts
    for part in result.sentences():
        if isinstance(part, str):
            assert ("p", part) in texts
        elif isinstance(part, WholeTable):
            for column in part.columns:
                assert ("th", str(column.header)) in texts
                assert all(("td", str(cell)) in texts for cell in column.cells)
    assert ("caption", "What decides: share of the variance") in texts


def test_rules_and_opinions_have_a_picture() -> None:
    study = made_up_study(2)
    result = rules(study, unsafe="collision", pool=Plant(study, box))
    undefined = Rule({}, None, None, None, None)
    axis = replace(result, rules=[*result.rules, undefined]).figure().axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["a above 7 N m\nb below 3 N m", "everywhere"]
    assert replace(result, rules=[]).figure().axes
    ends = [
        (RunEnd("collision", -2.0), RunEnd("collision", -1.5), "confirmed"),
        (RunEnd("stopped", 1.0), RunEnd(), "outside"),
    ]
    causes = tuple(
        Opinion(solution=f"rs:0:{number}", changes={"a": 7.0}, here=here, there=there, opinion=verdict, because="")
        for number, (here, there, verdict) in enumerate(ends)
    )
    opinions = Opinions(
        study=study, unsafe=Unsafe(), opinions=causes, original_here=RunEnd("stopped", 2.0), original_there=RunEnd()
    )
    shown = opinions.figure().axes[0]
    assert [line.get_label() for line in shown.lines[:1]] == ["confirmed"]
    assert shown.lines[0].get_xydata().tolist() == [[-2.0, -1.5]]
