"""The page that compares studies with published ones: conclusions, tables side by side, and published rows near each solution."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.research_questions.case import NSGA2, Case, are_collisions
from safevar_sumo.records import FloatArray
from safevar_sumo.reference.conclusions import (
    COMPARED_SIDES,
    DIFFERS,
    HERE,
    HOLDS,
    IN_DIRECTION,
    PUBLISHED,
    RULES,
    UNDECIDED,
    ComparedTable,
    Conclusion,
    Pairs,
    compare_tables,
    draw_conclusions,
)
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE

NEAREST_ROWS = 5
"""Number of published rows that a solution is compared with."""


class Nearness(NamedTuple):
    """The solutions of one algorithm, compared with the five published rows nearest to each solution.

    Distances are Euclidean in widths of the domains, and medians: `distance` from solutions to published rows, `distance_published`
    between published rows. Safety degrees are means [m, -m/s]. `also_collide` is the share of collisions among the published rows
    nearest to colliding solutions.
    """

    setting: str
    algorithm: str
    solutions: int
    distance: float
    distance_published: float
    safety_here: float
    safety_published: float
    collisions: int
    also_collide: float | None


def compare_with_nearest_rows(case: Case, references: Sequence[ReferenceData]) -> list[Nearness]:
    """Compare the solutions of each algorithm with the nearest rows of the references, which must be data of the same vehicle."""
    domains = case.characteristics
    width = domains.upper - domains.lower
    scaled_rows = np.concatenate([data.settings for data in references]) / width
    safety = np.concatenate([data.metrics[SAFETY_DEGREE] for data in references])
    tree, count = scipy.spatial.cKDTree(scaled_rows), min(NEAREST_ROWS, len(scaled_rows))
    published_distances = tree.query(scaled_rows, count + 1)[0][:, 1:] if len(scaled_rows) > count else np.full((1, 1), np.nan)
    results = []
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        if solutions.empty:
            continue
        scaled_solutions: FloatArray = solutions[list(domains.names)].to_numpy(dtype=float) / width
        distances, nearest_rows = (np.reshape(array, (len(scaled_solutions), count)) for array in tree.query(scaled_solutions, count))
        is_collision = are_collisions(solutions).to_numpy()
        results.append(Nearness(
            setting=case.name, algorithm=algorithm, solutions=len(solutions), distance=float(np.median(distances)),
            distance_published=float(np.median(published_distances)), safety_here=float(np.nanmean(solutions[SAFETY_DEGREE])),
            safety_published=float(safety[nearest_rows].mean()), collisions=int(is_collision.sum()),
            also_collide=float((safety[nearest_rows[is_collision]] <= 0).mean()) if is_collision.any() else None))
    return results


VERDICT_PLURALS = {HOLDS: "hold", IN_DIRECTION: "hold in direction", DIFFERS: "differ", UNDECIDED: "cannot be decided"}
TITLES = {
    "rq1": "RQ1: solutions against the original vehicle", "rq2": "RQ2: NSGA-II against the others",
    "rq3.1": "RQ3.1: how many characteristics are changed [% of the critical solutions]",
    "rq3.2": "RQ3.2: which characteristics are changed [% of the critical solutions]", "rq3.3": "RQ3.3: how large the changes are",
    "rq3.3-safety": "RQ3.3: how the changes affect safety", "collisions": "Collisions", "combinations": "Four changed together",
    "weather": "One weather against another"}


def render_replication(pairs: Pairs, comparisons: Sequence[Nearness]) -> str:
    """The page, as Markdown."""
    tables = compare_tables(pairs)
    conclusions = draw_conclusions(tables)
    sections = [_render_head(pairs, conclusions), _render_conclusions(conclusions)]
    if comparisons:
        sections.append(_render_nearest_rows(comparisons))
    return "\n".join([*sections, "## Tables side by side\n", *(_render_table(table) for table in tables)])


def _render_head(pairs: Pairs, conclusions: Sequence[Conclusion]) -> str:
    counts = Counter(conclusion.verdict for conclusion in conclusions)
    summary = ", ".join(f"{counts[verdict]} {words}" for verdict, words in VERDICT_PLURALS.items())
    lines = ["# Does the published study replicate?", "", f"Of {len(conclusions)} conclusions: {summary}.", ""]
    for case, published_case in zip(pairs.here, pairs.published, strict=True):
        sizes = f"{_count_solutions(case.solutions)} here, {_count_solutions(published_case.solutions)} published"
        lines.append(f"- {case.study.title} ({case.study.name}): {sizes}.")
    lines += [f"- {name}: results here, none published given." for name in pairs.only_here]
    lines += [f"- {name}: published results given, none here." for name in pairs.only_published]
    for case, published_case in zip(pairs.here, pairs.published, strict=True):
        for side, case_with_solutions, other_case in ((PUBLISHED, case, published_case), (HERE, published_case, case)):
            for name in [name for name in case_with_solutions.algorithms if name not in other_case.algorithms]:
                effect = "; RQ2, RQ3 and the weathers need them and are not compared" if name == NSGA2 else ""
                lines.append(f"- {case.study.name}: no solutions of {name} {side}{effect}.")
    lines += [f"- {note}" for case in pairs.here for note in case.remarks]
    return "\n".join([*lines, ""])


def _count_solutions(frame: pd.DataFrame) -> str:
    return " + ".join(f"{number} of {name}" for name, number in frame["algorithm"].value_counts(sort=False).items()) or "no solution"


def _render_conclusions(conclusions: Sequence[Conclusion]) -> str:
    rows = [(*conclusion[:3], f"*{conclusion.verdict}*", conclusion.evidence) for conclusion in conclusions]
    return "\n".join(["## Conclusions", "", "Conclusions of the published results, and whether they hold here. The rules:", "",
                      *(f"- {rule}" for rule in RULES), "",
                      _markdown_table(("question", "setting", "published conclusion", "here", "why"), rows), ""])


def _render_nearest_rows(comparisons: Sequence[Nearness]) -> str:
    rows = [(*values, None if also_collide is None else 100 * also_collide) for *values, also_collide in comparisons]
    headings = ("setting", "algorithm", "solutions", "distance to published rows", "distance among published rows", "mean SD here",
             "mean SD published", "collisions here", "published rows next to them that collide [%]")
    return "\n".join([
        "## Does the search exploit the model?", "",
        f"Each solution beside its {NEAREST_ROWS} nearest published rows; distances are medians, in widths of the domains. If the search "
        "found holes in the model, the published rows next to its solutions would be as safe as others.", "",
        _markdown_table(headings, rows), ""])


def _render_table(table: ComparedTable) -> str:
    lines = [f"### {TITLES[table.name]}", ""]
    if not table.frame.empty:
        keys = [column for column in table.frame if column not in _column_names(table.quantities)]
        headings = [*map(str, keys), *(f"{name} {HERE} / {PUBLISHED}" for name in table.quantities)]
        rows = [(*(row[key] for key in keys),
                 *(" / ".join(_cell_text(row[f"{name} {side}"]) for side in COMPARED_SIDES) for name in table.quantities))
                for row in table.frame.to_dict("records")]
        lines += [_markdown_table(headings, rows), ""]
    return "\n".join([*lines, *(f"{note}  " for note in table.notes), ""])


def _column_names(quantities: Iterable[str]) -> set[str]:
    return {f"{name} {side}" for name in quantities for side in COMPARED_SIDES}


def _markdown_table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [headings, [":---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(_cell_text(cell) for cell in line)} |" for line in lines)


def _cell_text(value: object) -> str:
    if value is None or (isinstance(value, float) and pd.isna(value)):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value).replace("|", r"\|").replace("\n", " ")
