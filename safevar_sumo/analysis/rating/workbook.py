"""Fills in the official spreadsheet: predictions, claimed layers and input parameters in a template, measurements in a preprocessed file.

Before anything is written, the headings of every target cell are checked; a spreadsheet with other headings is refused.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import openpyxl
from openpyxl.utils import coordinate_to_tuple
from openpyxl.utils.exceptions import InvalidFileException

from safevar_sumo.analysis.rating.compute import RatedVehicle
from safevar_sumo.errors import InputError
from safevar_sumo.protocol import EURO_NCAP_2026, Block, protocol_of
from safevar_sumo.protocol.points import DECIMALS, round_half_up

PARAMETERS, VERSION = "Input parameters", "Version"
NOT_ASSESSED_MARK, PREDICTED_MARK = "N/A", "Self claimed"
HEADINGS = ("Scenario", "Test point", "Range", "Value")
COMMANDS_IN_WORDS = "that pip install 'euroncap-rating-2026=={}' and euroncap_rating_2026 crash_avoidance {} write"


class _Spreadsheet:
    """A spreadsheet. The constructor reads and checks it; `fill` fills and saves it."""

    command = "generate-template"

    def __init__(self, source: Path, output: Path) -> None:
        self.source, self.output, self.protocol = source, output, protocol_of(EURO_NCAP_2026)
        if not source.is_file():
            raise InputError(source, "is a directory" if source.is_dir() else "there is no such file", self._expected_file)
        try:
            self._workbook = openpyxl.load_workbook(source)
        except (OSError, InvalidFileException, zipfile.BadZipFile, KeyError, ValueError) as error:
            raise InputError(source, f"cannot be read as a spreadsheet: {error}", self._expected_file) from None
        self._check_version()

    @property
    def _expected_file(self) -> str:
        return f"the file {COMMANDS_IN_WORDS.format(self.protocol.calculator, self.command)}"

    def _sheet(self, name: str) -> Any:
        if name not in self._workbook.sheetnames:
            raise InputError(self.source, f"has no sheet {name!r}", self._expected_file)
        return self._workbook[name]

    def _check_cell(self, sheet: str, cell: str, expected: object, value: object) -> None:
        if str(value).strip() != str(expected):
            raise InputError(self.source, f"sheet {sheet!r}, cell {cell}: {value!r} in place of {str(expected)!r}", self._expected_file)

    def _check_version(self) -> None:
        version = str(self._sheet(VERSION)["B1"].value)
        if version.split(".")[:2] != self.protocol.calculator.split(".")[:2]:
            raise InputError(self.source, f"sheet {VERSION!r}, cell B1: version {version!r}", self._expected_file)

    def _save(self) -> None:
        try:
            self._workbook.save(self.output)
        except OSError as error:
            raise InputError("--xlsx", f"cannot write {self.output}: {error.strerror or error}",
                             "a file in a directory that exists") from None


class Template(_Spreadsheet):
    """The template that the calculator generates, to be filled with predictions."""

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        for block in self.protocol.blocks:
            self._check_block(block)
        for layer in self.protocol.layers:
            sheet, (row, column) = self._sheet(layer.sheet), coordinate_to_tuple(layer.cell)
            self._check_cell(layer.sheet, sheet.cell(1, column).coordinate, layer.test, sheet.cell(1, column).value)
            self._check_cell(layer.sheet, f"B{row}", layer.layer, sheet.cell(row, 2).value)
        scenarios = {test for test, _, _ in self._iterate_parameters()}
        for test in self.protocol.tests:
            if test not in scenarios:
                raise InputError(self.source, f"sheet {PARAMETERS!r} has no scenario {test!r}", self._expected_file)

    def _check_block(self, block: Block) -> None:
        sheet, (top, left) = self._sheet(block.sheet), coordinate_to_tuple(block.first)
        self._check_cell(block.sheet, block.label, block.name, sheet[block.label].value)
        for k, location in enumerate(block.impact_locations):
            cell = sheet.cell(top - 1, left + k)
            is_number = isinstance(cell.value, int | float)
            self._check_cell(block.sheet, cell.coordinate, f"{location:g}", f"{100 * cell.value:g}" if is_number else cell.value)
        for k, speed in enumerate(block.target_speeds):
            cell = sheet.cell(top - 1, left + k)
            self._check_cell(block.sheet, cell.coordinate, f"{speed:g} km/h", cell.value)
        for k, row in enumerate(block.rows):
            self._check_cell(block.sheet, f"A{top + k}", f"{row.vut:g} km/h", sheet.cell(top + k, 1).value)

    def _iterate_parameters(self) -> Iterator[tuple[str, str, Any]]:
        """Scenario, parameter and cell of every input parameter."""
        sheet, test = self._sheet(PARAMETERS), ""
        self._check_cell(PARAMETERS, "E1", "Scenario", sheet["E1"].value)
        self._check_cell(PARAMETERS, "G1", "Value", sheet["G1"].value)
        for row in range(2, sheet.max_row + 1):
            test = str(sheet.cell(row, 5).value or test).strip()
            if sheet.cell(row, 6).value is not None:
                yield test, str(sheet.cell(row, 6).value).strip(), sheet.cell(row, 7)

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in a vehicle's colours, each row's function, whether each layer holds (simulated or claimed), and the predicted tests."""
        for cell_number, cell in enumerate(self.protocol.cells):
            if not cell.is_varied:
                top, left = coordinate_to_tuple(cell.block.first)
                colour = vehicle.colour(cell_number) or "red"
                self._sheet(cell.block.sheet).cell(top + cell.row, left + cell.column).value = colour.capitalize()
        for block in self.protocol.blocks:
            top, _ = coordinate_to_tuple(block.first)
            for row_number, row in enumerate(block.rows):
                if row.choice:
                    self._sheet(block.sheet)[f"{block.function}{top + row_number}"].value = "FCW" if block.is_warning(row_number) else "AEB"
        holds = {(test.block.test, layer): does_hold for test in vehicle.tests for layer, does_hold in test.layers.items()}
        for layer in self.protocol.layers:
            self._sheet(layer.sheet)[layer.cell].value = "YES" if holds[layer.test, layer.layer] else "NO"
        for test, parameter, cell in self._iterate_parameters():
            if "Heading correction" not in parameter:  # a lane departure parameter, which does not accept N/A
                cell.value = PREDICTED_MARK if test in self.protocol.tests else NOT_ASSESSED_MARK
        self._save()


class PreprocessedFile(_Spreadsheet):
    """The file that the calculator has preprocessed, with randomly drawn cells whose measurements are to be filled in."""

    command = "preprocess"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        self._sheets = [f"{sheet.removesuffix('pred.')}verif." for sheet in dict.fromkeys(block.sheet for block in self.protocol.blocks)]
        self._drawn_cells = [cells for sheet in self._sheets for cells in self._read_drawn_cells(sheet)]

    def _read_drawn_cells(self, name: str) -> list[tuple[Any, dict[str, int], int, int]]:
        """Sheet, columns by heading, row, and cell number of every drawn cell."""
        sheet, cells = self._sheet(name), []
        columns: dict[str, int] = {}
        for row in range(1, sheet.max_row + 1):
            values = [str(cell.value or "").strip() for cell in sheet[row]]
            if "Test point" in values:
                columns = {value: k + 1 for k, value in enumerate(values) if value}
                for heading in HEADINGS:
                    if heading not in columns:
                        raise InputError(self.source, f"sheet {name!r}, row {row}: there is no column {heading!r}", self._expected_file)
                continue
            test_point = values[columns["Test point"] - 1] if columns else ""
            if not test_point:
                continue
            scenario = values[columns["Scenario"] - 1]
            if scenario not in {block.name for block in self.protocol.blocks}:
                continue  # the test is not simulated
            indices = test_point.strip("()").split(",")
            cell_number = self.protocol.matrix_cell_numbers.get((scenario, int(indices[0]), int(indices[1]))) if all(
                part.strip().isdigit() for part in indices) and len(indices) == 2 else None
            if cell_number is None:
                problem = f"sheet {name!r}, row {row}: {scenario} has no test point {test_point!r}"
                raise InputError(self.source, problem, self._expected_file)
            cells.append((sheet, columns, row, cell_number))
        if not columns and sheet["A2"].value != "General requirements":  # the text of a sheet of red cells, from which none is drawn
            raise InputError(self.source, f"sheet {name!r} has no column 'Test point'", self._expected_file)
        return cells

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in each drawn cell's simulated value, and whether the robustness layer that is drawn with the cell holds."""
        layer_cells = {(cell.block.name, cell.row, cell.column, cell.range, cell.condition): cell_number
                       for cell_number, cell in enumerate(self.protocol.cells) if cell.is_varied}
        for sheet, columns, row, cell_number in self._drawn_cells:
            cell = self.protocol.cells[cell_number]
            sheet.cell(row, columns["Value"]).value = _measurement(vehicle, cell_number)
            if "Verification condition" in columns and "Robustness" in columns:
                layer, condition = (str(sheet.cell(row, columns[heading]).value or "")
                                    for heading in ("Robustness layer", "Verification condition"))
                layer_number = layer_cells.get((cell.block.name, cell.row, cell.column, layer, condition))
                if layer_number is not None:
                    sheet.cell(row, columns["Robustness"]).value = "PASS" if vehicle.passes(layer_number) else "FAIL"
        self._save()


def _measurement(vehicle: RatedVehicle, cell_number: int) -> float:
    """Relative impact speed [km/h], 0 without an impact; in a row with FCW, the time to collision at the warning [s]."""
    is_warning = vehicle.protocol.cells[cell_number].judged == "warning"
    value = float((vehicle.cells.warning if is_warning else vehicle.cells.impact)[0, cell_number])
    return 0.0 if math.isnan(value) else float(round_half_up(max(value, 0.0), DECIMALS))  # type: ignore[arg-type]
