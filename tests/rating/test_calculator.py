"""Euro NCAP's official calculator, from PyPI, computes equal points and colours; it runs in an
environment of its own, since it needs another version of pandas than this package, and reads two
spreadsheets.
"""

from __future__ import annotations

import os
import re
import subprocess
import venv
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from openpyxl.utils import coordinate_to_tuple

from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, protocol_of
from safevar_sumo.protocol.cells import WARNING
from safevar_sumo.protocol.rater import DECIMALS, Rater, passing_cells, round_half_up
from safevar_sumo.records import CellResults

pytestmark = pytest.mark.slow
PROTOCOL = protocol_of(EURO_NCAP_2026)
N = len(PROTOCOL.cells)
CLAIMS = {
    "CCRs": ["Driver input pre-crash", "Illumination (Sun glare)"],
    "CPNCO": ["Driver input pre-crash", "Type"],
}


@pytest.fixture(scope="module")
def calculator(tmp_path_factory: pytest.TempPathFactory) -> Calculator:
    return Calculator.built(tmp_path_factory.mktemp("calculator") / "environment")


@pytest.fixture(scope="module")
def template(calculator: Calculator, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return calculator.template(tmp_path_factory.mktemp("template"))


def agrees(
    rater: Rater, cells: CellResults, calculator: Calculator, template: Path, place: Path
) -> None:
    """Asserts that the calculator's points of every simulated test and its colour of every cell
    that it draws equal this package's.
    """
    place.mkdir(exist_ok=True)
    fill_template(template, place / "predicted.xlsx", rater, cells)
    drawn = calculator.preprocessed(place / "predicted.xlsx", place / "drawn")
    fill_drawn_cells(drawn, place / "measured.xlsx", rater, cells)
    theirs = calculator.scores(place / "measured.xlsx", place / "scored")
    scores = rater.points(cells)
    for test, matrices in PROTOCOL.tests.items():
        ours = sum(scores.tests[matrix.name][0] for matrix in matrices)
        assert theirs.points[test] == pytest.approx(ours, abs=0.01), test
    simulated = {matrix.name for matrix in PROTOCOL.matrices}
    verified = [row for row in theirs.verified if row["Scenario"] in simulated]
    assert verified or scores.total[0] == 0
    for row in verified:
        across, down = map(int, str(row["Test point"]).strip("()").split(","))
        number = PROTOCOL.matrix_cell_numbers[str(row["Scenario"]), across, down]
        assert str(row["Colour"]).lower() == COLOURS[scores.colours[0, number]], row


def test_the_protocols_data_is_what_the_calculator_has(calculator: Calculator) -> None:
    shipped = Path(__file__).parents[2] / "safevar_sumo/protocol/euro_ncap_2026.toml"
    assert calculator.derived() == shipped.read_text(encoding="utf-8")


@pytest.mark.parametrize("seed", range(2))
def test_vehicles_with_any_colours_score_alike(
    seed: int, calculator: Calculator, template: Path, tmp_path: Path
) -> None:
    """Colours at random, with speeds that round to a bound; layers as their cells or at random,
    some claimed.
    """
    rng = np.random.default_rng(seed)
    speeds = rng.choice([0.004, 5, 9.996, 10, 15, 20, 25, 30, 40], (1, N))
    impact = np.where(rng.random((1, N)) < rng.choice([0.1, 0.3, 0.7]), speeds, np.nan)
    if seed:
        impact[
            :,
            [
                k
                for k, cell in enumerate(PROTOCOL.cells)
                if cell.matrix.test_name == "CCRs" and cell.vut_speed <= 20
            ],
        ] = np.nan
    warning = np.where(rng.random((1, N)) < 0.7, 1.9, rng.choice([np.nan, 1.2, 1.696], (1, N)))
    nominal = list(range(N))
    if seed % 2:
        nominal = [
            PROTOCOL.matrix_cell_numbers[cell.matrix.name, cell.row, cell.column]
            for cell in PROTOCOL.cells
        ]
    cells, claims = (
        CellResults(impact[:, nominal], warning[:, nominal], np.ones((1, N), dtype=bool)),
        CLAIMS if seed % 3 else {},
    )
    rater = Rater(protocol=PROTOCOL, claims=claims)
    assert rater.points(cells).fails[0] == (seed == 0)
    agrees(rater, cells, calculator, template, tmp_path)


ENVIRONMENT = "SAFEVAR_CALCULATOR"
"""Environment variable that names the folder of an environment with the calculator."""


class Calculator:
    """The calculator's command line."""

    def __init__(self, folder: Path) -> None:
        self.python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
        self._program = self.python.with_name("euroncap_rating_2026")

    @classmethod
    def built(cls, folder: Path) -> Calculator:
        """Install the calculator from PyPI, in the version from which the protocol's data was
        derived.
        """
        if os.environ.get(ENVIRONMENT):
            return cls(Path(os.environ[ENVIRONMENT]))
        venv.create(folder, with_pip=True)
        calculator = cls(folder)
        version = protocol_of(EURO_NCAP_2026).calculator_version
        packages = [f"euroncap-rating-2026=={version}", "pandas<3"]
        subprocess.run(
            [calculator.python, "-m", "pip", "install", "-q", *packages], check=True, timeout=900
        )
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
        return subprocess.run(
            [self.python, script], capture_output=True, text=True, check=True, timeout=300
        ).stdout


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
            heads = ()
            for values in book[sheet].iter_rows(values_only=True):
                if "Test point" in values:
                    heads = values
                elif heads and values[heads.index("Test point")]:
                    self.verified.append(
                        {
                            str(head): value
                            for head, value in zip(heads, values, strict=True)
                            if head
                        }
                    )


def fill_template(template: Path, output: Path, rater: Rater, results: CellResults) -> None:
    """Write a vehicle's colours, rows' functions, layers that hold or are claimed, and self-claimed
    tests.
    """
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
    """Write each drawn cell's simulated value and, if a variation is drawn with it, whether that
    passes.
    """
    book, protocol = openpyxl.load_workbook(preprocessed), rater.protocol
    passes = passing_cells(protocol, rater.points(results).colours)[0]
    numbers, matrices = (
        {cell.name: number for number, cell in enumerate(protocol.cells)},
        protocol.matrices,
    )
    for sheet in dict.fromkeys(matrix.sheet.removesuffix("pred.") for matrix in matrices):
        headings = []
        for row in book[f"{sheet}verif."].iter_rows():
            values = [str(cell.value or "").strip() for cell in row]
            if "Test point" in values:
                headings = values
                continue
            cells = dict(zip(headings, row, strict=False))
            texts = dict(zip(headings, values, strict=False))
            if (
                texts.get("Scenario") not in {matrix.name for matrix in matrices}
                or not texts["Test point"]
            ):
                continue
            number = protocol.matrix_cell_numbers[
                texts["Scenario"], *map(int, re.findall(r"\d+", texts["Test point"]))
            ]
            # 0 km/h without an impact; 0 s without a warning.
            of_kind = (
                results.warning if protocol.cells[number].judged_by == WARNING else results.impact
            )
            measured = np.maximum(np.nan_to_num(of_kind[0, number]), 0.0)
            cells["Value"].value = float(round_half_up(measured, DECIMALS))
            if "Verification condition" in cells and "Robustness" in cells:
                layer, condition = (
                    cells[name].value for name in ("Robustness layer", "Verification condition")
                )
                varied = numbers.get(f"{protocol.cells[number].name}, {layer} {condition}")
                if varied is not None:
                    cells["Robustness"].value = "PASS" if passes[varied] else "FAIL"
    book.save(output)
