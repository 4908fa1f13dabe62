"""Rates the original vehicle and variants: simulates all cells and robustness layers, and scores them by the official
rules.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.table import Table

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, CellMatrix, Protocol
from safevar_sumo.protocol.cells import REQUIRED, UNCHECKED
from safevar_sumo.protocol.rater import Points, Rater, darken, with_protocol
from safevar_sumo.records import CellResults, FloatArray, JsonObject, finite_or_none
from safevar_sumo.results import SolutionId, row_of_handle
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import answer_as_html

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
            test = matrix.test_name
            standard, extended, robustness = self.scores.tests[matrix.name][0].round(DECIMALS).tolist()
            layers: dict[str, bool | None] = {}
            for layer in self.protocol.layers_of(test):
                claimed = layer.name in self.rater.claims.get(test, ()) or None
                held = self.scores.layers.get((test, layer.name))
                layers[layer.name] = claimed if held is None else bool(held[0])
            tests.append(RatedTest(matrix=matrix, points=(standard, extended, robustness), layers=layers))
        return tests

    def colour(self, cell_number: int) -> str | None:
        """Colour of a cell; None if the vehicle could not drive the test."""
        colour = int(self.scores.colours[0, cell_number])
        return None if colour < 0 else COLOURS[colour]

    def measured(self, cell_number: int) -> tuple[float | None, float | None]:
        """Relative impact speed [km/h] and time to collision at the warning [s] in a cell; None without impact or
        warning.
        """
        impact, warning = (finite_or_none(values[0, cell_number]) for values in (self.cells.impact, self.cells.warning))
        return None if impact is None else round(impact, DECIMALS), None if warning is None else round(
            warning, DECIMALS
        )

    def to_dict(self) -> JsonObject:
        cells: dict[str, list[JsonObject]] = {matrix.name: [] for matrix in self.protocol.matrices}
        for cell_number, cell in enumerate(self.protocol.cells):
            impact, warning = self.measured(cell_number)
            cells[cell.matrix.name].append(
                {
                    "range": cell.range_or_layer,
                    "vut_speed": cell.vut_speed,
                    "target_speed": cell.target_speed,
                    "impact_location": cell.impact_location,
                    "colour": self.colour(cell_number),
                    "relative_impact_speed": impact,
                    "warning_ttc": warning,
                }
            )
        tests = [
            {
                "test": test.matrix.test_name,
                "light": test.matrix.light,
                **dict(zip(POINT_KINDS, test.points, strict=True)),
                "possible": dict(zip(POINT_KINDS, test.matrix.points, strict=True)),
                "cells": cells[test.matrix.name],
                "layers": test.layers,
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
    vehicles: list[RatedVehicle]
    no_verdict: str = ""

    @property
    def protocol(self) -> Protocol:
        return self.original.protocol

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

    def to_frame(self) -> pd.DataFrame:
        """One row for each vehicle and test.

        Columns: `vehicle`, `test`, `light`, `standard`, `extended`, `robustness`, `total`, `possible` [points].
        """
        rows = [
            (vehicle.name, test.matrix.test_name, test.matrix.light, *test.points, test.total, sum(test.matrix.points))
            for vehicle in self.vehicles
            for test in vehicle.tests
        ]
        return pd.DataFrame(rows, columns=["vehicle", "test", "light", *POINT_KINDS, "total", "possible"])

    def to_dict(self) -> JsonObject:
        """The JSON of `rating`."""
        return {
            "study": self.study.name,
            **driven_entry(self.no_verdict),
            "variants": [vehicle.to_dict() for vehicle in self.vehicles],
            "not_simulated": [
                {"test": test, "points": points} for test, points in self.protocol.points_not_simulated.items()
            ],
        }

    def sentences(self) -> Sequence[str | Table]:
        """The verdict, the points of every test, the robustness layers that hold, and the tests not simulated."""
        from safevar_sumo.analysis.rating.render import rating_parts

        return rating_parts(self)

    def figure(self) -> Figure:
        """The matrices of all tests with the colours of their cells."""
        from safevar_sumo.analysis.rating.render import matrices_figure

        return matrices_figure(self)

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        vehicles = "; ".join(f"{vehicle.name} {vehicle.points:.2f}" for vehicle in self.vehicles)
        return f"<Rating of {self.study.name}, points of {max_points(self.protocol):g}: {vehicles}>"


def rate_variant(subject: Study | Case, options: RatingOptions, evaluator: Evaluator) -> Rating:
    """Rate the original vehicle, and the variant if the options describe one.

    Raises
    ------
    InputError
        If the results have no such solution, a value is outside its domain, or the changed variant violates a
        constraint.
    SimulationError
        If a vehicle cannot be simulated.
    """
    study, characteristics = evaluator.study, evaluator.characteristics
    setting_values, name = dict[str, float](), "variant"
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
        evaluator.region.check(variants[name][np.newaxis], "changes")
    return rate(evaluator, variants)


def rate(evaluator: Evaluator, settings: Mapping[str, FloatArray]) -> Rating:
    """Rate a study's original vehicle and variants, given as settings of shape (n,) by name; the filter is not applied.

    Raises
    ------
    InputError
        If the study cannot be assembled with the protocol.
    SimulationError
        If a vehicle cannot be simulated.
    """
    study = with_protocol(evaluator.study, EURO_NCAP_2026)
    rater, rated = assemble(study, study.source).rater, evaluator.for_study(study)
    assert rater is not None
    settings_by_name = {"original": rated.characteristics.original, **settings}
    cells = rated.simulate_cells(np.stack(list(settings_by_name.values())), "cells and robustness layers")
    names = rated.characteristics.names
    vehicles = [
        RatedVehicle(
            name=name, setting=dict(zip(names, setting.tolist(), strict=True)), rater=rater, cells=cells.of([index])
        )
        for index, (name, setting) in enumerate(settings_by_name.items())
    ]
    return Rating(study=study, vehicles=vehicles, no_verdict=rated.no_verdict)


def remarks(rating: Rating) -> list[str]:
    """Remarks on the weather, required cells, invalid tests and missing warnings, to be read with the rating."""
    weather, protocol = weather_of(rating.study.weather, f"study {rating.study.name!r}"), rating.protocol
    lines = []
    if weather.wet or weather.road_friction != 1:
        lines.append(
            f"Euro NCAP tests on a dry road; this rating has the weather {weather.name!r}, by night "
            f"{darken(weather).name!r}."
        )
    for vehicle in rating.vehicles:
        if vehicle.scores.fails[0]:
            lines.append(
                f"{vehicle.name}: it earns nothing, because {REQUIRED} is not green in the whole standard range."
            )
        elif vehicle.scores.colours[0, protocol.unchecked_cells].any():
            lines.append(
                f"{vehicle.name}: {UNCHECKED} is not green, which Euro NCAP requires; "
                f"Euro NCAP's calculator {protocol.calculator_version} does not check this, nor do these points."
            )
        invalid_cells = np.count_nonzero(~vehicle.cells.valid)
        if invalid_cells:
            lines.append(
                f"{vehicle.name}: {invalid_cells} cells are no valid tests and earn nothing: the vehicle "
                "cannot hold the speed."
            )
    if all(np.isnan(vehicle.cells.warning).all() for vehicle in rating.vehicles):
        lines.append("The driving system never warns: rows with FCW are red.")
    return lines
