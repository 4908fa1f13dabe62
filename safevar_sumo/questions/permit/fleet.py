"""Reads the list of cars that `permit` is asked about: a CSV file, a data frame, a mapping or typed
values become vehicle settings. A value that might be read in two ways is refused before anything is
simulated.
"""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain, compress
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError, about, check_name, check_text, did_you_mean
from safevar_sumo.output import read_file
from safevar_sumo.questions.changes import NUMBER_PATTERN, read_changes
from safevar_sumo.questions.words import EXACT, number_of
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet, region_of

CAR = "car"
"""Usual header of the column that names the cars, also in the answer."""
ROUGH = "rough"
YES = "yes"
"""The answer's column that says whether the answer is rough, and the text of a rough answer."""
NEW = "new"
"""Value of `--others`: a characteristic without a value has the original vehicle's value."""
TYPED = "--set"
THIS_CAR = "This car"
"""The option with which a user types the values of one car, and the name of this car."""
SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma"}
"""Separators of columns, in order of preference: a file's separator is the first of these that its
header has outside of quotation marks.
"""
SEPARATOR_LINE = re.compile(r"sep=(.)\r?\n", re.IGNORECASE)
"""A first line that states the separator, as Excel writes it."""
NUMBERS = {
    ".": re.compile(NUMBER_PATTERN, re.ASCII),
    ",": re.compile(NUMBER_PATTERN.replace(r"\.", ","), re.ASCII),
    ";": re.compile(rf"(?![+-]?[1-9]\d{{0,2}}\.\d{{3}}$){NUMBER_PATTERN}", re.ASCII),
}
"""The form of a number by the file's decimal mark. The key ";" is for a file with semicolons
between its columns and without decimal commas. In such a file 1.250 is refused, because it may mean
1250 or 1.25.
"""
MARKS = {
    ".": "a decimal point (a decimal comma is read only with semicolons between the columns)",
    ",": "a decimal comma, as others of the file",
    ";": "a decimal comma, or with a point that cannot be one of thousands",
}
"""The decimal marks of `NUMBERS` in words."""


class Fleet(NamedTuple):
    """The K cars of a list, in the order of the list.

    Attributes
    ----------
    names
        Names of the cars.
    settings
        Values of the n characteristics of the vehicle, in the study's order, shape (K, n).
    measured
        Which of these values the list states, shape (K, n).
    table
        The list as it was given: all columns, as text.
    is_rough
        Whether the list is the file of a rough answer.
    """

    names: list[str]
    settings: FloatArray
    measured: BoolArray
    table: pd.DataFrame
    is_rough: bool


class _Cells(NamedTuple):
    """The cells of a list as text. `place` and `places` say in errors where the header and each row
    are. `separator` is the separator of a file's columns; "" without a file.
    """

    place: str
    header: list[str]
    places: list[str]
    rows: list[list[str]]
    separator: str = ""


def read_fleet(
    study: Study,
    vehicle: CharacteristicSet,
    cars: str | Path | pd.DataFrame | Mapping[Any, Any] | None,
    values: Sequence[str],
    *,
    others: str | None,
    ignore: Sequence[str],
    answer_columns: Collection[str],
) -> Fleet:
    """Read a list of cars, or the values of one car.

    Parameters
    ----------
    vehicle
        The characteristics of the study's vehicle.
    cars
        A CSV file, a data frame, or a mapping from a car's name to its values by characteristic;
        None for the car that `values` describe. The first column of a file or frame names the car.
    values
        Texts NAME=VALUE with the values of one car.
    others
        "new": a characteristic without a value in the list and under `[unmeasured]` of the study
        has the original's value. None: a list with such a characteristic is refused.
    ignore
        Columns that are not read.
    answer_columns
        Columns of the answer. A list with all these columns, beside the name of the car, was
        written by `--out`: then these columns are not read. Any other list with one of these
        columns is refused.

    Raises
    ------
    InputError
        If the list cannot be read; if a column is unknown; if a value is missing, no number or
        outside of its domain; if a car has no name, the name of another car, or violates a
        constraint.
    """
    if others not in (None, NEW):
        raise InputError("--others", repr(others), NEW)
    if cars is None:
        with about(TYPED):
            typed = read_changes(values, vehicle, beyond=True)
        cells = _cells_of_mapping({THIS_CAR: typed}, TYPED)
    elif isinstance(cars, pd.DataFrame):
        cells = _cells_of_frame(cars)
    elif isinstance(cars, Mapping):
        cells = _cells_of_mapping(cars, "cars")
    else:
        cells = _cells_of_file(Path(check_text("cars", cars)))
    if not cells.rows:
        raise InputError(cells.place, "no car", "at least one car")
    # A file that `--out` wrote has commas between its columns. The columns of the user's list,
    # which the file repeats, may still have decimal commas: hence the separator is ",;".
    written = {*answer_columns} - {CAR}
    header = [text.strip() for text in cells.header]
    is_answer = bool(written) and written.issubset(header)
    if is_answer:
        cells = cells._replace(separator=",;", header=header)
        ignore = [*ignore, *written]
        answer_columns = ()

    naming, columns = _columns(cells, study, vehicle, ignore, answer_columns)
    names = _names(cells, naming)
    settings, measured = _values(cells, columns, vehicle)
    settings = _completed(cells, settings, study, vehicle, others)
    _check_constraints(cells, settings, study, vehicle)
    table = pd.DataFrame(cells.rows, columns=cells.header, dtype=str)
    is_rough = is_answer and YES in [text.strip() for text in table[ROUGH]]
    if is_answer:
        table = table.drop(columns=list(written))
    return Fleet(names, settings, measured, table, is_rough)


def list_without_names(path: Path, ignore: Collection[str]) -> bytes:
    """The list of cars of a file without private data: the cars are called `car 1`, `car 2` and so
    on, and the cells of ignored columns are empty. `read_fleet` reads the same values in it.
    """
    cells = _cells_of_file(path)
    is_read = [text.strip() not in ignore for text in cells.header]
    text = io.StringIO()
    writer = csv.writer(text, "unix", delimiter=cells.separator)
    writer.writerow(cells.header)
    for number, row in enumerate(cells.rows, 1):
        texts = np.where(is_read, row, "").tolist()
        if any(is_read):
            texts[is_read.index(True)] = f"{CAR} {number}"
        writer.writerow(texts)
    return text.getvalue().encode()


def _separator_in(head: str) -> str:
    """The separator that a header has; "" if it has none."""
    for separator in SEPARATORS:
        if separator in head:
            return separator
    return ""


def _cells_of_file(path: Path) -> _Cells:
    """The cells of a CSV file. The places are the file's name with the number of a line."""
    try:
        content = read_file(path)
        text = content.decode("utf-8-sig")
    except OSError as error:
        raise InputError(
            path, f"cannot be read: {error.strerror or error}", "a list of cars (CSV)"
        ) from None
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}, line {line}",
            "is not encoded in UTF-8",
            'UTF-8; in Excel: save as "CSV UTF-8"',
        ) from None

    # The separator is stated by Excel's first line, or else guessed from the header.
    stated = SEPARATOR_LINE.match(text)
    lines = io.StringIO(text[stated.end() :] if stated else text, newline="")
    header_line = 2 if stated else 1
    head = re.sub('"[^"]*"', "", lines.readline())
    lines.seek(0)
    separator = stated[1] if stated else _separator_in(head)
    place = f"{path}, line {header_line}"
    if separator not in SEPARATORS or separator not in head:
        raise InputError(
            place,
            repr(head.strip()),
            f"a header with a {', '.join(SEPARATORS.values())} between its columns",
        )

    # A record with a line break in a cell has several lines: its place is its first line.
    reader = csv.reader(lines, delimiter=separator, strict=True)
    records = []
    line = header_line
    try:
        for record in reader:
            records.append((f"{path}, line {line}", record))
            line = header_line + reader.line_num
    except csv.Error as error:
        raise InputError(f"{path}, line {line}", str(error), "CSV") from None
    while len(records) > 1 and not any(cell.strip() for cell in records[-1][1]):
        records.pop()
    places, rows = zip(*records, strict=True)
    number = len(rows[0])
    for row_place, row in records:
        if len(row) != number:
            raise InputError(
                row_place,
                number_of(len(row), "field"),
                f"{number} fields with a {SEPARATORS[separator]} between them",
            )
    return _Cells(place, rows[0], list(places[1:]), list(rows[1:]), separator)


def _cells_of_frame(frame: pd.DataFrame) -> _Cells:
    """The cells of a data frame. A missing value becomes an empty cell."""
    present = frame.astype(object).where(frame.notna(), None)
    rows = [list(map(_text, row)) for row in present.itertuples(index=False, name=None)]
    places = [f"cars, row {label}" for label in frame.index]
    return _Cells("cars", list(map(str, frame.columns)), places, rows)


def _cells_of_mapping(cars: Mapping[Any, Any], place: str) -> _Cells:
    """The cells of a mapping from cars to values. A value None becomes an empty cell, and so does a
    value that only other cars have.
    """
    for car, values in cars.items():
        if not isinstance(values, Mapping):
            raise InputError(
                place, f"{car!r}: {values!r}", "a mapping of values by characteristic"
            )
    columns = dict.fromkeys(chain.from_iterable(cars.values()))
    rows = [
        list(map(_text, (car, *map(values.get, columns))))
        for car, values in cars.items()
    ]
    places = [f"{place}, {car!r}" for car in cars]
    if place == TYPED:
        places = [place]
    return _Cells(place, [CAR, *map(str, columns)], places, rows)


def _text(cell: object) -> str:
    """A value as text; a number has all its digits, and None is ""."""
    if isinstance(cell, Real) and not isinstance(cell, bool):
        return str(int(cell)) if isinstance(cell, Integral) else repr(float(cell))
    return "" if cell is None else str(cell)


def _columns(
    cells: _Cells,
    study: Study,
    vehicle: CharacteristicSet,
    ignore: Sequence[str],
    answer_columns: Collection[str],
) -> tuple[int, dict[int, int]]:
    """The position of the column that names the cars, and, by the position of each other column
    that is read, the number of its characteristic.
    """
    with about(cells.place):
        # A header is a name, or a name with a unit, such as `mass [kg]`. The first column that is
        # read must not be a characteristic: the list would lack the names of the cars.
        header = [text.strip() for text in cells.header]
        for name in ignore:
            check_name("", f"--ignore {name}: there is no such column", name, header)
        read = [column for column, text in enumerate(header) if text not in ignore]
        names = list(header)
        for column in read:
            names[column] = header[column].partition("[")[0].strip()
        naming = read[0] if read else 0
        is_one = names[naming] in vehicle.names
        looks = "" if is_one else did_you_mean(names[naming], vehicle.names)
        has_numbers = all(
            NUMBERS["."].fullmatch(row[naming].strip()) for row in cells.rows
        )
        if not read or is_one or (looks and has_numbers):
            problem = f"the first column is {header[naming]!r}"
            raise InputError(
                "", f"{problem}{looks}", "a first column that names the car"
            )

        # Refuse a name that is there twice, or means something else than a characteristic.
        varied = {*study.ranges}.union(*map(study.axes_of, study.tests))
        for column, name in enumerate(names):
            if names.count(name) > 1:
                raise InputError(
                    "", f"the column {name!r} is there twice", "each column once"
                )
            if column in read and name in varied:
                raise InputError(
                    "",
                    f"the column {name!r} is a parameter that the study itself varies",
                    "characteristics of the vehicle, or --ignore",
                )
            if name in answer_columns and (column, name) != (naming, CAR):
                raise InputError(
                    "",
                    f"the column {name!r} has the name of a column of the answer",
                    "another name, or all columns that --out writes",
                )
        return naming, {
            column: _characteristic(names[column], header[column], vehicle)
            for column in read[1:]
        }


def _characteristic(name: str, header: str, vehicle: CharacteristicSet) -> int:
    """The number of the characteristic that a column's header names. If the header states a unit,
    this must be the characteristic's unit.
    """
    problem = f"the column {header!r} is no characteristic"
    check_name("", problem, name, vehicle.names, "; --ignore leaves a column out")
    number = vehicle.names.index(name)
    unit = vehicle.members[number].unit
    _, bracket, stated = header.partition("[")
    if bracket and stated.removesuffix("]").strip() != unit:
        raise InputError(
            "", f"the column {header!r} has another unit", f"{name} [{unit}]"
        )
    return number


def _names(cells: _Cells, naming: int) -> list[str]:
    """The names of the cars. A name that is not printable, or that another car has, is refused."""
    places = dict[str, str]()
    names = [row[naming].strip() for row in cells.rows]
    for name, place in zip(names, cells.places, strict=True):
        with about(f"{place}, column {cells.header[naming].strip()!r}"):
            if not name or not name.isprintable() or name[0] in "=+-@":
                raise InputError(
                    "",
                    f"{name!r} is no name of a car",
                    "a text of one line that does not begin with =, +, - or @, as formulas do",
                )
            # Names are equal if they differ only in case, blanks or the form of their characters.
            key = " ".join(unicodedata.normalize("NFKC", name).casefold().split())
            if key in places:
                legal = f"a name that no other car has ({places[key]})"
                raise InputError("", f"the car {name!r} is there twice", legal)
        places[key] = place
    return names


def _values(
    cells: _Cells, columns: Mapping[int, int], vehicle: CharacteristicSet
) -> tuple[FloatArray, BoolArray]:
    """The values of K cars, shape (K, n), with NaN for an empty cell or a missing column; and which
    values the list states, shape (K, n).
    """
    # A decimal comma is possible if semicolons separate the columns, or once did so (",;"). Then a
    # single number with a comma shows that the whole file has decimal commas.
    has_commas = any(
        "," in row[column] and NUMBERS[","].fullmatch(row[column].strip())
        for row in cells.rows
        for column in columns
    )
    mark = ";" if cells.separator == ";" else "."
    mark = "," if ";" in cells.separator and has_commas else mark
    settings = np.full((len(cells.rows), len(vehicle)), np.nan)
    faults = []
    for setting, row, place in zip(settings, cells.rows, cells.places, strict=True):
        for column, number in columns.items():
            if text := row[column].strip():
                with about(f"{place}, column {cells.header[column].strip()!r}"):
                    try:
                        setting[number] = _number(text, mark, vehicle.members[number])
                    except InputError as fault:
                        faults.append(fault)
    if faults:
        problems = [f"{fault.source}: {fault.problem}" for fault in faults]
        problems[0] = faults[0].problem
        legal = dict.fromkeys(fault.legal for fault in faults)
        raise InputError(faults[0].source, "\n".join(problems), "; ".join(legal))
    return settings, ~np.isnan(settings)


def _number(text: str, mark: str, item: Characteristic) -> float:
    """The value of a cell. A text that is no number with the decimal mark `mark` (a key of
    `NUMBERS`), or a value outside of the characteristic's domain, is refused.
    """
    lower = item.lower
    upper = item.upper
    domain = f"a number in [{lower:g}, {upper:g}]{item.suffix}"
    if not NUMBERS[mark].fullmatch(text):
        raise InputError("", f"{text!r} is no number with {MARKS[mark]}", domain)
    value = float(text.replace(",", "."))
    if item.is_legal(value, beyond=False):
        # The true value differs from the measured one by up to the measuring error. It must lie in
        # the domain, too, because no vehicle is simulated beyond it. An end that is the original's
        # value is exempt.
        if all(
            np.round(abs(value - end), 12) >= item.error
            for end in {lower, upper} - {item.original}
        ):
            return value
        raise InputError(
            "",
            f"{value:{EXACT}}, measured to within {item.error:g}, may be outside the domain",
            f"{domain}, also by that",
        )

    # If the new car's value is the upper end of the domain, a part may be measured as better than
    # new. The user may enter the new car's value then.
    problem = f"{value:{EXACT}} is outside {lower:g} to {upper:g}{item.suffix}"
    if upper == item.original and upper < value <= upper + item.error:
        raise InputError("", problem, f"{domain}; at most {upper:g}: enter {upper:g}")
    # Any other value may have another unit, such as percent. Then the message recommends no end of
    # the domain.
    is_share = not item.suffix and item.is_legal(value / 100, beyond=False)
    unit = "percent" if is_share else "of another unit"
    raise InputError("", f"{problem}: is this {unit}?", domain)


def _completed(
    cells: _Cells,
    settings: FloatArray,
    study: Study,
    vehicle: CharacteristicSet,
    others: str | None,
) -> FloatArray:
    """Settings in which a missing value (NaN) is replaced by the value under [unmeasured] of the
    study, or else, with `others` = "new", by the original's value. Settings in which a value is
    still missing are refused.
    """
    unmeasured = study.unmeasured_values
    stated = np.array([unmeasured.get(name, np.nan) for name in vehicle.names])
    if others == NEW:
        stated = np.where(np.isnan(stated), vehicle.original, stated)
    settings = np.where(np.isnan(settings), stated, settings)
    gaps = np.isnan(settings)
    if lacking := np.flatnonzero(gaps.any(axis=1)).tolist():
        names = ", ".join(compress(vehicle.names, map(any, gaps.T)))
        problem = (
            f"no value of {names}, neither measured nor under [unmeasured] of the study"
        )
        if len(settings) > 1:
            problem += f" ({len(lacking)} of {len(settings)} cars lack one)"
        raise InputError(
            cells.places[lacking[0]],
            problem,
            "a value for each car, or --others new: as in the original vehicle",
        )
    return settings


def _check_constraints(
    cells: _Cells, settings: FloatArray, study: Study, vehicle: CharacteristicSet
) -> None:
    """Refuse a car that violates a constraint of the study in which only characteristics of the
    vehicle occur.
    """
    with about(study.source):
        region = region_of(study)
    names = {*vehicle.names}
    bounds = [bound for bound in region.bounds if names >= {*bound.constraint.sum}]
    region = replace(region, bounds=tuple(bounds))
    cars = np.repeat(region.characteristics.original_settings, len(settings), axis=0)
    cars[:, region.characteristics.of_vehicle] = settings
    for car, place in zip(cars, cells.places, strict=True):
        with about(place):
            region.check(car[np.newaxis])
