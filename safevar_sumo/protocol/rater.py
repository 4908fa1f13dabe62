"""Turns the cells of a protocol into tests to simulate, and rates the simulated vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.protocol import Points, Protocol, points_of, protocol_of
from safevar_sumo.records import KMH_PER_MS, CellResults, FloatArray, Outcome, SimulationRuns
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import OBJECTIVES, MatrixTable, MatrixTest, RatingTable, Study, Weather

SHARED_PARAMETERS = ("vut_length", "vut_width", "grade")
"""Parameters of a study's scenario that apply to every cell."""
SUMO_CELLS = 8
"""Number of a protocol's cells that a check in SUMO simulates: all cells would take hours."""


@dataclass(frozen=True, kw_only=True)
class Rater:
    """Rates vehicles that were simulated in all cells of a protocol, in the order of the cells; `claims` are claimed
    layers by test.
    """

    protocol: Protocol
    claims: dict[str, list[str]]

    def points(self, results: CellResults) -> Points:
        return points_of(self.protocol, results, self.claims)


def rated_quantities(runs: SimulationRuns) -> tuple[FloatArray, FloatArray, Any]:
    """Rated quantities of N simulations of a cell: impact [km/h], warning [s], validity; shape (N,) each; see
    `CellResults`.
    """
    warning = np.broadcast_to(runs.warning_ttc, runs.relative_speed.shape)
    return (
        runs.relative_speed * KMH_PER_MS,
        warning,
        (runs.outcome != Outcome.INVALID_TEST) & (runs.outcome != Outcome.SIMULATOR_ERROR),
    )


def join_cells(quantities: Sequence[tuple[FloatArray, FloatArray, Any]]) -> CellResults:
    """Join the `rated_quantities` of each cell to the results of all cells for M vehicles."""
    return CellResults(*(np.stack(list(values), axis=1) for values in zip(*quantities, strict=True)))


def is_rated(study: Study) -> bool:
    return study.matrix is not None and bool(study.matrix.protocol)


def with_protocol(study: Study, protocol: str) -> Study:
    """The study with the matrix of a protocol; a study that is rated already stays unchanged."""
    return study if is_rated(study) else replace(study, matrix=MatrixTable(protocol=protocol))  # type: ignore[arg-type]


def rater_of(study: Study, source: str) -> Rater | None:
    """The rater of a study with a protocol's matrix; None for other studies.

    Raises
    ------
    InputError
        If a claim names an unknown test, or a layer that does not count for the test or is simulated.
    """
    if study.matrix is None or not study.matrix.protocol:
        return None
    protocol = protocol_of(study.matrix.protocol)
    for test, layers in study.rating.claims.items():
        key = f"rating.claims.{test}"
        if test not in protocol.tests:
            raise unknown_name(source, f"{key}: there is no such test, or it is not simulated", test, protocol.tests)
        is_simulated = {layer.name: bool(layer.simulated_conditions) for layer in protocol.layers_of(test)}
        for claimed in layers:
            if claimed not in is_simulated:
                raise unknown_name(source, f"{key}: {claimed!r} does not count for {test}", claimed, is_simulated)
            if is_simulated[claimed]:
                raise InputError(
                    source,
                    f"{key}: {claimed!r} is simulated for {test} and cannot be claimed",
                    "one of " + ", ".join(name for name in is_simulated if not is_simulated[name]),
                )
    return Rater(protocol=protocol, claims=study.rating.claims)


def study_for_sumo_check(study: Study, weather: Weather) -> Study:
    """The study for a check in SUMO; a rated study is reduced to a few of its cells, spread over the matrices."""
    if not is_rated(study):
        return study
    cell_count = len(protocol_of(study.matrix.protocol).cells)  # type: ignore[union-attr]
    return reduce_to_cells(study, weather, np.linspace(0, cell_count - 1, SUMO_CELLS).astype(int).tolist())


def reduce_to_cells(study: Study, weather: Weather, numbers: Sequence[int]) -> Study:
    """Reduce a rated study to some of its cells; the result has no rating points."""
    whole_matrix = expand_protocol(study, weather)
    assert whole_matrix.matrix is not None
    tests = [whole_matrix.matrix.tests[number] for number in numbers]
    search = replace(study.search, objectives=[*OBJECTIVES])
    return replace(whole_matrix, matrix=MatrixTable(tests=tests), rating=RatingTable(), search=search)


def darken(weather: Weather) -> Weather:
    """The weather by night: the same road; darkness changes visibility and recognition delay."""
    night = weather_of("night", "weather")
    if weather.light == "night":
        return weather
    name = "night" if weather == weather_of("clear", "weather") else f"{weather.name} by night"
    return replace(
        weather,
        name=name,
        visibility=weather.visibility * night.visibility,
        light="night",
        recognition_delay=weather.recognition_delay + night.recognition_delay,
    )


def expand_protocol(study: Study, weather: Weather) -> Study:
    """Give the study a test for each cell of its protocol; tests by day have the study's weather."""
    assert study.matrix is not None
    shared_parameters = {name: value for name, value in study.scenario.parameters.items() if name in SHARED_PARAMETERS}
    weather_by_night, tests = darken(weather), []
    for cell in protocol_of(study.matrix.protocol).cells:
        scenario = cell.scenario
        tests.append(
            MatrixTest(
                name=cell.name,
                model=scenario.model,
                parameters={**shared_parameters, **scenario.parameters},
                weathers=[weather_by_night if scenario.night else weather],
            )
        )
    no_parameters = replace(study.scenario, parameters={})  # each test has its own parameters
    return replace(study, matrix=MatrixTable(tests=tests), scenario=no_parameters)
