"""The cells of a rating, with their scenario parameters: all matrices of the protocol and all robustness layers that can be simulated."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from msgspec import Struct

EURO_NCAP_2026 = "euro_ncap_2026"
PROTOCOLS = (EURO_NCAP_2026,)
STANDARD, EXTENDED = "standard", "extended"
NOT_RED, NO_WORSE = "Not red", "Same or better than predicted"
MITIGATION, AVOIDANCE, WARNING = "mitigation", "avoidance", "warning"
NIGHT = "Illumination (Night)"
SPEED, ACCELERATION, OFFSET, HEADING = "Speed", "Acceleration", "Initial position offset", "Trajectory/Heading"
IN_DARKNESS = "Performance in darkness (1 lux)"
WARNING_TESTS = ("CPLA", "CBLA")
"""Tests in which a row with a choice of AEB or FCW is rated by the warning; in other tests the calculator always rates the impact."""
MODELS = {"CCR": "car_to_car", "CMR": "car_to_car", "CPLA": "along", "CBLA": "along"}
"""Scenario models by the prefix of a test's name; the model of all other tests is `crossing`."""
TARGET_DECELERATION, TARGET_HEADWAY = 4.0, 1.0
"""The target's deceleration [m/s^2] and its headway at the start [s] in CCRb and CMRb; robustness layers vary both."""


class CellRow(Struct, frozen=True, forbid_unknown_fields=True):
    """A row of a matrix: speeds of vehicle and target [km/h], and a letter per column: S (standard), E (extended) or - (no cell)."""

    vut: float
    ranges: str
    target: float | None = None
    choice: bool = False


class Block(Struct, frozen=True, forbid_unknown_fields=True):
    """A matrix of a test; a test that is driven by day and by night has one matrix for each `light`.

    `sheet`, `label`, `first` and `function` locate the matrix in the official template: sheet, name, first cell, column of functions.
    """

    test: str
    criterion: Literal["mitigation", "avoidance"]
    sheet: str
    label: str
    first: str
    points: tuple[float, float, float]
    rows: tuple[CellRow, ...]
    light: Literal["day", "night"] | None = None
    function: str = ""
    impact_locations: tuple[float, ...] = ()
    target_speeds: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        return self.test if self.light is None else f"{self.test} {self.light}"

    def is_warning(self, row: int) -> bool:
        """Whether a row is rated by the time to collision at the warning."""
        return self.rows[row].choice and self.test in WARNING_TESTS


class Condition(Struct, frozen=True, forbid_unknown_fields=True):
    """A variation of a robustness layer in the calculator's words, and the criterion that must hold."""

    condition: str
    criterion: str


class Layer(Struct, frozen=True, forbid_unknown_fields=True):
    """A robustness layer that counts for a test, and the cell of the official template that claims it."""

    test: str
    layer: str
    sheet: str
    cell: str
    conditions: tuple[Condition, ...]

    @property
    def simulated_conditions(self) -> tuple[Condition, ...]:
        """The layer's variations if they can be simulated; the calculator lists none for CBLA by night, which is rated like other tests."""
        if self.layer == NIGHT:
            return self.conditions or (Condition(IN_DARKNESS, NOT_RED),)
        return self.conditions if self.layer in (SPEED, ACCELERATION, OFFSET, HEADING) else ()


class CellScenario(NamedTuple):
    """The simulation of a cell: scenario model, parameters, and whether it is by night."""

    model: str
    parameters: dict[str, Any]
    night: bool


class Cell(NamedTuple):
    """One simulation of a rating.

    Attributes
    ----------
    block, row, column
        The cell's position in the matrices.
    range
        `standard`, `extended`, or the name of the robustness layer that the cell belongs to.
    condition, criterion
        The layer's variation in the calculator's words, and the criterion that must hold; "" for a cell of a matrix.
    judged
        Measure that determines the cell's colour: `mitigation`, `avoidance` or `warning`.
    target
        Speed of the target [km/h].
    """

    block: Block
    row: int
    column: int
    range: str
    condition: str
    criterion: str
    judged: str
    target: float

    @property
    def vut(self) -> float:
        """Speed of the vehicle under test [km/h]."""
        return self.block.rows[self.row].vut

    @property
    def location(self) -> float | None:
        """Impact location [% of the width]; None in a matrix whose columns are target speeds."""
        return self.block.impact_locations[self.column] if self.block.impact_locations else None

    @property
    def is_varied(self) -> bool:
        return bool(self.condition)

    @property
    def name(self) -> str:
        """The cell in words, such as `CPNA night, 40 km/h, 75 %, Speed +3 km/h`."""
        column = f"target {self.block.target_speeds[self.column]:g} km/h" if self.location is None else f"{self.location:g} %"
        choice = " FCW" if self.judged == WARNING else ""
        variation = f", {self.range} {self.condition}" if self.is_varied else ""
        return f"{self.block.name}, {self.vut:g} km/h{choice}, {column}{variation}"

    @property
    def scenario(self) -> CellScenario:
        test = self.block.test
        model = next((model for prefix, model in MODELS.items() if test.startswith(prefix)), "crossing")
        parameters: dict[str, Any] = {"test": test, "speed": self.vut, "target_speed": self.target}
        if self.location is not None:
            parameters["impact_location"] = self.location
        night = self.block.light == "night" or self.range == NIGHT
        if self.range == ACCELERATION:
            parameters["target_deceleration"] = TARGET_DECELERATION - _leading_number(self.condition)
        elif self.range == OFFSET and "headway" in self.condition:
            parameters["headway"] = TARGET_HEADWAY + _leading_number(self.condition)
        elif self.range == OFFSET:
            parameters["start_share"] = 1 + _leading_number(self.condition) / 100
        elif self.range == HEADING:
            parameters["heading"] = _leading_number(self.condition)
        return CellScenario(model, parameters, night)


def _leading_number(condition: str) -> float:
    """The number at the beginning of a condition."""
    match = re.match(r"\s*([+-]?[\d.]+)", condition)
    assert match is not None, condition
    return float(match[1])


class Protocol(Struct, frozen=True, eq=False, forbid_unknown_fields=True, dict=True):
    """A protocol; `mitigation` and `criteria` hold the value at which each colour begins, `scenarios` the points of every test."""

    calculator: str
    colours: dict[str, str]
    mitigation: dict[str, dict[str, float]]
    criteria: dict[str, dict[str, float]]
    scenarios: dict[str, tuple[float, float, float]]
    blocks: tuple[Block, ...]
    layers: tuple[Layer, ...]

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All simulations: the cells of the matrices, then the cells of the layers, which vary the standard range only."""
        return (*self._matrix_cells(), *self._layer_cells())

    @cached_property
    def matrix_cell_numbers(self) -> dict[tuple[str, int, int], int]:
        """Indices in `cells` of the cells of the matrices, by block name, row and column."""
        return {(cell.block.name, cell.row, cell.column): number for number, cell in enumerate(self.cells) if not cell.is_varied}

    @property
    def tests(self) -> dict[str, list[Block]]:
        """The blocks of every simulated test: one, or two if the test is driven by day and by night."""
        tests: dict[str, list[Block]] = {}
        for block in self.blocks:
            tests.setdefault(block.test, []).append(block)
        return tests

    def layers_of(self, test: str) -> list[Layer]:
        return [layer for layer in self.layers if layer.test == test]

    @property
    def points_not_simulated(self) -> dict[str, float]:
        """Points of tests that cannot be simulated here, by test."""
        return {test: sum(points) for test, points in self.scenarios.items() if test not in self.tests}

    def _matrix_cells(self) -> Iterator[Cell]:
        for block in self.blocks:
            for row, cell_row in enumerate(block.rows):
                for column, letter in enumerate(cell_row.ranges):
                    if letter != "-":
                        yield Cell(block, row, column, STANDARD if letter == "S" else EXTENDED, "", "",
                                   WARNING if block.is_warning(row) else block.criterion,
                                   block.target_speeds[column] if cell_row.target is None else cell_row.target)

    def _layer_cells(self) -> Iterator[Cell]:
        standard_cells = [cell for cell in self._matrix_cells() if cell.range == STANDARD]
        for layer in self.layers:
            for condition in layer.simulated_conditions:
                speed_increase = _leading_number(condition.condition) if layer.layer == SPEED else 0.0
                for cell in standard_cells:
                    if cell.block.test == layer.test:
                        yield cell._replace(range=layer.layer, condition=condition.condition, criterion=condition.criterion,
                                            target=cell.target + speed_increase)


def cells_of_part(protocol: Protocol, part: int, parts: int) -> list[int]:
    """Numbers of the cells in part `part` of `parts`, counted from 0; cells with the same network share a part as far as possible."""
    def network_of(number: int) -> tuple[Any, ...]:
        cell = protocol.cells[number]
        variation = (cell.scenario.parameters.get("heading", 0.0), "start_share" in cell.scenario.parameters)
        return cell.scenario.model, cell.block.test in ("CPNA", "CPFA", "CPNCO"), variation, cell.block.test

    numbers = sorted(range(len(protocol.cells)), key=network_of)
    return numbers[len(numbers) * part // parts:len(numbers) * (part + 1) // parts]


@lru_cache
def protocol_of(name: str) -> Protocol:
    """A protocol by its name, one of `PROTOCOLS`."""
    tables: Mapping[str, Any] = tomllib.loads(Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8"))
    return msgspec.convert(tables, Protocol)
