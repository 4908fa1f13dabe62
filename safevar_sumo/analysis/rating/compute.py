"""Rates the original vehicle and variants: simulates all cells and robustness layers, and scores them by the official
rules.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, open_evaluator
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.words import join_phrases
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError
from safevar_sumo.protocol import (
    COLOURS,
    EURO_NCAP_2026,
    NOT_RED,
    RED,
    REQUIRED_CELLS,
    UNCHECKED_CELLS,
    Cell,
    CellMatrix,
    Points,
    Protocol,
    RequiredCells,
    points_of,
)
from safevar_sumo.protocol.rater import darken, rater_of, with_protocol
from safevar_sumo.records import CellResults, FloatArray, finite_or_none
from safevar_sumo.results import SolutionId, row_of_handle
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.terminal import Progress, show_no_progress
from safevar_sumo.vehicles import CharacteristicSet, region_of

POINT_KINDS = ("standard", "extended", "robustness")
DECIMALS = 9
"""Decimals of points and speeds in JSON; further decimals would hold only rounding errors."""


@dataclass(frozen=True, kw_only=True)
class RatedTest:
    """One vehicle's result in a test (by day or by night if the test has both); `points` are in the order of
    `POINT_KINDS`.

    `layers` states whether each robustness layer holds, None if it is neither simulated nor claimed; day and night have
    the same layers.
    """

    matrix: CellMatrix
    points: tuple[float, float, float]
    layers: Mapping[str, bool | None]

    @property
    def total(self) -> float:
        return sum(self.points)


@dataclass(frozen=True, kw_only=True)
class RatedVehicle:
    """One vehicle with its setting, results and points; `fails`: a required cell is not green, so that the vehicle
    earns nothing.
    """

    name: str
    setting: Mapping[str, float]
    protocol: Protocol
    cells: CellResults
    scores: Points
    claims: Mapping[str, Sequence[str]]

    @property
    def points(self) -> float:
        return float(self.scores.total[0])

    @property
    def fails(self) -> bool:
        return bool(self.scores.fails[0])

    @cached_property
    def tests(self) -> list[RatedTest]:
        tests = []
        for matrix in self.protocol.matrices:
            standard, extended, robustness = (
                round(float(value), DECIMALS) for value in self.scores.tests[matrix.name][0]
            )
            tests.append(
                RatedTest(matrix=matrix, points=(standard, extended, robustness), layers=self._held_layers(matrix))
            )
        return tests

    def _held_layers(self, matrix: CellMatrix) -> dict[str, bool | None]:
        claimed = self.claims.get(matrix.test_name, ())
        return {
            layer.name: bool(self.scores.layers[matrix.test_name, layer.name][0])
            if layer.simulated_conditions
            else True
            if layer.name in claimed
            else None
            for layer in self.protocol.layers_of(matrix.test_name)
        }

    def colour(self, cell_number: int) -> str | None:
        """Colour of a cell; None if the vehicle could not drive the test."""
        colour = int(self.scores.colours[0, cell_number])
        return None if colour < 0 else COLOURS[colour]

    def passes(self, cell_number: int) -> bool:
        """Whether a robustness cell meets its criterion."""
        colour, nominal = self.scores.colours[0, [cell_number, self.matrix_cell_number(cell_number)]].tolist()
        return bool(
            colour >= 0
            and (colour < RED if self.protocol.cells[cell_number].criterion == NOT_RED else colour <= nominal)
        )

    def matrix_cell_number(self, cell_number: int) -> int:
        """Number of the matrix cell that a robustness cell varies; of a matrix cell its own number."""
        cell = self.protocol.cells[cell_number]
        return self.protocol.matrix_cell_numbers[cell.matrix.name, cell.row, cell.column]

    def cell_to_dict(self, cell_number: int) -> dict[str, Any]:
        """A cell as `rating --json` prints it."""
        cell, impact = self.protocol.cells[cell_number], finite_or_none(self.cells.impact[0, cell_number])
        warning = finite_or_none(self.cells.warning[0, cell_number])
        return {
            "range": cell.range_or_layer,
            "vut_speed": cell.vut_speed,
            "target_speed": cell.target_speed,
            "impact_location": cell.impact_location,
            "colour": self.colour(cell_number),
            "relative_impact_speed": None if impact is None else round(impact, DECIMALS),
            "warning_ttc": None if warning is None else round(warning, DECIMALS),
        }

    def to_dict(self) -> dict[str, Any]:
        cell_numbers: dict[str, list[int]] = {}
        for cell_number, cell in enumerate(self.protocol.cells):
            cell_numbers.setdefault(cell.matrix.name, []).append(cell_number)
        tests = [
            {
                "test": test.matrix.test_name,
                "light": test.matrix.light,
                **dict(zip(POINT_KINDS, test.points, strict=True)),
                "possible": dict(zip(POINT_KINDS, test.matrix.points, strict=True)),
                "cells": [self.cell_to_dict(cell_number) for cell_number in cell_numbers[test.matrix.name]],
                "layers": dict(test.layers),
            }
            for test in self.tests
        ]
        return {
            "name": self.name,
            "setting": dict(self.setting),
            "points": round(self.points, DECIMALS),
            "possible": max_points(self.protocol),
            "tests": tests,
        }


def max_points(protocol: Protocol) -> float:
    """Maximum points of all simulated tests."""
    return round(sum(sum(matrix.points) for matrix in protocol.matrices), DECIMALS)


@dataclass(frozen=True, kw_only=True)
class Rating:
    """A rating of the original vehicle, `vehicles[0]`, and of its variants."""

    study: Study
    protocol: Protocol
    vehicles: list[RatedVehicle]
    no_verdict: str = ""

    @property
    def original(self) -> RatedVehicle:
        return self.vehicles[0]

    @property
    def variant(self) -> RatedVehicle | None:
        """The first variant, which is compared with the original; None without one."""
        return self.vehicles[1] if len(self.vehicles) > 1 else None

    @property
    def lost(self) -> float:
        """The original vehicle's points minus the variant's points; negative if the variant earns more."""
        return 0.0 if self.variant is None else round(self.original.points - self.variant.points, DECIMALS)

    @property
    def unclaimed_points(self) -> float:
        """Points of the robustness layers of simulated tests that are neither simulated nor claimed."""
        claims, open_points = self.original.claims, 0.0
        for test, matrices in self.protocol.tests.items():
            layers = self.protocol.layers_of(test)
            open_layers = [
                layer for layer in layers if not layer.simulated_conditions and layer.name not in claims.get(test, ())
            ]
            open_points += sum(matrix.points[2] for matrix in matrices) * len(open_layers) / len(layers)
        return round(open_points, DECIMALS)

    def colour_changes(self) -> list[tuple[Cell, str | None, str | None]]:
        """Cells whose colour in the variant differs from the original's, with the original's and the variant's
        colour.
        """
        variant = self.variant
        if variant is None:
            return []
        cell_numbers = np.flatnonzero(self.original.scores.colours[0] != variant.scores.colours[0]).tolist()
        return [
            (self.protocol.cells[cell_number], self.original.colour(cell_number), variant.colour(cell_number))
            for cell_number in cell_numbers
        ]

    def to_frame(self) -> pd.DataFrame:
        """One row for each vehicle and test.

        Columns: `vehicle`, `test`, `light`, `standard`, `extended`, `robustness`, `total`, `possible` [points].
        """
        return pd.DataFrame(
            [
                {
                    "vehicle": vehicle.name,
                    "test": test.matrix.test_name,
                    "light": test.matrix.light,
                    **dict(zip(POINT_KINDS, test.points, strict=True)),
                    "total": test.total,
                    "possible": sum(test.matrix.points),
                }
                for vehicle in self.vehicles
                for test in vehicle.tests
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """The JSON of `rating`."""
        return {
            "study": self.study.name,
            **driven_entry(self.no_verdict),
            "variants": [vehicle.to_dict() for vehicle in self.vehicles],
            "not_simulated": [
                {"test": test, "points": points} for test, points in self.protocol.points_not_simulated.items()
            ],
        }

    def __repr__(self) -> str:
        vehicles = "; ".join(f"{vehicle.name} {vehicle.points:.2f}" for vehicle in self.vehicles)
        return f"<Rating of {self.study.name}, points of {max_points(self.protocol):g}: {vehicles}>"


def rate_variant(
    subject: Study | Case,
    options: RatingOptions,
    *,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Rating:
    """Rate the original vehicle, and the variant if the options describe one.

    Raises
    ------
    InputError
        If the results have no such solution, a value is outside its domain, the changed variant violates a constraint,
        or the study cannot be assembled.
    SimulationError
        If a vehicle cannot be simulated.
    """
    study = subject if isinstance(subject, Study) else subject.study
    setting_values, name = dict[str, float](), "variant"
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    if options.solution is not None:
        if isinstance(subject, Study):
            raise InputError("solution", f"{study.name!r} is a study and has no solutions", "a results directory")
        row = subject.solutions.iloc[row_of_handle(subject.solutions, SolutionId.parse(options.solution))]
        setting_values, name = (
            {characteristic: float(row[characteristic]) for characteristic in characteristics.names},
            options.solution,
        )
    if options.changes:
        characteristics.setting(options.changes, "changes", switch="")  # refuses unknown names
        setting_values, name = {**setting_values, **options.changes}, f"{name} changed" if setting_values else name
    variants = {name: characteristics.setting(setting_values, "changes")} if setting_values else {}
    if options.changes:
        region_of(study).check(variants[name][np.newaxis], "changes")
    return rate(study, variants, pool=pool, jobs=jobs, progress=progress)


def rate(
    study: Study,
    settings: Mapping[str, FloatArray],
    *,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
) -> Rating:
    """Rate a study's original vehicle and variants, given as settings of shape (n,) by name; the filter is not applied.

    Raises
    ------
    InputError
        If the study cannot be assembled.
    SimulationError
        If a vehicle cannot be simulated.
    """
    with open_evaluator(with_protocol(study, EURO_NCAP_2026), pool, jobs, progress) as evaluator:
        return rate_on(evaluator, settings)


def rate_on(evaluator: Evaluator, settings: Mapping[str, FloatArray]) -> Rating:
    """Rate the original vehicle and variants with an evaluator of a rated study; `settings` as in `rate`."""
    rater = rater_of(evaluator.study, evaluator.study.source)
    assert rater is not None
    names = CharacteristicSet.of(evaluator.study.vehicle.characteristics).names
    settings_by_name = {"original": evaluator.characteristics.original, **settings}
    cells = evaluator.simulate_cells(np.stack(list(settings_by_name.values())), "cells and robustness layers")
    vehicles = [
        RatedVehicle(
            name=name,
            setting=dict(zip(names, setting.tolist(), strict=True)),
            protocol=rater.protocol,
            cells=cells.of([index]),
            scores=points_of(rater.protocol, cells.of([index]), rater.claims),
            claims=rater.claims,
        )
        for index, (name, setting) in enumerate(settings_by_name.items())
    ]
    return Rating(study=evaluator.study, protocol=rater.protocol, vehicles=vehicles, no_verdict=evaluator.no_verdict)


def remarks(rating: Rating) -> list[str]:
    """Remarks on the weather, required cells, invalid tests and missing warnings, to be read with the rating."""
    weather = weather_of(rating.study.weather, f"study {rating.study.name!r}")
    lines = []
    if weather.wet or weather.road_friction != 1:
        lines.append(
            f"Euro NCAP tests on a dry road; this rating has the weather {weather.name!r}, by night "
            f"{darken(weather).name!r}."
        )
    for vehicle in rating.vehicles:
        if vehicle.fails:
            lines.append(
                f"{vehicle.name}: it earns nothing, because "
                f"{_describe_cells(REQUIRED_CELLS, vehicle.protocol)} is not green in "
                "the whole standard range."
            )
        elif any(vehicle.colour(cell_number) != "green" for cell_number in UNCHECKED_CELLS.numbers(vehicle.protocol)):
            lines.append(
                f"{vehicle.name}: {_describe_cells(UNCHECKED_CELLS, vehicle.protocol)} is not green, which "
                "Euro NCAP requires; "
                f"Euro NCAP's calculator {vehicle.protocol.calculator_version} does not check this, nor do "
                "these points."
            )
        invalid_cells = int(np.count_nonzero(~vehicle.cells.valid))
        if invalid_cells:
            lines.append(
                f"{vehicle.name}: {invalid_cells} cells are no valid tests and earn nothing: the vehicle "
                "cannot hold the speed."
            )
    if all(np.isnan(vehicle.cells.warning).all() for vehicle in rating.vehicles):
        lines.append("The driving system never warns: rows with FCW are red.")
    return lines


def _describe_cells(required: RequiredCells, protocol: Protocol) -> str:
    """Required cells in words, such as `CPNA at 10 km/h and 75 %`."""
    speeds = sorted({protocol.cells[cell_number].vut_speed for cell_number in required.numbers(protocol)})
    location = "" if required.impact_location is None else f" and {required.impact_location:g} %"
    return f"{required.test_name} at {join_phrases(f'{speed:g}' for speed in speeds)} km/h{location}"
