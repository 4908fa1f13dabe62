"""The result of `risk` as text on the terminal and as a figure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from safevar_sumo.analysis.figures import BLUE, FONT, GREY, escape_dollars, new_figure
from safevar_sumo.analysis.risk import RARE_BELOW
from safevar_sumo.analysis.risk.compute import FLEET_VEHICLES, Risk
from safevar_sumo.errors import InputError
from safevar_sumo.study import Study
from safevar_sumo.study.variation import Uniform
from safevar_sumo.terminal import WholeTable, print_constraints, print_heading, print_meanings, print_text
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def print_risk(console: Console, result: Risk) -> None:
    """Print the probability with its interval, how vehicles vary, and which characteristics decide."""
    low, high = result.interval
    print_heading(console, result.study.title, result.no_verdict)
    sampling = "" if result.method == "monte_carlo" else f", drawn by {result.method.replace('_', ' ')}"
    print_text(console, f"Unsafe: {result.unsafe.description}. {result.failures} of {result.samples} vehicles{sampling}.")
    label = "Share of the domain that is unsafe:" if result.is_share_of_domain else "Probability"
    print_text(console, f"{label} {result.probability:.4g}, with {100 * result.confidence:g} % confidence from {low:.4g} "
                        f"to {high:.4g}.")
    if result.remark:
        print_text(console, f"note: {result.remark}.")
    if result.design_point is not None:
        values = ", ".join(f"{characteristic.name} = {characteristic.text(result.design_point[characteristic.name])}{characteristic.suffix}"
                           for characteristic in CharacteristicSet.of(result.study.vehicle.characteristics))
        print_text(console, f"The most probable failure: {values}.")
    if not result.is_share_of_domain and 0 < result.probability < RARE_BELOW:
        print_text(console, f"Of {FLEET_VEHICLES:,} vehicles that vary independently at least one is unsafe with probability "
                            f"{result.of_fleet_in_words(FLEET_VEHICLES)}.")
    if result.is_share_of_domain:
        print_text(console, "warning: this is not a probability in the field: the study has no [variation] table for how real vehicles "
                            "vary.")
    print_text(console, _how_vehicles_vary(result.study))
    print_constraints(console, result.study)
    if result.sensitivity is None or result.sensitivity_of_unsafe is None:
        return
    table = WholeTable("characteristic", right=("SD alone", "SD in all", "unsafe alone", "unsafe in all"),
                       title="What decides: share of the variance")
    unsafe_indices = result.sensitivity_of_unsafe.set_index("characteristic")
    for row in result.sensitivity.sort_values("total", ascending=False, kind="stable").to_dict("records"):
        unsafe_row = unsafe_indices.loc[row["characteristic"]]
        table.add_row(row["characteristic"], *(_index_in_words(indices, name) for indices in (row, unsafe_row)
                                               for name in ("first_order", "total")))
    console.print(table)
    if result.sensitivity_of_unsafe["total"].isna().all():
        print_text(console, "There are no indices of the unsafe outcome, because too few settings are unsafe or too few are safe.")
    print_meanings(console, CharacteristicSet.of(result.study.vehicle.characteristics))
    print_text(console, f"Sobol indices, first order and total, with half of their {100 * result.confidence:g} % "
                        "intervals: estimates, which may exceed 1 or fall below 0 by their error.")


def _how_vehicles_vary(study: Study) -> str:
    """How vehicles vary, in a sentence."""
    not_uniform = [f"{name} {distribution.__struct_config__.tag}"
                   for name, distribution in study.variation.items() if distribution != Uniform()]
    pairs = ", ".join(f"{' with '.join(correlation.between)} {correlation.value:g}" for correlation in study.correlations)
    others = "" if len(not_uniform) == len(study.vehicle.characteristics) else "; the others uniformly"
    specified = f"as the study specifies: {'; '.join(not_uniform)}{others}"
    manner = specified if not_uniform else "uniformly over the whole domain"
    return f"They vary {manner}{f', correlated: {pairs}' if pairs else ''}."


def _index_in_words(row: object, name: str) -> str:
    value, low, high = (float(row[f"{name}{end}"]) for end in ("", "_lower", "_upper"))  # type: ignore[index]
    return "-" if math.isnan(value) else f"{value:.2f} ±{(high - low) / 2:.2f}"


def sensitivity_figure(result: Risk) -> Figure:
    """First-order and total Sobol indices of every characteristic with intervals: one panel for the safety degree, one for unsafe outcomes.

    Raises
    ------
    InputError
        If characteristics are correlated or bound by constraints, so that indices are undefined.
    """
    if result.sensitivity is None or result.sensitivity_of_unsafe is None:
        raise InputError("correlations", "there are no sensitivity indices of characteristics that are correlated or bound by constraints",
                         "a study without correlations and constraints")
    names = result.sensitivity.sort_values("total", kind="stable")["characteristic"].to_list()
    title = f"{result.study.name}: what decides ({100 * result.confidence:g} % intervals)"
    figure, (axes,) = new_figure(title, rows=1, columns=2, size=(7.2, 1.5 + 0.28 * max(len(names), 4)))
    frames = {"safety degree": result.sensitivity, f"unsafe ({result.unsafe})": result.sensitivity_of_unsafe}
    for axis, (output, frame) in zip(axes, frames.items(), strict=True):
        rows = frame.set_index("characteristic").loc[names]
        for column, label, colour, shift in (("total", "total: with all others", GREY, 0.2), ("first_order", "alone", BLUE, -0.2)):
            width = (rows[f"{column}_upper"] - rows[column]).clip(lower=0)
            axis.barh(np.arange(len(names)) + shift, rows[column], height=0.36, color=colour, xerr=width, label=label,
                      error_kw={"elinewidth": 0.8, "ecolor": "black"})
        axis.set_yticks(np.arange(len(names)), [escape_dollars(name) for name in names])
        axis.set_title(escape_dollars(output), fontsize=FONT)
        axis.set_xlabel("share of the variance [-]")
        axis.set_xlim(0, 1)
        if rows["total"].isna().all():
            axis.text(0.5, 0.5, "too few settings are unsafe,\nor safe, for indices", transform=axis.transAxes, ha="center", fontsize=FONT)
        axis.grid(visible=False, axis="y")
    axes[1].set_yticklabels([])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=FONT)
    return figure
