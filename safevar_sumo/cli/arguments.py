"""Check what users type (output files, changes of characteristics, numbers in a range), and complete it in the
shell.
"""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import click
import numpy as np
from click.shell_completion import CompletionItem

from safevar_sumo.errors import InputError, SafevarError, unknown_name
from safevar_sumo.output import check_writable
from safevar_sumo.records import FloatArray
from safevar_sumo.results import SOLUTIONS
from safevar_sumo.study import load_study, study_names, unit_text
from safevar_sumo.vehicles import CharacteristicSet

PICTURE_ENDINGS = (".png", ".pdf", ".svg")


def check_output(path: Path, flag: str, endings: tuple[str, ...]) -> None:
    """Refuse an output file that has an unknown ending, is the solutions of results, or cannot be written.

    Raises
    ------
    InputError
        Names the flag and what it expects.
    """
    if path.suffix.lower() not in endings:
        raise InputError(flag, str(path), f"a file that ends in {', '.join(endings)}")
    refuse_overwriting(path, flag, path.with_name(SOLUTIONS))
    check_writable(path, flag)


def refuse_overwriting(path: Path, flag: str, *inputs: str | Path) -> None:
    """Refuse to overwrite an input of the command; raises InputError, which names the flag and the file."""
    if path.exists() and any(Path(source).exists() and path.samefile(source) for source in inputs):
        raise InputError(flag, f"{path} is an input of the command, or holds results", "another file")


NUMBER_PATTERN = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
SIGNED_NUMBER = re.compile(r"[+-](?:\d+\.?\d*|\.\d+)")
PERCENTAGE = re.compile(rf"({SIGNED_NUMBER.pattern})%")
SWEEP = re.compile(rf"({NUMBER_PATTERN})\.\.({NUMBER_PATTERN})(?::(\d{{1,6}}))?")
DEFAULT_SWEEP_LENGTH = 11
"""Number of values of a sweep without `:NUMBER`."""
MAX_SETTINGS = 10_000
"""Maximum number of settings that all --set together may produce."""
SINGLE_VALUE_FORMS = "one value for each: NAME=VALUE in the characteristic's unit, or NAME=+10% of the original"
CHANGE_FORMS = (
    "NAME=VALUE in the characteristic's unit, NAME=+10% of the original, or NAME=FROM..TO, NAME=FROM..TO:NUMBER"
)


def read_changes(
    changes: tuple[str, ...], characteristics: CharacteristicSet, beyond: bool, *, single: bool = False
) -> dict[str, list[float]]:
    """Parse --set into the values of each named characteristic; `single` refuses sweeps, without suggesting --beyond.

    Raises
    ------
    InputError
        If a change cannot be parsed, a name is unknown or given twice, or a value is outside its domain.
    """
    values_by_name: dict[str, list[float]] = {}
    forms = SINGLE_VALUE_FORMS if single else CHANGE_FORMS
    for change in changes:
        name, equals, text = (text.strip() for text in change.partition("="))
        if not equals:
            raise InputError("--set", repr(change), forms)
        if name in values_by_name:
            raise InputError("--set", f"{name} is set twice", "each characteristic once")
        if name not in characteristics.names:
            raise unknown_name("--set", f"there is no characteristic {name!r}", name, characteristics.names)
        characteristic = characteristics.members[characteristics.names.index(name)]
        values_by_name[name] = _parse_values(change, text, characteristic.original, forms)
        if single and len(values_by_name[name]) > 1:
            raise InputError("--set", f"{change!r} is a sweep", forms)
        for value in values_by_name[name]:
            hint = f", or {name}={text}% of the original" if SIGNED_NUMBER.fullmatch(text) else ""
            characteristic.check(value, "--set", beyond=beyond, otherwise=hint, switch="" if single else "--beyond")
    if np.prod([len(values) for values in values_by_name.values()], dtype=float) > MAX_SETTINGS:
        raise InputError(
            "--set", f"{' '.join(changes)}: more than {MAX_SETTINGS} settings", "shorter sweeps, FROM..TO:NUMBER"
        )
    return values_by_name


def combine_values(
    values_by_name: dict[str, list[float]], base: FloatArray, characteristics: CharacteristicSet
) -> FloatArray:
    """Make M settings, shape (M, n): `base`, shape (n,), with each of the M combinations of values in turn."""
    columns = [characteristics.names.index(name) for name in values_by_name]
    settings = []
    for values in product(*values_by_name.values()):
        setting = base.copy()
        setting[columns] = values
        settings.append(setting)
    return np.array(settings)


def _parse_values(change: str, text: str, original: float, forms: str) -> list[float]:
    if percentage := PERCENTAGE.fullmatch(text):
        return [original + abs(original) * float(percentage[1]) / 100]
    if sweep := SWEEP.fullmatch(text):
        count = int(sweep[3] or DEFAULT_SWEEP_LENGTH)
        if count < 2:
            raise InputError(
                "--set", f"{change!r}: {count} values from {sweep[1]} to {sweep[2]}", "NUMBER of at least 2"
            )
        return np.linspace(float(sweep[1]), float(sweep[2]), count).tolist()  # type: ignore[no-any-return]
    if re.fullmatch(NUMBER_PATTERN, text):
        return [float(text)]
    raise InputError("--set", repr(change), forms)


def complete_study(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete names of studies, files and directories."""
    names = [CompletionItem(name) for name in study_names() if name.startswith(incomplete)]
    return [*names, CompletionItem(incomplete, type="file")]


def complete_changes(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete `NAME=` for each characteristic of the study named earlier in the command line, with its domain as
    help.
    """
    study = str(
        ctx.params.get("study") or next(iter(ctx.args), "")
    )  # while --set is incomplete, click has not parsed the rest
    if not study or Path(study).is_dir():
        return []
    try:
        characteristics = load_study(study).vehicle.characteristics
    except SafevarError:
        return []
    return [
        CompletionItem(f"{name}=", help=f"{item.lower:g} to {item.upper:g}{unit_text(item.unit)}")
        for name, item in characteristics.items()
        if name.startswith(incomplete)
    ]
