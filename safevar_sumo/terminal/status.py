"""How far a study is, for a second terminal."""

from __future__ import annotations

from datetime import timedelta

from rich.console import Group, RenderableType
from rich.text import Text

from safevar_sumo.analysis.quality import nondominated
from safevar_sumo.results.status import RunStatus, Status
from safevar_sumo.terminal.plain import WholeTable

FRONT = 5
"""Points of the front that are shown."""
RUNS_SHOWN = 12
"""Runs under way that are named."""


def status_view(told: Status, rate: float | None) -> RenderableType:
    """A study's runs by algorithm and the front so far; `rate` is the share of the work done per second, if it is known."""
    table = WholeTable("algorithm", title=Text(told.title), title_justify="left")
    for head in ("runs", "under\nway", "simulated", "collisions", "simulator\nerrors", "best\nSD"):
        table.add_column(head, justify="right")
    for algorithm in dict.fromkeys(run.algorithm for run in told.runs):
        of_it = [run for run in told.runs if run.algorithm == algorithm]
        table.add_row(Text(algorithm), *_cells(of_it))
    return Group(table, Text(_under_way(told)), Text(_left(told, rate)), _front(told))


def _cells(runs: list[RunStatus]) -> list[str]:
    best = [run.best for run in runs if run.best is not None]
    return [f"{sum(run.state == 'finished' for run in runs)}/{len(runs)}", str(sum(run.state == "begun" for run in runs)),
            str(sum(run.simulated for run in runs)), str(sum(run.collisions for run in runs)),
            str(sum(run.simulator_errors for run in runs)), f"{min(best):.2f}" if best else "-"]


def _under_way(told: Status) -> str:
    begun = [f"{run.algorithm}:{run.run} {run.simulated}/{told.budget}" for run in told.runs if run.state == "begun"]
    more = f" and {len(begun) - RUNS_SHOWN} more" if len(begun) > RUNS_SHOWN else ""
    return f"Under way: {', '.join(begun[:RUNS_SHOWN])}{more}" if begun else ""


def _left(told: Status, rate: float | None) -> str:
    if told.finished:
        return "Finished."
    if not rate:
        return f"{told.share:.0%} done."
    return f"{told.share:.0%} done, {timedelta(seconds=round((1 - told.share) / rate))} left at this pace."


def _front(told: Status) -> RenderableType:
    """The most severe points that no other one beats in all three objectives."""
    if not len(told.points):
        return Text("Nothing simulated yet.")
    front = nondominated(told.points)
    front = front[front[:, 0].argsort(kind="stable")]
    table = WholeTable(title=f"Front so far: {len(front)} points, the most severe ones", title_justify="left")
    for head in ("safety degree [m, -m/s]", "f_diff [fraction]", "changed"):
        table.add_column(head, justify="right")
    for f_safe, f_diff, number in front[:FRONT].tolist():
        table.add_row(f"{f_safe:.2f}", f"{f_diff:.3f}", f"{number:.0f}")
    return table
