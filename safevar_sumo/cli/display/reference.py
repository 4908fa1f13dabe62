"""A study beside reference data."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from safevar_sumo.metrics import METRICS
from safevar_sumo.reference import Agreement, Calibration, cost_line, on_a_bound
from safevar_sumo.study import Study
from safevar_sumo.terminal import WholeTable


def print_agreement(console: Console, study: Study, told: Agreement) -> None:
    """Comparison with reference data, metric by metric."""
    table = WholeTable("", title=escape(f"{study.title}: {told.rows} rows"), title_justify="left")
    for head in ("Spearman's rho", "mean abs. error", "in repeats", "bias", "original there", "original here"):
        table.add_column(head, justify="right")
    for name in told.spearman:
        head = METRICS[name].heading
        numbers = (told.spearman[name], told.mean_absolute_error[name], told.in_repeats[name], told.bias[name],
                   *told.original[name].values())
        table.add_row(head, *("-" if number is None else f"{number:.3f}" for number in numbers))
    console.print(table)
    collisions = told.collisions
    console.print(f"Collisions: {collisions['reference']} in the reference, {collisions['here']} here, {collisions['both']} in both: "
                  f"precision {_number(told.precision)}, recall {_number(told.recall)}; their mean speed is "
                  f"{_number(told.collision_speed['reference'])} m/s there and {_number(told.collision_speed['here'])} m/s here.")
    if told.undecided["within_repeats"] is not None:
        console.print(f"Of {told.undecided['differ']} settings that collide on one side alone, {told.undecided['within_repeats']} "
                      "may do either: repeats of them differ by as much.")
    bins = ", ".join(f"{part['lowest']:.2f} to {part['highest']:.2f}: {part['bias']:+.2f}" for part in told.by_predicted)
    console.print(f"Mean error by the safety degree here: {bins}.", markup=False)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def print_calibration(console: Console, study: Study, found: Calibration) -> None:
    """Found values, and how well they do on both halves of the data."""
    table = WholeTable("parameter", "unit", title=escape(study.title), title_justify="left")
    for head in ("found", "lower", "upper"):
        table.add_column(head, justify="right")
    for name, value in found.values.items():
        row = study.calibration[name]
        table.add_row(name, row.unit, *(f"{number:.5g}" for number in (value, row.lower, row.upper)))
    console.print(table)
    for name in found.used:
        both = WholeTable(title=escape(f"{name}: rows used / held back"), title_justify="left")
        both.add_column("")
        for head in ("Spearman's rho", "mean abs. error", "bias"):
            both.add_column(head, justify="right")
        halves = (found.used[name], found.held_back[name])
        for metric in halves[0].spearman:
            head = METRICS[metric].heading
            both.add_row(head, *(
                " / ".join("-" if number is None else f"{number:.3f}" for number in (getattr(half, what)[metric] for half in halves))
                for what in ("spearman", "mean_absolute_error", "bias")))
        console.print(both)
    for name in on_a_bound(found.values, study.calibration):
        console.print(f"{name} stands on its bound: a wider one may fit better.", markup=False)
    if not found.alone:
        console.print("SUMO simulated every trial in copies of the network: beside one copy, vehicles do something else in this scenario.")
    console.print(cost_line(found))
