"""Colours of cells and points of tests, by the rules of Euro NCAP's calculator, for many vehicles at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.protocol.cells import EXTENDED, NO_WORSE, NOT_RED, STANDARD, WARNING, Block, Layer, Protocol
from safevar_sumo.records import BoolArray, CellResults, FloatArray

COLOURS = ("green", "yellow", "orange", "brown", "red")
"""Colours from best to worst; arrays hold their indices."""
GREEN, RED = 0, len(COLOURS) - 1
UNKNOWN = -1
"""Colour of a cell whose test is invalid; it earns nothing."""
WEIGHTS = np.array([1.0, 0.75, 0.5, 0.25, 0.0, 0.0])
"""Worth of a cell of the standard range by colour; the last value is for an unknown colour (protocol 5.2)."""
STEPS = ((1.0, 1.0), (0.75, 0.75), (0.5, 0.5))
"""Minimum shares of cells of the extended range that are not red, and the shares of its points that they earn; fewer earn none."""
HALF = 0.5
"""Share of the standard range's points that is needed for robustness to count."""
DECIMALS = 2
"""Decimals to which the calculator rounds measured values, half up."""
SHARE_DECIMALS = 6
"""Decimals to which the calculator rounds shares before it compares them."""
REQUIRED = ("CCRs", 20.0)
"""Unless the cells of this test up to this speed [km/h] in the standard range are green, all frontal collisions score nothing.

The calculator is meant to require CPNA at 10 km/h and 75 % as well, but version 5.4.9 does not find those cells.
"""


@dataclass(frozen=True, kw_only=True)
class Points:
    """Points of M vehicles.

    Attributes
    ----------
    colours
        Numbers of `COLOURS`, shape (M, cells).
    tests
        By block name: points of the standard range, the extended range and robustness, shape (M, 3).
    layers
        By test and layer: whether the layer holds, shape (M,); simulated layers only.
    fails
        Whether a required cell is not green, so that the vehicle earns nothing, shape (M,).
    """

    colours: npt.NDArray[np.int8]
    tests: Mapping[str, FloatArray]
    layers: Mapping[tuple[str, str], BoolArray]
    fails: BoolArray

    @property
    def total(self) -> FloatArray:
        """All points, shape (M,)."""
        total = np.zeros(len(self.fails))
        for points in self.tests.values():
            for kind in range(3):
                total = total + points[:, kind]
        return np.where(self.fails, 0.0, np.round(total, SHARE_DECIMALS))


def half_up(values: FloatArray, decimals: int) -> FloatArray:
    """Values rounded, halves upwards."""
    scale = 10.0**decimals
    return np.asarray(np.floor(np.round(values * scale, 4) + 0.5) / scale)


class _Columns(NamedTuple):
    """Cells by the rules that apply to them, as column numbers."""

    bands: Sequence[tuple[npt.NDArray[np.intp], Sequence[tuple[int, float]], bool]]
    nominal: npt.NDArray[np.intp]
    ranges: dict[tuple[str, str], npt.NDArray[np.intp]]
    varied: list[tuple[Layer, str, npt.NDArray[np.intp]]]
    required: npt.NDArray[np.intp]


@lru_cache
def _columns(protocol: Protocol) -> _Columns:
    cells = protocol.cells
    kinds: dict[tuple[str, str], list[int]] = {}
    for number, cell in enumerate(cells):
        slowest = str(int(min(cell.vut, max(float(speed) for speed in protocol.mitigation))))
        kinds.setdefault((cell.judged, slowest if cell.judged == "mitigation" else ""), []).append(number)
    bands = []
    for (judged, speed), numbers in kinds.items():
        starts = protocol.mitigation[speed] if speed else protocol.criteria[judged]
        bands.append((np.array(numbers), [(COLOURS.index(name), start) for name, start in starts.items()], judged == WARNING))

    def numbers_of(condition: object) -> npt.NDArray[np.intp]:
        return np.array([number for number, cell in enumerate(cells) if condition(cell)], dtype=np.intp)  # type: ignore[operator]

    ranges = {(block.name, kind): numbers_of(lambda cell, b=block, k=kind: cell.block is b and cell.range == k)
              for block in protocol.blocks for kind in (STANDARD, EXTENDED)}
    varied = [(layer, condition.criterion, numbers_of(lambda cell, varied_by=layer, c=condition: cell.block.test == varied_by.test
                                                      and cell.range == varied_by.layer and cell.condition == c.condition))
              for layer in protocol.layers for condition in layer.simulated]
    nominal = np.array([protocol.matrix_of[cell.block.name, cell.row, cell.column] for cell in cells])
    required = numbers_of(lambda cell: cell.block.test == REQUIRED[0] and cell.range == STANDARD and cell.vut <= REQUIRED[1])
    return _Columns(bands, nominal, ranges, varied, required)


def colours_of(protocol: Protocol, results: CellResults) -> npt.NDArray[np.int8]:
    """The colour of every cell, shape (M, cells): a value at a bound has the worse colour for an impact, the better for a warning."""
    colours = np.full(results.impact.shape, UNKNOWN, dtype=np.int8)
    impact = half_up(np.maximum(np.nan_to_num(results.impact, nan=0.0), 0.0), DECIMALS)
    warning = half_up(np.nan_to_num(results.warning, nan=-1.0), DECIMALS)
    for numbers, starts, is_warning in _columns(protocol).bands:
        values = (warning if is_warning else impact)[:, numbers]
        band_colours = np.full(values.shape, starts[0][0], dtype=np.int8)
        for colour, start in starts[1:]:
            band_colours = np.where(values >= start, np.int8(colour), band_colours)
        colours[:, numbers] = band_colours
    return np.where(results.valid, colours, np.int8(UNKNOWN))


def points_of(protocol: Protocol, results: CellResults, claims: Mapping[str, Sequence[str]] | None = None) -> Points:
    """Points of vehicles; `claims` are layers by test that are not simulated and that count as if they held."""
    colours, columns = colours_of(protocol, results), _columns(protocol)
    layers = _layers(protocol, colours)
    fails = (colours[:, columns.required] != GREEN).any(axis=1)
    tests = {}
    for test, blocks in protocol.tests.items():
        shares = _robust_share(protocol, test, layers, (claims or {}).get(test, ()), len(colours))
        for block in blocks:
            points = np.stack([*_ranges(block, colours, columns), shares * block.points[2]], axis=1)
            points[:, 2] = np.where(_rounded(points[:, 0]) >= _rounded(HALF * block.points[0]), points[:, 2], 0.0)
            tests[block.name] = np.where(fails[:, np.newaxis], 0.0, points)
    return Points(colours=colours, tests=tests, layers=layers, fails=fails)


def _ranges(block: Block, colours: npt.NDArray[np.int8], columns: _Columns) -> tuple[FloatArray, FloatArray]:
    """Points of the standard and of the extended range, shape (M,) each."""
    weights = WEIGHTS[colours[:, columns.ranges[block.name, STANDARD]]]
    total = np.zeros(len(colours))
    for column in range(weights.shape[1]):  # column by column: numpy's own sum groups by the shape
        total = total + weights[:, column]
    extended = colours[:, columns.ranges[block.name, EXTENDED]]
    share = np.count_nonzero((extended != RED) & (extended != UNKNOWN), axis=1) / extended.shape[1]
    reached = _rounded(share * block.points[1])
    earned = np.zeros(len(colours))
    for needed, worth in reversed(STEPS):
        earned = np.where(reached >= _rounded(np.array(needed * block.points[1])), worth * block.points[1], earned)
    return total / weights.shape[1] * block.points[0], earned


def _layers(protocol: Protocol, colours: npt.NDArray[np.int8]) -> dict[tuple[str, str], BoolArray]:
    """Whether simulated layers hold: in every variation of all cells of the standard range that are not red; there must be such cells."""
    columns = _columns(protocol)
    holds: dict[tuple[str, str], BoolArray] = {}
    for layer, criterion, numbers in columns.varied:
        varied, nominal = colours[:, numbers], colours[:, columns.nominal[numbers]]
        counts = (nominal != RED) & (nominal != UNKNOWN)
        assert criterion in (NOT_RED, NO_WORSE)
        passes = (varied != UNKNOWN) & ((varied != RED) if criterion == NOT_RED else (varied <= nominal))
        holds_now = (passes | ~counts).all(axis=1) & counts.any(axis=1)
        key = (layer.test, layer.layer)
        holds[key] = holds_now & holds[key] if key in holds else holds_now
    return holds


def _robust_share(protocol: Protocol, test: str, layers: Mapping[tuple[str, str], BoolArray], claimed: Sequence[str], n: int) -> FloatArray:
    """Share of a test's layers that hold or are claimed, shape (M,)."""
    of_test, number = protocol.layers_of(test), np.zeros(n)
    for layer in of_test:
        number = number + layers.get((test, layer.layer), np.full(n, layer.layer in claimed))
    return np.asarray(number / len(of_test))


def _rounded(values: FloatArray | float) -> FloatArray:
    return half_up(np.asarray(values), SHARE_DECIMALS)
