"""Euro NCAP's own calculator, in a separate environment, since it needs another version of pandas than this package."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import openpyxl

from safevar_sumo.protocol import EURO_NCAP_2026, protocol_of

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
        script = Path(__file__).with_name("derive.py")
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


if __name__ == "__main__":
    print(Calculator.built(Path(sys.argv[1])).python)
