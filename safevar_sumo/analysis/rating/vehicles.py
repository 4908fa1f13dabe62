"""Rated vehicles: the colour of every cell, the points of every test, and the matrices as tables and as a figure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from rich.table import Table
from rich.text import Text

from safevar_sumo.analysis.figures import FONT_SIZE, escape_dollars
from safevar_sumo.protocol import COLOURS, CellMatrix, Protocol
from safevar_sumo.protocol.cells import EXTENDED, WARNING
from safevar_sumo.protocol.rater import Points, Rater
from safevar_sumo.records import CellResults, FloatArray, JsonObject
from safevar_sumo.terminal import WholeTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINT_KINDS = ("standard", "extended", "robustness")
DECIMALS = 9
"""Decimals of points and speeds in JSON; further decimals would hold only rounding errors."""
LEGEND = ", ".join(f"{colour[0].upper()} {colour}" for colour in COLOURS) + "; small letters: extended range"
TERMINAL_STYLES = {
    "green": "black on green",
    "yellow": "black on bright_yellow",
    "orange": "black on dark_orange",
    "brown": "white on dark_red",
    "red": "white on red",
}


class RatedTest(NamedTuple):
    """One vehicle's result in a test, by day or by night if the test has both.

    `points` are in the order of `POINT_KINDS`. `layers` states whether each robustness layer holds, None if it is
    neither simulated nor claimed; day and night have the same layers.
    """

    matrix: CellMatrix
    points: tuple[float, float, float]
    layers: Mapping[str, bool | None]

    @property
    def total(self) -> float:
        return sum(self.points)


@dataclass(frozen=True, kw_only=True)
class RatedVehicle:
    """One vehicle with its setting, its results in every cell, and the points that they earn."""

    name: str
    setting: Mapping[str, float]
    rater: Rater
    cells: CellResults

    @property
    def protocol(self) -> Protocol:
        return self.rater.protocol

    @cached_property
    def scores(self) -> Points:
        return self.rater.points(self.cells)

    @property
    def points(self) -> float:
        return float(self.scores.total[0])

    @cached_property
    def tests(self) -> list[RatedTest]:
        tests = []
        for matrix in self.protocol.matrices:
            test, layers = matrix.test_name, dict[str, bool | None]()
            for layer in self.protocol.layers_of(test):
                if (holds := self.scores.layers.get((test, layer.name))) is not None:
                    layers[layer.name] = bool(holds[0])
                else:
                    layers[layer.name] = layer.name in self.rater.claims.get(test, ()) or None
            standard, extended, robustness = self.scores.tests[matrix.name][0].round(DECIMALS).tolist()
            tests.append(RatedTest(matrix, (standard, extended, robustness), layers))
        return tests

    @cached_property
    def colours(self) -> list[str | None]:
        """The colour of every cell; None if the vehicle could not drive the test."""
        return [None if colour < 0 else COLOURS[colour] for colour in self.scores.colours[0].tolist()]

    @cached_property
    def impacts(self) -> list[float | None]:
        """The relative impact speed in every cell [km/h]; None without an impact."""
        return _rounded(self.cells.impact)

    @cached_property
    def warnings(self) -> list[float | None]:
        """The time to collision at the warning in every cell [s]; None without a warning."""
        return _rounded(self.cells.warning)

    def measured(self, number: int) -> float | None:
        """The value by which a cell is judged: the time to collision at the warning, or the relative impact speed."""
        values = self.warnings if self.protocol.cells[number].judged_by == WARNING else self.impacts
        return values[number]

    @cached_property
    def letters(self) -> npt.NDArray[np.str_]:
        """The colour of every cell as a letter, small in the extended range."""
        letters = [(colour or "?")[0] for colour in self.colours]
        is_extended = [cell.range_or_layer == EXTENDED for cell in self.protocol.cells]
        return np.where(is_extended, letters, np.char.upper(letters))

    def to_dict(self) -> JsonObject:
        cells: dict[str, list[JsonObject]] = {matrix.name: [] for matrix in self.protocol.matrices}
        for number, cell in enumerate(self.protocol.cells):
            cells[cell.matrix.name].append(
                {
                    "range": cell.range_or_layer,
                    "vut_speed": cell.vut_speed,
                    "target_speed": cell.target_speed,
                    "impact_location": cell.impact_location,
                    "colour": self.colours[number],
                    "relative_impact_speed": self.impacts[number],
                    "warning_ttc": self.warnings[number],
                }
            )
        tests = [
            {
                "test": matrix.test_name,
                "light": matrix.light,
                **dict(zip(POINT_KINDS, points, strict=True)),
                "possible": dict(zip(POINT_KINDS, matrix.points, strict=True)),
                "cells": cells[matrix.name],
                "layers": layers,
            }
            for matrix, points, layers in self.tests
        ]
        return {
            "name": self.name,
            "setting": dict(self.setting),
            "points": round(self.points, DECIMALS),
            "possible": max_points(self.protocol),
            "tests": tests,
        }


def _rounded(values: FloatArray) -> list[float | None]:
    return [None if math.isnan(value) else round(value, DECIMALS) for value in values[0].tolist()]


def max_points(protocol: Protocol) -> float:
    """Maximum points of all simulated tests."""
    return round(sum(sum(matrix.points) for matrix in protocol.matrices), DECIMALS)


def _cell_numbers(protocol: Protocol, matrix: CellMatrix) -> pd.DataFrame:
    """The numbers of a matrix's cells by speed of the vehicle under test and by column; -1 where there is no cell."""
    speeds = [
        f"{row.vut_speed:g}{' FCW' * matrix.is_rated_by_warning(number)}" for number, row in enumerate(matrix.rows)
    ]
    known = protocol.matrix_cell_numbers
    columns = {
        f"{value:g}": [known.get((matrix.name, row, column), -1) for row in range(len(speeds))]
        for column, value in enumerate(matrix.column_values)
    }
    return pd.DataFrame(columns, index=speeds)


def matrix_tables(vehicles: Sequence[RatedVehicle]) -> Iterator[str | Table]:
    """Every matrix of the last vehicle: for each cell a letter, a colour, and the impact speed [km/h] or the time to
    collision at the warning [s].
    """
    last, letters = vehicles[-1], _marked_letters(vehicles[-1], vehicles[0])
    for matrix in last.protocol.matrices:
        layout = _cell_numbers(last.protocol, matrix)
        meaning = "impact location [%]" if matrix.impact_locations else "speed of the target"
        table = WholeTable("VUT", "target", right=layout.columns, title=f"{matrix.name}: speeds [km/h], {meaning}")
        for row, (speed, *numbers) in zip(matrix.rows, layout.itertuples(), strict=True):
            cells = [_format_cell(last, number, letters[number]) if number >= 0 else "" for number in numbers]
            table.add_row(speed, "" if row.target_speed is None else f"{row.target_speed:g}", *cells)
        yield table
    yield (
        f"{LEGEND}; asterisk: colour differs from the original's. The number is the relative speed of the impact "
        "[km/h]; in rows with FCW it is the time to collision at the warning [s]."
    )


def _marked_letters(vehicle: RatedVehicle, original: RatedVehicle) -> npt.NDArray[np.str_]:
    """The letters of a vehicle's cells, with an asterisk where the colour differs from the original's."""
    differs = vehicle.scores.colours[0] != original.scores.colours[0]
    return np.char.add(vehicle.letters, np.where(differs, "*", ""))


def _format_cell(vehicle: RatedVehicle, number: int, letter: str) -> Text:
    """The letter of a cell and what was measured there, unless the cell is green by its impact."""
    colour, value = vehicle.colours[number], vehicle.measured(number)
    is_shown = colour != "green" or vehicle.protocol.cells[number].judged_by == WARNING
    digits = ""
    if value is not None and is_shown:
        digits = f"{value:.1f}" if value < 10 else f"{value:.0f}"
    return Text(letter + digits, TERMINAL_STYLES.get(colour or "", ""))


def draw_matrix(axis: Axes, vehicles: Sequence[RatedVehicle], matrix: CellMatrix) -> None:
    """Draw a matrix of every vehicle, side by side; small letters: extended range, asterisk: another colour than the
    original's.
    """
    import seaborn as sns
    from matplotlib.colors import ListedColormap

    original = vehicles[0]
    layout = _cell_numbers(original.protocol, matrix).assign(**{"": -1})  # a gap after each vehicle
    numbers = layout.to_numpy()
    colours = [np.where(numbers < 0, np.nan, vehicle.scores.colours[0, numbers]) for vehicle in vehicles]
    letters = [np.where(numbers < 0, "", _marked_letters(vehicle, original)[numbers]) for vehicle in vehicles]
    frame = pd.DataFrame(np.hstack(colours), layout.index, [*layout.columns] * len(vehicles))
    palette = ListedColormap(["#808080", *(f"#{original.protocol.colours[colour]}" for colour in COLOURS)])
    limits = {"vmin": -1, "vmax": len(COLOURS) - 1}
    sns.heatmap(frame, annot=np.hstack(letters), fmt="", cmap=palette, **limits, cbar=False, linewidths=0.6, ax=axis)
    axis.grid(False)
    axis.tick_params(labelsize=FONT_SIZE - 2, length=0, rotation=0)
    totals = " / ".join(f"{test.total:.2f}" for rated in vehicles for test in rated.tests if test.matrix is matrix)
    axis.set_title(escape_dollars(f"{matrix.name}: {totals} of {sum(matrix.points):g}"), fontsize=FONT_SIZE)
