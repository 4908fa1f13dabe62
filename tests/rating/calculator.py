"""Euro NCAP's official calculator, in a separate environment: it needs another version of pandas than this package."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import openpyxl

from safevar_sumo.protocol import EURO_NCAP_2026, protocol_of

GIVEN = "SAFEVAR_CALCULATOR"
"""Environment variable with the folder of an environment in which the calculator is installed."""


class Calculator:
    """The program, as it is typed."""

    def __init__(self, folder: Path) -> None:
        self.python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
        self._program = self.python.with_name("euroncap_rating_2026")

    @classmethod
    def built(cls, folder: Path) -> Calculator:
        """From PyPI, in the version that the protocol's data was derived from."""
        if os.environ.get(GIVEN):
            return cls(Path(os.environ[GIVEN]))
        venv.create(folder, with_pip=True)
        one = cls(folder)
        version = protocol_of(EURO_NCAP_2026).calculator
        subprocess.run([one.python, "-m", "pip", "install", "-q", f"euroncap-rating-2026=={version}", "pandas<3"], check=True, timeout=900)
        return one

    def run(self, command: str, place: Path, *options: str) -> str:
        done = subprocess.run([self._program, "crash_avoidance", command, *options], cwd=place, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def template(self, place: Path) -> Path:
        self.run("generate-template", place)
        return place / "ca_template.xlsx"

    def preprocessed(self, predicted: Path, place: Path) -> Path:
        place.mkdir()
        self.run("preprocess", place, "-i", str(predicted), "-o", str(place))
        return place / "ca_preprocessed_template.xlsx"

    def scored(self, filled: Path, place: Path) -> Scored:
        place.mkdir()
        said = self.run("compute-score", place, "-i", str(filled), "-o", str(place))
        assert "Warning" not in said, said
        return Scored(next(place.glob("*.xlsx")))

    def derived(self) -> str:
        """The protocol's data, derived anew."""
        script = Path(__file__).with_name("derive.py")
        return subprocess.run([self.python, script], capture_output=True, text=True, check=True, timeout=300).stdout


class Scored:
    """The calculator's results for a spreadsheet: points by test, and the rows that it verified."""

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
