"""Pages of `report` about the study `slippery`."""

from __future__ import annotations

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
