"""The research questions: the tables and figures that `tables` and `figures` give."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.research_questions.answer import answer
from safevar_sumo.analysis.research_questions.case import Case, Unanswerable
from safevar_sumo.analysis.research_questions.figures import draw
from safevar_sumo.analysis.research_questions.layout import Bold, Table, lay_out
from safevar_sumo.replay.comparison import raised
from safevar_sumo.report.findings import best_of, spread
from safevar_sumo.report.input import ReportInput
from safevar_sumo.report.svg import Dot, scatter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIGITS = re.compile(r"(\d\.\d\d)\d+")
"""Of a number in a picture, what is too fine to be seen."""
DOTS = 150
"""Points of a scatter chart, at the most."""
TEXT = {"svg.fonttype": "none", "svg.hashsalt": "safevar_sumo", "font.family": ["sans-serif"]}


def tables(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Every table, as the template takes it; nothing where no question can be answered."""
    try:
        answers = answer(cases)
    except Unanswerable as error:
        return [{"title": "RQ1 to RQ3", "heads": (), "spans": (), "rows": [], "labels": 0, "notes": [f"{error.source}: {error.problem}."]}]
    return [_plain(table) for one in answers for table in lay_out(one)]


def _plain(table: Table) -> dict[str, Any]:
    rows = [[{"text": raised(str(cell)), "bold": isinstance(cell, Bold)} for cell in row] for row in table.rows]
    spans = [("", table.labels), *((raised(name), width) for name, width in table.spans)] if table.spans else []
    heads, notes = ([raised(text) for text in texts] for texts in (table.heads, table.notes))
    return {"title": raised(table.title), "heads": heads, "spans": spans, "rows": rows, "labels": table.labels, "notes": notes}


def figures(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Every figure as a picture that stands in the page."""
    try:
        drawn, _ = draw(cases)
    except Unanswerable:
        return []
    return [{"name": name, "alt": _words(figure), "source": _inline(figure)} for name, figure in drawn.items()]


def _words(figure: Figure) -> str:
    axis = figure.axes[0]
    return f"{figure.get_suptitle()}: {axis.get_ylabel() or 'values'} over {axis.get_xlabel() or 'characteristics'}".replace("\n", " ")


def _inline(figure: Figure) -> str:
    import matplotlib

    buffer = BytesIO()
    with matplotlib.rc_context(TEXT):  # type: ignore[arg-type]
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    picture = DIGITS.sub(r"\1", buffer.getvalue().decode())
    return "data:image/svg+xml," + quote(picture, safe=" =:/;,()'!?@&+$*")


def front(material: ReportInput, shown: Sequence[str]) -> Markup:
    """The solutions that no other one beats, by largest change and safety degree; those that are replayed lead there."""
    rows = [row for row in material.solutions.values() if not np.isnan([row["f_safe"], row["f_diff"]]).any()]
    best = best_of(rows)
    kept = [best[place] for place in spread(len(best), DOTS)] + [row for row in rows if row["handle"] in shown]
    dots = {row["handle"]: _dot(material, row, row["handle"] in shown) for row in kept}
    return scatter(f"{material.case.name}: safety degree over the largest change of the solutions that no other beats",
                   list(dots.values()), "largest change [% of the original]", "safety degree [m, or -m/s]", 0.0, "collision below")


def _dot(material: ReportInput, row: dict[Any, Any], is_shown: bool) -> Dot:
    words = (f"{row['handle']}: {row['outcome']}, safety degree {row['f_safe']:.2f}, largest change {row['f_diff']:.0%}, "
             f"{row['f_num_diff']} changed")
    look = "hit" if row["outcome"] == "collision" else "miss"
    return Dot(100 * row["f_diff"], row["f_safe"], words, look, material.anchor("replay", row["handle"]) if is_shown else "")
