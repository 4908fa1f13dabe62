"""The words of a page of `report`."""

from __future__ import annotations

import html
import re


def words_of(page: str) -> str:
    """The text of a page, between single blanks."""
    return " ".join(
        html.unescape(
            re.sub(
                "<(style|script).*?</(style|script)>|<[^>]*>", "", page, flags=re.DOTALL
            )
        ).split()
    )
