"""The sentences of a verdict: each is one template, which names and numbers fill."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple, get_args

Kind = Literal["answer", "evidence", "condition", "note"]
"""What a sentence is to its reader, the most important kind first; a note stands below the table.
"""
KINDS = get_args(Kind)


class Sentence(NamedTuple):
    """A whole sentence, or the template of one, whose slots are in braces; more than one where a
    reader needs them together.
    """

    kind: Kind
    text: str

    def fill(self, **values: object) -> Sentence:
        """The sentence with values in its slots."""
        text = self.text.format(**values)
        return self._replace(text=text[:1].upper() + text[1:])


class Verdict(str):
    """Sentences, joined to one text by spaces."""

    sentences: tuple[Sentence, ...]

    def __new__(cls, sentences: Iterable[Sentence]) -> Verdict:
        """The text of sentences; one without text is left out."""
        said = tuple(sentence for sentence in sentences if sentence.text)
        verdict = super().__new__(cls, " ".join(sentence.text for sentence in said))
        verdict.sentences = said
        return verdict
