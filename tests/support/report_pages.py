"""Pages of `report` about the study `slippery`, and their words."""

from __future__ import annotations

import html
import re
import tempfile
from pathlib import Path
from typing import Any

from safevar_sumo.report import report

ASK = (
    "tolerance --fits 0 --characteristics tireFric,mass",
    "explain --quick --top 3",
    "risk --samples 400",
    "rules --samples 400",
)


def page_of(
    *directories: Path,
    ask: Any = ("rules --samples 20",),
    jobs: int = 1,
    **options: Any,
) -> str:
    """The page that `report` writes, with one quick answer unless others are asked for."""
    with tempfile.TemporaryDirectory() as folder:
        return report(
            *directories, out=Path(folder, "page.html"), ask=ask, jobs=jobs, **options
        ).read_text(encoding="utf-8")


def words_of(page: str) -> str:
    """The text of a page, between single blanks."""
    return " ".join(
        html.unescape(
            re.sub(
                "<(style|script).*?</(style|script)>|<[^>]*>", "", page, flags=re.DOTALL
            )
        ).split()
    )
