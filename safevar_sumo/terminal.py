"""What a person sees on the terminal: progress, summaries, lists."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from safevar_sumo.analysis import Agreement, brief, setting_of
from safevar_sumo.calibration import Calibration
from safevar_sumo.campaign import Campaign, Forecast, RunKey
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import record, solutions_frame
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

METRIC_HEADS = {"safety_degree": "SD", "tet": "TET, s", "tit": "TIT, s^2", "ave_dece": "aveDece, m/s^2"}
SAFETY_NOTE = "SD: least distance in m, or minus the collision's speed in m/s.\nTET, TIT: over solutions without collision."
SECONDS_BETWEEN_LINES = 30.0


class CampaignProgress:
    """Bars on a terminal, a line now and then elsewhere: what is done, how fast, what was found, how long yet."""

    def __init__(self, console: Console, study: Study, keys: list[RunKey], quiet: bool) -> None:
        self._console, self._quiet = console, quiet
        shown = console.is_terminal and not quiet
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=8), TextColumn("{task.fields[told]}"),
            console=console, disable=not shown)
        self._lines = {}
        for name in study.search.algorithms:
            runs = sum(key.algorithm == name for key in keys)
            if runs:
                task = self._bar.add_task(name, total=runs * study.search.evaluations, told=f"runs 0/{runs}")
                self._lines[name] = _Line(name, runs, study.search.evaluations, task)
        self._asked: dict[RunKey, int] = {}
        self._spoke = time.monotonic()

    def __enter__(self) -> CampaignProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        self._asked[key] = self._asked.get(key, 0) + len(evaluations)
        self._lines[key.algorithm].take_in(evaluations, simulated)
        self._tell(self._lines[key.algorithm])

    def finished(self, key: RunKey, asked: int) -> None:
        self._lines[key.algorithm].close_run(asked, self._asked.pop(key, 0))
        self._tell(self._lines[key.algorithm])

    def warned(self, message: str) -> None:
        self._console.print(f"warning: {message}", soft_wrap=True, markup=False, highlight=False)

    def _tell(self, line: _Line) -> None:
        self._bar.update(line.task, completed=line.done, total=line.total, told=line.told())
        now = time.monotonic()
        if not self._console.is_terminal and not self._quiet and now - self._spoke >= SECONDS_BETWEEN_LINES:
            self._spoke = now
            for one in self._lines.values():
                self._console.print(f"{one.name}: {one.told()}", soft_wrap=True, highlight=False)


class _Line:
    """How far the runs of one algorithm are."""

    def __init__(self, name: str, runs: int, evaluations: int, task: TaskID) -> None:
        self.name, self.task = name, task
        self.done, self.total = 0, runs * evaluations
        self._evaluations, self._runs = evaluations, runs
        self._finished = self._simulated = self._collisions = 0
        self._best = np.inf
        self._first = self._last = 0.0

    def take_in(self, evaluations: Evaluations, simulated: int) -> None:
        self._last = time.monotonic()
        if self._first:
            self._simulated += simulated
        else:
            self._first = self._last  # what came first took nobody knows how long
        self.done += len(evaluations)
        self._collisions += int(np.count_nonzero(evaluations.collided))
        if evaluations.valid.any():
            self._best = min(self._best, float(np.min(evaluations.f_safe[evaluations.valid])))

    def close_run(self, asked: int, seen: int) -> None:
        """A run that ends early asks for less than its budget; one from a finished journal was never seen."""
        self._finished += 1
        self.done += asked - seen
        self.total -= self._evaluations - asked

    def told(self) -> str:
        """What comes last may be cut off on a narrow terminal."""
        found = "" if np.isinf(self._best) else f", best SD {self._best:.2f}, collisions {self._collisions}"
        return f"runs {self._finished}/{self._runs}, {self._rate():.0f} evaluations/s, {self._left()}{found}"

    def _left(self) -> str:
        """Hours, minutes and seconds, as far as there is a telling."""
        rate = self._rate()
        if not rate and self.done < self.total:
            return "time left not known yet" if self.done else "not begun"
        return f"{timedelta(seconds=round((self.total - self.done) / rate) if rate else 0)} left"

    def _rate(self) -> float:
        """Evaluations per second while this algorithm's runs are under way."""
        return self._simulated / (self._last - self._first) if self._last > self._first else 0.0


def print_forecast(console: Console, study: Study, runs: int, told: Forecast) -> None:
    """What a campaign would take."""
    console.print(study.title, soft_wrap=True, highlight=False)
    table = Table(show_header=False)
    table.add_row("algorithms", ", ".join(study.search.algorithms))
    table.add_row("runs", str(runs))
    table.add_row("evaluations, at the most", str(told.evaluations))
    table.add_row("evaluations/s, measured by a short probe", f"{told.rate:.0f}")
    table.add_row("time, at the most", f"{told.seconds / 60:.1f} min")
    table.add_row("disk, at the most", f"{told.size / 1e6:.0f} MB")
    console.print(table)


def print_summary(console: Console, study: Study, campaign: Campaign, directory: Path) -> None:
    """Per algorithm what was found, beside the original vehicle; the most critical setting; what RQ1 and RQ2 say of it."""
    found = {"original vehicle": campaign.original}
    for algorithm in study.search.algorithms:
        of_it = [one for key, one in campaign.solutions.items() if key.algorithm == algorithm]
        if of_it:
            found[algorithm] = Evaluations.concatenate(of_it)
    table = Table("", title=study.title, title_justify="left")
    for head in found:
        table.add_column(head, justify="right")
    table.add_row("solutions", "-", *(str(len(one)) for one in list(found.values())[1:]))
    table.add_row("collisions", *(str(int(np.count_nonzero(one.collided))) for one in found.values()))
    for name, head in METRIC_HEADS.items():
        table.add_row(f"mean {head}", *(_mean(one.metrics[name]) for one in found.values()))
    console.print(table)
    console.print(SAFETY_NOTE)
    if campaign.failures:
        console.print(f"{campaign.failures} settings could not be simulated (simulator-error); they are in no result.")
    _print_most_critical(console, study, campaign)
    names = tuple(study.vehicle.characteristics)
    solutions = solutions_frame(names, campaign.solutions.items())
    for line in brief(setting_of(study, record(campaign.original, 0), solutions, solutions_frame(names, []), tuple(campaign.solutions))):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    console.print(f"All tables: python -m safevar_sumo tables {shlex.quote(str(directory))}", soft_wrap=True, markup=False, highlight=False)


def _mean(values: FloatArray) -> str:
    defined = values[~np.isnan(values)]
    return f"{np.mean(defined):.2f}" if defined.size else "-"


def _print_most_critical(console: Console, study: Study, campaign: Campaign) -> None:
    if not any(map(len, campaign.solutions.values())):
        console.print("No solution.")
        return
    pooled = Evaluations.concatenate(list(campaign.solutions.values()))
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


@contextmanager
def counted(console: Console, what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar that counts up to `total`; yields what to call with every number that is done."""
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=console, disable=not console.is_terminal)
    with bar:
        task = bar.add_task(what, total=total)
        yield lambda number: bar.update(task, advance=number)


def print_agreement(console: Console, study: Study, told: Agreement) -> None:
    """Comparison with reference data, metric by metric."""
    table = Table("", title=f"{study.title}: {told.rows} rows", title_justify="left")
    for head in ("Spearman's rho", "mean abs. error", "bias", "original there", "original here"):
        table.add_column(head, justify="right")
    for name, head in METRIC_HEADS.items():
        numbers = (told.spearman[name], told.mean_absolute_error[name], told.bias[name], *told.original[name].values())
        table.add_row(head, *("-" if number is None else f"{number:.3f}" for number in numbers))
    console.print(table)
    collisions = told.collisions
    console.print(f"Collisions: {collisions['reference']} in the reference, {collisions['here']} here, {collisions['both']} in both.")


@contextmanager
def trials(console: Console, total: int) -> Iterator[Callable[[float], None]]:
    """A bar that counts trials; yields what to call after each with the lowest cost so far."""
    columns = (TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.fields[told]}"))
    spoke = time.monotonic()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("trials", total=total, told="")

        def done(best: float) -> None:
            nonlocal spoke
            bar.update(task, advance=1, told=f"lowest cost {best:.4f}")
            if not console.is_terminal and time.monotonic() - spoke >= SECONDS_BETWEEN_LINES:
                spoke = time.monotonic()
                console.print(f"trial {bar.tasks[0].completed:.0f} of {total}, lowest cost {best:.4f}", highlight=False)

        yield done


def print_calibration(console: Console, study: Study, found: Calibration) -> None:
    """Found values, and how well they do on both halves of the data."""
    table = Table("parameter", "unit", title=study.title, title_justify="left")
    for head in ("found", "lower", "upper"):
        table.add_column(head, justify="right")
    for name, value in found.values.items():
        row = study.calibration[name]
        table.add_row(name, row.unit, *(f"{number:.5g}" for number in (value, row.lower, row.upper)))
    console.print(table)
    for name in found.used:
        both = Table(f"{name}: used half / held back", title_justify="left")
        for head in ("Spearman's rho", "mean abs. error", "bias"):
            both.add_column(head, justify="right")
        halves = (found.used[name], found.held_back[name])
        for metric, head in METRIC_HEADS.items():
            both.add_row(head, *(
                " / ".join("-" if number is None else f"{number:.3f}" for number in (getattr(half, what)[metric] for half in halves))
                for what in ("spearman", "mean_absolute_error", "bias")))
        console.print(both)
    console.print(f"Cost {found.cost:.4f}")


def print_names(console: Console, title: str, rows: Iterable[tuple[str, ...]], heads: tuple[str, ...]) -> None:
    """A plain table of what there is."""
    table = Table(*heads, title=title, title_justify="left")
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    console.print(table)
