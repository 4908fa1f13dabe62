"""Agreement of simulated settings with reference data: numbers, a figure, and the totals that ship with the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import numpy.typing as npt
import scipy

from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, VERMILION, as_formula, new_panels, save
from safevar_sumo.analysis.words import two_decimals
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, JsonObject, finite_or_none
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.results import evaluation_keys, write_whole
from safevar_sumo.study import SAFETY_DEGREE, Study, load_study, study_names, unit_text
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BINS = 8
"""Number of bins of values in the figure; all bins hold about equally many rows."""
SCATTER_WIDTH = 2.0
"""An outcome is undecided if its safety degree is at most this number of standard deviations of repeats from a
collision."""

Numbers = dict[str, float | None]
"""Numbers by metric, or by side; None where undefined."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Comparison of values simulated by this package ("here") with reference values.

    Numbers are None where there are no values to compare.

    Attributes
    ----------
    rows
        Number of settings.
    spearman, mean_absolute_error, bias
        By metric: rank correlation; mean |here - reference|; mean here - reference, both in the unit of the metric.
        TET and TIT are compared over settings that collide neither here nor in the reference.
    collisions
        Number of settings that collide in the reference, here, and in both.
    original
        By metric: the value of the original vehicle in the reference and here.
    precision, recall
        Share of the collisions here that the reference has too; share of the reference collisions that happen here too.
    collision_speed
        Mean over the settings that collide on both sides, in the reference and here [m/s].
    in_repeats
        By metric: mean absolute error divided by the standard deviation of repeats of one setting in the reference.
    undecided
        Number of settings that collide on one side only; and the number of these that may be scatter between repeats,
        because the safety degree in the reference or here is at most two standard deviations from a collision.
    by_predicted
        Bins of settings by their safety degree here: lowest and highest safety degree, number of settings, and mean
        error [m].
    """

    rows: int
    spearman: Numbers
    mean_absolute_error: Numbers
    bias: Numbers
    collisions: dict[str, int]
    original: dict[str, Numbers]
    precision: float | None
    recall: float | None
    collision_speed: Numbers
    in_repeats: Numbers
    undecided: dict[str, int | None]
    by_predicted: list[Numbers]

    def to_dict(self) -> JsonObject:
        """The attributes by name."""
        return asdict(self)

    def sentences(self) -> list[str]:
        """Sentences about collisions, and about errors by the safety degree here."""
        counts, speeds = self.collisions, {side: two_decimals(speed) for side, speed in self.collision_speed.items()}
        lines = [
            f"Collisions: {counts['reference']} in the reference, {counts['here']} here, {counts['both']} in both: "
            f"precision {two_decimals(self.precision)}, recall {two_decimals(self.recall)}; their mean speed is "
            f"{speeds['reference']} m/s in the reference, {speeds['here']} m/s here."
        ]
        if self.undecided["within_repeats"] is not None:
            lines.append(
                f"Of {self.undecided['differ']} settings that collide only in the reference or only here, "
                f"{self.undecided['within_repeats']} may collide or not within the scatter of repeats."
            )
        bins = ", ".join(
            f"{part['lowest']:.2f} to {part['highest']:.2f}: {part['bias']:+.2f}" for part in self.by_predicted
        )
        return [*lines, f"Mean error by the safety degree here: {bins}."]


def measure_agreement(
    reference: ReferenceData, evaluations: Evaluations, study: Study, original: Evaluations
) -> Agreement:
    """Compare evaluations of the reference's settings with the reference, row by row, and the original vehicle with the
    study's values.
    """
    pairs = {name: defined_pairs(values, evaluations.metrics[name]) for name, values in reference.metrics.items()}
    mean_errors = {name: _mean(np.abs(here - there)) for name, (there, here) in pairs.items()}
    both_collide, differ = reference.collided & evaluations.collided, reference.collided != evaluations.collided
    counts = {
        "reference": int(reference.collided.sum()),
        "here": int(evaluations.collided.sum()),
        "both": int(both_collide.sum()),
    }
    degrees, within_repeats = reference.metrics[SAFETY_DEGREE], None
    if (repeatability := study.repeatability.get(SAFETY_DEGREE)) is not None:
        distance = np.minimum(np.abs(degrees), np.abs(evaluations.f_safe))
        within_repeats = int(np.count_nonzero(differ & (distance <= SCATTER_WIDTH * repeatability)))
    errors = evaluations.f_safe - degrees
    return Agreement(
        rows=len(evaluations),
        spearman={name: rank_correlation(*pair) for name, pair in pairs.items()},
        mean_absolute_error=mean_errors,
        bias={name: _mean(here - there) for name, (there, here) in pairs.items()},
        collisions=counts,
        original={
            name: {"reference": study.published.get(name), "here": finite_or_none(values[0])}
            for name, values in original.metrics.items()
        },
        precision=_share_of(counts, "here"),
        recall=_share_of(counts, "reference"),
        collision_speed={
            "reference": _mean(-degrees[both_collide]),
            "here": _mean(evaluations.collision_speed[both_collide]),
        },
        in_repeats={
            name: None if error is None or name not in study.repeatability else error / study.repeatability[name]
            for name, error in mean_errors.items()
        },
        undecided={"differ": int(differ.sum()), "within_repeats": within_repeats},
        by_predicted=[
            {
                "lowest": float(evaluations.f_safe[rows].min()),
                "highest": float(evaluations.f_safe[rows].max()),
                "rows": len(rows),
                "bias": float(errors[rows].mean()),
            }
            for rows in _bins_of(np.where(np.isnan(errors), np.nan, evaluations.f_safe))
        ],
    )


def defined_pairs(values: FloatArray, other_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both values of the rows in which both are defined."""
    is_defined = ~np.isnan(values) & ~np.isnan(other_values)
    return values[is_defined], other_values[is_defined]


def _bins_of(values: FloatArray) -> list[npt.NDArray[np.intp]]:
    """Indices of defined values, in bins of about equal size; equal values share a bin."""
    defined = values[~np.isnan(values)]
    if not defined.size:
        return []
    edges = np.unique(np.quantile(defined, np.linspace(0, 1, BINS + 1)))
    last_bin = max(len(edges) - 2, 0)  # one edge alone, if all values are equal, is a bin
    numbers = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, last_bin)
    return [np.flatnonzero((numbers == i) & ~np.isnan(values)) for i in np.unique(numbers[~np.isnan(values)])]


def rank_correlation(values: FloatArray, other_values: FloatArray) -> float | None:
    """Spearman's rho; None for fewer than two values or if all values of one side are equal."""
    if len(values) < 2 or np.ptp(values) == 0 or np.ptp(other_values) == 0:
        return None
    return float(np.corrcoef(scipy.stats.rankdata(values), scipy.stats.rankdata(other_values))[0, 1])


def _share_of(collisions: Mapping[str, int], side: str) -> float | None:
    """Share of the collisions on a side that happen on both."""
    return collisions["both"] / collisions[side] if collisions[side] else None


def _mean(values: FloatArray) -> float | None:
    return float(np.mean(values)) if values.size else None


def plot_agreement(
    path: Path, title: str, characteristics: CharacteristicSet, reference: ReferenceData, evaluations: Evaluations
) -> None:
    """Draw simulated over reference values, errors over simulated values, and errors of the safety degree over each
    characteristic.

    Raises
    ------
    InputError
        If the file cannot be written or its ending names no picture format.
    """
    panel_count = 2 * len(reference.metrics) + len(characteristics)
    figure, axes = new_panels(title, panel_count, 4, (3.0, 2.4), min_width=12.0, title_height=0.8)
    for i, (metric, values) in enumerate(reference.metrics.items()):
        here = evaluations.metrics[metric]
        label = f"{METRICS[metric].title} [{as_formula(METRICS[metric].unit)}]"
        _draw_scatter(axes[i], values, here, reference.collided | evaluations.collided, label)
        _draw_error(axes[len(reference.metrics) + i], here, here - values, f"here: {label}", "mean error")
    error, panels = evaluations.f_safe - reference.metrics[SAFETY_DEGREE], axes[2 * len(reference.metrics) :]
    for axis in panels[1:]:
        axis.sharey(panels[0])
    for axis, characteristic, values in zip(panels, characteristics, evaluations.settings.T, strict=True):
        _draw_error(
            axis,
            values,
            error,
            characteristic.name + as_formula(unit_text(characteristic.unit, " [{}]")),
            "error of SD",
        )
    figure.supxlabel("orange: collides in the reference or here", fontsize=FONT_SIZE)
    save(figure, path, "plot")


def _draw_scatter(axis: Axes, reference: FloatArray, here: FloatArray, is_collision: BoolArray, label: str) -> None:
    """Draw simulated over reference values; settings that collide on either side have another colour."""
    axis.scatter(reference, here, s=6, alpha=0.4, c=np.where(is_collision, VERMILION, BLUE), linewidths=0)
    x, y = defined_pairs(reference, here)
    origin = float(x[0]) if x.size else 0.0  # in the range of the values, so that the line does not widen the axes
    axis.axline((origin, origin), slope=1, color="black", linewidth=0.8, linestyle="--")
    rho = rank_correlation(x, y)
    axis.set_title(f"rho = {'-' if rho is None else f'{rho:.3f}'}, {x.size} rows", fontsize=FONT_SIZE)
    axis.set(xlabel=f"reference: {label}", ylabel=f"here: {label}")


def _draw_error(axis: Axes, values: FloatArray, error: FloatArray, label: str, error_label: str) -> None:
    """Draw the mean error and the quartiles of the error over bins of `values`."""
    bins = _bins_of(np.where(np.isnan(error), np.nan, values))
    centres = [values[rows].mean() for rows in bins]
    low, high = ([np.quantile(error[rows], share) for rows in bins] for share in (0.25, 0.75))
    axis.fill_between(centres, low, high, color=BLUE, alpha=0.2, linewidth=0)
    axis.plot(centres, [error[rows].mean() for rows in bins], marker="o", markersize=3, color=BLUE)
    axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    axis.set(xlabel=label, ylabel=error_label)


SHIPPED_TOTALS = Path(__file__).with_name("agreement_totals.toml")
TOTALS_COMMENT = (
    "Agreement of studies with published data: totals, no row of it. "
    "`validate STUDY FILE --totals THIS_FILE` writes an entry."
)
SIMULATION_KEYS = ("scenario", "vehicle", "ads", "weather", "metrics", "step_length", "matrix")
"""Study keys that affect the metrics of a setting."""


class Totals(msgspec.Struct, frozen=True, kw_only=True):
    """Agreement of one study with one file of published data.

    Attributes
    ----------
    rows
        Number of settings compared.
    spearman
        Rank correlation by metric, where defined.
    mean_absolute_error
        By metric, in its unit.
    collisions
        Number of settings that collide in the published data ("reference"), in this simulation ("here"), and in both.
    """

    rows: int
    spearman: dict[str, float]
    mean_absolute_error: dict[str, float]
    collisions: dict[str, int]

    @property
    def recall(self) -> float | None:
        """Share of the published collisions that collide here; None if there are none."""
        return _share_of(self.collisions, "reference")

    @property
    def precision(self) -> float | None:
        """Share of the collisions here that the published data has too; None if there are none."""
        return _share_of(self.collisions, "here")


def shipped_totals_of(study: Study) -> dict[str, Totals]:
    """Shipped totals that hold for a study, by file: those of shipped studies with the same `SIMULATION_KEYS`."""
    tables = _simulation_tables(study)
    return {
        file: totals
        for name, files in _read_totals(SHIPPED_TOTALS).items()
        if name in study_names() and _simulation_tables(load_study(name)) == tables
        for file, totals in files.items()
    }


def write_totals(path: Path, study: Study, file: str, result: Agreement) -> None:
    """Write, or replace, the entry of one study and one file.

    Raises
    ------
    InputError
        If the file holds anything but totals, or cannot be written.
    """
    totals = _read_totals(path) if path.exists() else {}
    totals.setdefault(study.name, {})[file] = Totals(
        rows=result.rows,
        spearman=_rounded(result.spearman),
        mean_absolute_error=_rounded(result.mean_absolute_error),
        collisions=result.collisions,
    )
    write_whole(path, f"# {TOTALS_COMMENT}\n\n{msgspec.toml.encode(totals).decode()}")


def _rounded(values: Mapping[str, float | None]) -> dict[str, float]:
    """Values rounded to four decimals."""
    return {name: round(value, 4) for name, value in values.items() if value is not None}


def _read_totals(path: Path) -> dict[str, dict[str, Totals]]:
    try:
        return msgspec.toml.decode(path.read_bytes(), type=dict[str, dict[str, Totals]])
    except (OSError, ValueError):
        raise InputError(path, "holds no totals", "a new file, or one that `validate --totals` has written") from None


def _simulation_tables(study: Study) -> JsonObject:
    keys = evaluation_keys(study)
    return {name: keys.get(name) for name in SIMULATION_KEYS}
