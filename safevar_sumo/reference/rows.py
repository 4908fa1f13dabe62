"""The CSV format of the published package: settings before the filter, with measurements in the reference simulators.

A row holds one solution: the characteristics, then `MaxPercentage`, `SaftyDegree` (sic), `numbers`, `TIT`, `TET` and,
in most files, `Dece`. There is no run column.
"""

from __future__ import annotations

import csv
import io
import warnings
from collections import Counter
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, Outcome
from safevar_sumo.results import UNKNOWN
from safevar_sumo.study import SAFETY_DEGREE, refuse_other_than_file
from safevar_sumo.vehicles import CharacteristicSet

COLUMNS = {SAFETY_DEGREE: "SaftyDegree", "tet": "TET", "tit": "TIT", "ave_dece": "Dece"}
RANGES = {SAFETY_DEGREE: (-300.0, 1e4), "tet": (0.0, 1e4), "tit": (0.0, 1e5), "ave_dece": (-300.0, 300.0)}
"""Accepted values, wider than those of any road vehicle: m or -m/s; s; s^2; m/s^2 of either sign."""
OPTIONAL_METRIC = "ave_dece"
ALIASES = {"dampratezeroce": "dampratezerotce", "dampratezerocd": "dampratezerotcd", "wheelradius": "radius"}
"""Names of characteristics in the files of the published package -> names in its paper; in lower case, without underscores."""
SHARE_DECIMALS = 3
"""Decimals to which the published package rounds the ratio of change to domain width before it compares the ratio with beta."""


class ReferenceData(NamedTuple):
    """Rows of a reference file.

    Attributes
    ----------
    settings
        M settings of n characteristics after the filter of the published package; shape (M, n), units of the study's table.
    metrics
        Name -> values, shape (M,). TET and TIT of a collision are NaN, and so are metrics without a column.
    skipped
        Number of rows left out because a value lies outside its domain.
    fingerprint
        SHA-256 of the file's bytes.
    """

    settings: FloatArray
    metrics: dict[str, FloatArray]
    skipped: int
    fingerprint: str = ""

    @property
    def collided(self) -> BoolArray:
        return np.asarray(self.metrics[SAFETY_DEGREE] <= 0)

    def take(self, rows: BoolArray) -> ReferenceData:
        """The data in the rows of a mask."""
        return self._replace(settings=self.settings[rows], metrics={name: values[rows] for name, values in self.metrics.items()})


def read_reference(path: Path, characteristics: CharacteristicSet) -> ReferenceData:
    """Read a file of the published package.

    Raises
    ------
    InputError
        With file, row and column, if the file cannot be read, lacks a column or rows, or has a cell without a number in range.
    """
    content = _read_content(path)
    table = _parse_table(path, content)
    columns = _columns_of_characteristics(path, table, characteristics)
    required = [*columns, *(column for name, column in COLUMNS.items() if name != OPTIONAL_METRIC or column in table)]
    missing_columns = [column for column in required if column not in table]
    if missing_columns:
        raise InputError(path, f"lacks the columns {', '.join(missing_columns)}", "the format of the published package")
    ranges = {column: RANGES[name] for name, column in COLUMNS.items()}
    numbers = {column: _parse_numbers(path, table, column, *ranges.get(column, ())) for column in required}
    settings = np.stack([numbers[column] for column in columns], axis=1)
    is_in_domain = np.all((settings >= characteristics.lower) & (settings <= characteristics.upper), axis=1)
    if not is_in_domain.any():
        raise InputError(path, "has no row whose values are all in the domains of the study", "a file of this study's vehicle")
    no_values = np.full(len(table), np.nan)
    metrics = {name: numbers.get(column, no_values)[is_in_domain] for name, column in COLUMNS.items()}
    is_collision = metrics[SAFETY_DEGREE] <= 0
    metrics["ave_dece"] = np.abs(metrics["ave_dece"])
    metrics["tet"], metrics["tit"] = (np.where(is_collision, np.nan, metrics[name]) for name in ("tet", "tit"))
    return ReferenceData(package_filter(characteristics, settings[is_in_domain]), metrics, int(np.count_nonzero(~is_in_domain)),
                         sha256(content).hexdigest())


def package_filter(characteristics: CharacteristicSet, settings: FloatArray) -> FloatArray:
    """The published package's filter: it keeps a change if its share of the domain, rounded to three decimals, is at least beta."""
    width = characteristics.upper - characteristics.lower
    share = np.round(np.abs(settings - characteristics.original) / width, SHARE_DECIMALS)
    return np.where(share >= characteristics.threshold / width - 1e-12, settings, characteristics.original)


def _read_content(path: Path) -> bytes:
    """The bytes of a file, which is read once: a pipe cannot be read again."""
    try:
        refuse_other_than_file(path, streams=True)
        with open(path, "rb") as file:
            return file.read()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}", "a CSV file") from None


def _parse_table(path: Path, content: bytes) -> pd.DataFrame:
    """The rows of a file as text, without empty lines. The index is the line number minus two."""
    try:
        text = content.decode("utf-8-sig")
        header = [name.strip() for name in next(csv.reader(io.StringIO(text, newline="")), [])]
        duplicates = [name for name, number in Counter(header).items() if number > 1]
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(io.StringIO(text, newline=""), dtype=str, skipinitialspace=True, index_col=False, na_filter=False,
                                skip_blank_lines=False).fillna("")
    except pd.errors.ParserWarning:
        raise InputError(path, "has rows with more values than its header has columns", "a value for each column") from None
    except pd.errors.EmptyDataError:
        raise InputError(path, "is empty", "a CSV file with a header and rows") from None
    except (pd.errors.ParserError, csv.Error, UnicodeDecodeError) as error:
        raise InputError(path, f"is not CSV: {str(error).splitlines()[0]}", "a CSV file with a header and rows") from None
    table.columns = table.columns.str.strip()
    table = table[(table != "").any(axis=1)]
    if duplicates:
        raise InputError(path, f"has the column {duplicates[0]!r} twice", "each column once")
    if len(header) == 1:
        raise InputError(path, f"has one column, {header[0][:40]!r}", "values that are separated by commas")
    if table.empty:
        raise InputError(path, "has no rows", "a CSV file with a header and rows")
    return table


def _plain_name(name: str) -> str:
    key = name.strip().replace("_", "").lower()
    return ALIASES.get(key, key)


def _columns_of_characteristics(path: Path, table: pd.DataFrame, characteristics: CharacteristicSet) -> list[str]:
    """The columns of the characteristics, in the order of the study."""
    by_plain_name: dict[str, str] = {}
    for column in map(str, table.columns):
        name = _plain_name(column)
        if name in by_plain_name:
            raise InputError(path, f"has two columns of one name, {by_plain_name[name]!r} and {column!r}", "each column once")
        by_plain_name[name] = column
    missing_names = [name for name in characteristics.names if _plain_name(name) not in by_plain_name]
    if missing_names:
        raise InputError(path, f"lacks the columns {', '.join(missing_names)}", f"all of {', '.join(characteristics.names)}")
    return [by_plain_name[_plain_name(name)] for name in characteristics.names]


def _parse_numbers(path: Path, table: pd.DataFrame, column: str, lowest: float = -np.inf, highest: float = np.inf) -> FloatArray:
    values = pd.to_numeric(table[column], errors="coerce").to_numpy(dtype=float)
    invalid_rows = np.flatnonzero(~(np.isfinite(values) & (values >= lowest) & (values <= highest)))
    if invalid_rows.size:
        cell = table[column].iloc[invalid_rows[0]]
        problem = f"row {table.index[invalid_rows[0]] + 2}, column {column} " + (f"= {cell!r}" if cell.strip() else "is empty")
        raise InputError(path, problem, "a finite number" if lowest == -np.inf else f"a number in [{lowest:g}, {highest:g}]")
    return np.asarray(values)


METRIC_NAMES = {accepted_name: metric.name for metric in METRICS.values() for accepted_name in (metric.name, metric.title.lower())}
"""Names of metrics by each name that a command accepts."""
ORIGINAL_FORM = "sd=NUMBER,tet=NUMBER,tit=NUMBER,ave_dece=NUMBER"


def evaluations_of(data: ReferenceData, characteristics: CharacteristicSet) -> Evaluations:
    """Reference rows as evaluations, with f_diff and f_numDiff of the filtered settings (method section 3)."""
    return Evaluations(
        settings=data.settings, outcome=np.where(data.collided, str(Outcome.COLLISION), UNKNOWN),
        collision_speed=np.where(data.collided, -data.metrics[SAFETY_DEGREE], np.nan), metrics=data.metrics,
        f_diff=characteristics.largest_change(data.settings), f_num_diff=characteristics.number_changed(data.settings))


def original_metrics(text: str | None, published: Mapping[str, float]) -> dict[str, float | None]:
    """Metrics of the original vehicle: those in `text` (sd=2.7,tet=1.2,...), else the published ones; None without a value.

    Raises
    ------
    InputError
        If `text` has another form, or there is no safety degree.
    """
    original: dict[str, float | None] = {name: published.get(name) for name in METRICS}
    names = set()
    for assignment in text.split(",") if text is not None else ():
        name, _, number = (word.strip() for word in assignment.partition("="))
        if name in names:
            raise InputError("original", f"{text!r} has {name!r} twice", "each metric once")
        names.add(name)
        try:
            value = float(number)
        except ValueError:
            value = np.nan
        lowest, highest = RANGES.get(METRIC_NAMES.get(name, ""), (np.inf, -np.inf))
        if not lowest <= value <= highest:
            raise InputError("original", f"{assignment!r} in {text!r}", f"{ORIGINAL_FORM}, each in the metric's range")
        original[METRIC_NAMES[name]] = value
    if original[SAFETY_DEGREE] is None:
        raise InputError("original", "the study has no published values of the original vehicle", ORIGINAL_FORM)
    return original
