"""Answers as a notebook shows them: the sentences and tables of the terminal, escaped."""

from __future__ import annotations

from html.parser import HTMLParser

import msgspec

from safevar_sumo import risk
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
