"""The published package's CSV format: settings before the filter, with what the reference simulators measured.

One row is one solution: the characteristics, then `MaxPercentage`, `SaftyDegree` (sic), `numbers`, `TIT`, `TET` and,
in most files, `Dece`. There is no run column.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import CharacteristicSet

COLUMNS = {"safety_degree": "SaftyDegree", "tet": "TET", "tit": "TIT", "ave_dece": "Dece"}
OPTIONAL = "ave_dece"
ALIASES = {"dampratezeroce": "dampratezerotce", "dampratezerocd": "dampratezerotcd", "wheelradius": "radius"}
"""Names of characteristics in the package's files that are not those of its paper, without case and underscores."""
SHARE_DECIMALS = 3
"""The package rounds a change's share of the domain before it compares it with beta."""


class ReferenceData(NamedTuple):
    """Rows of a reference file.

    Attributes
    ----------
    settings
        Filtered as the package does; shape (M, n), table units.
    metrics
        Name -> values, shape (M,); NaN where undefined: TET and TIT of a collision, a column that is missing.
    skipped
        How many rows had a value outside its domain and were left out.
    """

    settings: FloatArray
    metrics: dict[str, FloatArray]
    skipped: int

    @property
    def collided(self) -> BoolArray:
        return np.asarray(self.metrics["safety_degree"] <= 0)


def read_reference(path: Path, characteristics: CharacteristicSet) -> ReferenceData:
    """Read a file of the published package.

    Raises
    ------
    InputError
        If it cannot be read, lacks a column or a row, or holds a cell that is no number; names file, row and column.
    """
    table = _table(path)
    columns = _characteristic_columns(path, table, characteristics)
    wanted = [*columns, *(column for name, column in COLUMNS.items() if name != OPTIONAL or column in table)]
    missing = [column for column in wanted if column not in table]
    if missing:
        raise InputError(path, f"lacks the columns {', '.join(missing)}", "the format of the published package")
    numbers = {column: _numbers(path, table, column) for column in wanted}
    settings = np.stack([numbers[column] for column in columns], axis=1)
    inside = np.all((settings >= characteristics.lower) & (settings <= characteristics.upper), axis=1)
    if not inside.any():
        raise InputError(path, "has no row whose values are all in the domains of the study", "a file of this study's vehicle")
    undefined = np.full(len(table), np.nan)
    metrics = {name: numbers.get(column, undefined)[inside] for name, column in COLUMNS.items()}
    collided = metrics["safety_degree"] <= 0
    metrics["ave_dece"] = np.abs(metrics["ave_dece"])
    metrics["tet"], metrics["tit"] = (np.where(collided, np.nan, metrics[name]) for name in ("tet", "tit"))
    return ReferenceData(package_filter(characteristics, settings[inside]), metrics, int(np.count_nonzero(~inside)))


def package_filter(characteristics: CharacteristicSet, settings: FloatArray) -> FloatArray:
    """The filter as the package has it: at least beta, of a share that is rounded to three decimals."""
    width = characteristics.upper - characteristics.lower
    share = np.round(np.abs(settings - characteristics.original) / width, SHARE_DECIMALS)
    return np.where(share >= characteristics.threshold / width - 1e-12, settings, characteristics.original)


def _table(path: Path) -> pd.DataFrame:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
            file.seek(0)
            table = pd.read_csv(file, dtype=str, skipinitialspace=True, index_col=False)
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}", "a CSV file") from None
    except pd.errors.EmptyDataError:
        raise InputError(path, "is empty", "a CSV file with a header and rows") from None
    except (pd.errors.ParserError, csv.Error, UnicodeDecodeError) as error:
        raise InputError(path, f"is not CSV: {str(error).splitlines()[0]}", "a CSV file with a header and rows") from None
    table.columns = table.columns.str.strip()
    twice = [name for name in header if header.count(name) > 1]
    if twice:
        raise InputError(path, f"has the column {twice[0]!r} twice", "one column of a name")
    if len(header) == 1:
        raise InputError(path, f"has one column, {header[0][:40]!r}", "values that are separated by commas")
    if table.empty:
        raise InputError(path, "has no rows", "a CSV file with a header and rows")
    return table


def _plain(name: str) -> str:
    key = name.strip().replace("_", "").lower()
    return ALIASES.get(key, key)


def _characteristic_columns(path: Path, table: pd.DataFrame, characteristics: CharacteristicSet) -> list[str]:
    """The file's columns of the characteristics, in the study's order."""
    found: dict[str, str] = {}
    for column in map(str, table.columns):
        if _plain(column) in found:
            raise InputError(path, f"has two columns of one name, {found[_plain(column)]!r} and {column!r}", "each column once")
        found[_plain(column)] = column
    missing = [name for name in characteristics.names if _plain(name) not in found]
    if missing:
        raise InputError(path, f"lacks the columns {', '.join(missing)}", f"all of {', '.join(characteristics.names)}")
    return [found[_plain(name)] for name in characteristics.names]


def _numbers(path: Path, table: pd.DataFrame, column: str) -> FloatArray:
    values = pd.to_numeric(table[column], errors="coerce").to_numpy(dtype=float)
    wrong = np.flatnonzero(~np.isfinite(values))
    if wrong.size:
        raise InputError(path, f"row {wrong[0] + 2}, column {column} = {table[column].iloc[wrong[0]]!r}", "a finite number")
    return np.asarray(values)
