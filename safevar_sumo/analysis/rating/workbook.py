"""Fills in the two spreadsheets of Euro NCAP's official calculator.

`Template` takes predictions, claimed layers and input parameters. From it the calculator makes a `PreprocessedFile`
with cells drawn at random, which takes measurements. Headings are checked before anything is written; a spreadsheet
with other headings is refused.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import openpyxl
from openpyxl.utils import coordinate_to_tuple
from openpyxl.utils.exceptions import InvalidFileException

from safevar_sumo.analysis.rating.compute import RatedVehicle
from safevar_sumo.errors import InputError
from safevar_sumo.output import whole_file
from safevar_sumo.protocol import EURO_NCAP_2026, protocol_of
from safevar_sumo.protocol.cells import WARNING
from safevar_sumo.protocol.rater import DECIMALS, passing_cells, round_half_up
from safevar_sumo.records import JsonObject

PARAMETERS, VERSION = "Input parameters", "Version"
NOT_ASSESSED_MARK, SELF_CLAIMED_MARK = "N/A", "Self claimed"


class _Spreadsheet:
    """A spreadsheet that a command of the calculator writes.

    The constructor reads and checks it; `fill` fills and saves it.
    """

    command: ClassVar[str]

    def __init__(self, source: Path, output: Path) -> None:
        self.source, self.output, self.protocol = source, output, protocol_of(EURO_NCAP_2026)
        try:
            self._workbook = openpyxl.load_workbook(source)
        except (OSError, InvalidFileException, zipfile.BadZipFile, KeyError, ValueError) as error:
            raise self._refusal(f"cannot be read as a spreadsheet: {error}") from None
        version = str(self._sheet(VERSION)["B1"].value)
        if version.split(".")[:2] != self.protocol.calculator_version.split(".")[:2]:
            raise self._refusal(f"sheet {VERSION!r}, cell B1: version {version!r}")

    def _refusal(self, problem: str) -> InputError:
        return InputError(
            self.source,
            problem,
            f"the file written by `euroncap_rating_2026 crash_avoidance {self.command}` "
            f"(to install it: `pip install euroncap-rating-2026=={self.protocol.calculator_version}`)",
        )

    def _sheet(self, name: str) -> Any:
        if name not in self._workbook.sheetnames:
            raise self._refusal(f"has no sheet {name!r}")
        return self._workbook[name]

    def _save(self) -> None:
        with whole_file(self.output, "xlsx") as file:
            self._workbook.save(file)


class Template(_Spreadsheet):
    """The template that the calculator generates, to be filled with predictions."""

    command = "generate-template"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        expected = {(PARAMETERS, "E1"): "Scenario", (PARAMETERS, "G1"): "Value"}
        for matrix in self.protocol.matrices:
            top, _ = coordinate_to_tuple(matrix.first_cell)
            expected[matrix.sheet, matrix.name_cell] = matrix.name
            for k, row in enumerate(matrix.rows):
                expected[matrix.sheet, f"A{top + k}"] = f"{row.vut_speed:g} km/h"
        for layer in self.protocol.layers:
            expected[layer.sheet, f"B{coordinate_to_tuple(layer.claim_cell)[0]}"] = layer.name
        for (sheet, address), heading in expected.items():
            value = self._sheet(sheet)[address].value
            if str(value).strip() != heading:
                raise self._refusal(f"sheet {sheet!r}, cell {address}: {value!r} in place of {heading!r}")

    def _iterate_parameters(self) -> Iterator[tuple[str, str, Any]]:
        """Test (in the sheet's words "Scenario"), name, and cell for the value, of every input parameter."""
        test = ""
        for *_, scenario, parameter, value_cell in self._sheet(PARAMETERS).iter_rows(min_row=2, max_col=7):
            test = str(scenario.value or test).strip()
            if parameter.value is not None:
                yield test, str(parameter.value), value_cell

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in a vehicle's colours, rows' functions, layers that hold or are claimed, and self-claimed tests."""
        for cell_number, cell in enumerate(self.protocol.cells):
            if not cell.is_robustness_cell:
                top, left = coordinate_to_tuple(cell.matrix.first_cell)
                colour = vehicle.colour(cell_number) or "red"
                self._sheet(cell.matrix.sheet).cell(top + cell.row, left + cell.column).value = colour.capitalize()
        for matrix in self.protocol.matrices:
            top, _ = coordinate_to_tuple(matrix.first_cell)
            for row_number, row in enumerate(matrix.rows):
                if row.has_function_choice:
                    function = "FCW" if matrix.is_rated_by_warning(row_number) else "AEB"
                    self._sheet(matrix.sheet)[f"{matrix.function_column}{top + row_number}"].value = function
        layers = {test.matrix.test_name: test.layers for test in vehicle.tests}
        for layer in self.protocol.layers:
            holds = layers[layer.test_name][layer.name]
            self._sheet(layer.sheet)[layer.claim_cell].value = "YES" if holds else "NO"
        for test, parameter, value_cell in self._iterate_parameters():
            if "Heading correction" not in parameter:  # a lane departure parameter, which does not accept N/A
                value_cell.value = SELF_CLAIMED_MARK if test in self.protocol.tests else NOT_ASSESSED_MARK
        self._save()


class PreprocessedFile(_Spreadsheet):
    """The calculator's preprocessed file, with randomly drawn cells whose measurements are to be filled in."""

    command = "preprocess"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        numbers = self.protocol.matrix_cell_numbers
        self._numbers = {(matrix, f"{row},{column}"): number for (matrix, row, column), number in numbers.items()}
        sheets = dict.fromkeys(matrix.sheet.removesuffix("pred.") for matrix in self.protocol.matrices)
        self._drawn_cells = [drawn_cell for sheet in sheets for drawn_cell in self._read_drawn_cells(f"{sheet}verif.")]

    def _read_drawn_cells(self, name: str) -> Iterator[tuple[JsonObject, int]]:
        """The spreadsheet's cells by heading, and the cell number, of every drawn cell of a simulated test."""
        headings = list[str]()
        for row in self._sheet(name).iter_rows():
            values = [str(cell.value or "").strip() for cell in row]
            if "Test point" in values:
                headings = values
                continue
            cells = dict(zip(headings, row, strict=False))
            if not headings or not cells["Test point"].value:
                continue
            matrix, point = str(cells["Scenario"].value).strip(), str(cells["Test point"].value)
            if matrix in {matrix.name for matrix in self.protocol.matrices}:
                key = matrix, re.sub("[() ]", "", point)
                if key not in self._numbers:
                    raise self._refusal(f"sheet {name!r}, row {row[0].row}: {matrix} has no test point {point!r}")
                yield cells, self._numbers[key]

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in each drawn cell's simulated value and, if a variation is drawn with it, whether that passes."""
        passes = passing_cells(self.protocol, vehicle.scores.colours)[0]
        numbers = {cell.name: number for number, cell in enumerate(self.protocol.cells)}
        for cells, cell_number in self._drawn_cells:
            cell = self.protocol.cells[cell_number]
            cells["Value"].value = _measurement(vehicle, cell_number)
            if "Verification condition" in cells and "Robustness" in cells:
                layer, condition = (cells[name].value for name in ("Robustness layer", "Verification condition"))
                number = numbers.get(f"{cell.name}, {layer} {condition}")
                if number is not None:
                    cells["Robustness"].value = "PASS" if passes[number] else "FAIL"
        self._save()


def _measurement(vehicle: RatedVehicle, cell_number: int) -> float:
    """Relative impact speed [km/h], 0 without an impact; in a row with FCW the time to collision at the warning [s]."""
    value = vehicle.measured(cell_number)[vehicle.protocol.cells[cell_number].judged_by == WARNING]
    return float(round_half_up(np.array(max(value or 0.0, 0.0)), DECIMALS))
