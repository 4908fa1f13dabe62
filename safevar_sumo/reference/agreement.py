"""Agreement of simulated settings with reference data: numbers, a figure, and the totals that ship with the package."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy
import tomli_w

from safevar_sumo.analysis.figures import FONT, as_formula, new_figure, save
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.results import evaluation_keys, write_whole
from safevar_sumo.study import SAFETY_DEGREE, Study, load_study, refuse_other_than_file, study_names, unit_text
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BINS = 8
"""Number of bins of values in the figure; all bins hold about equally many rows."""
SCATTER_WIDTH = 2.0
"""An outcome is undecided if its safety degree is at most this number of standard deviations of repeats away from 0, the collision."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Comparison of values simulated by this package ("here") with reference values; None if there are no values to compare.

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
        Number of settings that collide on one side only; and the number of these that may be scatter between repeats, because the safety
        degree in the reference or here is at most two standard deviations from a collision.
    by_predicted
        Bins of settings by their safety degree here: lowest and highest safety degree, number of settings, and mean error [m].
    """

    rows: int
    spearman: dict[str, float | None]
    mean_absolute_error: dict[str, float | None]
    bias: dict[str, float | None]
    collisions: dict[str, int]
    original: dict[str, dict[str, float | None]]
    precision: float | None
    recall: float | None
    collision_speed: dict[str, float | None]
    in_repeats: dict[str, float | None]
    undecided: dict[str, int | None]
    by_predicted: list[dict[str, float | None]]

    def to_dict(self) -> dict[str, Any]:
        """The attributes by name."""
        return asdict(self)


def measure_agreement(reference: ReferenceData, evaluations: Evaluations, study: Study, original: Evaluations) -> Agreement:
    """Compare evaluations of the reference's settings with the reference, row by row, and the original vehicle with the study's values."""
    defined_rows = {name: _is_defined(reference, evaluations, name) for name in reference.metrics}
    differences = {name: evaluations.metrics[name][rows] - reference.metrics[name][rows] for name, rows in defined_rows.items()}
    errors = {name: _mean(np.abs(values)) for name, values in differences.items()}
    both_collide = reference.collided & evaluations.collided
    counts = {"reference": int(np.count_nonzero(reference.collided)), "here": int(np.count_nonzero(evaluations.collided)),
              "both": int(np.count_nonzero(both_collide))}
    return Agreement(
        rows=len(evaluations),
        spearman={name: rank_correlation(reference.metrics[name][rows], evaluations.metrics[name][rows])
                  for name, rows in defined_rows.items()},
        mean_absolute_error=errors,
        bias={name: _mean(values) for name, values in differences.items()},
        collisions=counts,
        original={name: {"reference": study.published.get(name), "here": finite_or_none(values[0])}
                  for name, values in original.metrics.items()},
        precision=counts["both"] / counts["here"] if counts["here"] else None,
        recall=counts["both"] / counts["reference"] if counts["reference"] else None,
        collision_speed={"reference": _mean(-reference.metrics[SAFETY_DEGREE][both_collide]),
                         "here": _mean(evaluations.collision_speed[both_collide])},
        in_repeats={name: _error_in_repeats(error, study.repeatability.get(name)) for name, error in errors.items()},
        undecided=_count_undecided(reference, evaluations, study.repeatability.get(SAFETY_DEGREE)),
        by_predicted=_error_by_bin(evaluations.f_safe, evaluations.f_safe - reference.metrics[SAFETY_DEGREE]))


def may_be_scatter(reference: ReferenceData, evaluations: Evaluations, repeatability: float) -> BoolArray:
    """Settings that collide on one side only, although their repeats may end either way; a mask."""
    distance = np.minimum(np.abs(reference.metrics[SAFETY_DEGREE]), np.abs(evaluations.f_safe))
    return np.asarray((reference.collided != evaluations.collided) & (distance <= SCATTER_WIDTH * repeatability))


def _count_undecided(reference: ReferenceData, evaluations: Evaluations, repeatability: float | None) -> dict[str, int | None]:
    number = None if repeatability is None else int(np.count_nonzero(may_be_scatter(reference, evaluations, repeatability)))
    return {"differ": int(np.count_nonzero(reference.collided != evaluations.collided)), "within_repeats": number}


def _error_in_repeats(error: float | None, repeatability: float | None) -> float | None:
    return None if error is None or repeatability is None else error / repeatability


def _error_by_bin(predicted: FloatArray, error: FloatArray) -> list[dict[str, float | None]]:
    is_defined = ~np.isnan(predicted) & ~np.isnan(error)
    return [{"lowest": float(predicted[rows].min()), "highest": float(predicted[rows].max()), "rows": len(rows),
             "bias": float(error[rows].mean())}
            for rows in _split_into_bins(np.where(is_defined, predicted, np.nan))]


def _split_into_bins(values: FloatArray) -> list[npt.NDArray[np.intp]]:
    """Indices of defined values, in bins of about equal size; equal values share a bin."""
    defined = values[~np.isnan(values)]
    if not defined.size:
        return []
    edges = np.unique(np.quantile(defined, np.linspace(0, 1, BINS + 1)))
    bin_numbers = np.where(np.isnan(values), -1, np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0)))
    bins = [np.flatnonzero(bin_numbers == i) for i in range(max(len(edges) - 1, 1))]
    return [rows for rows in bins if rows.size]


def rank_correlation(values: FloatArray, other_values: FloatArray) -> float | None:
    """Spearman's rho; None for fewer than two values or if all values of one side are equal."""
    if len(values) < 2 or np.ptp(values) == 0 or np.ptp(other_values) == 0:
        return None
    return float(np.corrcoef(scipy.stats.rankdata(values), scipy.stats.rankdata(other_values))[0, 1])


def _is_defined(reference: ReferenceData, evaluations: Evaluations, metric: str) -> BoolArray:
    """Whether a metric is defined in the reference and here, by row."""
    return np.asarray(~np.isnan(reference.metrics[metric]) & ~np.isnan(evaluations.metrics[metric]))


def _mean(values: FloatArray) -> float | None:
    return float(np.mean(values)) if values.size else None


def plot_agreement(path: Path, title: str, characteristics: CharacteristicSet, reference: ReferenceData, evaluations: Evaluations,
                   repeatability: float | None = None) -> None:
    """Draw simulated over reference values, errors over simulated values, and errors of the safety degree over each characteristic.

    A ring marks a setting that collides on one side only, although its repeats may end either way.

    Raises
    ------
    InputError
        If the file cannot be written or its ending names no picture format.
    """
    axes_per_row = 4
    axes_rows = 2 + -(-len(characteristics) // axes_per_row)
    figure, axes = new_figure(title, axes_rows, axes_per_row, (12, 2.4 * axes_rows + 0.8),
                              gridspec_kw={"height_ratios": [1.5] + [1] * (axes_rows - 1)})
    undecided = np.zeros(len(evaluations), dtype=bool) if repeatability is None else may_be_scatter(reference, evaluations, repeatability)
    for axis, error_axis, metric in zip(axes[0], axes[1], reference.metrics, strict=False):
        _draw_scatter(axis, metric, reference, evaluations, undecided)
        _draw_error(error_axis, evaluations.metrics[metric], evaluations.metrics[metric] - reference.metrics[metric])
        error_axis.set_xlabel(f"here: {_axis_label(metric)}")
        error_axis.set_ylabel("mean error")
    error = evaluations.metrics[SAFETY_DEGREE] - reference.metrics[SAFETY_DEGREE]
    lowest, highest = [], []
    for i, axis in enumerate(axes[2:].flat):
        if i >= len(characteristics):
            axis.set_axis_off()
            continue
        lowest_on_axis, highest_on_axis = _draw_error(axis, evaluations.settings[:, i], error)
        lowest.append(lowest_on_axis)
        highest.append(highest_on_axis)
        characteristic = characteristics.members[i]
        axis.set_xlabel(characteristic.name + as_formula(unit_text(characteristic.unit, " [{}]")))
    margin = 0.1 * (max(highest) - min(lowest)) + 1e-6
    for i, axis in enumerate(axes[2:].flat):
        axis.set_ylim(min(lowest) - margin, max(highest) + margin)
        if i % axes_per_row == 0:
            axis.set_ylabel("error of SD")
    save(figure, path, "plot")


def _axis_label(metric: str) -> str:
    return f"{METRICS[metric].title} [{as_formula(METRICS[metric].unit)}]"


def _draw_scatter(axis: Axes, metric: str, reference: ReferenceData, evaluations: Evaluations, undecided: BoolArray) -> None:
    rows = _is_defined(reference, evaluations, metric)
    is_collision = (reference.collided | evaluations.collided)[rows]
    x, y = reference.metrics[metric][rows], evaluations.metrics[metric][rows]
    axis.scatter(x[~is_collision], y[~is_collision], s=6, alpha=0.35, color="#0072b2", linewidths=0, label="no collision")
    if is_collision.any():
        axis.scatter(x[is_collision], y[is_collision], s=14, alpha=0.7, color="#d55e00", marker="x", linewidths=0.8,
                     label="collision, either side")
        if undecided[rows].any():
            axis.scatter(x[undecided[rows]], y[undecided[rows]], s=40, facecolors="none", edgecolors="black", linewidths=0.6,
                         label="repeats may do either")
        axis.legend(loc="upper left", fontsize=7, frameon=True)
    if x.size:
        ends = [min(x.min(), y.min()), max(x.max(), y.max())]
        axis.plot(ends, ends, color="black", linewidth=0.8, linestyle="--")
    rho = rank_correlation(x, y)
    axis.set_title(f"rho = {'-' if rho is None else f'{rho:.3f}'}, {x.size} rows", fontsize=FONT)
    label = _axis_label(metric)
    axis.set_xlabel(f"reference: {label}")
    axis.set_ylabel(f"here: {label}")


def _draw_error(axis: Axes, values: FloatArray, error: FloatArray) -> tuple[float, float]:
    """Draw the mean error and the quartiles of the error over bins of `values`; return the lowest and highest value drawn."""
    bins = _split_into_bins(np.where(np.isnan(error), np.nan, values))
    if not bins:
        return 0.0, 0.0
    centres = np.array([values[rows].mean() for rows in bins])
    means = np.array([error[rows].mean() for rows in bins])
    quartiles = np.array([np.quantile(error[rows], [0.25, 0.75]) for rows in bins])
    axis.fill_between(centres, quartiles[:, 0], quartiles[:, 1], color="#0072b2", alpha=0.2, linewidth=0)
    axis.plot(centres, means, marker="o", markersize=3, color="#0072b2")
    axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    return float(min(quartiles.min(), means.min())), float(max(quartiles.max(), means.max()))


SHIPPED_TOTALS = Path(__file__).with_name("published.toml")
TOTALS_COMMENT = "Agreement of studies with published data: totals, no row of it. `validate STUDY FILE --totals THIS_FILE` writes an entry."
SIMULATION_KEYS = ("scenario", "vehicle", "ads", "weather", "metrics", "step_length", "matrix")
"""Study keys that affect the metrics of a setting."""


@dataclass(frozen=True, kw_only=True)
class Totals:
    """Agreement of one study with one file of published data.

    Attributes
    ----------
    rows
        Number of settings compared.
    spearman
        Rank correlation by metric, where defined.
    mean_absolute_error
        By metric, in its unit.
    reference, here, both
        Number of settings that collide in the published data, in this simulation, and in both.
    """

    study: str
    file: str
    rows: int
    spearman: Mapping[str, float]
    mean_absolute_error: Mapping[str, float]
    reference: int
    here: int
    both: int

    @property
    def recall(self) -> float | None:
        """Share of the published collisions that collide here; None if there are none."""
        return self.both / self.reference if self.reference else None

    @property
    def precision(self) -> float | None:
        """Share of the collisions here that the published data has too; None if there are none."""
        return self.both / self.here if self.here else None


def shipped_totals_of(study: Study) -> list[Totals]:
    """Shipped totals that hold for a study: those of shipped studies with the same `SIMULATION_KEYS`."""
    tables, shipped_names = _simulation_tables(study), study_names()
    return [_parse_totals(name, file, entry) for name, files in _read_totals(SHIPPED_TOTALS).items()
            if name in shipped_names and _simulation_tables(load_study(name)) == tables for file, entry in files.items()]


def write_totals(path: Path, study: Study, file: str, result: Agreement) -> None:
    """Write, or replace, the entry of one study and one file.

    Raises
    ------
    InputError
        If the file holds anything but totals, or cannot be written.
    """
    totals = _read_totals(path) if path.exists() else {}
    entry = {"rows": result.rows, "spearman": _rounded(result.spearman), "mean_absolute_error": _rounded(result.mean_absolute_error),
             "collisions": result.collisions}
    totals = {**totals, study.name: {**totals.get(study.name, {}), file: entry}}
    write_whole(path, f"# {TOTALS_COMMENT}\n\n{tomli_w.dumps(totals)}")


def _rounded(values: Mapping[str, float | None]) -> dict[str, float]:
    """Values rounded to four decimals."""
    return {name: round(value, 4) for name, value in values.items() if value is not None}


def _read_totals(path: Path) -> dict[str, dict[str, Any]]:
    refuse_other_than_file(path)
    try:
        totals: dict[str, dict[str, Any]] = tomllib.loads(path.read_text(encoding="utf-8"))
        for name, files in totals.items():
            for file, entry in files.items():
                _parse_totals(name, file, entry)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise InputError(path, "holds no totals", "a new file, or one that `validate --totals` has written") from None
    return totals


def _parse_totals(study: str, file: str, entry: Mapping[str, Any]) -> Totals:
    return Totals(study=study, file=file, rows=entry["rows"], spearman=entry["spearman"], mean_absolute_error=entry["mean_absolute_error"],
                  **{name: entry["collisions"][name] for name in ("reference", "here", "both")})


def _simulation_tables(study: Study) -> dict[str, Any]:
    keys = evaluation_keys(study)
    return {name: keys.get(name) for name in SIMULATION_KEYS}
