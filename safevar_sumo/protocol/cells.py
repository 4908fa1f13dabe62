"""The cells of a rating, with their scenario parameters: all matrices of the protocol and all
robustness layers that can be simulated.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct

from safevar_sumo.records import FloatArray, NamedValues
from safevar_sumo.shipped import shipped_table
from safevar_sumo.study.encounters import Parameters

EURO_NCAP_2026 = "euro_ncap_2026"
COLOURS = ("green", "yellow", "orange", "brown", "red")
"""Colours from best to worst; arrays hold indices of this tuple."""
STANDARD, EXTENDED = "standard", "extended"
NOT_RED = "Not red"
"""One of the two criteria of conditions; the other one is "Same or better than predicted"."""
WARNING = "warning"
NIGHT = "Illumination (Night)"
SPEED, ACCELERATION, OFFSET, HEADING = (
    "Speed",
    "Acceleration",
    "Initial position offset",
    "Trajectory/Heading",
)
IN_DARKNESS = "Performance in darkness (1 lux)"
WARNING_TESTS = ("CPLA", "CBLA")
"""Tests in which a row with a choice of AEB or FCW is rated by the warning; in other tests the
calculator always rates the impact.
"""
MODELS = {
    "CCR": "car_to_car",
    "CMR": "car_to_car",
    "CPLA": "along",
    "CBLA": "along",
    "": "crossing",
}
"""Scenario models by the prefix of a test's name, the first one that fits."""
REQUIRED, UNCHECKED = "CCRs at 10 and 20 km/h", "CPNA at 10 km/h and 75 %"
"""The cells that the protocol requires to be green, and those that the calculator does not check,
in words.
"""
TARGET_DECELERATION, TARGET_HEADWAY = 4.0, 1.0
"""The target's deceleration [m/s^2] and its headway at the start [s] in CCRb and CMRb; robustness
layers vary both.
"""


class CellRow(Struct, frozen=True, forbid_unknown_fields=True):
    """A row of a matrix: speeds of the vehicle under test (VUT) and of the target [km/h].

    `range_letters` has a letter for each column: S (standard range), E (extended range) or - (no
    cell). With `has_function_choice` the manufacturer chooses AEB or FCW.
    """

    vut_speed: float
    range_letters: str
    target_speed: float | None = None
    has_function_choice: bool = False


class CellMatrix(Struct, frozen=True, forbid_unknown_fields=True):
    """A matrix of a test; a test that is driven by day and by night has one matrix for each
    `light`.

    In the official template the matrix is on `sheet`, its first colour in `first_cell`, and the
    function of each row (AEB or FCW) in the column with the letter `function_column`. `points` are
    those of the standard range, the extended range and robustness.
    """

    test_name: str
    measure: Literal["mitigation", "avoidance"]
    sheet: str
    first_cell: str
    points: tuple[float, float, float]
    rows: tuple[CellRow, ...]
    light: Literal["day", "night"] | None = None
    function_column: str = ""
    impact_locations: tuple[float, ...] = ()
    target_speeds: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        return self.test_name if self.light is None else f"{self.test_name} {self.light}"

    def is_rated_by_warning(self, row: int) -> bool:
        """Whether a row is rated by the time to collision at the warning."""
        return self.rows[row].has_function_choice and self.test_name in WARNING_TESTS


class Condition(Struct, frozen=True, forbid_unknown_fields=True):
    """A variation of a robustness layer in the calculator's words, and the criterion that must
    hold.
    """

    text: str
    criterion: str


class Layer(Struct, frozen=True, forbid_unknown_fields=True):
    """A robustness layer that counts for a test.

    In the official template, `claim_cell` on `sheet` states whether the layer holds.
    """

    test_name: str
    name: str
    sheet: str
    claim_cell: str
    conditions: tuple[Condition, ...]

    @property
    def simulated_conditions(self) -> tuple[Condition, ...]:
        """The layer's conditions if they can be simulated, else none."""
        if (
            self.name == NIGHT
        ):  # the calculator lists no condition for CBLA by night, which is rated like other tests
            return self.conditions or (Condition(IN_DARKNESS, NOT_RED),)
        return self.conditions if self.name in (SPEED, ACCELERATION, OFFSET, HEADING) else ()


class Cell(NamedTuple):
    """One simulation of a rating.

    - `matrix`, `row`, `column`: the cell's position; a robustness cell has that of the matrix cell
      that it varies.
    - `range_or_layer`: of a matrix cell `standard` or `extended`; of a robustness cell the name of
      the layer.
    - `condition`, `criterion`: of a robustness cell as in `Condition`; of a matrix cell "".
    - `judged_by`: the measure that determines the colour: `mitigation`, `avoidance` or `warning`.
    - `target_speed`: of the target [km/h].
    """

    matrix: CellMatrix
    row: int
    column: int
    range_or_layer: str
    condition: str
    criterion: str
    judged_by: str
    target_speed: float

    @property
    def vut_speed(self) -> float:
        """Speed of the vehicle under test [km/h]."""
        return self.matrix.rows[self.row].vut_speed

    @property
    def impact_location(self) -> float | None:
        """Impact location [% of the width]; None in a matrix whose columns are target speeds."""
        return self.matrix.impact_locations[self.column] if self.matrix.impact_locations else None

    @property
    def is_robustness_cell(self) -> bool:
        return bool(self.condition)

    @property
    def name(self) -> str:
        """The cell in words, such as `CPNA night, 40 km/h, 75 %, Speed +3 km/h`."""
        location = self.impact_location
        column = (
            f"target {self.matrix.target_speeds[self.column]:g} km/h"
            if location is None
            else f"{location:g} %"
        )
        function = " FCW" if self.judged_by == WARNING else ""
        variation = f", {self.range_or_layer} {self.condition}" if self.is_robustness_cell else ""
        return f"{self.matrix.name}, {self.vut_speed:g} km/h{function}, {column}{variation}"

    @property
    def is_night(self) -> bool:
        """Whether the cell is simulated by night."""
        return self.matrix.light == "night" or self.range_or_layer == NIGHT

    @property
    def scenario(self) -> tuple[str, Parameters]:
        """The scenario of the cell: model and parameters."""
        test = self.matrix.test_name
        model = next(model for prefix, model in MODELS.items() if test.startswith(prefix))
        parameters = {"test": test, "speed": self.vut_speed, "target_speed": self.target_speed}
        if self.impact_location is not None:
            parameters["impact_location"] = self.impact_location
        if self.range_or_layer == ACCELERATION:
            parameters["target_deceleration"] = TARGET_DECELERATION - _leading_number(
                self.condition
            )
        elif self.range_or_layer == OFFSET and "headway" in self.condition:
            parameters["headway"] = TARGET_HEADWAY + _leading_number(self.condition)
        elif self.range_or_layer == OFFSET:
            parameters["start_share"] = 1 + _leading_number(self.condition) / 100
        elif self.range_or_layer == HEADING:
            parameters["heading"] = _leading_number(self.condition)
        return model, parameters


def _leading_number(condition: str) -> float:
    """The number at the beginning of a condition."""
    match = re.match(r"\s*([+-]?[\d.]+)", condition)
    assert match is not None, condition
    return float(match[1])


class Protocol(Struct, frozen=True, eq=False, forbid_unknown_fields=True, dict=True):
    """A protocol; `points_by_test` holds the points of every test, simulated or not, as in
    `CellMatrix.points`.

    Measured values at which colours begin: for `mitigation` in `starts_by_vut_speed`, for other
    measures in `starts_by_measure`.
    """

    calculator_version: str
    colours: dict[str, str]
    starts_by_vut_speed: dict[str, NamedValues]
    starts_by_measure: dict[str, NamedValues]
    points_by_test: dict[str, tuple[float, float, float]]
    matrices: tuple[CellMatrix, ...]
    layers: tuple[Layer, ...]

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All simulations: the cells of the matrices, then the robustness cells, which vary cells
        of the standard range only.
        """
        return (*self._iterate_matrix_cells(), *self._iterate_robustness_cells())

    def numbers_of(
        self, test: str, range_or_layer: str, matrix: CellMatrix | None = None
    ) -> list[int]:
        """Indices in `cells` of the cells of a range or a layer of a test, or of one of its
        matrices.
        """
        return [
            number
            for number, cell in enumerate(self.cells)
            if cell.matrix.test_name == test
            and cell.range_or_layer == range_or_layer
            and matrix in (None, cell.matrix)
        ]

    @cached_property
    def colour_starts(self) -> FloatArray:
        """The measured value from which on each cell has each of the `COLOURS`, shape (cells, 5);
        infinite for colours that it cannot have.
        """
        fastest = max(map(int, self.starts_by_vut_speed))
        rows = []
        for cell in self.cells:
            starts = self.starts_by_measure.get(cell.judged_by)
            if starts is None:  # mitigation
                starts = self.starts_by_vut_speed[str(min(int(cell.vut_speed), fastest))]
            rows.append([starts.get(colour, np.inf) for colour in COLOURS])
        return np.array(rows)

    @cached_property
    def nominal_numbers(self) -> list[int]:
        """For every cell the index of the matrix cell that it varies; of a matrix cell its own."""
        return [
            self.matrix_cell_numbers[cell.matrix.name, cell.row, cell.column] for cell in self.cells
        ]

    @property
    def required_cells(self) -> list[int]:
        """Indices of the cells of which each must be green, as otherwise all frontal collisions
        score nothing: `REQUIRED`.
        """
        return [
            number
            for number in self.numbers_of("CCRs", STANDARD)
            if self.cells[number].vut_speed <= 20
        ]

    @property
    def unchecked_cells(self) -> list[int]:
        """Indices of the cells that the calculator also intends to require, `UNCHECKED`; version
        5.4.9 does not find them.
        """
        numbers = self.numbers_of("CPNA", STANDARD)
        return [
            n
            for n in numbers
            if self.cells[n].vut_speed <= 10 and self.cells[n].impact_location == 75
        ]

    @cached_property
    def matrix_cell_numbers(self) -> dict[tuple[str, int, int], int]:
        """Indices in `cells` of the cells of the matrices, by matrix name, row and column."""
        return {
            (cell.matrix.name, cell.row, cell.column): number
            for number, cell in enumerate(self.cells)
            if not cell.is_robustness_cell
        }

    @property
    def tests(self) -> dict[str, list[CellMatrix]]:
        """The matrices of every simulated test: one, or two if the test is driven by day and by
        night.
        """
        tests: dict[str, list[CellMatrix]] = {}
        for matrix in self.matrices:
            tests.setdefault(matrix.test_name, []).append(matrix)
        return tests

    def layers_of(self, test: str) -> list[Layer]:
        return [layer for layer in self.layers if layer.test_name == test]

    @property
    def points_not_simulated(self) -> NamedValues:
        """Points of tests that this package cannot simulate, by test."""
        return {
            test: sum(points)
            for test, points in self.points_by_test.items()
            if test not in self.tests
        }

    def _iterate_matrix_cells(self) -> Iterator[Cell]:
        for matrix in self.matrices:
            for row_number, row in enumerate(matrix.rows):
                for column, letter in enumerate(row.range_letters):
                    if letter != "-":
                        yield Cell(
                            matrix,
                            row_number,
                            column,
                            range_or_layer=STANDARD if letter == "S" else EXTENDED,
                            condition="",
                            criterion="",
                            judged_by=WARNING
                            if matrix.is_rated_by_warning(row_number)
                            else matrix.measure,
                            target_speed=matrix.target_speeds[column]
                            if row.target_speed is None
                            else row.target_speed,
                        )

    def _iterate_robustness_cells(self) -> Iterator[Cell]:
        standard_cells = [
            cell for cell in self._iterate_matrix_cells() if cell.range_or_layer == STANDARD
        ]
        for layer in self.layers:
            for condition in layer.simulated_conditions:
                speed_increase = _leading_number(condition.text) if layer.name == SPEED else 0.0
                for cell in standard_cells:
                    if cell.matrix.test_name == layer.test_name:
                        yield cell._replace(
                            range_or_layer=layer.name,
                            condition=condition.text,
                            criterion=condition.criterion,
                            target_speed=cell.target_speed + speed_increase,
                        )


@lru_cache
def protocol_of(name: str) -> Protocol:
    """A protocol by its name."""
    return msgspec.convert(shipped_table(f"protocol/{name}.toml"), Protocol)
