"""Agreement of simulated settings with published rows: rank correlation, error, bias and
collisions.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.questions.answer import Answer, contents, tabulate
from safevar_sumo.questions.ask import question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.figures import (
    BLUE,
    FONT_SIZE,
    VERMILION,
    as_formula,
    new_panels,
)
from safevar_sumo.questions.research_questions.statistics import rounded_to_rank
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.questions.words import two_decimals
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.reference.rows import ReferenceData, read_reference
from safevar_sumo.results import evaluation_keys
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import SAFETY_DEGREE, Study, study_names, tables_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


COLUMNS = shipped_columns("validate")["agreement"]
ROWS_STAGE = "settings"
"""The name of the phase of progress."""
SHIPPED_AGREEMENT = Path(__file__).with_name("agreement.csv")
"""The file with the answers of `validate` for safety degrees of shipped studies and published
files.
"""
SIMULATION_KEYS = (
    "scenario",
    "vehicle",
    "ads",
    "weather",
    "metrics",
    "step_length",
    "matrix",
)
"""Keys of a study that change the metrics of a setting."""


@question
@contents(
    "rows",
    "collisions_here",
    "collisions_reference",
    "collisions_both",
    agreement=COLUMNS,
)
def validate(subject: Subject, evaluator: Evaluator, reference: Path) -> Answer:
    """Compare the simulation with published vehicles and metrics (a CSV file), row by row. For each
    metric, you get the rank correlation, the mean error and the bias of the simulated values
    against the published values. Rows that cannot be simulated, or whose values are outside the
    domains, are left out.

    Example: python -m safevar_sumo validate rain published.csv

    Parameters
    ----------
    reference
        The CSV file.
    """
    study = evaluator.study
    evaluator.begin({ROWS_STAGE: 1})
    data = read_reference(reference, evaluator.characteristics)
    evaluations = evaluator.evaluate(data.settings, ROWS_STAGE, ignore_constraints=True)
    valid = evaluations.valid
    if not valid.any():
        raise SimulationError(
            f"study {study.name!r} cannot be simulated with any row of {reference}"
        )
    data = data.take(valid)
    evaluations = evaluations.take(valid)
    numbers = agreement_counts(data, evaluations)
    table = measure_agreement(data, evaluations)
    measures = table.loc[
        table["metric"] == SAFETY_DEGREE, ["spearman", "mean_absolute_error", "bias"]
    ]
    order, error, bias = (
        two_decimals(measure) for measure in measures.to_numpy(float)[0]
    )
    verdict = (
        f"The safety degrees of {numbers['rows']} vehicles have a rank correlation of {order} with"
        f" the published data (mean error {error} m, bias {bias} m)."
        f" {numbers['collisions_both']} of {numbers['collisions_reference']} published collisions"
        " happen here, too."
    )
    return Answer(
        question="validate",
        study=study,
        verdict=verdict,
        numbers=numbers,
        tables={"agreement": tabulate("Agreement with the reference", COLUMNS, table)},
        draw=partial(
            _draw, f"{study.title}\nagainst {reference.name}", data, evaluations
        ),
    )


def _draw(
    title: str, reference: ReferenceData, evaluations: Evaluations, answer: Answer
) -> Figure:
    """Draw the values here over the values in the reference, in a panel for each metric."""
    table = answer.tables["agreement"]
    figure, axes = new_panels(
        title, len(table), 4, (3.0, 2.6), min_width=12.0, title_height=0.6
    )
    colours = np.where(reference.collided | evaluations.collided, VERMILION, BLUE)
    for axis, name, order in zip(axes, table["metric"], table["spearman"], strict=True):
        published = reference.metrics[name]
        simulated = evaluations.metrics[name]
        label = f"{METRICS[name].title} [{as_formula(METRICS[name].unit)}]"
        axis.scatter(published, simulated, s=6, alpha=0.4, c=colours, linewidths=0)
        # The line needs a point within the range of the values. Otherwise it would extend the axes.
        defined, _ = defined_pairs(published, simulated)
        origin = next(iter(defined), 0.0)
        axis.axline(
            (origin, origin), slope=1, color="black", linewidth=0.8, linestyle="--"
        )
        axis.set_title(f"rho = {two_decimals(order)}", fontsize=FONT_SIZE)
        axis.set(xlabel=f"reference: {label}", ylabel=f"here: {label}")
    figure.supxlabel("orange: collides in the reference or here", fontsize=FONT_SIZE)
    return figure


def agreement_counts(reference: ReferenceData, evaluations: Evaluations) -> JsonObject:
    """The numbers of rows, and of rows that collide here, in the reference, and in both."""
    return {
        "rows": len(evaluations),
        "collisions_here": int(evaluations.collided.sum()),
        "collisions_reference": int(reference.collided.sum()),
        "collisions_both": int((evaluations.collided & reference.collided).sum()),
    }


def measure_agreement(
    reference: ReferenceData, evaluations: Evaluations
) -> pd.DataFrame:
    """The rows of the table `COLUMNS`, one for each metric. NaN means undefined."""
    rows = []
    for name, values in reference.metrics.items():
        published, simulated = defined_pairs(values, evaluations.metrics[name])
        errors = simulated - published
        measures = np.nan, np.nan
        if errors.size:
            measures = np.abs(errors).mean(), errors.mean()
        rows.append(
            (
                name,
                METRICS[name].unit,
                rank_correlation(published, simulated),
                *measures,
            )
        )
    return pd.DataFrame(rows, columns=list(COLUMNS))


def defined_pairs(
    values: FloatArray, other_values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The values of both sides in the rows in which both are defined."""
    is_defined = ~np.isnan(values) & ~np.isnan(other_values)
    return values[is_defined], other_values[is_defined]


def rank_correlation(values: FloatArray, other_values: FloatArray) -> float:
    """Spearman's rank correlation. NaN for fewer than two values, or if all values of a side are
    equal.
    """
    pairs = rounded_to_rank(values), rounded_to_rank(other_values)
    if len(values) < 2 or np.ptp(pairs[0]) == 0 or np.ptp(pairs[1]) == 0:
        return np.nan
    return float(scipy.stats.spearmanr(*pairs).statistic)


def shipped_agreement(study: Study) -> pd.DataFrame:
    """The rows of `SHIPPED_AGREEMENT` that hold for a study: rows of shipped studies with the same
    values of `SIMULATION_KEYS`.
    """
    frame = pd.read_csv(SHIPPED_AGREEMENT)
    own_keys = evaluation_keys(tables_of(study))
    names = []
    for name in {*frame["study"]} & {*study_names()}:
        keys = evaluation_keys(tables_of(read_study(name)))
        if all(keys.get(key) == own_keys.get(key) for key in SIMULATION_KEYS):
            names.append(name)
    return frame[frame["study"].isin(names)]
