"""The answer on a risk: a probability and what decides it, as JSON, table, sentences and a figure."""

from __future__ import annotations

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
SOBOL, SHAPLEY = ("first_order", "total"), ("share",)
"""Columns of Sobol indices, and of Shapley effects as shares of the variance."""
UNSAFE = "unsafe"
"""Name of the second output whose variance is divided; the first is the safety degree."""
BARS = {
    "total": ("total: with all others", GREY, 0.2),
    "first_order": ("alone", BLUE, -0.2),
    "share": ("Shapley effect", BLUE, 0.0),
}
"""Label, colour and place of each index in the figure."""


def effect_columns(indices: tuple[str, ...]) -> list[str]:
    """The columns of `Risk.effects` for Sobol indices or Shapley effects."""
    columns = ["output", "characteristic", *(["effect"] if indices == SHAPLEY else [])]
    return columns + [f"{name}{suffix}" for name in indices for suffix in ("", "_lower", "_upper")]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A probability with its interval (for plain Monte Carlo by Clopper and Pearson).

    Attributes
    ----------
    probability, interval
        The probability of an unsafe outcome, and its confidence interval.
    samples, failures, errors
        Number of simulated vehicles, of unsafe ones among them, and of vehicles that could not be simulated.
    method
        "monte_carlo", "subset_simulation" or "cross_entropy".
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
    samples: int
    failures: int
    errors: int
    method: str
    design_point: dict[str, float] | None = None
    remark: str = ""


@dataclass(frozen=True, kw_only=True)
class Risk(Estimate):
    """Probability of an unsafe outcome, and what decides it.

    Attributes
    ----------
    simulations
        Number of simulations for the estimate, without those for the effects.
    effects
        Sobol indices or, if characteristics are correlated or bound by constraints, Shapley effects: see `to_frame`.
    """

    study: Study
    unsafe: Unsafe
    simulations: int
    confidence: float
    effects: pd.DataFrame
    no_verdict: str = ""

    def of_fleet(self, vehicles: int) -> float:
        """Probability that at least one of N = `vehicles` vehicles that vary independently is unsafe, 1 - (1 - p)^N."""
        return float(-np.expm1(vehicles * np.log1p(-self.probability))) if self.probability < 1 else 1.0

    @property
    def _indices(self) -> tuple[str, ...]:
        """The columns with the indices of a characteristic; the last one ranks the characteristics."""
        return SHAPLEY if "share" in self.effects else SOBOL

    def _effects_on(self, output: str) -> pd.DataFrame:
        return self.effects[self.effects["output"] == output].set_index("characteristic")

    def to_dict(self) -> JsonObject:
        """The JSON of `risk`; `shapley` only where Sobol indices are undefined."""
        numbers = [*(["effect"] if self._indices == SHAPLEY else []), *self._indices]
        rows = [
            {
                "characteristic": name,
                **{number: finite_or_none(row[number]) for number in numbers},
                **{
                    f"{index}_interval": [finite_or_none(row[f"{index}_{end}"]) for end in ("lower", "upper")]
                    for index in self._indices
                },
            }
            for name, row in self._effects_on(SAFETY_DEGREE).iterrows()
        ]
        return {
            "study": self.study.name,
            **driven_entry(self.no_verdict),
            "unsafe": str(self.unsafe),
            "samples": self.samples,
            "failures": self.failures,
            "probability": self.probability,
            "interval": list(self.interval),
            "confidence": self.confidence,
            **({"sensitivity": rows} if self._indices == SOBOL else {"sensitivity": [], "shapley": rows}),
            "method": self.method,
            "simulations": self.simulations,
            "coefficient_of_variation": finite_or_none(self.coefficient_of_variation),
            "design_point": self.design_point,
            "remark": self.remark,
        }

    def to_frame(self) -> pd.DataFrame:
        """What decides: one row for each output (safety_degree or unsafe) and characteristic; empty if a method for
        rare failures was required.

        Columns: `output`, `characteristic`, and Sobol indices, `first_order` and `total`, or Shapley effects, `effect`
        [the output's unit squared; they sum to its variance] and `share` [of the variance]. Each index has the ends of
        its interval, such as `total_lower` and `total_upper`. NaN where nothing varies, or too few settings are unsafe
        (or safe).
        """
        return self.effects.copy()

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        low, high = self.interval
        return f"<Risk of {self.study.name}, unsafe {self.unsafe}: {self.probability:.4g} ({low:.4g} to {high:.4g})>"

    def sentences(self) -> Iterator[str | Table]:
        """The probability with its interval, how vehicles vary, and which characteristics decide."""
        (low, high), percent = self.interval, f"{100 * self.confidence:g} %"
        characteristics, is_share = CharacteristicSet.of(self.study), not self.study.variation
        sampling = "" if self.method == "monte_carlo" else f", drawn by {self.method.replace('_', ' ')}"
        yield f"Unsafe: {self.unsafe.description}. {self.failures} of {self.samples} vehicles{sampling}."
        label = "Share of the domain that is unsafe:" if is_share else "Probability"
        yield f"{label} {self.probability:.4g}, with {percent} confidence from {low:.4g} to {high:.4g}."
        if self.remark:
            yield f"note: {self.remark}."
        if point := self.design_point:
            values = ", ".join(f"{item.name} = {item.text(point[item.name])}{item.suffix}" for item in characteristics)
            yield f"The most probable failure: {values}."
        if is_share:
            yield (
                "warning: this is not a probability in the field: the study has no [variation] table for how real "
                "vehicles vary."
            )
        elif 0 < self.probability < RARE_BELOW:
            of_fleet = self.of_fleet(FLEET_VEHICLES)
            yield (
                f"Of {FLEET_VEHICLES:,} vehicles that vary independently at least one is unsafe with probability "
                f"{'above 0.99' if of_fleet > 0.99 else f'{of_fleet:.2g}'}."
            )
        yield _how_vehicles_vary(self.study)
        yield from constraints_in_words(self.study)
        if self.effects.empty:
            return
        is_sobol, outputs = self._indices == SOBOL, [self._effects_on(name) for name in (SAFETY_DEGREE, UNSAFE)]
        heads = ("SD alone", "SD in all", "unsafe alone", "unsafe in all") if is_sobol else ("SD", "unsafe")
        table = WholeTable("characteristic", right=heads, title="What decides: share of the variance")
        for name in outputs[0].sort_values(self._indices[-1], ascending=False, kind="stable").index:
            rows = [output.loc[name] for output in outputs]
            table.add_row(name, *(_index_in_words(row, index) for row in rows for index in self._indices))
        yield table
        if outputs[1][self._indices[-1]].isna().all():
            yield "There are no indices of the unsafe outcome, because too few settings are unsafe or too few are safe."
        yield meanings(characteristics)
        yield (
            f"{'Sobol indices, first order and total' if is_sobol else 'Shapley effects, which sum to 1'}, with half "
            f"of their {percent} intervals: estimates, which may exceed 1 or fall below 0 by their error."
        )

    def figure(self) -> Figure:
        """Sobol indices or Shapley effects of every characteristic with intervals, for the safety degree and for unsafe
        outcomes.

        Raises
        ------
        InputError
            If there are none, because a method for rare failures was required.
        """
        if self.effects.empty:
            raise InputError(
                "method", "there are no sensitivity indices with a method for rare failures", "auto or monte_carlo"
            )
        order = self._effects_on(SAFETY_DEGREE).sort_values(self._indices[-1], kind="stable").index
        title = f"{self.study.name}: what decides ({100 * self.confidence:g} % intervals)"
        figure, (axes,) = new_figure(title, rows=1, columns=2, size=(7.2, 1.5 + 0.28 * max(len(order), 4)), sharey=True)
        titles = {SAFETY_DEGREE: "safety degree", UNSAFE: f"unsafe ({self.unsafe})"}
        for axis, (output, subtitle) in zip(axes, titles.items(), strict=True):
            rows = self._effects_on(output).loc[order]
            for index in reversed(self._indices):
                label, colour, shift = BARS[index]
                error = (rows[f"{index}_upper"] - rows[index]).clip(lower=0)
                style = {"elinewidth": 0.8, "ecolor": "black"}
                places = np.arange(len(order)) + shift
                axis.barh(places, rows[index], height=0.36, color=colour, label=label, xerr=error, error_kw=style)
            axis.set_yticks(np.arange(len(order)), map(escape_dollars, order))
            axis.set_title(escape_dollars(subtitle), fontsize=FONT_SIZE)
            axis.set(xlabel="share of the variance [-]", xlim=(0, 1))
            axis.grid(visible=False, axis="y")
        figure.legend(
            *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=FONT_SIZE
        )
        return figure


def _index_in_words(row: pd.Series[float], index: str) -> str:
    """An index with half of its interval."""
    half = (row[f"{index}_upper"] - row[f"{index}_lower"]) / 2
    return "-" if pd.isna(row[index]) else f"{row[index]:.2f} ±{half:.2f}"


def _how_vehicles_vary(study: Study) -> str:
    """How vehicles vary, in a sentence."""
    parts = [
        f"{name} {distribution.__struct_config__.tag}"
        for name, distribution in study.variation.items()
        if distribution != Uniform()
    ]
    if len(parts) < len(study.vehicle.characteristics):
        parts.append("the others uniformly" if parts else "uniformly over the whole domain")
    pairs = ", ".join(f"{' with '.join(pair.between)} {pair.value:g}" for pair in study.correlations)
    manner = "as the study specifies: " if study.variation else ""
    return f"They vary {manner}{'; '.join(parts)}{f', correlated: {pairs}' if pairs else ''}."
