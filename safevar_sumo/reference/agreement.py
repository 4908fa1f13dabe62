"""Agreement of simulated settings with published rows: rank correlation, error, bias and collisions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, VERMILION, as_formula, new_panels, save
from safevar_sumo.analysis.words import two_decimals
from safevar_sumo.api.simulation import evaluate_settings
from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, finite_or_none
from safevar_sumo.reference.rows import ReferenceData, read_reference
from safevar_sumo.results import evaluation_keys
from safevar_sumo.study import SAFETY_DEGREE, Study, StudyLike, load_study, study_names, tables_of
from safevar_sumo.terminal import Progress, show_no_progress
from safevar_sumo.vehicles import CharacteristicSet

MEANINGS = {
    "spearman": "Spearman's rank correlation",
    "mean_absolute_error": "mean of |here - reference|",
    "bias": "mean of here - reference",
}
"""The measures of agreement. TET and TIT are compared over settings that collide neither here nor in the reference."""
HEADINGS = {"spearman": "rank correlation", "mean_absolute_error": "mean error", "bias": "bias"}
SHIPPED_AGREEMENT = Path(__file__).with_name("agreement.csv")
"""Safety degrees of shipped studies and published files: what `validate STUDY FILE` answers."""
SIMULATION_KEYS = ("scenario", "vehicle", "ads", "weather", "metrics", "step_length", "matrix")
"""Study keys that affect the metrics of a setting."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of a study with a file of published rows.

    Attributes
    ----------
    study
        Name of the study.
    numbers
        Numbers of rows, and of those that collide here, in the reference, and in both.
    table
        A row for each metric; columns as in `MEANINGS`, NaN where undefined.
    reference, here
        The rows, and what they are here.
    """

    study: str
    numbers: dict[str, int]
    table: pd.DataFrame
    reference: ReferenceData
    here: Evaluations

    @property
    def verdict(self) -> str:
        """How well the safety degrees agree, in a sentence."""
        order, error, bias = map(two_decimals, self.table.loc[SAFETY_DEGREE].to_numpy(dtype=float))
        return (
            f"Over {self.numbers['rows']} vehicles the safety degree has a rank correlation of {order} "
            f"with the reference, a mean error of {error} m and a bias of {bias} m; of "
            f"{self.numbers['collisions_reference']} collisions in the reference "
            f"{self.numbers['collisions_both']} happen here."
        )

    def to_dict(self) -> JsonObject:
        """The answer for JSON; undefined numbers are null."""
        meanings = {"metric": "safety metric", "unit": "unit of the metric and of its errors", **MEANINGS}
        units = dict.fromkeys(meanings, "-") | dict.fromkeys(("mean_absolute_error", "bias"), "as in column unit")
        columns = {name: {"unit": units[name], "meaning": meaning} for name, meaning in meanings.items()}
        rows = [
            {
                "metric": name,
                "unit": METRICS[name].unit,
                **dict(zip(MEANINGS, [finite_or_none(value) for value in values], strict=True)),
            }
            for name, *values in self.table.itertuples()
        ]
        return {
            "question": "validate",
            "study": self.study,
            "verdict": self.verdict,
            "numbers": self.numbers,
            "tables": {"agreement": {"columns": columns, "rows": rows}},
        }

    def plot(self, path: Path, title: str) -> None:
        """Draw the values here over those in the reference, metric by metric.

        Raises
        ------
        InputError
            If the file cannot be written or its ending names no picture format.
        """
        figure, axes = new_panels(title, len(self.table), 4, (3.0, 2.6), min_width=12.0, title_height=0.6)
        colours = np.where(self.reference.collided | self.here.collided, VERMILION, BLUE)
        for axis, (name, there) in zip(axes, self.reference.metrics.items(), strict=True):
            here = self.here.metrics[name]
            label = f"{METRICS[name].title} [{as_formula(METRICS[name].unit)}]"
            axis.scatter(there, here, s=6, alpha=0.4, c=colours, linewidths=0)
            defined, _ = defined_pairs(there, here)
            origin = float(defined[0]) if defined.size else 0.0  # in the values' range, so that the axes keep theirs
            axis.axline((origin, origin), slope=1, color="black", linewidth=0.8, linestyle="--")
            axis.set_title(f"rho = {two_decimals(self.table['spearman'][name])}", fontsize=FONT_SIZE)
            axis.set(xlabel=f"reference: {label}", ylabel=f"here: {label}")
        figure.supxlabel("orange: collides in the reference or here", fontsize=FONT_SIZE)
        save(figure, path, "plot")


def validate(
    study: StudyLike, reference: str | Path, *, jobs: int | None = None, progress: Progress = show_no_progress
) -> Agreement:
    """Compare a study with settings and metrics in the published package's CSV format.

    Parameters
    ----------
    study
        A study, or anything that `load_study` accepts.
    reference
        The CSV file. Rows with values outside the domains, and rows that cannot be simulated, are left out.
    jobs
        Worker processes, by default one for each core.
    progress
        A function called with the stage, the number of settings done, and of all.

    Raises
    ------
    InputError
        If the study or the file cannot be used.
    SimulationError
        If no row can be simulated.
    """
    loaded_study = load_study(study)
    data = read_reference(Path(reference), CharacteristicSet.of(loaded_study))
    here = evaluate_settings(loaded_study, data.settings, jobs=jobs, progress=progress)
    if not here.valid.any():
        raise SimulationError(f"study {loaded_study.name!r} cannot be simulated with any row of {reference}")
    data, here = data.take(here.valid), here.take(here.valid)
    return Agreement(loaded_study.name, count_collisions(data, here), measure_agreement(data, here), data, here)


def count_collisions(reference: ReferenceData, here: Evaluations) -> dict[str, int]:
    """Numbers of rows, and of those that collide here, in the reference, and in both."""
    return {
        "rows": len(here),
        "collisions_here": int(here.collided.sum()),
        "collisions_reference": int(reference.collided.sum()),
        "collisions_both": int((here.collided & reference.collided).sum()),
    }


def measure_agreement(reference: ReferenceData, here: Evaluations) -> pd.DataFrame:
    """The measures of `MEANINGS` by metric."""
    rows = {}
    for name, values in reference.metrics.items():
        there, simulated = defined_pairs(values, here.metrics[name])
        errors = simulated - there
        measures = (np.abs(errors).mean(), errors.mean()) if errors.size else (np.nan, np.nan)
        rows[name] = (rank_correlation(there, simulated), *measures)
    return pd.DataFrame.from_dict(rows, "index", columns=list(MEANINGS)).rename_axis("metric")


def defined_pairs(values: FloatArray, other_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both values of the rows in which both are defined."""
    is_defined = ~np.isnan(values) & ~np.isnan(other_values)
    return values[is_defined], other_values[is_defined]


def rank_correlation(values: FloatArray, other_values: FloatArray) -> float:
    """Spearman's rho; NaN for fewer than two values or if all values of one side are equal."""
    if len(values) < 2 or np.ptp(values) == 0 or np.ptp(other_values) == 0:
        return np.nan
    return float(scipy.stats.spearmanr(values, other_values).statistic)


def shipped_agreement(study: Study) -> pd.DataFrame:
    """The rows of `SHIPPED_AGREEMENT` that hold for a study: those of shipped studies with the same
    `SIMULATION_KEYS`.
    """
    frame = pd.read_csv(SHIPPED_AGREEMENT)
    keys = {
        name: evaluation_keys(tables_of(load_study(name))) for name in frame["study"].unique() if name in study_names()
    }
    own_keys = evaluation_keys(tables_of(study))
    same = [name for name, keys in keys.items() if all(keys.get(key) == own_keys.get(key) for key in SIMULATION_KEYS)]
    return frame[frame["study"].isin(same)]
