"""The fenced blocks of the manual's pages, without any package."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PROGRAM = "python -m safevar_sumo "
BLOCK = re.compile(
    r'(?:^<!-- ([^\n]*) -->\n+)?^```(\w*)(?: title="([^"]+)")?\n(.*?)^```$',
    flags=re.DOTALL | re.MULTILINE,
)
GENERATED = re.compile(
    "<!-- generated: .*?<!-- end of what is generated -->", re.DOTALL
)


class Block(NamedTuple):
    """A fenced block of a page: the comment above it, its language, the file that it is the content
    of, its text, and the place of the text in the page. What is not there is "".
    """

    comment: str
    language: str
    title: str
    text: str
    place: tuple[int, int]


def written(page: str) -> str:
    """A page of the manual, with empty lines in place of what docs/generate.py writes."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return GENERATED.sub(lambda match: "\n" * len(match[0]), text)


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page of the manual."""
    found = []
    for match in BLOCK.finditer(written(page)):
        comment, language, title, text = match.groups(default="")
        found.append(Block(comment, language, title, text, match.span(4)))
    return found


def files_of(*pages: str) -> dict[str, str]:
    """The files that pages of the manual show, by their names."""
    return {
        block.title: block.text
        for page in pages
        for block in blocks(page)
        if block.title
    }
