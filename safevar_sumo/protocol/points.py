"""Colours of cells and points of tests, by the rules of Euro NCAP's calculator, for M vehicles at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.protocol.cells import (
    EXTENDED,
    MITIGATION,
    NO_WORSE,
    NOT_RED,
    STANDARD,
    WARNING,
    CellMatrix,
    Layer,
    Protocol,
)
from safevar_sumo.records import BoolArray, CellResults, FloatArray

COLOURS = ("green", "yellow", "orange", "brown", "red")
"""Colours from best to worst; arrays hold indices of this tuple."""
GREEN, RED = 0, len(COLOURS) - 1
UNKNOWN = -1
"""Colour of a cell whose test is invalid; it earns nothing."""
WEIGHTS = np.array([1.0, 0.75, 0.5, 0.25, 0.0, 0.0])
"""Weight of a standard-range cell by its colour's index (protocol 5.2); UNKNOWN is -1 and so takes the last one."""
EXTENDED_STEPS = ((1.0, 1.0), (0.75, 0.75), (0.5, 0.5))
"""Minimum share of extended-range cells that are not red, and the share of the range's points earned from it on; below
0.5, none.
"""
ROBUSTNESS_SHARE = 0.5
"""Share of the standard range's points from which on robustness earns points."""
DECIMALS = 2
"""Decimals to which the calculator rounds measured values, half up."""
SHARE_DECIMALS = 6
"""Decimals to which the calculator rounds shares before a comparison."""


class RequiredCells(NamedTuple):
    """Standard-range cells that must be green: of a test up to a speed [km/h], at one impact location [%] or, if it is
    None, at all.
    """

    test_name: str
    max_speed: float
    impact_location: float | None = None

    def numbers(self, protocol: Protocol) -> list[int]:
        """Numbers of these cells."""
        return [
            number
            for number, cell in enumerate(protocol.cells)
            if cell.matrix.test_name == self.test_name
            and cell.range_or_layer == STANDARD
            and cell.vut_speed <= self.max_speed
            and self.impact_location in (None, cell.impact_location)
        ]


REQUIRED_CELLS = RequiredCells("CCRs", 20.0)
"""If one of these cells is not green, all frontal collisions score nothing."""
UNCHECKED_CELLS = RequiredCells("CPNA", 10.0, 75.0)
"""Cells that the calculator also intends to require; version 5.4.9 does not find them."""


@dataclass(frozen=True, kw_only=True)
class Points:
    """Points of M vehicles.

    - `colours`: indices of `COLOURS`, shape (M, cells).
    - `tests`: by matrix name the points of the standard range, the extended range and robustness, shape (M, 3).
    - `layers`: by test and layer, for simulated layers only, whether the layer holds, shape (M,).
    - `fails`: whether a required cell is not green, so that the vehicle earns nothing, shape (M,).
    """

    colours: npt.NDArray[np.int8]
    tests: Mapping[str, FloatArray]
    layers: Mapping[tuple[str, str], BoolArray]
    fails: BoolArray

    @property
    def total(self) -> FloatArray:
        """Sum of all points, shape (M,)."""
        total = np.zeros(len(self.fails))
        for points in self.tests.values():
            for column in range(3):
                total = total + points[:, column]
        return np.where(self.fails, 0.0, np.round(total, SHARE_DECIMALS))


def round_half_up(values: FloatArray, decimals: int) -> FloatArray:
    """Round values to decimals; a half rounds up."""
    scale = 10.0**decimals
    return np.asarray(np.floor(np.round(values * scale, 4) + 0.5) / scale)


class _Columns(NamedTuple):
    """Columns of the arrays of cells, grouped by the rules that apply to the cells.

    - `bands`: columns whose colours begin at the same values, with each colour's index and start, and whether the
      warning is rated.
    - `nominal_cells`: for every cell the matrix cell that it varies, or itself. `ranges`: by matrix name and range.
    """

    bands: Sequence[tuple[npt.NDArray[np.intp], Sequence[tuple[int, float]], bool]]
    nominal_cells: npt.NDArray[np.intp]
    ranges: dict[tuple[str, str], npt.NDArray[np.intp]]
    variations: list[tuple[Layer, str, npt.NDArray[np.intp]]]
    required_cells: npt.NDArray[np.intp]


@lru_cache
def _columns_of(protocol: Protocol) -> _Columns:
    cells = protocol.cells
    numbers_by_measure: dict[tuple[str, str], list[int]] = {}
    for number, cell in enumerate(cells):
        listed_speed = str(int(min(cell.vut_speed, max(float(speed) for speed in protocol.starts_by_vut_speed))))
        numbers_by_measure.setdefault(
            (cell.judged_by, listed_speed if cell.judged_by == MITIGATION else ""), []
        ).append(number)
    bands = []
    for (judged_by, speed), numbers in numbers_by_measure.items():
        starts = protocol.starts_by_vut_speed[speed] if speed else protocol.starts_by_measure[judged_by]
        bands.append(
            (np.array(numbers), [(COLOURS.index(name), start) for name, start in starts.items()], judged_by == WARNING)
        )

    def cells_where(condition: object) -> npt.NDArray[np.intp]:
        numbers = [number for number, cell in enumerate(cells) if condition(cell)]  # type: ignore[operator]
        return np.array(numbers, dtype=np.intp)

    ranges = {
        (matrix.name, name): cells_where(lambda cell, b=matrix, n=name: cell.matrix is b and cell.range_or_layer == n)
        for matrix in protocol.matrices
        for name in (STANDARD, EXTENDED)
    }
    variations = [
        (
            layer,
            condition.criterion,
            cells_where(
                lambda cell, key=(layer.test_name, layer.name, condition.text): (
                    (cell.matrix.test_name, cell.range_or_layer, cell.condition) == key
                )
            ),
        )
        for layer in protocol.layers
        for condition in layer.simulated_conditions
    ]
    nominal_cells = np.array([protocol.matrix_cell_numbers[cell.matrix.name, cell.row, cell.column] for cell in cells])
    return _Columns(bands, nominal_cells, ranges, variations, np.array(REQUIRED_CELLS.numbers(protocol), dtype=np.intp))


def colours_of(protocol: Protocol, results: CellResults) -> npt.NDArray[np.int8]:
    """The colour of every cell, shape (M, cells); a value at which two colours meet makes an impact the worse one, a
    warning the better.
    """
    colours = np.full(results.impact.shape, UNKNOWN, dtype=np.int8)
    impact = round_half_up(np.maximum(np.nan_to_num(results.impact, nan=0.0), 0.0), DECIMALS)
    warning = round_half_up(np.nan_to_num(results.warning, nan=-1.0), DECIMALS)
    for numbers, starts, is_warning in _columns_of(protocol).bands:
        values = (warning if is_warning else impact)[:, numbers]
        band_colours = np.full(values.shape, starts[0][0], dtype=np.int8)
        for colour, start in starts[1:]:
            band_colours = np.where(values >= start, np.int8(colour), band_colours)
        colours[:, numbers] = band_colours
    return np.where(results.valid, colours, np.int8(UNKNOWN))


def points_of(protocol: Protocol, results: CellResults, claims: Mapping[str, Sequence[str]] | None = None) -> Points:
    """Points of M vehicles; `claims` lists, for each test, layers that are not simulated and count as if they held."""
    colours, columns = colours_of(protocol, results), _columns_of(protocol)
    layers = _which_layers_hold(protocol, colours)
    fails = (colours[:, columns.required_cells] != GREEN).any(axis=1)
    tests = {}
    for test, matrices in protocol.tests.items():
        shares = _layer_share(protocol, test, layers, claimed=(claims or {}).get(test, ()), m=len(colours))
        for matrix in matrices:
            points = np.stack([*_range_points(matrix, colours, columns), shares * matrix.points[2]], axis=1)
            points[:, 2] = np.where(
                _rounded_share(points[:, 0]) >= _rounded_share(ROBUSTNESS_SHARE * matrix.points[0]), points[:, 2], 0.0
            )
            tests[matrix.name] = np.where(fails[:, np.newaxis], 0.0, points)
    return Points(colours=colours, tests=tests, layers=layers, fails=fails)


def _range_points(
    matrix: CellMatrix, colours: npt.NDArray[np.int8], columns: _Columns
) -> tuple[FloatArray, FloatArray]:
    """Points of the standard range and of the extended range, shape (M,) each."""
    weights = WEIGHTS[colours[:, columns.ranges[matrix.name, STANDARD]]]
    total = np.zeros(len(colours))
    for column in range(weights.shape[1]):  # column by column: the order of numpy's own sum depends on the shape
        total = total + weights[:, column]
    extended = colours[:, columns.ranges[matrix.name, EXTENDED]]
    share = np.count_nonzero((extended != RED) & (extended != UNKNOWN), axis=1) / extended.shape[1]
    share_points = _rounded_share(share * matrix.points[1])
    earned_points = np.zeros(len(colours))
    for minimum, earned_share in reversed(EXTENDED_STEPS):
        earned_points = np.where(
            share_points >= _rounded_share(np.array(minimum * matrix.points[1])),
            earned_share * matrix.points[1],
            earned_points,
        )
    return total / weights.shape[1] * matrix.points[0], earned_points


def _which_layers_hold(protocol: Protocol, colours: npt.NDArray[np.int8]) -> dict[tuple[str, str], BoolArray]:
    """Whether simulated layers hold, shape (M,) each: some standard-range cell is not red, and every such cell passes
    in all variations.
    """
    columns = _columns_of(protocol)
    holds: dict[tuple[str, str], BoolArray] = {}
    for layer, criterion, numbers in columns.variations:
        varied, nominal = colours[:, numbers], colours[:, columns.nominal_cells[numbers]]
        is_counted = (nominal != RED) & (nominal != UNKNOWN)
        assert criterion in (NOT_RED, NO_WORSE)
        passes = (varied != UNKNOWN) & ((varied != RED) if criterion == NOT_RED else (varied <= nominal))
        condition_holds = (passes | ~is_counted).all(axis=1) & is_counted.any(axis=1)
        key = (layer.test_name, layer.name)
        holds[key] = condition_holds & holds[key] if key in holds else condition_holds
    return holds


def _layer_share(
    protocol: Protocol, test: str, layers: Mapping[tuple[str, str], BoolArray], claimed: Sequence[str], m: int
) -> FloatArray:
    """Share of a test's layers that hold or are claimed, for M = `m` vehicles; shape (M,)."""
    test_layers, count = protocol.layers_of(test), np.zeros(m)
    for layer in test_layers:
        count = count + layers.get((test, layer.name), np.full(m, layer.name in claimed))
    return np.asarray(count / len(test_layers))


def _rounded_share(values: FloatArray | float) -> FloatArray:
    return round_half_up(np.asarray(values), SHARE_DECIMALS)
