"""The cells of a rating: every matrix of the protocol, and every robustness layer that a simulation can vary, as scenario parameters."""

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
WARNED = ("CPLA", "CBLA")
"""Tests whose rows with a choice of AEB or FCW are rated by the warning; elsewhere the calculator rates the impact either way."""
MODELS = {"CCR": "car_to_car", "CMR": "car_to_car", "CPLA": "along", "CBLA": "along"}
"""Scenario models by how a test's name begins; all others cross the way."""
BRAKING, HEADWAY_AT_START = 4.0, 1.0
"""Of the target in CCRb and CMRb, which the layers vary [m/s^2, s]."""


class Row(Struct, frozen=True, forbid_unknown_fields=True):
    """A row of a matrix: speeds [km/h], and for every column S (standard), E (extended) or - (no cell)."""

    vut: float
    ranges: str
    target: float | None = None
    choice: bool = False


class Block(Struct, frozen=True, forbid_unknown_fields=True):
    """A matrix: of a test, in one light where it is tested by day and by night.

    `sheet`, `label`, `first` and `function` are where the official template has it: its name, its first cell, its column of functions.
    """

    test: str
    criterion: Literal["mitigation", "avoidance"]
    sheet: str
    label: str
    first: str
    points: tuple[float, float, float]
    rows: tuple[Row, ...]
    light: Literal["day", "night"] | None = None
    function: str = ""
    impact_locations: tuple[float, ...] = ()
    target_speeds: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        return self.test if self.light is None else f"{self.test} {self.light}"

    def is_warning(self, row: int) -> bool:
        """Whether a row is rated by the time to collision at the warning."""
        return self.rows[row].choice and self.test in WARNED


class Condition(Struct, frozen=True, forbid_unknown_fields=True):
    """A variation of a robustness layer as the calculator words it, and what must hold."""

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
    def simulated(self) -> tuple[Condition, ...]:
        """Its variations, if a simulation can make them; the calculator has no words for CBLA by night, which is judged as the others."""
        if self.layer == NIGHT:
            return self.conditions or (Condition(IN_DARKNESS, NOT_RED),)
        return self.conditions if self.layer in (SPEED, ACCELERATION, OFFSET, HEADING) else ()


class CellScenario(NamedTuple):
    """What is simulated for a cell: a scenario model, its parameters, and whether by night."""

    model: str
    parameters: dict[str, Any]
    night: bool


class Cell(NamedTuple):
    """One simulation of a rating.

    Attributes
    ----------
    block, row, column
        Its place in the matrices.
    range
        `standard`, `extended`, or the robustness layer that it varies.
    condition, criterion
        The variation in the calculator's words and what must hold; "" in the matrices themselves.
    judged
        What gives the colour: `mitigation`, `avoidance` or `warning`.
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
        """Impact location [% of the width]; None in a matrix over the target's speed."""
        return self.block.impact_locations[self.column] if self.block.impact_locations else None

    @property
    def is_varied(self) -> bool:
        return bool(self.condition)

    @property
    def name(self) -> str:
        """In words, such as `CPNA night, 40 km/h, 75 %, Speed +3 km/h`."""
        what = f"target {self.block.target_speeds[self.column]:g} km/h" if self.location is None else f"{self.location:g} %"
        choice = " FCW" if self.judged == WARNING else ""
        varied = f", {self.range} {self.condition}" if self.is_varied else ""
        return f"{self.block.name}, {self.vut:g} km/h{choice}, {what}{varied}"

    @property
    def scene(self) -> CellScenario:
        test = self.block.test
        model = next((model for begin, model in MODELS.items() if test.startswith(begin)), "crossing")
        parameters: dict[str, Any] = {"test": test, "speed": self.vut, "target_speed": self.target}
        if self.location is not None:
            parameters["impact_location"] = self.location
        night = self.block.light == "night" or self.range == NIGHT
        if self.range == ACCELERATION:
            parameters["target_deceleration"] = BRAKING - _number(self.condition)
        elif self.range == OFFSET and "headway" in self.condition:
            parameters["headway"] = HEADWAY_AT_START + _number(self.condition)
        elif self.range == OFFSET:
            parameters["start_share"] = 1 + _number(self.condition) / 100
        elif self.range == HEADING:
            parameters["heading"] = _number(self.condition)
        return CellScenario(model, parameters, night)


def _number(condition: str) -> float:
    """The number that a condition begins with."""
    found = re.match(r"\s*([+-]?[\d.]+)", condition)
    assert found is not None, condition
    return float(found[1])


class Protocol(Struct, frozen=True, eq=False, forbid_unknown_fields=True, dict=True):
    """A protocol: `mitigation` and `criteria` say from which value on a cell has a colour, `scenarios` what every test can earn."""

    calculator: str
    colours: dict[str, str]
    mitigation: dict[str, dict[str, float]]
    criteria: dict[str, dict[str, float]]
    scenarios: dict[str, tuple[float, float, float]]
    blocks: tuple[Block, ...]
    layers: tuple[Layer, ...]

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Every simulation: the matrices' cells first, then those of the layers, of the standard range alone."""
        return (*self._matrices(), *self._varied())

    @cached_property
    def matrix_of(self) -> dict[tuple[str, int, int], int]:
        """Numbers of the matrices' own cells by name of the block, row and column."""
        return {(cell.block.name, cell.row, cell.column): number for number, cell in enumerate(self.cells) if not cell.is_varied}

    @property
    def tests(self) -> dict[str, list[Block]]:
        """The simulated tests, each by day and by night where it is tested in both."""
        tests: dict[str, list[Block]] = {}
        for block in self.blocks:
            tests.setdefault(block.test, []).append(block)
        return tests

    def layers_of(self, test: str) -> list[Layer]:
        return [layer for layer in self.layers if layer.test == test]

    @property
    def not_simulated(self) -> dict[str, float]:
        """Points of the tests that no simulation here can make, by test."""
        return {test: sum(points) for test, points in self.scenarios.items() if test not in self.tests}

    def _matrices(self) -> Iterator[Cell]:
        for block in self.blocks:
            for row, line in enumerate(block.rows):
                for column, letter in enumerate(line.ranges):
                    if letter != "-":
                        yield Cell(block, row, column, STANDARD if letter == "S" else EXTENDED, "", "",
                                   WARNING if block.is_warning(row) else block.criterion,
                                   block.target_speeds[column] if line.target is None else line.target)

    def _varied(self) -> Iterator[Cell]:
        standard = [cell for cell in self._matrices() if cell.range == STANDARD]
        for layer in self.layers:
            for condition in layer.simulated:
                faster = _number(condition.condition) if layer.layer == SPEED else 0.0
                for cell in standard:
                    if cell.block.test == layer.test:
                        yield cell._replace(range=layer.layer, condition=condition.condition, criterion=condition.criterion,
                                            target=cell.target + faster)


def part_of(protocol: Protocol, part: int, parts: int) -> list[int]:
    """Numbers of the cells in one of several parts, of 0 to `parts` - 1; cells on one network are in one part as far as possible."""
    def network(number: int) -> tuple[Any, ...]:
        cell = protocol.cells[number]
        varied = (cell.scene.parameters.get("heading", 0.0), "start_share" in cell.scene.parameters)
        return cell.scene.model, cell.block.test in ("CPNA", "CPFA", "CPNCO"), varied, cell.block.test

    ordered = sorted(range(len(protocol.cells)), key=network)
    return ordered[len(ordered) * part // parts:len(ordered) * (part + 1) // parts]


@lru_cache
def protocol_of(name: str) -> Protocol:
    """A protocol by its name, one of `PROTOCOLS`."""
    tables: Mapping[str, Any] = tomllib.loads(Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8"))
    return msgspec.convert(tables, Protocol)
