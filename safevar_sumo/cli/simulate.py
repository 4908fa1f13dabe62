"""The command `simulate`, which simulates a study once or, in a sweep, many times, and prints the results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.text import Text

from safevar_sumo.api.evaluation import evaluate_settings
from safevar_sumo.api.simulation import Simulation, simulate_with_original
from safevar_sumo.cli.arguments import (
    CommandTarget,
    JsonAnswer,
    as_it_is_now_option,
    check_output,
    combine_values,
    complete_changes,
    complete_study,
    file_option,
    gated,
    json_option,
    load_target,
    point_option,
)
from safevar_sumo.cli.program import commands, print_json, print_note, print_warning
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS, STOPPING_DISTANCE
from safevar_sumo.output import whole_file
from safevar_sumo.questions.ask import find_question
from safevar_sumo.questions.changes import read_changes
from safevar_sumo.questions.model_spread import ModelSpread, compute_model_spreads, remarks_on_sets, studies_of_sets
from safevar_sumo.questions.words import points_in_words
from safevar_sumo.records import KMH_PER_MS, Evaluations, FloatArray, JsonObject, Outcome, finite_or_none
from safevar_sumo.results import record
from safevar_sumo.scenarios import LOCATION_DIMENSION, SPEED_DIMENSION, degree_note, pre_crash_sentence
from safevar_sumo.study import SAFETY_DEGREE, Study, unit_text
from safevar_sumo.sumo.empty_road import summary_entry, why_no_verdict
from safevar_sumo.sumo.matrix import (
    PointResult,
    contact_degree,
    point_record,
    simulate_all_points,
    system_at_point,
    vehicle_remarks,
)
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import WholeTable, print_heading, print_meanings, print_text
from safevar_sumo.vehicles import CharacteristicSet


@commands.command(name="simulate")
@click.argument("study", metavar="STUDY|DIR", shell_complete=complete_study)
@click.option(
    "--solution", metavar="ALG:RUN:N", help="Replay solution N of a run in a results directory; N counts from 0."
)
@click.option("--most-severe", "choice", flag_value="most_severe", help="Replay the most severe solution.")
@click.option("--fewest", "choice", flag_value="fewest", help="Replay the unsafe solution with the fewest changes.")
@click.option(
    "--smallest", "choice", flag_value="smallest", help="Replay the unsafe solution with the smallest changes."
)
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="NAME=VALUE",
    shell_complete=complete_changes,
    help="A characteristic's value in its unit, +10% of the original, or a sweep FROM..TO; repeat --set for others.",
)
@click.option("--no-filter", is_flag=True, help="Keep changes that are smaller than the filter's thresholds.")
@click.option(
    "--beyond", is_flag=True, help="Also accept values beyond the domains, and settings that violate a constraint."
)
@file_option("--trace", "Write the simulation step by step.", metavar="FILE.csv")
@file_option("--plot", "Draw the simulation beside the original vehicle's to this file: png, pdf or svg.")
@file_option("--animate", "Animate both simulations, seen from above, in this file: gif or html.")
@click.option("--gui", is_flag=True, help="Show both simulations in sumo-gui, each on its own road.")
@click.option(
    "--slower",
    type=click.FloatRange(0.01, 1000),
    metavar="TIMES",
    help="How many times slower than real time --gui plays.  [default: 1]",
)
@as_it_is_now_option
@point_option
@click.option(
    "--spread",
    is_flag=True,
    help="Add the vehicle model's own uncertainty: other parameters that fit published data as well.",
)
@json_option
@gated
def simulate_command(
    study: str,
    solution: str | None,
    choice: str | None,
    changes: tuple[str, ...],
    no_filter: bool,
    beyond: bool,
    trace: Path | None,
    plot: Path | None,
    animate: Path | None,
    gui: bool,
    slower: float | None,
    point: str | None,
    spread: bool,
    as_json: bool,
) -> JsonAnswer:
    """Simulate STUDY once, or a solution of the results directory DIR with the study as recorded there."""
    target = load_target(study, solution, choice)
    system = assemble(target.study, target.source)
    if point is not None:
        system = system_at_point(system, point, source="--point")
    values_by_name = read_changes(changes, system.characteristics, "--set", beyond=beyond)
    base = system.characteristics.original if target.setting is None else target.setting
    requested_settings = combine_values(values_by_name, base, system.characteristics)
    if not beyond and changes:
        system.check_feasible(requested_settings, "--set", filtered=not no_filter, switch="--beyond")
    _check_outputs(trace, plot, animate)
    if any(len(values) > 1 for values in values_by_name.values()):
        if trace or plot or animate or gui or spread:
            expected = "one value for each characteristic with --trace, --plot, --animate, --gui or --spread"
            raise InputError("--set", f"{' '.join(changes)} is a sweep", expected)
        return _simulate_sweep(target, system, requested_settings, tuple(values_by_name), not no_filter, as_json)
    if spread:
        studies_of_sets(target.study)  # refuses a study without sets before any simulation
        for remark in remarks_on_sets(target.study):
            print_note(remark)
    simulation = simulate_with_original(target.study, system, requested_settings[0], filtered=not no_filter)
    if target.row is not None and not changes and point is None:  # results belong to the whole matrix
        from safevar_sumo.replay.comparison import list_differences, why_different

        for difference in list_differences(simulation.evaluation, target.row):
            why = why_different(is_imported="run" not in target.row)
            print_warning(f"{target.handle} of {study}: {difference}; {why}")
    if trace is not None:
        with whole_file(trace, "--trace") as file:
            simulation.trace.to_csv(file, index=False, lineterminator="\n")
    if plot or animate or gui:
        _show(target.study, system, simulation.evaluation.settings[0], plot, animate, (slower or 1.0) if gui else None)
    spreads = []
    if spread:
        settings = np.stack([simulation.evaluation.settings[0], system.characteristics.original])
        spreads = compute_model_spreads(target.study, settings, point or "")
    return _print_results(target, system, simulation, spreads, as_json)


def _check_outputs(trace: Path | None, plot: Path | None, animation: Path | None) -> None:
    """Before any simulation, refuse files that cannot be written."""
    check_output(trace, "--trace", (".csv",))
    check_output(plot, "--plot")
    if animation is not None:
        from safevar_sumo.replay.animation import ENDINGS

        check_output(animation, "--animate", ENDINGS)


def _show(
    study: Study, system: System, setting: FloatArray, plot: Path | None, animation: Path | None, slower: float | None
) -> None:
    """Simulate a filtered setting, shape (n,), beside the original vehicle, and show both: as files, and `slower` in
    sumo-gui.
    """
    from safevar_sumo.questions.figures import save
    from safevar_sumo.replay.animation import animate
    from safevar_sumo.replay.comparison import compare_setting
    from safevar_sumo.replay.figure import draw_comparison
    from safevar_sumo.replay.gui import show_in_gui

    comparison = compare_setting(study, system, setting)
    if plot is not None:
        save(draw_comparison(comparison), plot, "--plot")
    if animation is not None:
        animate(comparison, animation)
    if slower is not None:
        show_in_gui(comparison, slower=slower)


def _simulate_sweep(
    target: CommandTarget,
    system: System,
    requested_settings: FloatArray,
    names: tuple[str, ...],
    filtered: bool,
    as_json: bool,
) -> list[JsonObject]:
    """Simulate and print a sweep; returns its JSON."""
    settings = system.characteristics.filter(requested_settings) if filtered else requested_settings
    evaluations = evaluate_settings(
        target.study, np.concatenate([system.characteristics.original[np.newaxis], settings])
    )
    no_verdict, contact = why_no_verdict(system), contact_degree(system)
    gaps = evaluations.gaps(contact)
    _, *records = [  # without the original
        {
            "study": target.study.name,
            "vcs": dict(zip(system.characteristics.names, setting, strict=True)),
            **record(evaluations, row),
            "gap": finite_or_none(gaps[row]),
        }
        for row, setting in enumerate(evaluations.settings.tolist())
    ]
    if as_json:
        print_json([*records, *summary_entry(no_verdict)])
    else:
        print_heading(Console(), target.study.title, no_verdict)
        print_sweep(Console(), system.characteristics, names, evaluations, contact)
    reset_count = np.count_nonzero((settings != requested_settings).any(axis=1))
    if reset_count:
        print_note(
            f"in {reset_count} of {len(requested_settings)} settings the filter reset small changes; "
            "--no-filter keeps them"
        )
    return records


def _print_results(
    target: CommandTarget, system: System, simulation: Simulation, spreads: Sequence[ModelSpread], as_json: bool
) -> JsonObject:
    """Print a simulation; returns its JSON."""
    shows_points = system.matrix and (as_json or system.rater is None)
    results_at_points = simulate_all_points(system, simulation.evaluation.settings) if shows_points else []
    solution = {} if target.handle is None else {"solution": str(target.handle)}
    matrix = {"points": [point_record(result) for result in results_at_points]} if results_at_points else {}
    spread = {"spread": {**spreads[0]._asdict(), "original": spreads[1]._asdict()}} if spreads else {}
    answer: JsonObject = {**simulation.to_dict(), **solution, **matrix, **spread}
    if as_json:
        print_json(answer)
    else:
        print_simulation(Console(), simulation)
        # strict=False: without --spread there are none
        for vehicle, model_spread in zip(("the simulated vehicle", "the original"), spreads, strict=False):
            print_text(Console(), f"The vehicle model's own uncertainty, {vehicle}: {model_spread}.")
        if system.rater is None:
            print_matrix(Console(), results_at_points)
        else:
            print_text(
                Console(),
                f"{len(system.matrix)} cells and variations: run `{_rating_command(target, system, simulation)}`",
            )
        if types := pre_crash_sentence(system.points):
            print_text(Console(), types)
    remarks = [remark for point in system.points for remark in point.scenario.remarks()]
    for remark in dict.fromkeys([*remarks, *system.remarks, *vehicle_remarks(system)]):
        print_note(remark)
    for name, value in simulation.reset_values.items():
        print_note(
            f"{name} = {value:g} differs from the original by less than the filter threshold and was reset to "
            f"{simulation.setting[name]:g}; --no-filter keeps it"
        )
    return answer


def _rating_command(target: CommandTarget, system: System, simulation: Simulation) -> str:
    """The command that rates the simulated vehicle: a solution, and the values that differ from it or from the
    original.
    """
    base = system.characteristics.original if target.setting is None else target.setting
    changes = [
        f"{name}={simulation.setting[name]!r}"
        for name, value in zip(system.characteristics.names, base.tolist(), strict=True)
        if simulation.setting[name] != value
    ]
    solution = None if target.handle is None else str(target.handle)
    return find_question("rating").command_line([target.source], None, {"set": tuple(changes), "solution": solution})


def print_simulation(console: Console, simulation: Simulation) -> None:
    """Print a setting beside the original vehicle: its values, outcome, metrics and objectives, and a verdict."""
    if simulation.no_verdict:
        print_text(console, simulation.no_verdict)
    table = WholeTable("characteristic", "unit", right=("original", "simulated"), title=simulation.study.title)
    characteristics = CharacteristicSet.of(simulation.study)
    changed = [row for row in characteristics if simulation.setting[row.name] != row.original]
    for row in characteristics:
        value, style = simulation.setting[row.name], "bold" if row in changed else None
        beyond = "" if row.lower <= value <= row.upper else " (beyond)"
        table.add_row(row.name, row.unit, f"{row.original:g}", f"{value:g}{beyond}", style=style)
    console.print(table)
    print_meanings(console, changed)
    records = (simulation.original.to_dict(), simulation.to_dict())
    table = WholeTable("result", "unit", right=("original", "simulated"))
    table.add_row("outcome", "", *(record["outcome"] for record in records))
    for name, unit in simulation.units.items():
        table.add_row(
            name, unit, *("undefined" if record[name] is None else f"{record[name]:.4g}" for record in records)
        )
    console.print(table)
    print_text(console, f"The original vehicle {simulation.original.verdict}.")
    if simulation is not simulation.original and simulation.setting != simulation.original.setting:
        print_text(console, f"The changed vehicle {simulation.verdict}: {_safety_comparison(simulation)}.")


def _safety_comparison(simulation: Simulation) -> str:
    degree, original = simulation.metrics[SAFETY_DEGREE], simulation.original.metrics[SAFETY_DEGREE]
    if np.isnan(degree) or np.isnan(original):
        return "whether that is less safe cannot be decided"
    if degree == original:
        return "as safe as the original"
    gaps = "" if simulation.gap == degree else f", gap {simulation.gap:.2f} against {simulation.original.gap:.2f} m"
    change = "less safe" if degree < original else "safer"
    return f"{change} than the original, SD {degree:.2f} against {original:.2f}{gaps if degree > 0 else ''}"


def print_sweep(
    console: Console, characteristics: CharacteristicSet, names: Sequence[str], evaluations: Evaluations, contact: float
) -> None:
    """Print a row for each setting, of which the first is the original: the named characteristics, outcome and
    metrics; where bodies touch at a safety degree of `contact` above 0 [m], gaps too.
    """
    columns = [characteristics.names.index(name) for name in names]
    units = [characteristics.members[column].unit for column in columns]
    table = WholeTable(right=(name + unit_text(unit, ", {}") for name, unit in zip(names, units, strict=True)))
    table.add_column("outcome")
    columns_of_metrics = {
        METRICS[name].heading if name in METRICS else name: values for name, values in evaluations.metrics.items()
    }
    if contact:
        columns_of_metrics["gap, m"] = evaluations.gaps(contact)
    for head in columns_of_metrics:
        table.add_column(head, justify="right")
    for row, outcome in enumerate(evaluations.outcome):
        metrics = [values[row] for values in columns_of_metrics.values()]
        table.add_row(
            *(f"{value:g}" for value in evaluations.settings[row, columns]),
            str(outcome),
            *("-" if np.isnan(value) else f"{value:.3f}" for value in metrics),
            end_section=row == 0,
        )
    console.print(table)
    print_text(console, f"First row: the original vehicle. {degree_note(contact)}")


COLOUR_BANDS = ((5.0, "green"), (15.0, "yellow"), (25.0, "dark_orange"), (35.0, "orange4"))
"""Upper limits of the relative impact speed [km/h] and their colours, from Euro NCAP's car-to-car AEB tests; above
them: red.
"""


def print_matrix(console: Console, results: Sequence[PointResult]) -> None:
    """Print a table for each test and weather: rows are speeds and other dimensions, columns are impact locations."""
    records = [point_record(result) for result in results]
    tables: dict[str, dict[str, dict[Any, Text]]] = {}
    for result, entry in zip(results, records, strict=True):
        coordinates = dict(result.point.parameters)
        title = f"{coordinates.pop('test')}, {coordinates.pop('weather')}"
        location = coordinates.pop(LOCATION_DIMENSION, None)
        speed = [f"{coordinates.pop(SPEED_DIMENSION):g} km/h"] if SPEED_DIMENSION in coordinates else []
        name = ", ".join([*speed, *(f"{key} {value}" for key, value in coordinates.items())])
        tables.setdefault(title, {}).setdefault(name, {})[location] = _cell_text(entry)
    for title, rows in tables.items():
        columns = dict.fromkeys(location for cells in rows.values() for location in cells)
        table = WholeTable(
            "speed", right=("" if column is None else f"{column:g} %" for column in columns), title=title
        )
        for name, cells in rows.items():
            table.add_row(name, *(cells.get(column, "") for column in columns))
        console.print(table)
    if records:
        failing = [entry["point"] for entry in records if entry["impact_speed"] is not None]
        summary = points_in_words(failing, len(records))
        if invalid := sum(entry["outcome"] == Outcome.INVALID_TEST for entry in records):
            summary += (
                f" {invalid} are invalid tests: the vehicle violates the test's speed tolerance before the ADS acts."
            )
        print_text(console, summary)


def _cell_text(result: JsonObject) -> Text:
    if stop := result.get(STOPPING_DISTANCE.name):
        return Text(f"{stop:.1f} m")
    if result["outcome"] == Outcome.INVALID_TEST:
        return Text(f"{result['outcome']} ({result['test_speed_error']:+.1f} km/h)", "magenta")
    if result["impact_speed"] is None:
        contact = f", {result['contact']['side']} side touched" if "contact" in result else ""
        is_avoided = result["outcome"] in (Outcome.STOPPED, Outcome.PASSED)
        return Text(f"avoided{contact}" if is_avoided else result["outcome"], "green")
    relative_speed = (result["relative_impact_speed"] or 0.0) * KMH_PER_MS
    colour = next((colour for limit, colour in COLOUR_BANDS if relative_speed < limit), "red")
    return Text(f"{result['impact_speed'] * KMH_PER_MS:.1f} km/h", colour)
