"""Values that people type: checks of output files, changes of characteristics, numbers in a range; and shell completion."""

from __future__ import annotations

import math
import re
from itertools import product
from pathlib import Path
from typing import Any

import click
import numpy as np
from click.shell_completion import CompletionItem

from safevar_sumo.errors import InputError, SafevarError, unknown
from safevar_sumo.records import FloatArray
from safevar_sumo.study import check_writable, load_study, study_names
from safevar_sumo.vehicles import CharacteristicSet

PICTURES = (".png", ".pdf", ".svg")


def check_output(path: Path, flag: str, endings: tuple[str, ...]) -> None:
    """Refuse an output file that has an unknown ending or cannot be written.

    Raises
    ------
    InputError
        Names the flag and the legal endings.
    """
    if path.suffix.lower() not in endings:
        raise InputError(flag, str(path), f"a file that ends in {', '.join(endings)}")
    check_writable(path, flag)


def refuse_inputs(path: Path, flag: str, *inputs: str | Path) -> None:
    """Refuse to overwrite an input of the command: a file, or a file of a results directory.

    Raises
    ------
    InputError
        Names the flag and the file.
    """
    if not path.exists():
        return
    for source in map(Path, inputs):
        files = [source, *source.glob("*.*"), *source.glob("runs/*")] if source.is_dir() else [source]
        if any(file.exists() and path.samefile(file) for file in files if file.suffix not in PICTURES):
            raise InputError(flag, f"{path} is an input of the command", "another file")


class Within(click.FloatRange):
    """A range of numbers that refuses NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number if it is within the range."""
        number = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value} is not in the range {self._describe_range()}.", param, ctx)
        return number


NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
SIGNED = re.compile(r"[+-](?:\d+\.?\d*|\.\d+)")
SHARE = re.compile(rf"({SIGNED.pattern})%")
SWEEP = re.compile(rf"({NUMBER})\.\.({NUMBER})(?::(\d{{1,6}}))?")
DEFAULT_SWEEP_LENGTH = 11
"""Number of values of a sweep that gives none."""
MAX_SETTINGS = 10_000
"""Maximum number of settings of all sweeps together."""
ONE_VALUE = "one value for each: NAME=VALUE in the characteristic's unit, or NAME=+10% of the original"
LEGAL = "NAME=VALUE in the characteristic's unit, NAME=+10% of the original, or NAME=FROM..TO, NAME=FROM..TO:NUMBER"


def read_changes(changes: tuple[str, ...], characteristics: CharacteristicSet, beyond: bool, *, single: bool = False
                 ) -> dict[str, list[float]]:
    """The values of each named characteristic; `single`: no sweeps, and errors do not suggest --beyond.

    Raises
    ------
    InputError
        If a change has another form, a name is unknown or given twice, or a value is outside its domain.
    """
    values_by_name: dict[str, list[float]] = {}
    legal = ONE_VALUE if single else LEGAL
    for change in changes:
        name, equals, text = (part.strip() for part in change.partition("="))
        if not equals:
            raise InputError("--set", repr(change), legal)
        if name in values_by_name:
            raise InputError("--set", f"{name} is set twice", "each characteristic once")
        if name not in characteristics.names:
            raise unknown("--set", f"there is no characteristic {name!r}", name, characteristics.names)
        member = characteristics.members[characteristics.names.index(name)]
        values_by_name[name] = _values(change, text, member.original, legal)
        if single and len(values_by_name[name]) > 1:
            raise InputError("--set", f"{change!r} is a sweep", legal)
        for value in values_by_name[name]:
            hint = f", or {name}={text}% of the original" if SIGNED.fullmatch(text) else ""
            member.check(value, "--set", beyond=beyond, otherwise=hint, switch="" if single else "--beyond")
    if np.prod([len(values) for values in values_by_name.values()], dtype=float) > MAX_SETTINGS:
        raise InputError("--set", f"{' '.join(changes)}: more than {MAX_SETTINGS} settings", "shorter sweeps, FROM..TO:NUMBER")
    return values_by_name


def settings_of(changes: dict[str, list[float]], base: FloatArray, characteristics: CharacteristicSet) -> FloatArray:
    """`base`, shape (n,), with every combination of the values; shape (M, n)."""
    columns = [characteristics.names.index(name) for name in changes]
    rows = []
    for values in product(*changes.values()):
        row = base.copy()
        row[columns] = values
        rows.append(row)
    return np.array(rows)


def _values(change: str, text: str, original: float, legal: str) -> list[float]:
    if share := SHARE.fullmatch(text):
        return [original + abs(original) * float(share[1]) / 100]
    if sweep := SWEEP.fullmatch(text):
        number = int(sweep[3] or DEFAULT_SWEEP_LENGTH)
        if number < 2:
            raise InputError("--set", f"{change!r}: {number} values from {sweep[1]} to {sweep[2]}", "NUMBER of at least 2")
        return np.linspace(float(sweep[1]), float(sweep[2]), number).tolist()  # type: ignore[no-any-return]
    if re.fullmatch(NUMBER, text):
        return [float(text)]
    raise InputError("--set", repr(change), legal)


def complete_study(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Names of studies, and files or directories."""
    names = [CompletionItem(name) for name in study_names() if name.startswith(incomplete)]
    return [*names, CompletionItem(incomplete, type="file")]


def complete_changes(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """`NAME=` for each characteristic of the study named earlier in the command line, with its domain as help."""
    study = str(ctx.params.get("study") or next(iter(ctx.args), ""))  # while --set is incomplete, click has not parsed what follows
    if not study or Path(study).is_dir():
        return []
    try:
        characteristics = load_study(study).vehicle.characteristics
    except SafevarError:
        return []
    return [CompletionItem(f"{name}=", help=f"{row.lower:g} to {row.upper:g}" + (f" {row.unit}" if row.unit != "-" else ""))
            for name, row in characteristics.items() if name.startswith(incomplete)]
