"""Euro NCAP's own calculator, in a separate environment, since it needs another version of pandas than this package;
and its two spreadsheets, filled in with what is known of a vehicle.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import openpyxl
from openpyxl.utils import coordinate_to_tuple

from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, protocol_of
from safevar_sumo.protocol.cells import WARNING
from safevar_sumo.protocol.rater import DECIMALS, Rater, passing_cells, round_half_up
from safevar_sumo.records import CellResults

ENVIRONMENT = "SAFEVAR_CALCULATOR"
"""Environment variable that names the folder of an environment with the calculator."""


class Calculator:
    """The calculator's command line."""

    def __init__(self, folder: Path) -> None:
        self.python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
        self._program = self.python.with_name("euroncap_rating_2026")

    @classmethod
    def built(cls, folder: Path) -> Calculator:
        """Install the calculator from PyPI, in the version from which the protocol's data was derived."""
        if os.environ.get(ENVIRONMENT):
            return cls(Path(os.environ[ENVIRONMENT]))
        venv.create(folder, with_pip=True)
        calculator = cls(folder)
        version = protocol_of(EURO_NCAP_2026).calculator_version
        packages = [f"euroncap-rating-2026=={version}", "pandas<3"]
        subprocess.run([calculator.python, "-m", "pip", "install", "-q", *packages], check=True, timeout=900)
        return calculator

    def run(self, command: str, place: Path, *options: str) -> str:
        arguments = [self._program, "crash_avoidance", command, *options]
        process = subprocess.run(arguments, cwd=place, capture_output=True, text=True, timeout=300)
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    def template(self, place: Path) -> Path:
        self.run("generate-template", place)
        return place / "ca_template.xlsx"

    def preprocessed(self, predicted: Path, place: Path) -> Path:
        place.mkdir()
        self.run("preprocess", place, "-i", str(predicted), "-o", str(place))
        return place / "ca_preprocessed_template.xlsx"

    def scores(self, filled: Path, place: Path) -> CalculatorScores:
        place.mkdir()
        output = self.run("compute-score", place, "-i", str(filled), "-o", str(place))
        assert "Warning" not in output, output
        return CalculatorScores(next(place.glob("*.xlsx")))

    def derived(self) -> str:
        """Derive the protocol's data again."""
        script = Path(__file__).parents[2] / "calibration/euro_ncap.py"
        return subprocess.run([self.python, script], capture_output=True, text=True, check=True, timeout=300).stdout


class CalculatorScores:
    """The calculator's scores of a spreadsheet: points by test, and the verified rows."""

    def __init__(self, path: Path) -> None:
        book = openpyxl.load_workbook(path)
        self.points: dict[str, list[float]] = {}
        test = ""
        for row in book["Scenario Scores"].iter_rows(min_row=2, values_only=True):
            test = row[4] or test
            self.points.setdefault(test, []).append(float(row[6]))
        self.verified: list[dict[str, object]] = []
        for sheet in ("FC - Car & PTW verif.", "FC - Ped & Cyc verif."):
            heads: tuple[object, ...] = ()
            for values in book[sheet].iter_rows(values_only=True):
                if "Test point" in values:
                    heads = values
                elif heads and values[heads.index("Test point")]:
                    self.verified.append({str(head): value for head, value in zip(heads, values, strict=True) if head})


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


if __name__ == "__main__":
    print(Calculator.built(Path(sys.argv[1])).python)
