"""The matrix of a protocol as points that are simulated, and the rating of what vehicles did there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace

from safevar_sumo.errors import InputError, unknown
from safevar_sumo.protocol import Points, Protocol, points_of, protocol_of
from safevar_sumo.records import KMH_PER_MS, CellResults, FloatArray, Outcome, SimulationRuns
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import OBJECTIVES, MatrixTable, MatrixTest, RatingTable, Study, Weather

SHARED = ("vut_length", "vut_width", "grade")
"""Parameters of a study's scenario that every cell takes over."""


IN_SUMO = 8
"""Cells of a protocol in which SUMO drives settings, too: all of them would take it hours."""


@dataclass(frozen=True, kw_only=True)
class Rater:
    """Rates vehicles that were simulated at all points of a protocol's matrix, in their order; `claims` are layers by test."""

    protocol: Protocol
    claims: dict[str, list[str]]

    def points(self, results: CellResults) -> Points:
        return points_of(self.protocol, results, self.claims)


def cell_columns(runs: SimulationRuns) -> tuple[FloatArray, FloatArray, Any]:
    """What N simulations of a cell are for a rating: impact [km/h], warning [s], validity; shape (N,) each, see `CellResults`."""
    warning = np.broadcast_to(runs.warning_ttc, runs.relative_speed.shape)
    return runs.relative_speed * KMH_PER_MS, warning, (runs.outcome != Outcome.INVALID_TEST) & (runs.outcome != Outcome.SIMULATOR_ERROR)


def joined_cells(columns: Sequence[tuple[FloatArray, FloatArray, Any]]) -> CellResults:
    """The cells of M vehicles, of what `cell_columns` has for each cell."""
    return CellResults(*(np.stack(list(values), axis=1) for values in zip(*columns, strict=True)))


def is_rated(study: Study) -> bool:
    return study.matrix is not None and bool(study.matrix.protocol)


def rated_study(study: Study, protocol: str) -> Study:
    """The study in the matrix of a protocol."""
    return study if is_rated(study) else replace(study, matrix=MatrixTable(protocol=protocol))  # type: ignore[arg-type]


def rater_of(study: Study, source: str) -> Rater | None:
    """The rater of a study in a protocol's matrix; None of another.

    Raises
    ------
    InputError
        If a claim is of no test, or of a layer that does not count for it or is simulated.
    """
    if study.matrix is None or not study.matrix.protocol:
        return None
    protocol = protocol_of(study.matrix.protocol)
    for test, layers in study.rating.claims.items():
        key = f"rating.claims.{test}"
        if test not in protocol.tests:
            raise unknown(source, f"{key}: there is no such test, or none that is simulated", test, protocol.tests)
        simulated = {layer.layer: bool(layer.simulated) for layer in protocol.layers_of(test)}
        for layer in layers:
            if layer not in simulated:
                raise unknown(source, f"{key}: {layer!r} does not count for {test}", layer, simulated)
            if simulated[layer]:
                raise InputError(source, f"{key}: {layer!r} is simulated for {test} and cannot be claimed",
                                 "one of " + ", ".join(one for one, is_simulated in simulated.items() if not is_simulated))
    return Rater(protocol=protocol, claims=study.rating.claims)


def driven_in_sumo(study: Study, weather: Weather) -> Study:
    """What SUMO drives of a study beside recorded scenes: the study itself; of a rated one a few cells, spread over the matrices."""
    if not is_rated(study):
        return study
    number = len(protocol_of(study.matrix.protocol).cells)  # type: ignore[union-attr]
    return in_some_cells(study, weather, np.linspace(0, number - 1, IN_SUMO).astype(int).tolist())


def in_some_cells(study: Study, weather: Weather, numbers: Sequence[int]) -> Study:
    """A rated study in some of its cells, which have no points."""
    everything = rated(study, weather)
    assert everything.matrix is not None
    tests = [everything.matrix.tests[number] for number in numbers]
    search = replace(study.search, objectives=[*OBJECTIVES])
    return replace(everything, matrix=MatrixTable(tests=tests), rating=RatingTable(), search=search)


def by_night(weather: Weather) -> Weather:
    """A weather by night: its road, and what darkness leaves of what its sensors see."""
    night = weather_of("night", "weather")
    if weather.light == "night":
        return weather
    name = "night" if weather == weather_of("clear", "weather") else f"{weather.name} by night"
    return replace(weather, name=name, visibility=weather.visibility * night.visibility, light="night",
                   recognition_delay=weather.recognition_delay + night.recognition_delay)


def rated(study: Study, weather: Weather) -> Study:
    """A study whose protocol is written out as tests, one for each cell; by day in the study's weather."""
    assert study.matrix is not None
    shared = {name: value for name, value in study.scenario.parameters.items() if name in SHARED}
    night, tests = by_night(weather), []
    for cell in protocol_of(study.matrix.protocol).cells:
        scene = cell.scene
        tests.append(MatrixTest(name=cell.name, model=scene.model, parameters={**shared, **scene.parameters},
                                weathers=[night if scene.night else weather]))
    scenario = replace(study.scenario, parameters={})  # each test has all of its own
    return replace(study, matrix=MatrixTable(tests=tests), scenario=scenario)
