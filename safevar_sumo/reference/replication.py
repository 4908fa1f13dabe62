"""The page that compares studies with published ones: conclusions, tables side by side, and published rows near each
solution.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.case import NSGA2, Case, are_collisions
from safevar_sumo.analysis.research_questions.tables import TITLES
from safevar_sumo.errors import InputError
from safevar_sumo.records import JsonObject
from safevar_sumo.reference.conclusions import (
    DIFFERS,
    HERE,
    HOLDS,
    IN_DIRECTION,
    PUBLISHED,
    RULES,
    UNDECIDED,
    Conclusion,
    ReplicationVerdict,
    compare_tables,
    draw_conclusions,
)
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE

NEAREST_ROWS = 5
"""Number of published rows that a solution is compared with."""
VERDICT_PLURALS = {HOLDS: "hold", IN_DIRECTION: "hold in direction", DIFFERS: "differ", UNDECIDED: "cannot be decided"}


def replicate(
    here: Sequence[Case], published: Sequence[Case], references: Mapping[str, Sequence[ReferenceData]]
) -> str:
    """The page, as Markdown; `references` are published rows by the case that they are compared with.

    Raises
    ------
    InputError
        If one side has two results of a study, or no study has results on both sides.
    """
    for argument, cases in (("directories", here), ("published", published)):
        names = [case.study.name for case in cases]
        if len({*names}) < len(names):
            raise InputError(argument, f"has two results of a study: {', '.join(names)}", "one of each study")
    ours, theirs = ({case.study.name: case for case in cases} for cases in (here, published))
    pairs = [(case, theirs[name]) for name, case in ours.items() if name in theirs]
    if not pairs:
        raise InputError(
            "published",
            f"has {', '.join(theirs)} and none of {', '.join(ours)}",
            "published results of a study in DIR (the command `import` makes them)",
        )
    tables = compare_tables(*zip(*pairs, strict=True))
    conclusions = draw_conclusions(tables)
    lines = [
        *_head_lines(pairs, conclusions),
        *(f"- {name}: results here, none published given." for name in ours if name not in theirs),
        *(f"- {name}: published results given, none here." for name in theirs if name not in ours),
        "",
        "## Conclusions",
        "",
        "Conclusions of the published results, and whether they hold here. The rules:",
        "",
        *(f"- {rule}" for rule in RULES),
        "",
        _markdown_table(("question", "setting", "published conclusion", "here", "why"), conclusions),
        "",
    ]
    lines += _lines_on_nearest_rows([case for case, _ in pairs], references)
    lines.append("## Tables side by side\n")
    for table in tables:
        lines += [
            f"### {TITLES[table.name]}",
            "",
            *([_render_table(table.frame), ""] if len(table.frame) else []),
            *(f"{note}  " for note in table.notes),
            "",
        ]
    return "\n".join(lines)


def _lines_on_nearest_rows(cases: Sequence[Case], references: Mapping[str, Sequence[ReferenceData]]) -> list[str]:
    known = [case for case in cases if case.name in references]
    rows = [row for case in known for row in compare_with_nearest_rows(case, references[case.name])]
    if not rows:
        return []
    return [
        "## Does the search exploit the model?",
        "",
        f"Each solution beside its {NEAREST_ROWS} nearest published rows; distances are medians, in widths of the "
        "domains. If the search found holes in the model, the published rows next to its solutions would be as safe as "
        "others.",
        "",
        _markdown_table(list(rows[0]), [list(row.values()) for row in rows]),
        "",
    ]


def _head_lines(pairs: Sequence[tuple[Case, Case]], conclusions: Sequence[Conclusion]) -> list[str]:
    counts = Counter(conclusion.verdict for conclusion in conclusions)
    summary = ", ".join(f"{counts[verdict]} {words}" for verdict, words in VERDICT_PLURALS.items())
    lines = ["# Does the published study replicate?", "", f"Of {len(conclusions)} conclusions: {summary}.", ""]
    for here, published in pairs:
        name, texts = here.study.name, []
        for case in (here, published):
            sizes = Counter(case.solutions["algorithm"])
            texts.append(" + ".join(f"{number} of {algorithm}" for algorithm, number in sizes.items()) or "no solution")
        lines.append(f"- {here.study.title} ({name}): {texts[0]} here, {texts[1]} published.")
        one_sided = {*here.algorithms} ^ {*published.algorithms}
        if one_sided:
            effect = "; RQ2, RQ3 and the weathers need them" if NSGA2 in one_sided else ""
            lines.append(
                f"- {name}: solutions on one side only are not compared: {', '.join(sorted(one_sided))}{effect}."
            )
        lines += [f"- {note}" for note in here.remarks]
    return lines


def compare_with_nearest_rows(case: Case, references: Sequence[ReferenceData]) -> list[JsonObject]:
    """Compare the solutions of each algorithm with the nearest rows of references of the same vehicle.

    Distances are Euclidean in widths of the domains, and medians. Safety degrees are means [m, -m/s]. The last column
    is the share of collisions among the published rows nearest to colliding solutions; NaN without such solutions.
    """
    domains = case.characteristics
    width = domains.upper - domains.lower
    scaled_rows = np.concatenate([data.settings for data in references]) / width
    safety = np.concatenate([data.metrics[SAFETY_DEGREE] for data in references])
    tree, count = scipy.spatial.cKDTree(scaled_rows), min(NEAREST_ROWS, len(scaled_rows))
    published_distance = np.nan
    if len(scaled_rows) > count:
        distances, _ = tree.query(scaled_rows, count + 1)
        published_distance = float(np.median(distances[:, 1:]))  # without a row's distance from itself
    results = []
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        if not solutions.empty:
            scaled_solutions = solutions[list(domains.names)].to_numpy(dtype=float) / width
            distances, nearest_rows = (
                np.reshape(array, (len(scaled_solutions), count)) for array in tree.query(scaled_solutions, count)
            )
            is_collision = are_collisions(solutions).to_numpy()
            collision_share = np.nan
            if is_collision.any():
                collision_share = 100 * float((safety[nearest_rows[is_collision]] <= 0).mean())
            results.append(
                {
                    "setting": case.name,
                    "algorithm": algorithm,
                    "solutions": len(solutions),
                    "distance to published rows": float(np.median(distances)),
                    "distance among published rows": published_distance,
                    "mean SD here": float(np.nanmean(solutions[SAFETY_DEGREE])),
                    "mean SD published": float(safety[nearest_rows].mean()),
                    "collisions here": int(is_collision.sum()),
                    "published rows next to them that collide [%]": collision_share,
                }
            )
    return results


def _render_table(frame: pd.DataFrame) -> str:
    texts = frame.map(_cell_text)
    quantities = frame.columns.get_level_values(1).unique()
    cells = {f"{name} {HERE} / {PUBLISHED}": texts[HERE, name] + " / " + texts[PUBLISHED, name] for name in quantities}
    table = pd.DataFrame(cells).reset_index()
    return _markdown_table([*table], table.to_numpy().tolist())


def _markdown_table(headings: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    return "\n".join(f"| {' | '.join(map(_cell_text, line))} |" for line in (headings, [":---"] * len(headings), *rows))


def _cell_text(value: object) -> str:
    if isinstance(value, ReplicationVerdict):
        return f"*{value}*"
    if str(value) in ("None", "nan", "<NA>"):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value).replace("|", r"\|").replace("\n", " ")
