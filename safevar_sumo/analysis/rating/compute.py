"""Rates the original vehicle and variants: simulates all cells and robustness layers, and scores them by the official
rules.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import pandas as pd
from rich.table import Table

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.figures import FONT_SIZE, new_panels
from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.analysis.rating.vehicles import DECIMALS, LEGEND, POINT_KINDS, RatedVehicle, draw_matrix, max_points
from safevar_sumo.analysis.words import join_phrases
from safevar_sumo.errors import InputError
from safevar_sumo.protocol import EURO_NCAP_2026, Protocol
from safevar_sumo.protocol.cells import REQUIRED, UNCHECKED
from safevar_sumo.protocol.rater import darken, is_rated
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.results import SolutionId, row_of_handle
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import MatrixTable, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Answer, WholeTable
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, repr=False)
class Rating(Answer):
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

    @property
    def largest_losses(self) -> tuple[list[str], float]:
        """The tests in which the variant loses most points, and the points that it loses in each; no tests if it loses
        none.
        """
        losses = {}
        for original, variant in zip(self.original.tests, (self.variant or self.original).tests, strict=True):
            name = " by ".join(filter(None, (original.matrix.test_name, original.matrix.light)))
            losses[name] = round(original.total - variant.total, DECIMALS)
        largest = max(losses.values())
        return [name for name, loss in losses.items() if loss == largest > 0], largest

    @property
    def points(self) -> list[tuple[str, FloatArray, float]]:
        """The name of each test, the points of each vehicle, shape (vehicles, 3), and the possible points; in the last
        row the sums of all tests.
        """
        rows = [
            (tests[0].matrix.name, np.array([test.points for test in tests]), sum(tests[0].matrix.points))
            for tests in zip(*(vehicle.tests for vehicle in self.vehicles), strict=True)
        ]
        return [*rows, ("all", np.sum([points for _, points, _ in rows], axis=0), max_points(self.protocol))]

    def to_frame(self) -> pd.DataFrame:
        """One row for each vehicle and test.

        Columns: `variant`, `test`, `light`, `points`, `possible`, and both for each range and for robustness [points].
        """
        rows = [
            (vehicle.name, test.matrix.test_name, test.matrix.light, test.total, sum(possible), *test.points, *possible)
            for vehicle in self.vehicles
            for test in vehicle.tests
            for possible in [test.matrix.points]
        ]
        kinds = [*POINT_KINDS, *(f"possible_{kind}" for kind in POINT_KINDS)]
        return pd.DataFrame(rows, columns=["variant", "test", "light", "points", "possible", *kinds])

    @property
    def cells(self) -> pd.DataFrame:
        """One row for each vehicle and simulated cell.

        Columns: `variant`, `test`, `light`, `range` (or the condition of a robustness layer), `vut_speed`,
        `target_speed` [km/h], `impact_location` [% of the width], `colour` (none if the vehicle could not drive the
        test), `relative_impact_speed` [km/h] (none without an impact), `warning_ttc` [s].
        """
        return pd.DataFrame(
            [
                {"variant": vehicle.name, "test": test["test"], "light": test["light"], **cell}
                for vehicle in self.vehicles
                for test in vehicle.to_dict()["tests"]
                for cell in test["cells"]
            ]
        )

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

    def sentences(self) -> list[str | Table]:
        """The verdict, the points of every test, the robustness layers that fail, and the tests not simulated."""
        return [self.verdict, self._points_table(), *self.failed_layers, self.not_simulated]

    @property
    def verdict(self) -> str:
        """How many points the variant loses and in which test; without a variant, the original's points."""
        earned, possible = f"{self.original.points:.2f}", f"{max_points(self.protocol):g}"
        if self.variant is None:
            return f"The original vehicle earns {earned} of the {possible} points of the tests that are simulated."
        changes = [
            f"{item.short_name} {float(item.text(self.variant.setting[item.name])):g}{item.suffix}"
            for item in CharacteristicSet.of(self.study)
            if self.variant.setting[item.name] != item.original
        ]
        result, largest_loss = f"loses {self.lost:.2f}", ""
        if self.lost < 0:
            result = f"earns {-self.lost:.2f} points more, {self.variant.points:.2f} instead"
        elif self.lost:
            tests, loss = self.largest_losses
            each = "each of " if len(tests) > 1 else ""
            largest_loss = f", {loss:.2f} of them in {each}{join_phrases(tests)}"
        return (
            f"With {join_phrases(changes or ['no change at all'])} the vehicle {result} of the {earned} points that "
            f"the original earns (of {possible} that are simulated){largest_loss}."
        )

    def _points_table(self) -> Table:
        """Points of every test as standard + extended + robustness = total."""
        table = WholeTable(
            "test",
            right=[*(vehicle.name for vehicle in self.vehicles), *(["lost"] if self.variant else []), "of"],
            title="Points: standard + extended + robustness = total",
        )
        for name, points, possible in self.points:
            totals = points.sum(axis=1)
            lost = round(totals[0] - totals[-1], 2)
            sums = [
                f"{'+'.join(f'{value:.2f}' for value in row)} = {total:.2f}"
                for row, total in zip(points, totals, strict=True)
            ]
            table.add_row(name, *sums, *([f"{lost:.2f}" if lost else ""] if self.variant else []), f"{possible:g}")
        return table

    @property
    def failed_layers(self) -> list[str]:
        """A sentence for each vehicle on the robustness layers that fail, and one on those that the study claims."""
        claims = "; ".join(f"{test}: {', '.join(layers)}" for test, layers in self.original.rater.claims.items())
        sentences = [f"Robustness layers claimed, not simulated: {claims}."] if claims else []
        for vehicle in self.vehicles:
            failed = {
                matrix.test_name: ", ".join(name for name, holds in layers.items() if holds is False)
                for matrix, _, layers in vehicle.tests
            }
            tests = "; ".join(f"{test}: {names}" for test, names in failed.items() if names)
            sentences.append(f"Robustness layers that fail, {vehicle.name}: {tests or 'none'}.")
        return sentences

    @property
    def not_simulated(self) -> str:
        """Sentences on the tests and robustness layers without points."""
        points_by_test = self.protocol.points_not_simulated
        tests = ", ".join(f"{test} {points:g}" for test, points in points_by_test.items())
        open_points = 0.0
        for matrix, _, layers in self.original.tests:
            _, _, robustness = matrix.points
            open_points += robustness * [*layers.values()].count(None) / len(layers)
        return (
            f"Not simulated, neither passed nor failed: {tests}; {sum(points_by_test.values()):g} points. "
            f"Robustness layers neither simulated nor claimed: {open_points:.2f} points of the simulated tests."
        )

    @property
    def remarks(self) -> list[str]:
        """Remarks on the weather, required cells, invalid tests and missing warnings, to be read with the rating."""
        weather, lines = weather_of(self.study.weather, f"study {self.study.name!r}"), []
        if weather.wet or weather.road_friction != 1:
            lines.append(
                f"Euro NCAP tests on a dry road; this rating has the weather {weather.name!r}, by night "
                f"{darken(weather).name!r}."
            )
        for vehicle in self.vehicles:
            scores, name = vehicle.scores, vehicle.name
            if scores.fails[0]:
                lines.append(f"{name}: it earns nothing, because {REQUIRED} is not green in the whole standard range.")
            elif scores.colours[0, self.protocol.unchecked_cells].any():
                lines.append(
                    f"{name}: {UNCHECKED} is not green, which Euro NCAP requires; Euro NCAP's calculator "
                    f"{self.protocol.calculator_version} does not check this, nor do these points."
                )
            if invalid := np.count_nonzero(~vehicle.cells.valid):
                lines.append(
                    f"{name}: {invalid} cells, in which it cannot hold the speed, are invalid and earn nothing."
                )
        if all(np.isnan(vehicle.cells.warning).all() for vehicle in self.vehicles):
            lines.append("The driving system never warns: rows with FCW are red.")
        return lines

    def figure(self) -> Figure:
        """The matrices of all tests with the colours of their cells."""
        points = "; ".join(f"{vehicle.name}: {vehicle.points:.2f} points" for vehicle in self.vehicles)
        arrangement = " (original left, variant right)" if self.variant else ""
        title = f"{self.study.name}: {points} of {max_points(self.protocol):g}{arrangement}"
        figure, axes = new_panels(title, len(self.protocol.matrices), 4, (3.75, 2.6), min_width=15.0, title_height=0.0)
        for axis, matrix in zip(axes, self.protocol.matrices, strict=True):
            draw_matrix(axis, self.vehicles, matrix)
        figure.supxlabel(
            f"impact location [% of the width], or speed of the target [km/h] in CCCscp and CMCscp; {LEGEND}; "
            "asterisk: colour differs from the original's",
            fontsize=FONT_SIZE,
        )
        figure.supylabel("speed of the vehicle under test [km/h]", fontsize=FONT_SIZE)
        return figure


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
    values, name = {}, "variant"
    if options.solution is not None:
        if isinstance(subject, Study):
            raise InputError("solution", f"{study.name!r} is a study and has no solutions", "a results directory")
        row = subject.solutions.iloc[row_of_handle(subject.solutions, SolutionId.parse(options.solution))]
        values, name = {key: float(row[key]) for key in characteristics.names}, options.solution
    if options.changes:
        characteristics.setting(options.changes, "changes", switch="")  # refuses unknown names
        values, name = {**values, **options.changes}, f"{name} changed" if values else name
    variants = {name: characteristics.setting(values, "changes")} if values else {}
    if options.changes:
        evaluator.region.check(variants[name][np.newaxis], "changes")
    return rate(evaluator, variants)


def rate(evaluator: Evaluator, variants: Mapping[str, FloatArray]) -> Rating:
    """Rate a study's original vehicle, and variants by name, settings of shape (n,) to which no filter is applied.

    Raises
    ------
    InputError
        If the study cannot be assembled with the protocol.
    SimulationError
        If a vehicle cannot be simulated.
    """
    study = evaluator.study
    if not is_rated(study):
        study = msgspec.structs.replace(study, matrix=MatrixTable(protocol=EURO_NCAP_2026))  # type: ignore[arg-type]
    rater, rated = assemble(study, study.source).rater, evaluator.for_study(study)
    assert rater is not None
    names, settings = rated.characteristics.names, {"original": rated.characteristics.original, **variants}
    cells = rated.simulate_cells(np.stack(list(settings.values())), "cells and robustness layers")
    vehicles = [
        RatedVehicle(
            name=name, setting=dict(zip(names, setting.tolist(), strict=True)), rater=rater, cells=cells.of([index])
        )
        for index, (name, setting) in enumerate(settings.items())
    ]
    return Rating(study=study, vehicles=vehicles, no_verdict=rated.no_verdict)
