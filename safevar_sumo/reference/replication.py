"""Does the published study replicate? Our results and the published ones as one Markdown page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import pandas as pd

from safevar_sumo.analysis.case import NSGA2
from safevar_sumo.reference.beside import HERE, THERE, Beside, Pairs, paired, tables_beside
from safevar_sumo.reference.conclusions import DIFFERS, DIRECTION, HOLDS, OPEN, RULES, Conclusion, conclusions
from safevar_sumo.reference.nearness import NEIGHBOURS, Nearness

COUNTED = {HOLDS: "hold", DIRECTION: "hold in direction", DIFFERS: "differ", OPEN: "cannot be told"}
TITLES = {
    "rq1": "RQ1: solutions against the original vehicle", "rq2": "RQ2: NSGA-II against the others",
    "rq3.1": "RQ3.1: how many characteristics are changed [% of the critical solutions]",
    "rq3.2": "RQ3.2: which characteristics are changed [% of the critical solutions]", "rq3.3": "RQ3.3: how large the changes are",
    "rq3.3-safety": "RQ3.3: what they do to safety", "collisions": "Collisions", "combinations": "Four changed together",
    "weather": "One weather against another"}

NOT_COMPARED = ": RQ2, RQ3 and the weathers are about them and are not compared"


def replication(pairs: Pairs, near: Sequence[Nearness]) -> str:
    """The whole page."""
    tables = tables_beside(pairs)
    found = conclusions(tables)
    parts = [_head(pairs, found), _conclusions(found)]
    if near:
        parts.append(_near(near))
    return "\n".join([*parts, "## Cell beside cell\n", *(_beside(table) for table in tables)])


def _head(pairs: Pairs, found: Sequence[Conclusion]) -> str:
    counts = Counter(one.verdict for one in found)
    told = ", ".join(f"{counts[verdict]} {words}" for verdict, words in COUNTED.items())
    lines = ["# Does the published study replicate?", "", f"Of {len(found)} conclusions: {told}.", ""]
    for here, there in zip(pairs.here, pairs.there, strict=True):
        sizes = f"{_solutions(here.solutions)} here, {_solutions(there.solutions)} published"
        lines.append(f"- {here.study.title} ({here.study.name}): {sizes}.")
    lines += [f"- {name}: results here, none published given." for name in pairs.only_here]
    lines += [f"- {name}: published results given, none here." for name in pairs.only_there]
    for here, there in zip(pairs.here, pairs.there, strict=True):
        lines += [f"- {here.study.name}: no solutions of {name} {side}{NOT_COMPARED if name == NSGA2 else ''}."
                  for side, one, other in ((THERE, here, there), (HERE, there, here))
                  for name in one.algorithms if name not in other.algorithms]
    lines += [f"- {note}" for case in pairs.here for note in case.remarks]
    return "\n".join([*lines, ""])


def _solutions(frame: pd.DataFrame) -> str:
    return " + ".join(f"{number} of {name}" for name, number in frame["algorithm"].value_counts(sort=False).items()) or "no solution"


def _conclusions(found: Sequence[Conclusion]) -> str:
    rows = [(one.question, one.setting, one.words, f"*{one.verdict}*", one.why) for one in found]
    return "\n".join(["## Conclusions", "", "What the published results say, and whether it holds here. The rules:", "",
                      *(f"- {rule}" for rule in RULES), "",
                      _markdown(("question", "setting", "published conclusion", "here", "why"), rows), ""])


def _near(near: Sequence[Nearness]) -> str:
    rows = [(one.setting, one.algorithm, one.solutions, one.distance, one.distance_there, one.safety_here, one.safety_there,
             one.collisions, None if one.also_collide is None else 100 * one.also_collide) for one in near]
    heads = ("setting", "algorithm", "solutions", "distance to published rows", "these to each other", "mean SD here", "mean SD there",
             "collisions here", "published rows next to them that collide [%]")
    return "\n".join([
        "## Does the search exploit the model?", "",
        f"The {NEIGHBOURS} published rows nearest to each solution, distances in widths of the domains (median). If the search found "
        "holes in the model, the published rows next to what it found would be as safe as any.", "", _markdown(heads, rows), ""])


def _beside(table: Beside) -> str:
    lines = [f"### {TITLES[table.name]}", ""]
    if not table.frame.empty:
        keys = [column for column in table.frame if column not in _pairs(table.quantities)]
        heads = [*map(str, keys), *(f"{name} {HERE} / {THERE}" for name in table.quantities)]
        rows = [(*(row[key] for key in keys),
                 *(" / ".join(_cell(row[f"{name} {side}"]) for side in (HERE, THERE)) for name in table.quantities))
                for row in table.frame.to_dict("records")]
        lines += [_markdown(heads, rows), ""]
    return "\n".join([*lines, *(f"{note}  " for note in table.notes), ""])


def _pairs(quantities: Iterable[str]) -> set[str]:
    return {f"{name} {side}" for name in quantities for side in (HERE, THERE)}


def _markdown(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [heads, [":---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(_cell(cell) for cell in line)} |" for line in lines)


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and pd.isna(value)):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value).replace("|", r"\|").replace("\n", " ")


__all__ = ["paired", "replication"]
