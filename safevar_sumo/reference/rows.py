"""Reads the CSV files of the published package. These files have settings before the filter, and
measurements in the reference simulators.

A row holds one solution: the characteristics, then `MaxPercentage`, `SaftyDegree` (sic), `numbers`,
`TIT`, `TET` and, in most files, `Dece`. No column names the run.
"""

from __future__ import annotations

from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError, warn
from safevar_sumo.metrics import METRICS
from safevar_sumo.output import read_file
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.subject import load
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, Outcome, nans
from safevar_sumo.results import UNKNOWN, write_imported
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import SAFETY_DEGREE, StudyLike
from safevar_sumo.vehicles import CharacteristicSet

COLUMNS = {SAFETY_DEGREE: "SaftyDegree", "tet": "TET", "tit": "TIT", "ave_dece": "Dece"}
RANGES = {
    SAFETY_DEGREE: (-300.0, 1e4),
    "tet": (0.0, 1e4),
    "tit": (0.0, 1e5),
    "ave_dece": (-300.0, 300.0),
}
"""The accepted values of each metric: m or -m/s; s; s^2; m/s^2 of either sign. Values of any road
vehicle are well within these ranges.
"""
OPTIONAL_METRIC = "ave_dece"
FIRST_ROW = 2
"""Errors count rows like a spreadsheet: the first row after the header is row 2."""
ALIASES = {
    "dampratezeroce": "dampratezerotce",
    "dampratezerocd": "dampratezerotcd",
    "wheelradius": "radius",
}
"""Names of characteristics in the published files -> names in the paper, in lower case without
underscores.
"""
CHANGE_SIZE_DECIMALS = 3
"""Decimals to which the published package rounds the size of a change, as a share of the domain.
The package then compares the rounded share with beta.
"""
ROUNDING_ERROR = 1e-12
"""Largest rounding error of such a share."""


class ReferenceData(NamedTuple):
    """Rows of a reference file.

    Attributes
    ----------
    settings
        M settings of n characteristics after the filter of the published package; shape (M, n),
        units of the study's table.
    metrics
        Name -> values, shape (M,). TET and TIT of a collision are NaN, and so are metrics without a
        column.
    """

    settings: FloatArray
    metrics: dict[str, FloatArray]

    @property
    def collided(self) -> BoolArray:
        return self.metrics[SAFETY_DEGREE] <= 0

    def take(self, rows: BoolArray) -> ReferenceData:
        """The data of the rows that a mask selects."""
        return self._replace(
            settings=self.settings[rows],
            metrics={name: values[rows] for name, values in self.metrics.items()},
        )


def read_reference(path: Path, characteristics: CharacteristicSet) -> ReferenceData:
    """Read a file of the published package. Rows with values outside the domains are left out, with
    a warning.

    Raises
    ------
    InputError
        With file, row and column, if the file cannot be read, lacks a column or rows, or has a cell
        without a number in range.
    """
    table = _read_texts(path)
    columns = _columns_by_name(path, table, characteristics)
    numbers = {
        name: _parse_numbers(path, table[column], *RANGES.get(name, (-np.inf, np.inf)))
        for name, column in columns.items()
    }
    settings = np.stack([numbers[name] for name in characteristics.names], axis=1)
    is_in_domain = np.all(
        (settings >= characteristics.lower) & (settings <= characteristics.upper),
        axis=1,
    )
    if not is_in_domain.any():
        raise InputError(
            path,
            "has no row whose values are all in the domains of the study",
            "a file of this study's vehicle",
        )
    if skipped := np.count_nonzero(~is_in_domain):
        warn(f"{path}: {skipped} rows with values outside the domains are left out")

    undefined = nans(len(table))
    metrics = {name: numbers.get(name, undefined)[is_in_domain] for name in COLUMNS}
    metrics["ave_dece"] = np.abs(metrics["ave_dece"])
    # In the paper, a collision has no TET and no TIT.
    for name in ("tet", "tit"):
        metrics[name] = np.where(metrics[SAFETY_DEGREE] <= 0, np.nan, metrics[name])
    return ReferenceData(
        package_filter(characteristics, settings[is_in_domain]), metrics
    )


def _read_texts(path: Path) -> pd.DataFrame:
    """Read a CSV file as a table of texts."""
    try:
        lines = pd.read_csv(
            BytesIO(read_file(path)),
            dtype=str,
            skipinitialspace=True,
            skip_blank_lines=False,
            encoding="utf-8-sig",
        )
        if not isinstance(lines.index, pd.RangeIndex):
            raise ValueError("rows have more values than the header has columns")
    except OSError as error:
        raise InputError(
            path, f"cannot be read: {error.strerror or error}", "a CSV file"
        ) from None
    # pandas raises subclasses of ValueError for text that is no CSV.
    except ValueError as error:
        raise InputError(
            path,
            f"is not CSV: {str(error).splitlines()[0]}",
            "a CSV file with a header and rows",
        ) from None
    return lines.rename(columns=str.strip).dropna(how="all")


def _columns_by_name(
    path: Path, table: pd.DataFrame, characteristics: CharacteristicSet
) -> dict[str, str]:
    """The column of each characteristic and metric in the table of a file, by its name. A missing
    column and a column that is there twice are refused.
    """
    names = [str(name) for name in table]
    plain_names = [_plain_name(name) for name in names]
    names_by_plain_name = dict(zip(plain_names, names, strict=True))
    columns = {
        name: names_by_plain_name.get(_plain_name(name), name)
        for name in characteristics.names
    }
    columns |= COLUMNS
    if columns[OPTIONAL_METRIC] not in table:
        del columns[OPTIONAL_METRIC]
    missing_columns = [column for column in columns.values() if column not in table]
    problem = "has no rows"
    if missing_columns:
        problem = f"lacks the columns {', '.join(missing_columns)}"
    if missing_columns or table.empty:
        raise InputError(path, problem, "the format of the published package")
    counts = Counter(plain_names)
    doubled = [column for column in columns.values() if counts[_plain_name(column)] > 1]
    if doubled:
        raise InputError(
            path,
            f"has more than one column for {', '.join(doubled)}",
            "each column once",
        )
    return columns


def _plain_name(name: str) -> str:
    # pandas renames a second column with the name NAME to NAME.1.
    key = name.removesuffix(".1").replace("_", "").lower()
    return ALIASES.get(key, key)


def _parse_numbers(
    path: Path, column: pd.Series[str], lowest: float, highest: float
) -> FloatArray:
    """Convert a column of texts to numbers. Refuse the first cell without a number in the range."""
    values = pd.to_numeric(column, errors="coerce")
    is_legal = np.isfinite(values) & values.between(lowest, highest)
    for row, cell in column[~is_legal].items():
        legal = f"a number in [{lowest:g}, {highest:g}]"
        if lowest == -np.inf:
            legal = "a finite number"
        fault = f"= {cell!r}"
        if pd.isna(cell):
            fault = "is empty"
        raise InputError(
            path, f"row {int(row) + FIRST_ROW}, column {column.name} {fault}", legal
        )
    return values.to_numpy(float)


def package_filter(
    characteristics: CharacteristicSet, settings: FloatArray
) -> FloatArray:
    """Filter settings as the published package does. A change is kept if its size, as a share of
    the domain rounded to three decimals, is at least beta.
    """
    width = characteristics.upper - characteristics.lower
    share = np.round(
        np.abs(settings - characteristics.original) / width, CHANGE_SIZE_DECIMALS
    )
    return np.where(
        share >= characteristics.threshold / width - ROUNDING_ERROR,
        settings,
        characteristics.original,
    )


def evaluations_of(
    data: ReferenceData, characteristics: CharacteristicSet
) -> Evaluations:
    """Convert reference rows to evaluations. f_diff and f_num_diff are those of the filtered
    settings (method section 3).
    """
    return Evaluations(
        settings=data.settings,
        outcome=np.where(data.collided, str(Outcome.COLLISION), UNKNOWN),
        collision_speed=np.where(data.collided, -data.metrics[SAFETY_DEGREE], np.nan),
        metrics=data.metrics,
        f_diff=characteristics.largest_change(data.settings),
        f_num_diff=characteristics.number_changed(data.settings),
    )


@checked
def import_published(
    study: StudyLike,
    *,
    out: str | Path,
    nsga2: str | Path | None = None,
    rs: str | Path | None = None,
    safe_fuzzer: str | Path | None = None,
) -> Results:
    """Import published solutions (CSV files) of a study as a directory of results. An earlier
    import in this directory is replaced.

    Example: python -m safevar_sumo import rain --nsga2 nsga2.csv --out published

    Parameters
    ----------
    out
        Directory for the results.
    nsga2
        CSV file with the solutions of NSGA-II.
    rs
        CSV file with the solutions of random search.
    safe_fuzzer
        CSV file with the solutions of SafeFuzzer.

    Raises
    ------
    InputError
        If the study or a file cannot be used, no file is given, or the original vehicle's safety
        degree is unknown.
    """
    loaded_study = read_study(study)
    directory = Path(out)
    arguments = {"nsga2": nsga2, "rs": rs, "safe_fuzzer": safe_fuzzer}
    files = {name: Path(file) for name, file in arguments.items() if file is not None}
    if not files:
        raise InputError(
            "import", "no file is given", "at least one of nsga2, rs, safe_fuzzer"
        )

    metrics = {name: loaded_study.published.get(name) for name in METRICS}
    if metrics[SAFETY_DEGREE] is None:
        raise InputError(
            loaded_study.source,
            "published: the study has no values of the original vehicle",
            "at least its safety_degree",
        )

    characteristics = CharacteristicSet.of(loaded_study)
    solutions = {}
    names = {}
    for algorithm, path in files.items():
        data = read_reference(path, characteristics)
        solutions[algorithm] = evaluations_of(data, characteristics)
        names[algorithm] = path.name
    write_imported(directory, loaded_study, solutions, metrics, names)
    return load(directory)
