"""Rates the original vehicle and variants: simulates all cells and robustness layers, and scores them by the official rules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, Progress, open_evaluator, show_no_progress
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, NOT_RED, RED, Block, Cell, Points, Protocol, points_of
from safevar_sumo.protocol.rater import darken, rater_of, with_protocol
from safevar_sumo.records import CellResults, FloatArray, finite_or_none
from safevar_sumo.results import SolutionId, row_of_handle
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool

POINT_KINDS = ("standard", "extended", "robustness")
DECIMALS = 9
"""Decimals of points and speeds in JSON; further decimals would hold only rounding errors."""


@dataclass(frozen=True, kw_only=True)
class RatedTest:
    """One vehicle's result in a test, by day or by night if the test has both; `points` are in the order of `POINT_KINDS`.

    `layers` states whether each robustness layer holds, None if the layer is neither simulated nor claimed. Day and night share layers.
    """

    block: Block
    points: tuple[float, float, float]
    layers: Mapping[str, bool | None]

    @property
    def total(self) -> float:
        return sum(self.points)


@dataclass(frozen=True, kw_only=True)
class RatedVehicle:
    """One vehicle with its setting, results and points; the vehicle `fails` and earns nothing if a required cell is not green."""

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
        for block in self.protocol.blocks:
            standard, extended, robustness = (round(float(value), DECIMALS) for value in self.scores.tests[block.name][0])
            tests.append(RatedTest(block=block, points=(standard, extended, robustness), layers=self._held_layers(block)))
        return tests

    def _held_layers(self, block: Block) -> dict[str, bool | None]:
        claimed = self.claims.get(block.test, ())
        return {layer.layer: bool(self.scores.layers[block.test, layer.layer][0]) if layer.simulated_conditions
                else (True if layer.layer in claimed else None) for layer in self.protocol.layers_of(block.test)}

    def colour(self, cell_number: int) -> str | None:
        """Colour of the cell with this number; None if the vehicle could not drive the test."""
        colour = int(self.scores.colours[0, cell_number])
        return None if colour < 0 else COLOURS[colour]

    def passes(self, cell_number: int) -> bool:
        """Whether a cell of a robustness layer meets the layer's criterion."""
        colour, nominal = self.scores.colours[0, [cell_number, self.matrix_cell_number(cell_number)]].tolist()
        return bool(colour >= 0 and (colour < RED if self.protocol.cells[cell_number].criterion == NOT_RED else colour <= nominal))

    def matrix_cell_number(self, cell_number: int) -> int:
        """Number of the matrix cell of which a layer's cell is a variation."""
        cell = self.protocol.cells[cell_number]
        return self.protocol.matrix_cell_numbers[cell.block.name, cell.row, cell.column]

    def cell_to_dict(self, cell_number: int) -> dict[str, Any]:
        """A cell as `rating --json` prints it."""
        cell, impact = self.protocol.cells[cell_number], finite_or_none(self.cells.impact[0, cell_number])
        warning = finite_or_none(self.cells.warning[0, cell_number])
        return {"range": cell.range, "vut_speed": cell.vut, "target_speed": cell.target, "impact_location": cell.location,
                "colour": self.colour(cell_number), "relative_impact_speed": None if impact is None else round(impact, DECIMALS),
                "warning_ttc": None if warning is None else round(warning, DECIMALS)}

    def to_dict(self) -> dict[str, Any]:
        block_cells: dict[str, list[int]] = {}
        for cell_number, cell in enumerate(self.protocol.cells):
            block_cells.setdefault(cell.block.name, []).append(cell_number)
        tests = [{"test": test.block.test, "light": test.block.light, **dict(zip(POINT_KINDS, test.points, strict=True)),
                  "possible": dict(zip(POINT_KINDS, test.block.points, strict=True)),
                  "cells": [self.cell_to_dict(cell_number) for cell_number in block_cells[test.block.name]], "layers": dict(test.layers)}
                 for test in self.tests]
        return {"name": self.name, "setting": dict(self.setting), "points": round(self.points, DECIMALS),
                "possible": max_points(self.protocol), "tests": tests}


def max_points(protocol: Protocol) -> float:
    """Maximum points of all simulated tests."""
    return round(sum(sum(block.points) for block in protocol.blocks), DECIMALS)


@dataclass(frozen=True, kw_only=True)
class Rating:
    """A rating of the original vehicle, `variants[0]`, and of its variants."""

    study: Study
    protocol: Protocol
    variants: list[RatedVehicle]

    @property
    def original(self) -> RatedVehicle:
        return self.variants[0]

    @property
    def variant(self) -> RatedVehicle | None:
        """The vehicle that is compared with the original."""
        return self.variants[1] if len(self.variants) > 1 else None

    @property
    def lost(self) -> float:
        """The original vehicle's points minus the variant's points; negative if the variant earns more."""
        return 0.0 if self.variant is None else round(self.original.points - self.variant.points, DECIMALS)

    @property
    def left_open(self) -> float:
        """Points of the robustness layers of simulated tests that are neither simulated nor claimed."""
        claims, open_points = self.original.claims, 0.0
        for test, blocks in self.protocol.tests.items():
            layers = self.protocol.layers_of(test)
            open_layers = [layer for layer in layers if not layer.simulated_conditions and layer.layer not in claims.get(test, ())]
            open_points += sum(block.points[2] for block in blocks) * len(open_layers) / len(layers)
        return round(open_points, DECIMALS)

    def turned(self, variant: RatedVehicle | None = None) -> list[tuple[Cell, str | None, str | None]]:
        """Cells whose colour differs from the original's, with both colours."""
        compared = variant or self.variant
        if compared is None:
            return []
        cell_numbers = np.flatnonzero(self.original.scores.colours[0] != compared.scores.colours[0]).tolist()
        return [(self.protocol.cells[cell_number], self.original.colour(cell_number), compared.colour(cell_number))
                for cell_number in cell_numbers]

    def to_frame(self) -> pd.DataFrame:
        """One row for each vehicle and test.

        Columns: `vehicle`, `test`, `light`, `standard`, `extended`, `robustness`, `total`, `possible` [points].
        """
        return pd.DataFrame([{
            "vehicle": vehicle.name, "test": test.block.test, "light": test.block.light,
            **dict(zip(POINT_KINDS, test.points, strict=True)), "total": test.total,
            "possible": sum(test.block.points)} for vehicle in self.variants for test in vehicle.tests])

    def to_dict(self) -> dict[str, Any]:
        """The JSON of `rating`."""
        return {"study": self.study.name, "variants": [variant.to_dict() for variant in self.variants],
                "not_simulated": [{"test": test, "points": points} for test, points in self.protocol.points_not_simulated.items()]}

    def __repr__(self) -> str:
        vehicles = "; ".join(f"{vehicle.name} {vehicle.points:.2f}" for vehicle in self.variants)
        return f"<Rating of {self.study.name}, points of {max_points(self.protocol):g}: {vehicles}>"


def rate_variant(subject: Study | Case, options: RatingOptions, *, pool: Pool | None = None, jobs: int | None = None,
                 progress: Progress = show_no_progress) -> Rating:
    """Rate the original vehicle, and the variant if the options describe one; raises as `rate`.

    Raises
    ------
    InputError
        If the results have no such solution, or a value is outside its domain.
    """
    study, setting_values, name = subject if isinstance(subject, Study) else subject.study, dict[str, float](), "variant"
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    if options.solution is not None:
        if isinstance(subject, Study):
            raise InputError("solution", f"{study.name!r} is a study and has no solutions", "a results directory")
        row = subject.solutions.iloc[row_of_handle(subject.solutions, SolutionId.parse(options.solution))]
        setting_values, name = {characteristic: float(row[characteristic]) for characteristic in characteristics.names}, options.solution
    if options.changes:
        characteristics.setting(options.changes, "changes", switch="")  # refuses unknown names
        setting_values, name = {**setting_values, **options.changes}, f"{name} changed" if setting_values else name
    variants = {name: characteristics.setting(setting_values, "changes")} if setting_values else {}
    return rate(study, variants, pool=pool, jobs=jobs, progress=progress)


def rate(study: Study, settings: Mapping[str, FloatArray], *, pool: Pool | None = None, jobs: int | None = None,
         progress: Progress = show_no_progress) -> Rating:
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
    """As `rate`, with an evaluator of the rated study."""
    rater = rater_of(evaluator.study, evaluator.study.source)
    assert rater is not None
    names = CharacteristicSet.of(evaluator.study.vehicle.characteristics).names
    all_settings = {"original": evaluator.characteristics.original, **settings}
    cells = evaluator.simulate_cells(np.stack(list(all_settings.values())), "cells and robustness layers")
    variants = [RatedVehicle(name=name, setting=dict(zip(names, setting.tolist(), strict=True)), protocol=rater.protocol,
                             cells=cells.of([index]), scores=points_of(rater.protocol, cells.of([index]), rater.claims),
                             claims=rater.claims)
                for index, (name, setting) in enumerate(all_settings.items())]
    return Rating(study=evaluator.study, protocol=rater.protocol, variants=variants)


def remarks(rating: Rating) -> list[str]:
    """Conditions and failures that a reader of the rating should know."""
    weather = weather_of(rating.study.weather, f"study {rating.study.name!r}")
    lines = []
    if weather.wet or weather.road_friction != 1:
        lines.append(f"Euro NCAP tests on a dry road; this rating has the weather {weather.name!r}, by night {darken(weather).name!r}.")
    for vehicle in rating.variants:
        if vehicle.fails:
            lines.append(f"{vehicle.name}: it earns nothing, because CCRs at 10 and 20 km/h is not green in the whole standard range.")
        required_cells = [cell_number for cell_number, cell in enumerate(vehicle.protocol.cells)
                          if cell.block.test == "CPNA" and cell.vut == 10 and cell.location == 75 and not cell.is_varied]
        if not vehicle.fails and any(vehicle.colour(cell_number) != "green" for cell_number in required_cells):
            lines.append(f"{vehicle.name}: CPNA at 10 km/h and 75 % is not green, which Euro NCAP requires; Euro NCAP's calculator "
                         f"{vehicle.protocol.calculator} does not check this, nor do these points.")
        invalid_cells = int(np.count_nonzero(~vehicle.cells.valid))
        if invalid_cells:
            lines.append(f"{vehicle.name}: {invalid_cells} cells are no valid tests and earn nothing: the vehicle cannot hold the speed.")
    if all(np.isnan(vehicle.cells.warning).all() for vehicle in rating.variants):
        lines.append("The driving system never warns: rows with FCW are red.")
    return lines

