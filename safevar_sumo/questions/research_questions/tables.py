"""The tables of the research questions, and the functions that compute them. The file tables.toml
beside this module has their titles and columns, and how readers see them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pandas as pd

from safevar_sumo.questions.answer import Wide
from safevar_sumo.questions.research_questions import budgets, changes, comparisons
from safevar_sumo.questions.research_questions.fronts import (
    count_evaluations,
    summarise_convergence,
)
from safevar_sumo.questions.tables import NamedColumns, columns_from
from safevar_sumo.shipped import shipped_table

CAUSES = "causes"
CHOSEN = (
    "rq1-runs",
    "rq2-runs",
    "rq2-common",
    "medians",
    "budget",
    CAUSES,
    "rq1",
    "rq2",
    "a12",
)
"""Names of the tables that depend on a reader's `Choices`."""
Compute = Callable[..., pd.DataFrame]


class PaperTable(NamedTuple):
    """A table: its title, the function of a case that computes it, its columns, and how readers see
    a long table (`wide`; None for no other form).
    """

    title: str
    compute: Compute
    columns: NamedColumns
    wide: Wide | None

    @classmethod
    def of(cls, name: str, compute: Compute) -> PaperTable:
        """The table `name` as tables.toml declares it."""
        table = DATA["tables"][name]
        definitions = DATA["columns"] | table.get("own", {})
        columns = columns_from({key: definitions[key] for key in table["columns"]})
        wide = Wide(**table["wide"]) if "wide" in table else None
        return cls(table["title"], compute, columns, wide)


DATA = shipped_table("questions/research_questions/tables.toml")
FUNCTIONS: dict[str, Compute] = {
    "rq1-runs": comparisons.rq1_runs,
    "rq2-runs": comparisons.rq2_runs,
    "rq2-common": comparisons.rq2_common,
    "a12": comparisons.effects,
    "medians": comparisons.medians_over_runs,
    CAUSES: comparisons.minimal_causes,
    "rq1": comparisons.rq1,
    "rq2": comparisons.rq2,
    "evaluations": count_evaluations,
    "convergence": summarise_convergence,
    "rq3.1": changes.rq31,
    "rq3.2": changes.rq32,
    "rq3.3": changes.rq33,
    "rq3.3-safety": changes.rq33_safety,
    "collisions": changes.count_collisions,
    "combinations": changes.frequent_combinations,
}
ON_REQUEST = {"budget": budgets.compare_budgets}
"""Tables that are computed only if a user names them. Then no other table is computed."""
OVER_RUNS = ("rq1-runs", "rq2-runs", "rq2-common", "a12", "collisions", CAUSES)
AS_PUBLISHED = ("rq1", "rq2")
POOLED = (*AS_PUBLISHED, "collisions")
"""Names of tables. `OVER_RUNS` may lead an answer about results with runs, and `POOLED` an answer
about imported solutions, which belong to no run. `AS_PUBLISHED` pool the solutions of all runs, as
the paper does.
"""
TABLES = {
    name: PaperTable.of(name, compute)
    for name, compute in (FUNCTIONS | ON_REQUEST).items()
}
