"""The command `simulate`: one setting of a study beside the original vehicle, or a sweep over
many.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.api.evaluation import evaluate_with_workers
from safevar_sumo.api.simulation import Simulation, simulate_with_original
from safevar_sumo.errors import InputError, about, warn
from safevar_sumo.metrics import STOPPING_DISTANCE
from safevar_sumo.output import check_writable, whole_file
from safevar_sumo.questions.answer import Answer, Column, Columns, contents, tabulate
from safevar_sumo.questions.between import with_encounters
from safevar_sumo.questions.changes import read_changes
from safevar_sumo.questions.counterexamples import fewest_changes
from safevar_sumo.questions.model_spread import (
    compute_model_spreads,
    remarks_on_sets,
    studies_of_sets,
)
from safevar_sumo.questions.options import PointName, Range, UpTo
from safevar_sumo.questions.part import part_of_study
from safevar_sumo.questions.subject import refuse_part_of_results, study_in, study_or_case
from safevar_sumo.questions.words import (
    EXACT,
    change_texts,
    ending_in_words,
    join_phrases,
    number_of,
    points_in_words,
)
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.replay import animation
from safevar_sumo.replay.comparison import comparison_of, list_differences, why_different
from safevar_sumo.replay.figure import draw_comparison
from safevar_sumo.replay.gui import show_in_gui
from safevar_sumo.replay.safer import rises_again, why_safer
from safevar_sumo.results import CHOICES, SOLUTIONS, SolutionId, choose_handle, row_of_handle
from safevar_sumo.scenarios import FROM_CENTRES, pre_crash_sentence
from safevar_sumo.study import ORIGINAL_DEGREE, PHASE, PHASE_DECIMALS, SAFETY_DEGREE, Study
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.encounters import where_met
from safevar_sumo.sumo.matrix import PointResult, point_record, simulate_all_points, vehicle_remarks
from safevar_sumo.sumo.measuring import own_criterion
from safevar_sumo.sumo.system import System, assemble
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
    "relative_impact_speed": Column("m/s", "relative speed of the impact", ".2f", is_shown=False),
    SAFETY_DEGREE: Column("m", "safety degree; minus a collision's closing speed in m/s", ".2f"),
    "gap": Column("m", "least distance between bodies", ".2f", is_shown=False),
    STOPPING_DISTANCE.name: Column("m", "distance from the first brake force to standstill", ".1f"),
    "test_speed_error": Column(
        "km/h", "deviation from the test speed before the driving system acts", "+.1f"
    ),
    "warning_ttc": Column("s", "time to collision at the first warning", is_shown=False),
    "side": Column("", "side of the vehicle that touches", is_shown=False),
    "place": Column("%", "position of the contact along that side", is_shown=False),
}
SPREAD: Columns = {
    "vehicle": "the simulated vehicle or the original",
    "sets": "parameter sets that fit published data equally well",
    "lower": Column("m", "lower end of the 90 % band of the safety degree", ".2f"),
    "upper": Column("m", "its upper end", ".2f"),
    "collisions": "parameter sets with which it collides",
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
NOT_SAFE = "the original vehicle keeps less than a search demands of it in the same encounter"
"""Why a setting of a study whose encounters are ranges is in no result."""


class Target(NamedTuple):
    """What is simulated: a study, and its name in errors; of a solution also its handle and its row
    of the results; where changes of it are undone, the row has the values alone.
    """

    study: Study
    source: str
    handle: SolutionId | None = None
    row: JsonObject | None = None

    def setting(self, system: System) -> FloatArray:
        """The solution's setting, or the original."""
        if self.row is None:
            return system.characteristics.original
        values = system.characteristics.named(system.characteristics.original)
        return np.array([self.row.get(name, value) for name, value in values.items()], dtype=float)


@contents(
    *("solution", "settings", "collisions", *OUTCOME_NAMES, ...),
    characteristics=CHARACTERISTICS,
    results=RESULTS,
    points=POINTS,
    spread=SPREAD,
    sweep=[*OUTCOME_NAMES, ...],
    remarks=REMARKS,
)
def show_simulation(
    source: str,
    *,
    solution: Annotated[str | None, "ALG:RUN:N"] = None,
    set: Annotated[tuple[str, ...], "NAME=VALUE"] = (),
    beyond: bool = False,
    trace: Path | None = None,
    animate: Path | None = None,
    gui: bool = False,
    spread: bool = False,
    point: PointName = None,
    ranges: bool = False,
    up_to: UpTo = None,
    fit: Annotated[int, Range(0, 1000)] = 0,
    as_it_is_now: bool = False,
) -> Answer:
    """Simulate a study once, or a solution of results with the study as recorded there, beside the
    original vehicle.

    Parameters
    ----------
    solution
        Replay solution N of a run in a results directory; N counts from 0. Or the unsafe solution
        with the smallest changes, or the most severe one: smallest, most-severe; fewest: that with
        the fewest changes, of which as many are undone as it stays unsafe without.
    set
        The value of a characteristic, of an axis of the matrix or of the phase, in its unit, +10%
        of the original, or a sweep FROM..TO; repeat it for others.
    beyond
        Also accept values beyond the domains, and settings that violate a constraint.
    trace
        Write the simulation step by step to this csv file.
    animate
        Animate both simulations, seen from above, in this gif or html file.
    gui
        Show both simulations in sumo-gui, one upon the other: the original blue, the changed one
        orange.
    spread
        Add the vehicle model's own uncertainty: other parameters that fit published data as well.
    point
        Only this test, or this point, of the study's matrix.
    ranges
        The encounter has values of its own, in the ranges of the study's axes.
    up_to
        Only encounters up to this value of an axis, such as speed=40.
    fit
        With this parameter set of the vehicle model, by its number in [spread]; 0 is the study's.
    as_it_is_now
        If results were computed with other files or versions, simulate with the present ones and
        say so.
    """
    # What is simulated: a study or a solution, with changes.
    target = load_target(source, solution, as_it_is_now, point, ranges=ranges, up_to=up_to)
    target = target._replace(study=_with_set(target.study, fit))
    system = assemble(target.study)
    changes = set
    with about("set"):
        names = [change.partition("=")[0].strip() for change in changes]
        study, system = with_encounters(target.study, system, names)
        target = target._replace(study=study)
        values = read_changes(changes, system.characteristics, beyond=beyond)
        if PHASE in values:
            values[PHASE] = np.round(values[PHASE], PHASE_DECIMALS).tolist()
        requested = _combine(values, target.setting(system), system)
        if changes and not beyond:  # what a study or results hold has been checked
            system.region.check(requested, otherwise=", or any with --beyond")

    # Files that cannot be written are refused first.
    if trace is not None:
        check_writable(trace, "trace", (".csv",), but=SOLUTIONS)
    if gui:
        system.require("sumo-gui", "simulate --gui")
    if animate is not None:
        check_writable(animate, "animate", animation.ENDINGS, but=SOLUTIONS)

    # Several values of a characteristic are a sweep.
    if any(len(options) > 1 for options in values.values()):
        if trace or animate or gui or spread:
            expected = (
                "one value for each characteristic with --trace, --animate, --gui or --spread"
            )
            raise InputError("set", f"{' '.join(changes)} is a sweep", expected)
        return _sweep(target.study, system, requested, list(values))

    # One setting beside the original vehicle, in the tests that have its encounter.
    system = _where_met(system, requested[0])
    simulation = simulate_with_original(target.study, system, requested[0], filtered=False)
    # Results belong to the whole matrix.
    if target.row and "outcome" in target.row and not changes and point is None:
        _warn_of_differences(target, target.row, simulation)
    if trace is not None:
        if simulation.pair.runs.lacking("speed").any():
            system.require("a trace", "simulate --trace")
        with whole_file(trace, "trace") as file:
            simulation.trace.to_csv(file, index=False, lineterminator="\n")
    comparison = comparison_of(simulation)
    if animate is not None:
        animation.animate(comparison, animate)
    if gui:
        show_in_gui(comparison)
    answer = _answer(target, system, simulation, with_spread=spread)
    return replace(answer, draw=lambda _: draw_comparison(comparison))


def _where_met(system: System, setting: FloatArray) -> System:
    """The system at the points that a setting, shape (n,), meets; a warning names other tests."""
    here = where_met(system, setting)
    of_test = [
        {dict(one.parameters).get("test", "") for one in each.points} for each in (system, here)
    ]
    if left_out := sorted(of_test[0] - of_test[1]):
        warn(f"not driven, as their ranges do not have this encounter: {', '.join(left_out)}")
    return here


def _meets(system: System, setting: FloatArray) -> list[str]:
    """Sentences on an encounter that is not the study's, and on its phase."""
    met = system.characteristics.named(setting)
    places = [
        f"{item.name.replace('_', ' ')} {met[item.name]:{EXACT}}{item.suffix}"
        for item in system.characteristics.scenario
        if item.name != PHASE and met[item.name] != item.original
    ]
    sentences = [f"The encounter has {join_phrases(places)}."] if places else []
    if phase := met.get(PHASE):
        sentences.append(f"The encounter begins {phase:g} steps of the driving system later.")
    return sentences


def _fails(study: Study, result: PointResult) -> bool:
    """Whether the first setting fails at a point: by the study's own criterion, or by a contact
    that is faster than the point allows.
    """
    criterion = own_criterion(study)
    bound = criterion.bound
    evaluations = result.evaluations
    if bound is not None and bound.measure in evaluations.metrics:
        return bool(criterion.of(evaluations)[0])
    is_allowed = result.runs.relative_speed[0] <= result.point.allowed_impact_speed
    return bool(evaluations.collided[0] and not is_allowed)


def _answer(target: Target, system: System, simulation: Simulation, *, with_spread: bool) -> Answer:
    """A setting beside the original: its values, outcome, metrics and objectives, and the points of
    a matrix.
    """
    # Which numbers are of the filtered setting, and what came too early.
    study = target.study
    setting = simulation.evaluation.settings[0]
    remarks = _remarks(system)
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

    # Values and results of both vehicles.
    original = simulation.original.numbers
    simulated = simulation.numbers
    units = {"outcome": "", **simulation.units}
    results = [(name, unit, original[name], simulated[name]) for name, unit in units.items()]
    tables = {
        "characteristics": _characteristics(simulation),
        "results": _without_repetition(tabulate("Results", RESULTS, results), simulation),
    }
    names = tables["results"]["result"]
    tables["results"].attrs["words"] = {name: name.replace("_", " ") for name in names}
    tables["results"].attrs["lead_rows"] = np.flatnonzero(~names.isin(OF_SEARCH)).tolist()

    # The verdict; of a matrix with the points at which it fails.
    verdict = [simulation.no_verdict, *_verdict(simulation, len(system.matrix))]
    if system.rater is not None:
        verdict.append(
            f"The command `rating` simulates all {len(system.matrix)} cells and variations."
        )
    elif system.matrix:
        tables["points"], failing = _points(study, system, setting)
        is_changed = simulation.setting != simulation.original.setting
        who = "changed" if is_changed else "original"
        verdict.append(points_in_words(f"The {who} vehicle", failing, len(system.matrix)))

    verdict += _acted_early(system, setting)

    # The model's own uncertainty.
    if with_spread:
        remarks += remarks_on_sets(study)
        vehicles = {
            "simulated": setting,
            "original": system.characteristics.with_original_vehicle(setting),
        }
        bands = compute_model_spreads(study, np.stack([*vehicles.values()]))
        rows = [(name, *band) for name, band in zip(vehicles, bands, strict=True)]
        tables["spread"] = tabulate("The vehicle model's own uncertainty", SPREAD, rows)
    tables["remarks"] = _remark_table(remarks)
    if texts := change_texts(system.characteristics.vehicle, system.characteristics.named(setting)):
        verdict.append(f"Changed: {', '.join(texts)}.")
    verdict += _meets(system, setting)
    solution = {} if target.handle is None else {"solution": str(target.handle)}
    return Answer(
        question="simulate",
        study=study,
        verdict=" ".join(filter(None, verdict)),
        numbers={**solution, **simulation.numbers},
        tables=tables,
        lead="points" if "points" in tables else "results",
    )


def _points(study: Study, system: System, setting: FloatArray) -> tuple[pd.DataFrame, list[str]]:
    """The table of the points of a matrix, of which the worst ones lead, and the points at which a
    setting fails.
    """
    results = [*simulate_all_points(system, setting[np.newaxis])]
    records = map(point_record, results)
    points = [{**row, **row.get("contact", {})} for row in records]  # side and place are columns
    table = tabulate("Points of the matrix", POINTS, pd.DataFrame(points))
    table.attrs["lead_rows"] = np.argsort(table[SAFETY_DEGREE], kind="stable").tolist()
    return table, [one.point.name for one in results if _fails(study, one)]


def _acted_early(system: System, setting: FloatArray) -> Iterator[str]:
    """Points at which the driving system acts while others still move by a vehicle that keeps its
    speed.
    """
    if any(np.any(point.scenario.depends_until > 0) for point in system.points):
        for result in simulate_all_points(system, setting[np.newaxis]):
            (acted,) = result.runs.acted_early
            if np.isfinite(acted):  # NaN: it never did
                at = f"{result.point.name}: " if result.point.name else ""
                yield (
                    f"Remark: {at}invalid test: {result.point.scenario.dependence}, and the driving"
                    f" system acts at {acted:.1f} s: other simulators would show another encounter."
                )


def load_target(
    source: str,
    solution: str | None,
    as_it_is_now: bool,
    point: str | None,
    *,
    ranges: bool = False,
    up_to: str | None = None,
) -> Target:
    """The study by name or path, or that of a results directory, at a point or as a whole, with the
    solution that is named or chosen.

    Raises
    ------
    InputError
        If there is no such study, directory, solution or point.
    """
    # The study, of results as it is recorded there, at a point.
    subject = study_or_case(source, as_it_is_now=as_it_is_now, results_only=solution is not None)
    if not isinstance(subject, Study) and subject.shortfall:
        warn(subject.shortfall)
    if not isinstance(subject, Study):
        refuse_part_of_results(ranges=ranges, up_to=up_to)
    study = part_of_study(study_in(subject), ranges, point, up_to)
    if isinstance(subject, Study) or solution is None:
        return Target(study, source)

    # The solution, by a choice or its handle.
    subject.require_solutions()
    choice = solution.replace("-", "_")
    with about(source):
        handle = (
            choose_handle(subject.solutions, subject.unsafe, choice)
            if choice in CHOICES
            else SolutionId.parse(solution)
        )
    row = subject.solutions.iloc[row_of_handle(subject.solutions, handle)]
    values = {str(name): value for name, value in row.items()}
    if choice == "fewest" and (found := fewest_changes(subject)):
        values = subject.characteristics.named(found.settings[0])
    return Target(study, source, handle, values)


def _with_set(study: Study, fit: int) -> Study:
    """The study with a parameter set of its vehicle, by its number."""
    if not fit:
        return study
    with about("fit"):
        sets = studies_of_sets(study)
        if fit >= len(sets):
            raise InputError("", f"{fit}", f"a number up to {len(sets) - 1}")
    return sets[fit]


def _combine(values: dict[str, list[float]], base: FloatArray, system: System) -> FloatArray:
    """M settings, shape (M, n): `base`, shape (n,), with each of the M combinations of values in
    turn.
    """
    combinations = list(product(*values.values()))
    settings = np.tile(base, (len(combinations), 1))
    settings[:, [system.characteristics.names.index(name) for name in values]] = combinations
    return settings


def _warn_of_differences(target: Target, row: JsonObject, simulation: Simulation) -> None:
    why = why_different(is_imported="run" not in row)
    for difference in list_differences(simulation.evaluation, row):
        warn(f"{target.handle} of {target.source}: {difference}; {why}")


def _sweep(study: Study, system: System, settings: FloatArray, names: list[str]) -> Answer:
    """A row for each setting of a sweep."""
    # All settings, and the original vehicle first.
    characteristics = system.characteristics
    evaluations = evaluate_with_workers(
        study, np.concatenate([characteristics.original_settings, settings])
    )
    contact = system.contact
    no_verdict = why_no_verdict(system)

    # A column for each characteristic that varies, and for each metric.
    frame = pd.DataFrame(settings, columns=list(characteristics.names))[names]
    columns = {
        item.name: Column(item.unit, "value", "g") for item in characteristics if item.name in names
    }
    columns["outcome"] = Column("", "how the simulation ends")
    metrics = {metric.name: metric for metric in system.measuring.scoring.metrics}
    for name in evaluations.metrics:
        columns[name] = (
            Column(metrics[name].unit, metrics[name].title, ".3f")
            if name in metrics
            else Column("", name)
        )
    columns["gap"] = Column("m", "least distance between bodies", ".3f", is_shown=bool(contact))
    values = {
        "outcome": evaluations.outcome,
        **evaluations.metrics,
        "gap": evaluations.gaps(contact),
    }
    frame = frame.assign(**{name: column[1:] for name, column in values.items()})

    # What a reader should know of the settings.
    collisions = int(evaluations.collided[1:].sum())
    centres = f" ({FROM_CENTRES.strip()}: bodies touch at {contact:.2f} m)" if contact else ""
    note = f"Safety degree: least distance in m{centres}, or minus the collision speed in m/s."
    remarks = [*_remarks(system), note]
    read_first = list[str]()
    if unsafe_originals := np.count_nonzero(system.measuring.scoring.violation(evaluations)[1:]):
        read_first.append(f"Remark: In {unsafe_originals} of {len(frame)} settings {NOT_SAFE}.")
    if len(names) == 1 and rises_again(frame, names[0], characteristics):
        read_first.append(
            "Remark: The safety degree does not fall steadily along this sweep: it rises again"
            " further from the original value, so do not extrapolate from two values."
        )
        remarks.append(
            "The driving system decides only once per frame, so a weaker vehicle may get a harder"
            " or an earlier brake command."
        )
    verb = "collide" if collisions > 1 else "collides"
    counts = f"Of {number_of(len(frame), 'setting')}, {collisions or 'none'} {verb}."
    sentences = [no_verdict, counts, _original_in_words(system, evaluations), *read_first]
    return Answer(
        question="simulate",
        study=study,
        verdict=" ".join(filter(None, sentences)),
        numbers={"driven": not no_verdict, "settings": len(frame), "collisions": collisions},
        tables={"sweep": tabulate(study.title, columns, frame), "remarks": _remark_table(remarks)},
    )


def _original_in_words(system: System, evaluations: Evaluations) -> str:
    """How the original vehicle ends, the first of a sweep's evaluations."""
    where = " in the original encounter" if len(system.characteristics.scenario) else ""
    ending = ending_in_words(evaluations.outcome[0], evaluations.f_safe[0], system.contact)
    points = len(system.matrix)
    worst = f", in the worst of {points} test cases" if points > 1 else ""
    return f"The original vehicle{where} {ending}{worst}."


def _remark_table(remarks: list[str]) -> pd.DataFrame:
    return tabulate("Remarks", REMARKS, [(remark,) for remark in dict.fromkeys(remarks)])


def _without_repetition(frame: pd.DataFrame, simulation: Simulation) -> pd.DataFrame:
    """A table whose readers see the values of the original vehicle once if nothing is changed."""
    if simulation.row == 0:
        columns = frame.attrs["columns"]
        for name in {"simulated", "changed"} & set(columns):
            columns[name] = columns[name]._replace(is_shown=False)
    return frame


def _characteristics(simulation: Simulation) -> pd.DataFrame:
    pairs = zip(CharacteristicSet.of(simulation.study), simulation.setting.values(), strict=True)
    rows = (
        (item.name, item.unit, item.original, value, value != item.original, item.words)
        for item, value in pairs
    )
    return _without_repetition(tabulate(simulation.study.title, CHARACTERISTICS, rows), simulation)


def _verdict(simulation: Simulation, point_count: int) -> list[str]:
    """How the simulated vehicle and, if it differs, the original end; of a matrix in the worst of
    its test cases.
    """
    # Where both meet the obstacle: in an encounter, a test case, or the worst of several.
    least = simulation.scoring.safe_original
    name = simulation.pair.point.name
    where = "The" if least is None else "In this encounter the"
    worst = ""
    if point_count > 1:
        kind = "least" if simulation.metrics[SAFETY_DEGREE] > 0 else "worst"
        worst = f", the {kind} of {point_count} test cases ({name})"
        where = "The"
    elif name:
        where = f"In the test case {name}, the"

    # The simulated vehicle first if the case is its worst one.
    original = f"original vehicle {simulation.original.verdict}"
    changed = f"changed vehicle {simulation.verdict}"
    comparison = _safety_comparison(simulation)
    if simulation.setting == simulation.original.setting:
        verdict = [f"{where} {original}{worst}."]
    elif worst:
        verdict = [f"The {changed}{worst}.", f"In the same test case the {original}: {comparison}."]
    else:
        verdict = [f"{where} {original}.", f"The {changed}: {comparison}."]

    # Why it looks safer, and why a search leaves this encounter out.
    verdict += why_safer(simulation)
    if least is not None and not simulation.original.metrics[SAFETY_DEGREE] >= least:
        verdict.append(f"Here {NOT_SAFE}: at least {least:.2f} m.")
    return verdict


def _safety_comparison(simulation: Simulation) -> str:
    # By the stopping distance, if both stop for it.
    stop = simulation.metrics.get(STOPPING_DISTANCE.name, np.nan)
    original_stop = simulation.original.metrics.get(STOPPING_DISTANCE.name, np.nan)
    if np.isfinite(stop / original_stop):
        return (
            f"the stopping distance of the changed vehicle is {stop / original_stop:.2f} times that"
            " of the original"
        )

    # Else by the safety degree.
    degree = simulation.metrics[SAFETY_DEGREE]
    original = simulation.original.metrics[SAFETY_DEGREE]
    if np.isnan(degree) or np.isnan(original):
        return "whether the changed vehicle is less safe cannot be decided"
    if degree == original:
        return "both are equally safe"
    return f"the changed vehicle is {'less safe' if degree < original else 'safer'}"


def _remarks(system: System) -> list[str]:
    remarks = [remark for point in system.points for remark in point.scenario.remarks()]
    pre_crash = pre_crash_sentence(system.points)
    return [*remarks, *system.remarks, *vehicle_remarks(system), *filter(None, [pre_crash])]
