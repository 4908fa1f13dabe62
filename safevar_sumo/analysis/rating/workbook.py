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

from safevar_sumo.analysis.rating.vehicles import RatedVehicle
from safevar_sumo.errors import InputError
from safevar_sumo.output import whole_file
from safevar_sumo.protocol import EURO_NCAP_2026, protocol_of
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

    def fill(self, vehicle: RatedVehicle) -> None:
        """Fill in what is known of a vehicle, and save the spreadsheet."""
        for cell, value in self._values(vehicle):
            cell.value = value
        with whole_file(self.output, "xlsx") as file:
            self._workbook.save(file)

    def _values(self, vehicle: RatedVehicle) -> Iterator[tuple[Any, str | float]]:
        """The cells to fill, with their values."""
        raise NotImplementedError


class Template(_Spreadsheet):
    """The template that the calculator generates, to be filled with predictions."""

    command = "generate-template"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        expected = {(PARAMETERS, "E1"): "Scenario", (PARAMETERS, "G1"): "Value"}
        for matrix in self.protocol.matrices:
            top, _ = coordinate_to_tuple(matrix.first_cell)
            expected[matrix.sheet, matrix.name_cell] = matrix.name
            expected |= {(matrix.sheet, f"A{top + k}"): f"{row.vut_speed:g} km/h" for k, row in enumerate(matrix.rows)}
        for layer in self.protocol.layers:
            expected[layer.sheet, f"B{coordinate_to_tuple(layer.claim_cell)[0]}"] = layer.name
        for (sheet, address), heading in expected.items():
            value = self._sheet(sheet)[address].value
            if str(value).strip() != heading:
                raise self._refusal(f"sheet {sheet!r}, cell {address}: {value!r} in place of {heading!r}")

    def _values(self, vehicle: RatedVehicle) -> Iterator[tuple[Any, str | float]]:
        """A vehicle's colours, rows' functions, layers that hold or are claimed, and self-claimed tests."""
        for (_, row, column), number in self.protocol.matrix_cell_numbers.items():
            matrix = self.protocol.cells[number].matrix
            top, left = coordinate_to_tuple(matrix.first_cell)
            colour = vehicle.colours[number] or "red"
            yield self._sheet(matrix.sheet).cell(top + row, left + column), colour.capitalize()
            if matrix.rows[row].has_function_choice:
                function = "FCW" if matrix.is_rated_by_warning(row) else "AEB"
                yield self._sheet(matrix.sheet)[f"{matrix.function_column}{top + row}"], function
        layers = {test.matrix.test_name: test.layers for test in vehicle.tests}
        for layer in self.protocol.layers:
            holds = layers[layer.test_name][layer.name]
            yield self._sheet(layer.sheet)[layer.claim_cell], "YES" if holds else "NO"
        test = ""  # the sheet names it, as "Scenario", in the first row of each test alone
        for *_, scenario, parameter, cell in self._sheet(PARAMETERS).iter_rows(min_row=2, max_col=7):
            test = str(scenario.value or test).strip()
            # "Heading correction", a lane departure parameter, does not accept N/A.
            if parameter.value is not None and "Heading correction" not in str(parameter.value):
                yield cell, SELF_CLAIMED_MARK if test in self.protocol.tests else NOT_ASSESSED_MARK


class PreprocessedFile(_Spreadsheet):
    """The calculator's preprocessed file, with randomly drawn cells whose measurements are to be filled in."""

    command = "preprocess"

    def __init__(self, source: Path, output: Path) -> None:
        super().__init__(source, output)
        sheets = dict.fromkeys(matrix.sheet.removesuffix("pred.") for matrix in self.protocol.matrices)
        self._drawn_cells = [drawn_cell for sheet in sheets for drawn_cell in self._read_drawn_cells(f"{sheet}verif.")]

    def _read_drawn_cells(self, name: str) -> Iterator[tuple[JsonObject, int]]:
        """For every drawn cell of a simulated test: the spreadsheet's cells by heading, and the number of the
        protocol's cell.
        """
        headings, matrices = [], {matrix.name for matrix in self.protocol.matrices}
        for row in self._sheet(name).iter_rows():
            values = [str(cell.value or "").strip() for cell in row]
            if "Test point" in values:
                headings = values
                continue
            texts = dict(zip(headings, values, strict=False))
            if texts.get("Scenario") in matrices and texts["Test point"]:
                matrix, point = texts["Scenario"], texts["Test point"]
                key = matrix, *map(int, re.findall(r"\d+", point))
                if key not in self.protocol.matrix_cell_numbers:
                    raise self._refusal(f"sheet {name!r}, row {row[0].row}: {matrix} has no test point {point!r}")
                yield dict(zip(headings, row, strict=False)), self.protocol.matrix_cell_numbers[key]

    def _values(self, vehicle: RatedVehicle) -> Iterator[tuple[Any, str | float]]:
        """Each drawn cell's simulated value and, if a variation is drawn with it, whether that passes."""
        passes = passing_cells(self.protocol, vehicle.scores.colours)[0]
        numbers = {cell.name: number for number, cell in enumerate(self.protocol.cells)}
        for cells, number in self._drawn_cells:
            # 0 km/h without an impact; 0 s without a warning.
            yield cells["Value"], float(round_half_up(np.array(max(vehicle.measured(number) or 0.0, 0.0)), DECIMALS))
            if "Verification condition" in cells and "Robustness" in cells:
                layer, condition = (cells[name].value for name in ("Robustness layer", "Verification condition"))
                varied = numbers.get(f"{self.protocol.cells[number].name}, {layer} {condition}")
                if varied is not None:
                    yield cells["Robustness"], "PASS" if passes[varied] else "FAIL"
