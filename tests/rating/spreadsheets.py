"""Fills in the two spreadsheets of Euro NCAP's calculator with what is known of a vehicle."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import openpyxl
from openpyxl.utils import coordinate_to_tuple

from safevar_sumo.protocol import COLOURS
from safevar_sumo.protocol.cells import WARNING
from safevar_sumo.protocol.rater import DECIMALS, Rater, passing_cells, round_half_up
from safevar_sumo.records import CellResults


def fill_template(template: Path, output: Path, rater: Rater, results: CellResults) -> None:
    """Write a vehicle's colours, rows' functions, layers that hold or are claimed, and self-claimed tests."""
    book, protocol, scores = openpyxl.load_workbook(template), rater.protocol, rater.points(results)
    for (_, row, column), number in protocol.matrix_cell_numbers.items():
        matrix = protocol.cells[number].matrix
        top, left = coordinate_to_tuple(matrix.first_cell)
        colour = COLOURS[scores.colours[0, number]]  # an unknown one, -1, is the last: red
        book[matrix.sheet].cell(top + row, left + column).value = colour.capitalize()
        if matrix.rows[row].has_function_choice:
            function = "FCW" if matrix.is_rated_by_warning(row) else "AEB"
            book[matrix.sheet][f"{matrix.function_column}{top + row}"].value = function
    for layer in protocol.layers:
        is_claimed = layer.name in rater.claims.get(layer.test_name, ())
        holds = scores.layers.get((layer.test_name, layer.name), [is_claimed])[0]
        book[layer.sheet][layer.claim_cell].value = "YES" if holds else "NO"
    test = ""  # the sheet names it, as "Scenario", in the first row of each test alone
    for *_, scenario, parameter, cell in book["Input parameters"].iter_rows(min_row=2, max_col=7):
        test = str(scenario.value or test).strip()
        # "Heading correction", a lane departure parameter, does not accept N/A.
        if parameter.value is not None and "Heading correction" not in str(parameter.value):
            cell.value = "Self claimed" if test in protocol.tests else "N/A"
    book.save(output)


def fill_drawn_cells(preprocessed: Path, output: Path, rater: Rater, results: CellResults) -> None:
    """Write each drawn cell's simulated value and, if a variation is drawn with it, whether that passes."""
    book, protocol = openpyxl.load_workbook(preprocessed), rater.protocol
    passes = passing_cells(protocol, rater.points(results).colours)[0]
    numbers, matrices = {cell.name: number for number, cell in enumerate(protocol.cells)}, protocol.matrices
    for sheet in dict.fromkeys(matrix.sheet.removesuffix("pred.") for matrix in matrices):
        headings: list[str] = []
        for row in book[f"{sheet}verif."].iter_rows():
            values = [str(cell.value or "").strip() for cell in row]
            if "Test point" in values:
                headings = values
                continue
            cells = dict(zip(headings, row, strict=False))
            texts = dict(zip(headings, values, strict=False))
            if texts.get("Scenario") not in {matrix.name for matrix in matrices} or not texts["Test point"]:
                continue
            number = protocol.matrix_cell_numbers[texts["Scenario"], *map(int, re.findall(r"\d+", texts["Test point"]))]
            # 0 km/h without an impact; 0 s without a warning.
            of_kind = results.warning if protocol.cells[number].judged_by == WARNING else results.impact
            measured = np.maximum(np.nan_to_num(of_kind[0, number]), 0.0)
            cells["Value"].value = float(round_half_up(measured, DECIMALS))
            if "Verification condition" in cells and "Robustness" in cells:
                layer, condition = (cells[name].value for name in ("Robustness layer", "Verification condition"))
                varied = numbers.get(f"{protocol.cells[number].name}, {layer} {condition}")
                if varied is not None:
                    cells["Robustness"].value = "PASS" if passes[varied] else "FAIL"
    book.save(output)
