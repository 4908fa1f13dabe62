"""Rates simulated vehicles: the tests of a protocol's cells, the colours of cells and the points of
tests, by Euro NCAP's calculator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from safevar_sumo.errors import check_name
from safevar_sumo.protocol.cells import (
    COLOURS,
    EXTENDED,
    NOT_RED,
    STANDARD,
    WARNING,
    CellMatrix,
    Protocol,
    protocol_of,
)
from safevar_sumo.records import (
    KMH_PER_MS,
    BoolArray,
    CellResults,
    FloatArray,
    Outcome,
    SimulationRuns,
)
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import MatrixTable, MatrixTest, Study, Weather

GREEN, RED = 0, len(COLOURS) - 1
UNKNOWN = -1
"""Colour of a cell whose test is invalid; it earns nothing."""
WEIGHTS = np.array([1.0, 0.75, 0.5, 0.25, 0.0, 0.0])
"""Weight of a standard-range cell by its colour's index (protocol 5.2); UNKNOWN is -1 and so takes
the last one.
"""
EXTENDED_STEPS = (0.5, 0.75, 1.0)
"""Share of extended-range cells that are not red, from which on this share of the range's points is
earned.
"""
ROBUSTNESS_SHARE = 0.5
"""Share of the standard range's points from which on robustness earns points."""
DECIMALS = 2
"""Decimals to which the calculator rounds measured values, half up."""
SHARE_DECIMALS = 6
"""Decimals to which the calculator rounds shares before a comparison."""
SHARED_PARAMETERS = ("vut_length", "vut_width", "grade")
"""Parameters of a study's scenario that apply to every cell."""


@dataclass(frozen=True, kw_only=True)
class Points:
    """Points of M vehicles.

    - `colours`: indices of `COLOURS`, shape (M, cells).
    - `tests`: by matrix name the points of the standard range, the extended range and robustness,
      shape (M, 3).
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
        points = np.concatenate([*self.tests.values()], axis=1)
        return np.where(self.fails, 0.0, np.round(sum(points.T), SHARE_DECIMALS))


@dataclass(frozen=True, kw_only=True)
class Rater:
    """Rates vehicles that were simulated in all cells of a protocol, in the order of the cells.

    `claims` lists, for each test, layers that are not simulated and count as if they held.
    """

    protocol: Protocol
    claims: Mapping[str, Sequence[str]]

    def points(self, results: CellResults) -> Points:
        """Points of M vehicles."""
        # A red cell that is required leaves nothing.
        protocol = self.protocol
        colours = colours_of(self.protocol, results)
        layers = _which_layers_hold(protocol, colours)
        fails = (colours[:, protocol.required_cells] != GREEN).any(axis=1)
        tests = {}

        # The share of robustness layers that hold, then points of each matrix.
        for test, matrices in protocol.tests.items():
            claimed = self.claims.get(test, ())
            test_layers = protocol.layers_of(test)
            held_count = sum(
                layers.get((test, layer.name), np.full(len(fails), layer.name in claimed))
                for layer in test_layers
            )
            for matrix in matrices:
                standard, extended = _range_points(protocol, matrix, colours)
                earns_robustness = _rounded_share(standard) >= _rounded_share(
                    ROBUSTNESS_SHARE * matrix.points[0]
                )
                robustness = np.where(
                    earns_robustness, held_count / len(test_layers) * matrix.points[2], 0.0
                )
                tests[matrix.name] = np.where(fails, 0.0, [standard, extended, robustness]).T
        return Points(colours=colours, tests=tests, layers=layers, fails=fails)


def round_half_up(values: FloatArray, decimals: int) -> FloatArray:
    """Round values to decimals; a half rounds up."""
    scale = 10.0**decimals
    return np.floor(np.round(values * scale, 4) + 0.5) / scale


def _rounded_share(values: FloatArray | float) -> FloatArray:
    return round_half_up(np.asarray(values), SHARE_DECIMALS)


def colours_of(protocol: Protocol, results: CellResults) -> npt.NDArray[np.int8]:
    """The colour of every cell, shape (M, cells); a value at which two colours meet makes an impact
    the worse one, a warning the better.
    """
    is_warning = [cell.judged_by == WARNING for cell in protocol.cells]
    measured = np.where(is_warning, results.warning, results.impact)
    values = round_half_up(np.maximum(np.nan_to_num(measured, nan=0.0), 0.0), DECIMALS)[
        ..., np.newaxis
    ]
    starts = np.where(values >= protocol.colour_starts, protocol.colour_starts, -np.inf)
    return np.where(results.valid, starts.argmax(axis=-1), UNKNOWN).astype(np.int8)


def _range_points(
    protocol: Protocol, matrix: CellMatrix, colours: npt.NDArray[np.int8]
) -> tuple[FloatArray, FloatArray]:
    """Points of the standard range and of the extended range, shape (M,) each."""
    standard, extended = (
        colours[:, protocol.numbers_of(matrix.test_name, name, matrix)]
        for name in (STANDARD, EXTENDED)
    )
    is_good = (extended != RED) & (extended != UNKNOWN)
    good_points = _rounded_share(is_good.mean(axis=1) * matrix.points[1])
    steps = np.array(EXTENDED_STEPS) * matrix.points[1]
    earned = np.append(0.0, steps)[
        np.searchsorted(_rounded_share(steps), good_points, side="right")
    ]
    return WEIGHTS[standard].mean(axis=1) * matrix.points[0], earned


def _which_layers_hold(
    protocol: Protocol, colours: npt.NDArray[np.int8]
) -> dict[tuple[str, str], BoolArray]:
    """Whether simulated layers hold, shape (M,) each: some standard-range cell is not red, and
    every such cell passes in all variations.
    """
    passes = passing_cells(protocol, colours)
    nominal = colours[:, protocol.nominal_numbers]
    is_counted = (nominal != RED) & (nominal != UNKNOWN)
    holds = {}
    for layer in protocol.layers:
        if layer.simulated_conditions:
            numbers = protocol.numbers_of(layer.test_name, layer.name)
            has_counted = is_counted[:, numbers].any(axis=1)
            holds[layer.test_name, layer.name] = has_counted & (passes | ~is_counted)[
                :, numbers
            ].all(axis=1)
    return holds


def passing_cells(protocol: Protocol, colours: npt.NDArray[np.int8]) -> BoolArray:
    """Whether robustness cells meet their criteria, shape (M, cells): not red, or the colour of the
    cell that they vary or a better one.
    """
    nominal = colours[:, protocol.nominal_numbers]
    only_not_red = [cell.criterion == NOT_RED for cell in protocol.cells]
    return np.asarray(
        (colours != UNKNOWN) & np.where(only_not_red, colours != RED, colours <= nominal)
    )


def rated_quantities(runs: SimulationRuns) -> CellResults:
    """The results of N simulations of one cell; shape (N,) each."""
    is_valid = (runs.outcome != Outcome.INVALID_TEST) & (runs.outcome != Outcome.SIMULATOR_ERROR)
    return CellResults(
        runs.relative_speed * KMH_PER_MS,
        np.broadcast_to(runs.warning_ttc, is_valid.shape),
        is_valid,
    )


def join_cells(quantities: Sequence[CellResults]) -> CellResults:
    """Join the `rated_quantities` of each cell to the results of all cells for M vehicles."""
    return CellResults(*(np.stack(values, axis=1) for values in zip(*quantities, strict=True)))


def rater_of(study: Study) -> Rater | None:
    """The rater of a study with a protocol's matrix; None for other studies.

    Raises
    ------
    InputError
        If a claim names an unknown test, or a layer that does not count for the test or is
        simulated.
    """
    if study.matrix is None or not study.is_rated:
        return None
    protocol = protocol_of(study.matrix.protocol)
    for test, claims in study.rating.claims.items():
        key = f"rating.claims.{test}"
        check_name(
            "", f"{key}: there is no such test, or it is not simulated", test, protocol.tests
        )
        legal = [layer.name for layer in protocol.layers_of(test) if not layer.simulated_conditions]
        for claim in claims:
            check_name(
                "", f"{key}: {claim!r} does not count for {test}, or is simulated", claim, legal
            )
    return Rater(protocol=protocol, claims=study.rating.claims)


def darken(weather: Weather) -> Weather:
    """The weather by night: the same road; darkness changes visibility and recognition delay."""
    if weather.light == "night":
        return weather
    night = weather_of("night")
    name = "night" if weather == weather_of("clear") else f"{weather.name} by night"
    return replace(
        weather,
        name=name,
        visibility=weather.visibility * night.visibility,
        light="night",
        recognition_delay=weather.recognition_delay + night.recognition_delay,
    )


def expand_protocol(study: Study, weather: Weather) -> Study:
    """Give a study with a protocol a test for each of its cells; tests by day have the study's
    weather.
    """
    if study.matrix is None or not study.is_rated:
        return study
    shared_parameters = {
        name: value
        for name, value in study.scenario.parameters.items()
        if name in SHARED_PARAMETERS
    }
    by_night = darken(weather)
    tests = []
    for cell in protocol_of(study.matrix.protocol).cells:
        model, parameters = cell.scenario
        parameters = {**shared_parameters, **parameters}
        weathers: list[str | Weather] = [by_night if cell.is_night else weather]
        tests.append(
            MatrixTest(name=cell.name, model=model, parameters=parameters, weathers=weathers)
        )
    no_parameters = replace(study.scenario, parameters={})  # each test has its own parameters
    return replace(study, matrix=MatrixTable(tests=tests), scenario=no_parameters)
