"""The answer on a risk: a probability and what decides it, as JSON, table, sentences and a figure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.table import Table

from safevar_sumo.analysis.evaluator import Interval
from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, GREY, escape_dollars, new_figure
from safevar_sumo.analysis.risk import RARE_BELOW
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import JsonObject, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.study.characteristics import Uniform
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.terminal import WholeTable, answer_as_html, constraints_in_words, meanings
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FLEET_VEHICLES = 1000
"""Number of vehicles of the fleet in examples."""
INDICES = ("first_order", "total")
"""Sobol indices."""
SHARE = ("share",)
"""Shapley effects as shares of the variance."""
BARS = {
    "total": ("total: with all others", GREY, 0.2),
    "first_order": ("alone", BLUE, -0.2),
    "share": ("Shapley effect", BLUE, 0.0),
}
"""Label, colour and place of each index in the figure."""
ERROR_STYLE = {"elinewidth": 0.8, "ecolor": "black"}


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A probability with its interval (for plain Monte Carlo by Clopper and Pearson).

    Attributes
    ----------
    failures, errors
        Number of unsafe vehicles, and of vehicles that could not be simulated.
    method
        "monte_carlo", "subset_simulation" or "cross_entropy".
    simulations
        Number of simulations for the estimate, without the simulations for the sensitivities.
    coefficient_of_variation
        Standard error divided by the probability; NaN if no vehicle was unsafe.
    design_point
        Values of the most probable failure by characteristic, if a method for rare failures was used.
    remark
        Failures that the estimate may have missed, or the reason for its method; may be empty.
    """

    probability: float
    coefficient_of_variation: float
    interval: Interval
    failures: int
    errors: int
    simulations: int
    method: str
    design_point: dict[str, float] | None = None
    remark: str = ""


@dataclass(frozen=True, kw_only=True)
class Risk(Estimate):
    """Probability of an unsafe outcome, and Sobol indices.

    Attributes
    ----------
    samples
        Number of simulated vehicles.
    sensitivity, sensitivity_of_unsafe
        The two frames of `compute_sensitivities`; None if characteristics are correlated or bound by constraints,
        because Sobol indices are then undefined.
    shapley, shapley_of_unsafe
        In that case the two frames of `compute_shapley_effects`, unless a method for rare failures is required.
    """

    study: Study
    unsafe: Unsafe
    samples: int
    confidence: float
    sensitivity: pd.DataFrame | None = None
    sensitivity_of_unsafe: pd.DataFrame | None = None
    shapley: pd.DataFrame | None = None
    shapley_of_unsafe: pd.DataFrame | None = None
    no_verdict: str = ""

    @property
    def is_share_of_domain(self) -> bool:
        """Whether the probability is a share of the domain, because the study does not say how vehicles vary."""
        return not self.study.variation

    def of_fleet(self, vehicles: int) -> float:
        """Probability that at least one of N = `vehicles` vehicles that vary independently is unsafe, 1 - (1 - p)^N."""
        return float(-np.expm1(vehicles * np.log1p(-self.probability))) if self.probability < 1 else 1.0

    @property
    def _what_decides(self) -> tuple[tuple[str, ...], list[pd.DataFrame]]:
        """The names of the indices, and the two frames that hold them; no frame without indices."""
        of_sobol, of_shapley = (self.sensitivity, self.sensitivity_of_unsafe), (self.shapley, self.shapley_of_unsafe)
        indices, both = (INDICES, of_sobol) if self.shapley is None else (SHARE, of_shapley)
        return indices, [frame for frame in both if frame is not None]

    def to_dict(self) -> JsonObject:
        """The JSON of `risk`."""
        rows = [] if self.sensitivity is None else self.sensitivity.to_dict("records")
        return {
            "study": self.study.name,
            **driven_entry(self.no_verdict),
            "unsafe": str(self.unsafe),
            "samples": self.samples,
            "failures": self.failures,
            "probability": self.probability,
            "interval": list(self.interval),
            "confidence": self.confidence,
            "sensitivity": [
                {
                    "characteristic": row["characteristic"],
                    **{name: finite_or_none(row[name]) for name in INDICES},
                    **{
                        f"{name}_interval": [finite_or_none(row[f"{name}_{end}"]) for end in ("lower", "upper")]
                        for name in INDICES
                    },
                }
                for row in rows
            ],
            **self._shapley_entry(),
            "method": self.method,
            "simulations": self.simulations,
            "coefficient_of_variation": finite_or_none(self.coefficient_of_variation),
            "design_point": self.design_point,
            "remark": self.remark,
        }

    def _shapley_entry(self) -> JsonObject:
        """The entry `shapley` of the JSON, only where Sobol indices are undefined."""
        if self.shapley is None:
            return {}
        rows = [
            {
                "characteristic": row["characteristic"],
                "effect": finite_or_none(row["effect"]),
                "share": finite_or_none(row["share"]),
                "share_interval": [finite_or_none(row[f"share_{end}"]) for end in ("lower", "upper")],
            }
            for row in self.shapley.to_dict("records")
        ]
        return {"shapley": rows}

    def to_frame(self) -> pd.DataFrame:
        """Sensitivity of the safety degree and of the unsafe outcome, one row per output and characteristic; empty if
        there is none.

        Columns: `output` (safety_degree or unsafe), and the columns of `compute_sensitivities` or, if Sobol indices
        are undefined, of `compute_shapley_effects`.
        """
        indices, frames = self._what_decides
        columns = [
            *("output", "characteristic", *(["effect"] if indices == SHARE else [])),
            *(f"{name}{end}" for name in indices for end in ("", "_lower", "_upper")),
        ]
        outputs = (SAFETY_DEGREE, "unsafe")
        tables = [frame.assign(output=name) for name, frame in zip(outputs, frames, strict=False)]
        return pd.concat(tables, ignore_index=True)[columns] if tables else pd.DataFrame(columns=columns)

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        low, high = self.interval
        return f"<Risk of {self.study.name}, unsafe {self.unsafe}: {self.probability:.4g} ({low:.4g} to {high:.4g})>"

    def sentences(self) -> Iterator[str | Table]:
        """The probability with its interval, how vehicles vary, and which characteristics decide."""
        low, high = self.interval
        characteristics = CharacteristicSet.of(self.study)
        sampling = "" if self.method == "monte_carlo" else f", drawn by {self.method.replace('_', ' ')}"
        yield f"Unsafe: {self.unsafe.description}. {self.failures} of {self.samples} vehicles{sampling}."
        label = "Share of the domain that is unsafe:" if self.is_share_of_domain else "Probability"
        yield (
            f"{label} {self.probability:.4g}, with {100 * self.confidence:g} % confidence from {low:.4g} to {high:.4g}."
        )
        if self.remark:
            yield f"note: {self.remark}."
        if self.design_point is not None:
            values = ", ".join(
                f"{one.name} = {one.text(self.design_point[one.name])}{one.suffix}" for one in characteristics
            )
            yield f"The most probable failure: {values}."
        if self.is_share_of_domain:
            yield (
                "warning: this is not a probability in the field: the study has no [variation] table for how "
                "real vehicles "
                "vary."
            )
        elif 0 < self.probability < RARE_BELOW:
            of_fleet = self.of_fleet(FLEET_VEHICLES)
            yield (
                f"Of {FLEET_VEHICLES:,} vehicles that vary independently at least one is unsafe with probability "
                f"{'above 0.99' if of_fleet > 0.99 else f'{of_fleet:.2g}'}."
            )
        yield _how_vehicles_vary(self.study)
        yield from constraints_in_words(self.study)
        indices, frames = self._what_decides
        if not frames:
            return
        heads = ("SD alone", "SD in all", "unsafe alone", "unsafe in all") if indices == INDICES else ("SD", "unsafe")
        table = WholeTable("characteristic", right=heads, title="What decides: share of the variance")
        outputs = [frame.set_index("characteristic") for frame in frames]
        for name in outputs[0].sort_values(indices[-1], ascending=False, kind="stable").index:
            rows = [output.loc[name] for output in outputs]
            table.add_row(name, *(_index_in_words(row, index) for row in rows for index in indices))
        yield table
        if outputs[1][indices[-1]].isna().all():
            yield "There are no indices of the unsafe outcome, because too few settings are unsafe or too few are safe."
        yield meanings(characteristics)
        kind = "Sobol indices, first order and total" if indices == INDICES else "Shapley effects, which sum to 1"
        yield (
            f"{kind}, with half of their {100 * self.confidence:g} % intervals: estimates, "
            "which may exceed 1 or fall below 0 by their error."
        )

    def figure(self) -> Figure:
        """Sobol indices or Shapley effects of every characteristic with intervals, for the safety degree and for unsafe
        outcomes.

        Raises
        ------
        InputError
            If there are none, because a method for rare failures was required.
        """
        indices, both = self._what_decides
        if not both:
            raise InputError(
                "method", "there are no sensitivity indices with a method for rare failures", "auto or monte_carlo"
            )
        order = both[0].sort_values(indices[-1], kind="stable")["characteristic"]
        title = f"{self.study.name}: what decides ({100 * self.confidence:g} % intervals)"
        figure, (axes,) = new_figure(title, rows=1, columns=2, size=(7.2, 1.5 + 0.28 * max(len(order), 4)), sharey=True)
        frames = dict(zip(("safety degree", f"unsafe ({self.unsafe})"), both, strict=True))
        names = [escape_dollars(name) for name in order]
        for axis, (output, frame) in zip(axes, frames.items(), strict=True):
            rows = frame.set_index("characteristic").loc[order]
            for index in reversed(indices):
                label, colour, shift = BARS[index]
                error = (rows[f"{index}_upper"] - rows[index]).clip(lower=0)
                places = np.arange(len(names)) + shift
                axis.barh(places, rows[index], height=0.36, color=colour, label=label, xerr=error, error_kw=ERROR_STYLE)
            axis.set_yticks(np.arange(len(names)), names)
            axis.set_title(escape_dollars(output), fontsize=FONT_SIZE)
            axis.set(xlabel="share of the variance [-]", xlim=(0, 1))
            axis.grid(visible=False, axis="y")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=FONT_SIZE)
        return figure


def _index_in_words(row: pd.Series[float], index: str) -> str:
    """A Sobol index with half of its interval."""
    half = (row[f"{index}_upper"] - row[f"{index}_lower"]) / 2
    return "-" if math.isnan(row[index]) else f"{row[index]:.2f} ±{half:.2f}"


def _how_vehicles_vary(study: Study) -> str:
    """How vehicles vary, in a sentence."""
    parts = [f"{name} {one.__struct_config__.tag}" for name, one in study.variation.items() if one != Uniform()]
    if len(parts) < len(study.vehicle.characteristics):
        parts.append("the others uniformly" if parts else "uniformly over the whole domain")
    pairs = ", ".join(f"{' with '.join(pair.between)} {pair.value:g}" for pair in study.correlations)
    manner = "as the study specifies: " if study.variation else ""
    return f"They vary {manner}{'; '.join(parts)}{f', correlated: {pairs}' if pairs else ''}."
