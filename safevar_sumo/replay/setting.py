"""The answer about one setting beside the original vehicle."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.api.simulation import Simulation
from safevar_sumo.metrics import STOPPING_DISTANCE
from safevar_sumo.questions.answer import Answer, Column, Columns, tabulate
from safevar_sumo.questions.words import (
    EXACT,
    change_texts,
    join_phrases,
    points_in_words,
)
from safevar_sumo.records import FloatArray
from safevar_sumo.results import SolutionId
from safevar_sumo.scenarios import pre_crash_sentence
from safevar_sumo.study import ORIGINAL_DEGREE, PHASE, SAFETY_DEGREE
from safevar_sumo.sumo.matrix import (
    PointResult,
    point_record,
    simulate_all_points,
    vehicle_remarks,
)
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.without_effect import without_effect
from safevar_sumo.vehicles import CharacteristicSet

REMARKS: Columns = {"remark": "what to know about this simulation"}
CHARACTERISTICS: Columns = {
    "characteristic": "characteristic",
    "unit": "unit of its values",
    "original": Column("", "value of the original vehicle", "g"),
    "simulated": Column("", "simulated value", "g"),
    "changed": "whether the simulated value differs from the original's",
    "meaning": Column("", "what it is", is_shown=False),
}
RESULTS: Columns = {
    "result": "outcome, metric or objective",
    "unit": "its unit",
    "original": "of the original vehicle",
    "simulated": "of the simulated vehicle",
}
POINTS: Columns = {
    "point": "point of the study's matrix",
    "outcome": "how the simulation ends",
    "impact_speed": Column("m/s", "speed of the vehicle at the collision", ".2f"),
    "relative_impact_speed": Column(
        "m/s", "relative speed of the impact", ".2f", is_shown=False
    ),
    SAFETY_DEGREE: Column(
        "m", "safety degree; minus a collision's closing speed in m/s", ".2f"
    ),
    "gap": Column("m", "least distance between bodies", ".2f", is_shown=False),
    STOPPING_DISTANCE.name: Column(
        "m", "distance from the first brake force to standstill", ".1f"
    ),
    "test_speed_error": Column(
        "km/h", "deviation from the test speed before the driving system acts", "+.1f"
    ),
    "warning_ttc": Column(
        "s", "time to collision at the first warning", is_shown=False
    ),
    "side": Column("", "side of the vehicle that touches", is_shown=False),
    "place": Column("%", "position of the contact along that side", is_shown=False),
}
OUTCOME_NAMES = (
    "outcome",
    "collision",
    "collision_speed",
    "gap",
    ORIGINAL_DEGREE,
    "f_safe",
    "f_diff",
    "f_num_diff",
)
"""What every study says of a simulation besides its metrics."""
OF_SEARCH = ("gap", "f_safe", "f_diff", "f_num_diff")
"""Results that say what others say, or that a search minimises."""


def _meets(system: System, setting: FloatArray) -> list[str]:
    """Sentences on an encounter that is not the study's, and on its phase."""
    values = system.characteristics.named(setting)
    places = [
        f"{item.name.replace('_', ' ')} {values[item.name]:{EXACT}}{item.suffix}"
        for item in system.characteristics.scenario
        if item.name != PHASE and values[item.name] != item.original
    ]
    sentences = []
    if places:
        sentences.append(f"The encounter has {join_phrases(places)}.")
    if phase := values.get(PHASE):
        sentences.append(
            f"The encounter begins {phase:g} steps of the driving system later."
        )
    return sentences


def _fails(system: System, result: PointResult) -> bool:
    """Whether the first setting fails at a point: by the study's own criterion, or by a contact
    that is faster than the point allows.
    """
    criterion = system.with_contact(system.criterion)
    bound = criterion.bound
    evaluations = result.evaluations
    if not criterion.is_collision and (
        bound is None or bound.measure in evaluations.metrics
    ):
        return bool(criterion.of(evaluations)[0])
    is_allowed = result.runs.relative_speed[0] <= result.point.allowed_impact_speed
    return bool(evaluations.collided[0] and not is_allowed)


def answer_of_setting(
    system: System, simulation: Simulation, handle: SolutionId | None
) -> Answer:
    """A setting beside the original: its values, outcome, metrics and objectives, and the points of
    a matrix; of a solution its handle.
    """
    study = simulation.study
    setting = simulation.evaluation.settings[0]
    remarks = _remarks_of(system)
    small = [
        f"{name} = {value:g}"
        for name, value in simulation.reset_values.items()
        if name in system.characteristics.vehicle.names
    ]
    if small:
        remarks.append(
            f"f_diff and f_num_diff are of the filtered setting, as in a search: they count"
            f" {' and '.join(small)} as unchanged. Everything else is of the vehicle as given."
        )

    original = simulation.original.numbers
    simulated = simulation.numbers
    units = {"outcome": "", **simulation.units}
    results = [
        (name, unit, original[name], simulated[name]) for name, unit in units.items()
    ]
    frame = _without_repetition(tabulate("Results", RESULTS, results), simulation)
    names = frame["result"]
    frame.attrs["words"] = {name: name.replace("_", " ") for name in names}
    frame.attrs["lead_rows"] = np.flatnonzero(~names.isin(OF_SEARCH)).tolist()
    tables = {"characteristics": _characteristics(simulation), "results": frame}

    verdict = [simulation.no_verdict, *_verdict(simulation, len(system.matrix))]
    if system.matrix:
        tables["points"], failing = _points(system, setting)
        is_changed = simulation.setting != simulation.original.setting
        vehicle = "changed" if is_changed else "original"
        verdict.append(
            points_in_words(f"The {vehicle} vehicle", failing, len(system.matrix))
        )

    rows = [(remark,) for remark in dict.fromkeys(remarks)]
    tables["remarks"] = tabulate("Remarks", REMARKS, rows)
    if texts := change_texts(
        system.characteristics.vehicle, system.characteristics.named(setting)
    ):
        verdict.append(f"Changed: {', '.join(texts)}.")
    verdict += _meets(system, setting)
    numbers = simulation.numbers
    if handle is not None:
        numbers = {"solution": str(handle), **numbers}
    return Answer(
        question="simulate",
        study=study,
        verdict=" ".join(filter(None, verdict)),
        numbers=numbers,
        tables=tables,
        lead="points" if "points" in tables else "results",
    )


def _points(system: System, setting: FloatArray) -> tuple[pd.DataFrame, list[str]]:
    """The table of the points of a matrix, of which the worst ones lead, and the points at which a
    setting fails.
    """
    results = list(simulate_all_points(system, setting[None]))
    records = map(point_record, results)
    # Side and place of a contact are columns of their own.
    points = [{**row, **row.get("contact", {})} for row in records]
    table = tabulate("Points of the matrix", POINTS, pd.DataFrame(points))
    table.attrs["lead_rows"] = np.argsort(table[SAFETY_DEGREE], kind="stable").tolist()
    return table, [result.point.name for result in results if _fails(system, result)]


def _without_repetition(frame: pd.DataFrame, simulation: Simulation) -> pd.DataFrame:
    """A table whose readers see the values of the original vehicle once if nothing is changed."""
    if simulation.row == 0:
        columns = frame.attrs["columns"]
        for name in {"simulated", "changed"} & set(columns):
            columns[name] = columns[name]._replace(is_shown=False)
    return frame


def _characteristics(simulation: Simulation) -> pd.DataFrame:
    pairs = zip(
        CharacteristicSet.of(simulation.study), simulation.setting.values(), strict=True
    )
    rows = (
        (item.name, item.unit, item.original, value, value != item.original, item.words)
        for item, value in pairs
    )
    return _without_repetition(
        tabulate(simulation.study.title, CHARACTERISTICS, rows), simulation
    )


def _verdict(simulation: Simulation, point_count: int) -> list[str]:
    """How the simulated vehicle and, if it differs, the original end; of a matrix in the worst of
    its test cases.
    """
    demand = simulation.scoring.safe_original
    name = simulation.pair.point.name
    where = "The" if demand is None else "In this encounter the"
    worst = ""
    if point_count > 1:
        kind = "least" if simulation.metrics[SAFETY_DEGREE] > 0 else "worst"
        worst = f", the {kind} of {point_count} test cases ({name})"
        where = "The"
    elif name:
        where = f"In the test case {name}, the"

    original = f"original vehicle {simulation.original.verdict}"
    changed = f"changed vehicle {simulation.verdict}"
    comparison = _safety_comparison(simulation)
    if simulation.setting == simulation.original.setting:
        verdict = [f"{where} {original}{worst}."]
    elif worst:
        verdict = [
            f"The {changed}{worst}.",
            f"In the same test case the {original}: {comparison}.",
        ]
    else:
        verdict = [f"{where} {original}.", f"The {changed}: {comparison}."]

    # NaN is no safety degree that suffices.
    if demand is not None and not simulation.original.metrics[SAFETY_DEGREE] >= demand:
        verdict.append(
            "Here the original vehicle keeps less than a search demands of it in the same"
            f" encounter: at least {demand:.2f} m."
        )
    return verdict


def _safety_comparison(simulation: Simulation) -> str:
    stop = simulation.metrics.get(STOPPING_DISTANCE.name, np.nan)
    original_stop = simulation.original.metrics.get(STOPPING_DISTANCE.name, np.nan)
    if np.isfinite(stop / original_stop):
        return (
            f"the stopping distance of the changed vehicle is {stop / original_stop:.2f} times that"
            " of the original"
        )

    degree = simulation.metrics[SAFETY_DEGREE]
    original = simulation.original.metrics[SAFETY_DEGREE]
    if np.isnan(degree) or np.isnan(original):
        return "whether the changed vehicle is less safe cannot be decided"
    if degree == original:
        return "both are equally safe"
    return f"the changed vehicle is {'less safe' if degree < original else 'safer'}"


def _remarks_of(system: System) -> list[str]:
    remarks = [remark for point in system.points for remark in point.scenario.remarks()]
    pre_crash = pre_crash_sentence(system.points)
    return [
        *remarks,
        *without_effect(system),
        *vehicle_remarks(system),
        *filter(None, [pre_crash]),
    ]
