"""Fills in the two spreadsheets of Euro NCAP's official calculator.

`Template` takes predictions, claimed layers and input parameters. From it the calculator makes a `PreprocessedFile`
with cells drawn at random, which takes measurements. Headings are checked before anything is written; a spreadsheet
with other headings is refused.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import openpyxl
from openpyxl.utils import coordinate_to_tuple
from openpyxl.utils.exceptions import InvalidFileException

from safevar_sumo.analysis.rating.compute import RatedVehicle
from safevar_sumo.errors import InputError
from safevar_sumo.output import whole_file
from safevar_sumo.protocol import EURO_NCAP_2026, CellMatrix, protocol_of
from safevar_sumo.protocol.points import DECIMALS, round_half_up

PARAMETERS, VERSION = "Input parameters", "Version"
NOT_ASSESSED_MARK, SELF_CLAIMED_MARK = "N/A", "Self claimed"
VERIFICATION_HEADINGS = ("Scenario", "Test point", "Range", "Value")


class _Spreadsheet:
    """A spreadsheet that a command of the calculator writes. The constructor reads and checks it; `fill` fills and
    saves it.
    """

    command: ClassVar[str]

    def __init__(self, source: Path, output: Path) -> None:
        self.source, self.output, self.protocol = source, output, protocol_of(EURO_NCAP_2026)
        if not source.is_file():
            raise InputError(
                source, "is a directory" if source.is_dir() else "there is no such file", self._expected_file
            )
        try:
            self._workbook = openpyxl.load_workbook(source)
        except (OSError, InvalidFileException, zipfile.BadZipFile, KeyError, ValueError) as error:
            raise InputError(source, f"cannot be read as a spreadsheet: {error}", self._expected_file) from None
        self._check_version()

    @property
    def _expected_file(self) -> str:
        return (
            f"the file written by `euroncap_rating_2026 crash_avoidance {self.command}` "
            f"(to install it: `pip install euroncap-rating-2026=={self.protocol.calculator_version}`)"
        )

    def _sheet(self, name: str) -> Any:
        if name not in self._workbook.sheetnames:
            raise InputError(self.source, f"has no sheet {name!r}", self._expected_file)
        return self._workbook[name]

    def _check_cell(self, sheet: str, address: str, value: object, expected: object) -> None:
        if str(value).strip() != str(expected):
            raise InputError(
                self.source,
                f"sheet {sheet!r}, cell {address}: {value!r} in place of {str(expected)!r}",
                self._expected_file,
            )

    def _check_version(self) -> None:
        version = str(self._sheet(VERSION)["B1"].value)
        if version.split(".")[:2] != self.protocol.calculator_version.split(".")[:2]:
            raise InputError(self.source, f"sheet {VERSION!r}, cell B1: version {version!r}", self._expected_file)

    def _save(self) -> None:
        with whole_file(self.output, "xlsx") as file:
            self._workbook.save(file)


class Template(_Spreadsheet):
    """The template that the calculator generates, to be filled with predictions."""

    command = "generate-template"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        for matrix in self.protocol.matrices:
            self._check_matrix(matrix)
        for layer in self.protocol.layers:
            sheet, (row, column) = self._sheet(layer.sheet), coordinate_to_tuple(layer.claim_cell)
            self._check_cell(
                layer.sheet, sheet.cell(1, column).coordinate, sheet.cell(1, column).value, expected=layer.test_name
            )
            self._check_cell(layer.sheet, f"B{row}", sheet.cell(row, 2).value, expected=layer.name)
        tests = {test for test, _, _ in self._iterate_parameters()}
        for test in self.protocol.tests:
            if test not in tests:
                raise InputError(self.source, f"sheet {PARAMETERS!r} has no scenario {test!r}", self._expected_file)

    def _check_matrix(self, matrix: CellMatrix) -> None:
        sheet, (top, left) = self._sheet(matrix.sheet), coordinate_to_tuple(matrix.first_cell)
        self._check_cell(matrix.sheet, matrix.name_cell, sheet[matrix.name_cell].value, expected=matrix.name)
        for k, location in enumerate(matrix.impact_locations):
            heading = sheet.cell(top - 1, left + k)
            percentage = f"{100 * heading.value:g}" if isinstance(heading.value, int | float) else heading.value
            self._check_cell(matrix.sheet, heading.coordinate, percentage, expected=f"{location:g}")
        for k, speed in enumerate(matrix.target_speeds):
            heading = sheet.cell(top - 1, left + k)
            self._check_cell(matrix.sheet, heading.coordinate, heading.value, expected=f"{speed:g} km/h")
        for k, row in enumerate(matrix.rows):
            self._check_cell(
                matrix.sheet, f"A{top + k}", sheet.cell(top + k, 1).value, expected=f"{row.vut_speed:g} km/h"
            )

    def _iterate_parameters(self) -> Iterator[tuple[str, str, Any]]:
        """Test (in the sheet's words "Scenario"), name, and cell for the value, of every input parameter."""
        sheet, test = self._sheet(PARAMETERS), ""
        self._check_cell(PARAMETERS, "E1", sheet["E1"].value, expected="Scenario")
        self._check_cell(PARAMETERS, "G1", sheet["G1"].value, expected="Value")
        for row in range(2, sheet.max_row + 1):
            test = str(sheet.cell(row, 5).value or test).strip()
            if sheet.cell(row, 6).value is not None:
                yield test, str(sheet.cell(row, 6).value).strip(), sheet.cell(row, 7)

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in a vehicle's colours, rows' functions, layers that hold or are claimed, and which tests' parameters
        are self-claimed.
        """
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
        holds = {
            (test.matrix.test_name, layer): does_hold
            for test in vehicle.tests
            for layer, does_hold in test.layers.items()
        }
        for layer in self.protocol.layers:
            self._sheet(layer.sheet)[layer.claim_cell].value = "YES" if holds[layer.test_name, layer.name] else "NO"
        for test, parameter, value_cell in self._iterate_parameters():
            if "Heading correction" not in parameter:  # a lane departure parameter, which does not accept N/A
                value_cell.value = SELF_CLAIMED_MARK if test in self.protocol.tests else NOT_ASSESSED_MARK
        self._save()


class PreprocessedFile(_Spreadsheet):
    """The file that the calculator has preprocessed, with randomly drawn cells whose measurements are to be filled
    in.
    """

    command = "preprocess"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        prediction_sheets = dict.fromkeys(matrix.sheet for matrix in self.protocol.matrices)
        self._drawn_cells = [
            drawn_cell
            for sheet in prediction_sheets
            for drawn_cell in self._read_drawn_cells(f"{sheet.removesuffix('pred.')}verif.")
        ]

    def _read_drawn_cells(self, name: str) -> list[tuple[Any, dict[str, int], int, int]]:
        """Sheet, columns by heading, row, and cell number of every drawn cell."""
        sheet, drawn_cells = self._sheet(name), []
        columns: dict[str, int] = {}
        for row in range(1, sheet.max_row + 1):
            values = [str(sheet_cell.value or "").strip() for sheet_cell in sheet[row]]
            if "Test point" in values:
                columns = {value: k + 1 for k, value in enumerate(values) if value}
                for heading in VERIFICATION_HEADINGS:
                    if heading not in columns:
                        raise InputError(
                            self.source,
                            f"sheet {name!r}, row {row}: there is no column {heading!r}",
                            self._expected_file,
                        )
                continue
            test_point = values[columns["Test point"] - 1] if columns else ""
            if not test_point:
                continue
            matrix_name = values[columns["Scenario"] - 1]
            if matrix_name not in {matrix.name for matrix in self.protocol.matrices}:
                continue  # the test is not simulated
            indices = test_point.strip("()").split(",")
            cell_number = (
                self.protocol.matrix_cell_numbers.get((matrix_name, int(indices[0]), int(indices[1])))
                if all(part.strip().isdigit() for part in indices) and len(indices) == 2
                else None
            )
            if cell_number is None:
                problem = f"sheet {name!r}, row {row}: {matrix_name} has no test point {test_point!r}"
                raise InputError(self.source, problem, self._expected_file)
            drawn_cells.append((sheet, columns, row, cell_number))
        if (
            not columns and sheet["A2"].value != "General requirements"
        ):  # in A2 of a sheet without drawn cells: all its predictions are red
            raise InputError(self.source, f"sheet {name!r} has no column 'Test point'", self._expected_file)
        return drawn_cells

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in each drawn cell's simulated value and, if a variation is drawn with the cell, whether the robustness
        cell passes.
        """
        robustness_cells = {
            (cell.matrix.name, cell.row, cell.column, cell.range_or_layer, cell.condition): cell_number
            for cell_number, cell in enumerate(self.protocol.cells)
            if cell.is_robustness_cell
        }
        for sheet, columns, row, cell_number in self._drawn_cells:
            cell = self.protocol.cells[cell_number]
            sheet.cell(row, columns["Value"]).value = _measurement(vehicle, cell_number)
            if "Verification condition" in columns and "Robustness" in columns:
                layer, condition = (
                    str(sheet.cell(row, columns[heading]).value or "")
                    for heading in ("Robustness layer", "Verification condition")
                )
                robustness_cell = robustness_cells.get((cell.matrix.name, cell.row, cell.column, layer, condition))
                if robustness_cell is not None:
                    sheet.cell(row, columns["Robustness"]).value = "PASS" if vehicle.passes(robustness_cell) else "FAIL"
        self._save()


def _measurement(vehicle: RatedVehicle, cell_number: int) -> float:
    """Relative impact speed [km/h], 0 without an impact; in a row with FCW, the time to collision at the warning
    [s].
    """
    is_warning = vehicle.protocol.cells[cell_number].judged_by == "warning"
    value = float((vehicle.cells.warning if is_warning else vehicle.cells.impact)[0, cell_number])
    return 0.0 if math.isnan(value) else float(round_half_up(max(value, 0.0), DECIMALS))  # type: ignore[arg-type]
