"""The sentences of a verdict: each is one template, which names and numbers fill."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

FIRST_WORD = re.compile(r"^[a-z]+\b")
KINDS = "answer", "evidence", "condition", "note"
"""What a sentence is to its reader, the most important kind first; a note stands below the table.
"""


class Sentence(NamedTuple):
    """A whole sentence, or the template of one, whose slots are in braces; more than one where a
    reader needs them together.
    """

    kind: str
    text: str

    def __call__(self, **values: object) -> Sentence:
        """The sentence with values in its slots."""
        text = self.text.format(**values)
        # A key, such as `brake_force` or `sensorLatency`, stays as users write it.
        return self._replace(text=FIRST_WORD.sub(lambda word: word[0].title(), text))


answer, evidence, condition, note = (partial(Sentence, kind) for kind in KINDS)
"""A sentence of this kind."""


class Verdict(str):
    """Sentences by kind, joined to one text by spaces."""

    sentences: list[Sentence]

    def __new__(cls, sentences: Iterable[Sentence]) -> Verdict:
        """The text of sentences, sorted by kind; each once, and none without text."""
        kept_sentences = [item for item in dict.fromkeys(sentences) if item.text]
        kept_sentences.sort(key=lambda sentence: KINDS.index(sentence.kind))
        verdict = super().__new__(cls, " ".join(text for _, text in kept_sentences))
        verdict.sentences = kept_sentences
        return verdict

    def __getnewargs__(self) -> tuple[Any]:
        """What makes the same verdict again, in a copy or in another process."""
        return (self.sentences,)

    @classmethod
    def of(cls, text: str) -> Verdict:
        """A text as a verdict; one without kinds is a single sentence."""
        return text if isinstance(text, Verdict) else cls([answer(text)])
