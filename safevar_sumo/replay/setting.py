"""The answer of `simulate`: the simulations of one setting and of the original vehicle."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.api.simulation import Simulation
from safevar_sumo.metrics import STOPPING_DISTANCE
from safevar_sumo.questions.answer import Answer, Column, Columns, tabulate
from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.questions.sentence import Sentence, Verdict, answer, evidence
from safevar_sumo.questions.tables import AnswerTable, shipped_columns
from safevar_sumo.questions.words import (
    EXACT,
    change_texts,
    join_phrases,
    points_in_words,
)
from safevar_sumo.records import FloatArray
from safevar_sumo.replay import words
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
COLUMNS_BY_TABLE = shipped_columns("simulate")
"""The columns of the answer's tables, by the names of the tables."""
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
"""Names of numbers that an answer has in every study, besides the metrics."""
SEARCH_RESULTS = ("gap", "f_safe", "f_diff", "f_num_diff")
"""Results that the first view leaves out: only a search needs them, or other results say the same.
"""


def _fails(system: System, result: PointResult) -> bool:
    """Whether the first setting fails at a point. The study's criterion decides, unless it is a
    collision, or its metric is missing: then a contact that is faster than the point allows is a
    failure.
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
    """The answer about a setting and the original vehicle: values, outcomes, metrics, objectives,
    and the results at the points of a matrix. `handle` is None if the setting is no solution.
    """
    setting = simulation.evaluation.settings[0]
    remarks = _remarks_of(system)
    small = [
        f"{name} = {value:g}"
        for name, value in simulation.reset_values.items()
        if name in system.characteristics.vehicle.names
    ]
    if small:
        remarks.append(words.IGNORED.format(small=" and ".join(small)))

    original = simulation.original.numbers
    numbers = simulation.numbers
    units = {"outcome": "", **simulation.units}
    results = [
        {
            "result": name,
            "unit": unit,
            "original": original[name],
            "simulated": numbers[name],
        }
        for name, unit in units.items()
    ]
    tables = {
        "characteristics": _characteristics(simulation),
        "results": tabulate(
            "How both simulations end",
            _without_repetition(COLUMNS_BY_TABLE["results"], simulation),
            results,
            words={name: name.replace("_", " ") for name in units},
            lead_rows=[
                row for row, name in enumerate(units) if name not in SEARCH_RESULTS
            ],
        ),
    }

    sentences = _verdict(simulation, len(system.matrix))
    if system.matrix:
        tables["points"], failing = _points(system, setting)
        is_changed = simulation.row > 0
        vehicle = f"The {'changed' if is_changed else 'original'} vehicle"
        points = points_in_words(vehicle, failing, len(system.matrix))
        sentences.append(evidence(points))

    rows = [{"remark": remark} for remark in dict.fromkeys(remarks) if remark]
    tables["remarks"] = tabulate("Remarks", REMARKS, rows)
    named = system.characteristics.named(setting)
    places = [
        f"{item.name.replace('_', ' ')} {named[item.name]:{EXACT}}{item.suffix}"
        for item in system.characteristics.scenario
        if item.name != PHASE and named[item.name] != item.original
    ]
    texts = change_texts(system.characteristics.vehicle, named)
    if texts:
        sentences.append(words.CHANGES(changes=", ".join(texts)))
    if places:
        sentences.append(words.ENCOUNTER(values=join_phrases(places)))
    phase = named.get(PHASE)
    if phase:
        sentences.append(words.LATER(phase=phase))
    if handle is not None:
        numbers = {"solution": str(handle), **numbers}
    return Answer(
        question="simulate",
        study=simulation.study,
        verdict=Verdict(sentences),
        numbers=numbers,
        tables=tables,
        lead="points" if "points" in tables else "results",
    )


def _points(system: System, setting: FloatArray) -> tuple[AnswerTable, list[str]]:
    """The table of the points of a matrix, in which the worst points come first; and the names of
    the points at which a setting fails.
    """
    results = list(simulate_all_points(system, setting[np.newaxis]))
    records = (point_record(result) for result in results)
    # A contact is a record in a record: its side and its place become columns.
    points = pd.DataFrame([{**row, **row.get("contact", {})} for row in records])
    worst = np.argsort(points[SAFETY_DEGREE], kind="stable").tolist()
    table = tabulate(
        "Test cases, worst first", COLUMNS_BY_TABLE["points"], points, lead_rows=worst
    )
    return table, [result.point.name for result in results if _fails(system, result)]


def _without_repetition(
    columns: dict[str, Column], simulation: Simulation
) -> dict[str, Column]:
    """The columns, without those of the simulated vehicle if nothing is changed: they would repeat
    the values of the original vehicle.
    """
    if simulation.row:
        return columns
    names = columns.keys() & {"simulated", "changed"}
    return columns | {name: columns[name]._replace(is_shown=False) for name in names}


def _characteristics(simulation: Simulation) -> AnswerTable:
    """The table of the values of all characteristics."""
    pairs = zip(
        CharacteristicSet.of(simulation.study), simulation.setting.values(), strict=True
    )
    rows = [
        {
            "characteristic": item.name,
            "unit": item.unit,
            "original": item.original,
            "simulated": value,
            "changed": value != item.original,
            "meaning": item.words,
        }
        for item, value in pairs
    ]
    columns = _without_repetition(COLUMNS_BY_TABLE["characteristics"], simulation)
    return tabulate(simulation.study.title, columns, rows)


def _verdict(simulation: Simulation, point_count: int) -> list[Sentence]:
    """Sentences on the ends of the simulations of the changed vehicle, if there is one, and of the
    original vehicle. In a matrix they are about the worst test case.
    """
    is_changed = simulation.row > 0
    test = simulation.pair.point.name
    template = words.CHANGED if is_changed else words.ORIGINAL
    if point_count > 1:
        template = words.CHANGED_IN_WORST if is_changed else words.ORIGINAL_IN_WORST
    elif test:
        template = words.CHANGED_IN_TEST if is_changed else words.ORIGINAL_IN_TEST
    sentences = [
        answer(simulation.no_verdict),
        template(
            original=simulation.original.verdict,
            changed=simulation.verdict,
            number=point_count,
            test=test,
        ),
    ]
    if is_changed and simulation.evaluation.repeats:
        sentences += _comparison_of_runs(simulation)
    elif is_changed:
        sentences.append(_safety_comparison(simulation))

    # The comparison is negated, because an undefined safety degree, NaN, does not suffice.
    demand = simulation.scoring.safe_original
    if demand is not None and not simulation.original.metrics[SAFETY_DEGREE] >= demand:
        sentences.append(words.LEFT_OUT(demand=demand))
    return sentences


def _comparison_of_runs(simulation: Simulation) -> list[Sentence]:
    """Sentences that compare the mean safety degrees of the repeated runs of both vehicles."""
    changed = [run.f_safe[0] for run in simulation.evaluation.repeats]
    original = [run.f_safe[0] for run in simulation.original.evaluation.repeats]
    difference, low, high = difference_of_means(np.array(changed), np.array(original))
    if np.isnan(difference):
        return [words.UNDECIDED]
    conclusion = words.NO_DIFFERENCE
    if low > 0 or high < 0:
        conclusion = words.LESS_SAFE if high < 0 else words.SAFER
    return [words.DIFFERENCE(difference=difference, low=low, high=high), conclusion]


def difference_of_means(
    first: FloatArray, second: FloatArray
) -> tuple[float, float, float]:
    """The difference of the means of two samples, and its 95 % interval (Welch's t)."""
    # The import takes a second.
    import scipy

    difference = float(first.mean() - second.mean())
    if not first.std() and not second.std():
        return difference, difference, difference
    test = scipy.stats.ttest_ind(first, second, equal_var=False)
    interval = test.confidence_interval(CONFIDENCE)
    return difference, float(interval.low), float(interval.high)


def _safety_comparison(simulation: Simulation) -> Sentence:
    """A sentence that compares the stopping distances of both vehicles, or else their safety
    degrees.
    """
    changed = simulation.metrics
    original = simulation.original.metrics
    stop = changed.get(STOPPING_DISTANCE.name, np.nan)
    original_stop = original.get(STOPPING_DISTANCE.name, np.nan)
    if np.isfinite(stop / original_stop):
        return words.STOPPING_DISTANCE(factor=stop / original_stop)
    gain = changed[SAFETY_DEGREE] - original[SAFETY_DEGREE]
    if np.isnan(gain):
        return words.UNDECIDED
    if gain:
        return words.LESS_SAFE if gain < 0 else words.SAFER
    return words.EQUALLY_SAFE


def _remarks_of(system: System) -> list[str]:
    remarks = [remark for point in system.points for remark in point.scenario.remarks()]
    return [
        *remarks,
        *without_effect(system),
        *vehicle_remarks(system),
        pre_crash_sentence(system.points),
    ]
