"""How many Euro NCAP points does a vehicle earn, and how many does a worn variant lose?

All cells and robustness layers of the protocol are simulated, and scored by the official rules
(`protocol/rater.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.errors import InputError, about
from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, Protocol
from safevar_sumo.protocol.cells import REQUIRED, UNCHECKED
from safevar_sumo.protocol.rater import Points, Rater, darken
from safevar_sumo.questions.answer import Answer, Column, Columns, contents, tabulate
from safevar_sumo.questions.ask import question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.changes import read_changes
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.options import ValueTexts
from safevar_sumo.questions.rating.picture import draw
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import CellResults, FloatArray, NamedValues
from safevar_sumo.results import SolutionId, row_of_handle
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import MatrixTable, Study
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

CELLS_STAGE = "cells and robustness layers"
"""The phase of progress."""
DECIMALS = 9
"""Decimals of points and measured values; further decimals would hold only rounding errors."""
POINTS = partial(Column, "", number_format=".2f")
VEHICLE: Columns = {"variant": "the original vehicle, or its variant"}
TEST: Columns = VEHICLE | {
    "test": "test of the protocol, with the light if it is driven by day and by night"
}
TESTS: Columns = TEST | {
    "possible": POINTS(meaning="points of the test"),
    "points": POINTS(meaning="points that the vehicle earns"),
    "lost": POINTS(meaning="points of the original vehicle minus those of this one"),
    "first_speed": Column(
        "km/h", "slowest test speed at which a cell is not green; of a variant, is worse", "g"
    ),
    "standard": POINTS(meaning="points of the standard range", is_detail=True),
    "extended": POINTS(meaning="points of the extended range", is_detail=True),
    "robustness": POINTS(meaning="points of robustness layers", is_detail=True),
    "possible_standard": POINTS(meaning="points of the test in the standard range", is_shown=False),
    "possible_extended": POINTS(meaning="points of the test in the extended range", is_shown=False),
    "failing_layers": "robustness layers that the vehicle does not pass",
    "claimed_layers": "robustness layers that the study claims and that are not simulated",
}
VEHICLES: Columns = VEHICLE | {
    "points": POINTS(meaning="points that the vehicle earns"),
    "lost": POINTS(meaning="points of the original vehicle minus those of this one"),
    "changes": "values that differ from the original's, in the study's units",
    "invalid_cells": "cells in which the vehicle cannot hold the speed; they earn nothing",
    "remark": "what to know about the points of this vehicle",
}
NOT_SIMULATED: Columns = {
    "test": "test of the protocol",
    "points": POINTS(meaning="points of the test"),
}
CELLS: Columns = TEST | {
    "range": "standard or extended range, or a robustness layer",
    "condition": "condition of the robustness layer",
    "vut_speed": Column("km/h", "speed of the vehicle under test"),
    "target_speed": Column("km/h", "speed of the target"),
    "impact_location": Column("%", "impact location in percent of the vehicle's width"),
    "colour": "colour; none if the vehicle cannot drive the test",
    "relative_impact_speed": Column("km/h", "relative speed of the impact; none without one"),
    "warning_ttc": Column("s", "time to collision at the warning; none without one"),
}


@question
@contents(
    *("points", "possible", "lost", "not_simulated", "layers_not_simulated"),
    lead="tests",
    next="explain",
    tests=TESTS,
    vehicles=VEHICLES,
    not_simulated=NOT_SIMULATED,
    cells=CELLS,
)
def rating(
    subject: Subject,
    evaluator: Evaluator,
    *,
    set: ValueTexts = (),
    solution: Annotated[str | None, "ALG:RUN:N"] = None,
) -> Answer:
    """Rate the crash avoidance (frontal collisions) of a vehicle and of a worn variant of it as
    Euro NCAP does in 2026.

    Tests by day take place in the study's weather. The numbers are the points of the original
    vehicle, the points that the simulated tests give at most, and the points that the variant
    loses.

    Parameters
    ----------
    set
        Value of a characteristic of the variant, in its unit or as +10% of the original; may be
        repeated.
    solution
        The variant is the N-th solution of a run, from 0, of a results directory; `set` changes it
        further.
    """
    # The vehicles, in a study that is rated.
    evaluator.system.require("a robot", "rating")
    study = evaluator.study
    original = evaluator.characteristics.original
    settings = {"original": original, **_variant(subject, evaluator, set, solution)}
    if study.ranges:
        raise InputError(
            study.name,
            "has ranges of encounters, and the cells of a rating are fixed",
            "a study whose encounters are tests",
        )
    if not study.is_rated:
        study = msgspec.structs.replace(study, matrix=MatrixTable(protocol=EURO_NCAP_2026))  # type: ignore[arg-type]

    # All cells of the protocol.
    rater = assemble(study).rater
    assert rater is not None
    cells = evaluator.for_study(study).at_each_point(np.stack([*settings.values()]), CELLS_STAGE)
    return rate(study, rater, settings, cells)


def _variant(
    subject: Subject, evaluator: Evaluator, changes: tuple[str, ...], solution: str | None
) -> dict[str, FloatArray]:
    """The variant's setting by its name; empty if the options describe none.

    Raises
    ------
    InputError
        If there is no such solution, a value is outside its domain, or the changed variant violates
        a constraint.
    """
    characteristics = evaluator.characteristics
    setting = characteristics.original
    name = "variant"

    # The solution's setting.
    if solution is not None:
        if isinstance(subject, Study):
            raise InputError(
                "solution",
                f"{subject.name!r} is a study and has no solutions",
                "a results directory",
            )
        row = subject.solutions.iloc[row_of_handle(subject.solutions, SolutionId.parse(solution))]
        setting = row[list(characteristics.names)].to_numpy(float)
        name = solution

    # Changes to it.
    if changes:
        with about("set"):
            values = characteristics.named(setting)
            values |= {
                key: value
                for key, (value,) in read_changes(changes, characteristics, single=True).items()
            }
            setting = characteristics.setting(values)
            evaluator.region.check(setting[np.newaxis])
        name = "variant" if solution is None else f"{solution} changed"
    return {name: setting} if changes or solution else {}


def rate(
    study: Study, rater: Rater, settings: Mapping[str, FloatArray], cells: CellResults
) -> Answer:
    """The answer about the original vehicle and its variant, settings by name, that were simulated
    in all cells.
    """
    # Points of all vehicles.
    protocol = rater.protocol
    scores = rater.points(cells)
    names = list(settings)
    lost = (scores.total[0] - scores.total).round(DECIMALS)
    possible = round(sum(sum(matrix.points) for matrix in protocol.matrices), DECIMALS)

    # Tables of tests, vehicles and cells.
    tests = tabulate("Points by test", TESTS, _rows_of_tests(rater, scores, names))
    loses = tests["lost"] > 0 if len(names) > 1 else tests["points"] < tests["possible"]
    tests.attrs["lead_rows"] = np.flatnonzero(loses).tolist()
    changes = [_changes(study, setting) for setting in settings.values()]
    invalid = (~cells.valid).sum(axis=1)
    remarks = [*_remarks(rater, scores, cells)]
    vehicles = tabulate(
        "Vehicles", VEHICLES, zip(names, scores.total, lost, changes, invalid, remarks, strict=True)
    )
    not_simulated = tabulate(
        "Tests that are not simulated: neither passed nor failed",
        NOT_SIMULATED,
        protocol.points_not_simulated.items(),
    )
    return Answer(
        question="rating",
        study=study,
        verdict=_verdict(study, settings, scores, possible, tests),
        numbers={
            "points": float(scores.total[0]),
            "possible": possible,
            "lost": float(lost[-1]),
            "not_simulated": sum(protocol.points_not_simulated.values()),
            "layers_not_simulated": _points_of_open_layers(rater),
        },
        tables={
            "tests": tests,
            "vehicles": vehicles,
            "not_simulated": not_simulated,
            "cells": tabulate("Cells", CELLS, _cells(protocol, scores, cells, names)),
        },
        draw=partial(draw, protocol, scores),
        tested=" ".join(vehicle_remarks(assemble(study))),
    )


def _rows_of_tests(
    rater: Rater, scores: Points, names: list[str]
) -> Iterator[tuple[float | str | None, ...]]:
    for number, name in enumerate(names):
        for matrix in rater.protocol.matrices:
            points = scores.tests[matrix.name].round(DECIMALS)
            totals = points.sum(axis=1)
            colours = scores.colours[[number, 0]]
            is_worse = colours[0] > (colours[1] if number else 0)
            speeds = [
                cell.vut_speed
                for cell, loses in zip(rater.protocol.cells, is_worse, strict=True)
                if loses and cell.matrix is matrix
            ]
            failing = [
                layer
                for (of_test, layer), holds in scores.layers.items()
                if of_test == matrix.test_name and not holds[number]
            ]
            yield (
                *(name, matrix.name, sum(matrix.points)),
                *(
                    totals[number],
                    round(totals[0] - totals[number], DECIMALS),
                    min(speeds, default=None),
                    *points[number],
                    *matrix.points[:2],
                ),
                *(
                    ", ".join(layers) or None
                    for layers in (failing, rater.claims.get(matrix.test_name, ()))
                ),
            )


def _cells(
    protocol: Protocol, scores: Points, results: CellResults, names: list[str]
) -> pd.DataFrame:
    """The rows of `CELLS`: all cells of each vehicle."""
    # What is tested in each cell.
    placed = pd.DataFrame(
        [
            (
                *(cell.matrix.name, cell.range_or_layer, cell.condition or None),
                *(cell.vut_speed, cell.target_speed, cell.impact_location),
            )
            for cell in protocol.cells
        ],
        columns=["test", "range", "condition", "vut_speed", "target_speed", "impact_location"],
    )

    # What each vehicle does there.
    measured = zip(names, scores.colours, results.impact, results.warning, strict=True)
    return pd.concat(
        [
            placed.assign(
                variant=name,
                colour=np.array([*COLOURS, None], dtype=object)[colours],  # an unknown one is -1
                relative_impact_speed=impact.round(DECIMALS),
                warning_ttc=warning.round(DECIMALS),
            )
            for name, colours, impact, warning in measured
        ],
        ignore_index=True,
    )


def _changes(study: Study, setting: FloatArray) -> NamedValues:
    pairs = zip(CharacteristicSet.of(study), setting.tolist(), strict=True)
    return {item.name: value for item, value in pairs if value != item.original}


def _remarks(rater: Rater, scores: Points, cells: CellResults) -> Iterator[str | None]:
    """For each vehicle: required cells that are not green, and missing warnings."""
    protocol = rater.protocol
    for number, fails in enumerate(scores.fails):
        remarks = []
        if fails:
            remarks.append(
                f"The vehicle earns nothing: {REQUIRED} is not green in the whole standard range."
            )
        elif scores.colours[number, protocol.unchecked_cells].any():
            remarks.append(
                f"Euro NCAP requires that {UNCHECKED} is green, and it is not. Euro NCAP's"
                f" calculator {protocol.calculator_version} does not check this, and neither do"
                " these points."
            )
        if np.isnan(cells.warning[number]).all():
            remarks.append("The vehicle never warns, so rows with FCW are red.")
        yield " ".join(remarks) or None


def _points_of_open_layers(rater: Rater) -> float:
    """Points of the robustness layers of simulated tests that are neither simulated nor claimed."""
    protocol = rater.protocol
    points = 0.0
    for matrix in protocol.matrices:
        layers = protocol.layers_of(matrix.test_name)
        claimed = rater.claims.get(matrix.test_name, ())
        is_open = [not layer.simulated_conditions and layer.name not in claimed for layer in layers]
        points += matrix.points[2] * sum(is_open) / len(layers)
    return points


def _verdict(
    study: Study,
    settings: Mapping[str, FloatArray],
    scores: Points,
    possible: float,
    tests: pd.DataFrame,
) -> str:
    """How many points the variant loses and in which tests; without a variant, the original's
    points.
    """
    # The weather, if it is not that of the tests.
    weather = weather_of(study.weather)
    road = ""
    if weather.water or weather.road_friction != 1:
        road = (
            " Not comparable with an official rating: Euro NCAP tests on a dry road, and here the"
            f" weather is {weather.name!r}, and {darken(weather).name!r} in the tests by night."
        )

    # Where most points are lost, and from which speed on.
    *others, variant = settings
    own = tests[tests["variant"] == variant]
    missing = own["lost"] if others else own["possible"] - own["points"]
    largest = own[missing == missing.max()]
    where = ""
    if missing.max() > 0:
        prefix = "each of " if len(largest) > 1 else ""
        speed = largest["first_speed"].min()
        since = "" if np.isnan(speed) else f", from {speed:g} km/h on"
        names = join_phrases(largest["test"])
        where = f" It loses most in {prefix}{names}: {missing.max():.2f} points{since}."

    # Without a variant, what the original earns.
    earned = f"{scores.total[0]:.2f}"
    if not others:
        return (
            f"The original vehicle earns {earned} of the {possible:g} points that the simulated"
            f" tests give.{where}{road}"
        )

    # What changes, what it costs, and where.
    items = {item.name: item for item in CharacteristicSet.of(study)}
    changes = [
        f"{items[name].short_name} at {float(items[name].text(value)):g}{items[name].suffix}"
        for name, value in _changes(study, settings[variant]).items()
    ]
    lost = round(scores.total[0] - scores.total[-1], DECIMALS)
    result = f"loses {lost:.2f} of the {earned} points that the original vehicle earns"
    if lost <= 0:
        more = f"{-lost:.2f} more than" if lost < 0 else "as many as"
        result = f"earns {scores.total[-1]:.2f} points, {more} the original vehicle"
    return (
        f"With {join_phrases(changes or ['no change at all'])}, the vehicle {result}; the simulated"
        f" tests give {possible:g}.{where}{road}"
    )
