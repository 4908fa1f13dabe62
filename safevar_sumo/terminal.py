"""What a person sees on the terminal: progress, summaries, lists."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from safevar_sumo.campaign import Campaign, RunKey
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

METRIC_HEADS = {"safety_degree": "SD", "tet": "TET, s", "tit": "TIT, s^2", "ave_dece": "aveDece, m/s^2"}
SAFETY_NOTE = "SD: least distance in m, or minus the collision's speed in m/s.\nTET, TIT: over solutions without collision."
SECONDS_BETWEEN_LINES = 30.0


class CampaignProgress:
    """A bar on a terminal, a line now and then elsewhere: what is done, how fast, how long yet, what was found."""

    def __init__(self, console: Console, study: Study) -> None:
        search = study.search
        self._console, self._runs = console, len(search.algorithms) * search.runs
        self._total = self._runs * search.evaluations
        self._done = self._finished = self._collisions = 0
        self._asked: dict[RunKey, int] = {}
        self._best = np.inf
        self._started = self._spoke = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(), _Rate(), TimeRemainingColumn(),
            TextColumn("{task.fields[found]}"), console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task(self._runs_told(), total=self._total, found="")

    def __enter__(self) -> CampaignProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def evaluated(self, key: RunKey, evaluations: Evaluations) -> None:
        self._asked[key] = self._asked.get(key, 0) + len(evaluations)
        self._done += len(evaluations)
        self._collisions += int(np.count_nonzero(evaluations.collided))
        if evaluations.valid.any():
            self._best = min(self._best, float(np.min(evaluations.f_safe[evaluations.valid])))
        self._tell()

    def finished(self, key: RunKey) -> None:
        self._finished += 1
        self._total -= self._total // self._runs - self._asked.pop(key)
        self._tell()

    def _runs_told(self) -> str:
        return f"runs {self._finished}/{self._runs}"

    def _tell(self) -> None:
        found = f"best SD {self._best:.2f}, collisions {self._collisions}"
        self._bar.update(self._task, completed=self._done, total=self._total, description=self._runs_told(), found=found)
        now = time.monotonic()
        if not self._console.is_terminal and now - self._spoke >= SECONDS_BETWEEN_LINES:
            rate = self._done / (now - self._started)
            left = (self._total - self._done) / rate
            self._spoke = now
            self._console.print(
                f"{self._runs_told()}, {self._done} of {self._total} evaluations, {rate:.0f}/s, {left:.0f} s left, {found}")


class _Rate(ProgressColumn):
    """Evaluations per second."""

    def render(self, task: Task) -> Text:
        return Text("- evaluations/s" if task.speed is None else f"{task.speed:.0f} evaluations/s")


def print_summary(console: Console, study: Study, campaign: Campaign) -> None:
    """Per algorithm what was found, beside the original vehicle; then the most critical setting."""
    found = {"original vehicle": campaign.original}
    for algorithm in study.search.algorithms:
        found[algorithm] = Evaluations.concatenate([one for key, one in campaign.solutions.items() if key.algorithm == algorithm])
    table = Table("", title=study.title, title_justify="left")
    for head in found:
        table.add_column(head, justify="right")
    table.add_row("solutions", "-", *(str(len(found[algorithm])) for algorithm in study.search.algorithms))
    table.add_row("collisions", *(str(int(np.count_nonzero(one.collided))) for one in found.values()))
    for name, head in METRIC_HEADS.items():
        table.add_row(f"mean {head}", *(_mean(one.metrics[name]) for one in found.values()))
    console.print(table)
    console.print(SAFETY_NOTE)
    _print_most_critical(console, study, campaign)


def _mean(values: FloatArray) -> str:
    defined = values[~np.isnan(values)]
    return f"{np.mean(defined):.2f}" if defined.size else "-"


def _print_most_critical(console: Console, study: Study, campaign: Campaign) -> None:
    pooled = Evaluations.concatenate(list(campaign.solutions.values()))
    if not len(pooled):
        console.print("No solution.")
        return
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    worst = pooled.take([int(np.lexsort((pooled.f_diff, pooled.f_num_diff, pooled.f_safe))[0])])
    changes = [
        f"{member.name} {member.original:g} -> {value:.6g} {'' if member.unit == '-' else member.unit}".rstrip()
        for member, value in zip(characteristics, worst.settings[0].tolist(), strict=True) if value != member.original]
    console.print(f"Most critical setting: SD {worst.f_safe[0]:.2f} ({worst.outcome[0]}), "
                  f"the original's {campaign.original.f_safe[0]:.2f} ({campaign.original.outcome[0]}), by")
    for change in changes or ["no change at all"]:
        console.print(f"  {change}")


def print_evaluation(console: Console, study: Study, record: Mapping[str, Any], characteristics: CharacteristicSet) -> None:
    """One simulation: the setting, how it ended, metrics and objectives."""
    table = Table("characteristic", "unit", title=study.title)
    for head in ("original", "simulated"):
        table.add_column(head, justify="right")
    for member in characteristics:
        value = record["vcs"][member.name]
        table.add_row(member.name, member.unit, f"{member.original:g}", f"{value:g}", style="bold" if value != member.original else None)
    console.print(table)
    units = {"collision_speed": "m/s", "safety_degree": "m, or -m/s", "tet": "s", "tit": "s^2", "ave_dece": "m/s^2",
             "f_safe": "m, or -m/s", "f_diff": "fraction", "f_num_diff": "characteristics"}
    results = Table("result", "value", "unit")
    results.add_row("outcome", record["outcome"], "")
    for name, unit in units.items():
        value = record[name]
        results.add_row(name, "undefined" if value is None else f"{value:.4g}", unit)
    console.print(results)


def print_names(console: Console, title: str, rows: Iterable[tuple[str, ...]], heads: tuple[str, ...]) -> None:
    """A plain table of what there is."""
    table = Table(*heads, title=title, title_justify="left")
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    console.print(table)
