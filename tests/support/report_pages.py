"""Pages of `report` about the study `slippery`, and their words."""

from __future__ import annotations

import html
import re
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo.replay.animation import player_of
from safevar_sumo.report import replays, report

ASK = (
    "tolerance --fits 0 --characteristics tireFric,mass",
    "explain --quick --top 3",
    "risk --samples 400",
    "rules --samples 400",
)


def draw_few_frames(patch: pytest.MonkeyPatch) -> None:
    """Replays on pages have two frames, which are drawn in a twentieth of the time."""
    patch.setattr(replays, "player_of", partial(player_of, frames=2))


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
