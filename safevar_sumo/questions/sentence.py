"""The sentences of a verdict. Each sentence is one template, whose slots names and numbers fill."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

FIRST_SLOT = re.compile(r"(?:^|(?<=\. ))\{(\w+)\}")
"""A slot at the beginning of a sentence, in a template of one or several sentences."""
KINDS = "answer", "evidence", "condition", "note"
"""The kinds of sentences, in the order in which readers see them. A note stands below the table."""


class Sentence(NamedTuple):
    """A whole sentence, or its template with slots in braces. The text may have several sentences,
    if a reader needs them together.
    """

    kind: str
    text: str

    def __call__(self, **values: object) -> Sentence:
        """The sentence with values in its slots. Each sentence begins with a capital letter."""

        def begin(slot: re.Match[str]) -> str:
            """The value of a slot, as a text that `format` leaves as it is."""
            text = with_capital(str(values[slot[1]]))
            return text.replace("{", "{{").replace("}", "}}")

        return self._replace(text=FIRST_SLOT.sub(begin, self.text).format(**values))


def with_capital(text: str) -> str:
    """A text with a capital letter at its beginning. A key such as `brake_force` or `sensorLatency`
    stays as users write it, after a noun.
    """
    word, _, _ = text.partition(" ")
    if not text[:1].islower():
        return text
    if word.replace("-", "").isalpha() and word.islower():
        return text[0].upper() + text[1:]
    return f"The characteristic {text}"


Sentences = Iterator[Sentence]

answer, evidence, condition, note = (partial(Sentence, kind) for kind in KINDS)
"""Functions that make a sentence of their kind from a text."""


class Verdict(str):
    """A text of several sentences, which knows the kind of each sentence."""

    sentences: list[Sentence]

    def __new__(cls, sentences: Iterable[Sentence]) -> Verdict:
        """Join sentences, sorted by kind. Equal sentences occur once, and empty ones not at all."""
        kept_sentences = [item for item in dict.fromkeys(sentences) if item.text]
        kept_sentences.sort(key=lambda sentence: KINDS.index(sentence.kind))
        verdict = super().__new__(cls, " ".join(text for _, text in kept_sentences))
        verdict.sentences = kept_sentences
        return verdict

    def __getnewargs__(self) -> tuple[Any]:
        """The arguments with which pickle or copy makes the same verdict again."""
        return (self.sentences,)

    @classmethod
    def of(cls, text: str) -> Verdict:
        """A text as a verdict. A text that knows no kinds becomes a single answer."""
        return text if isinstance(text, Verdict) else cls([answer(text)])
