"""A rating in words, as text on the terminal, and its matrices as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from safevar_sumo.analysis.figures import FONT_SIZE, escape_dollars, new_panels
from safevar_sumo.analysis.rating.compute import RatedTest, RatedVehicle, Rating, max_points
from safevar_sumo.analysis.words import join_phrases, list_of_changes, number_of, question_command
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol import COLOURS, CellMatrix
from safevar_sumo.protocol.cells import EXTENDED, WARNING
from safevar_sumo.records import Evaluations
from safevar_sumo.results import choose_handle, record, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.terminal import WholeTable, print_answer, print_text
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEGEND = ", ".join(f"{colour[0].upper()} {colour}" for colour in COLOURS) + "; small letters: extended range"
TERMINAL_STYLES = {
    "green": "black on green",
    "yellow": "black on bright_yellow",
    "orange": "black on dark_orange",
    "brown": "white on dark_red",
    "red": "white on red",
}
LIGHT_WORDS = {"day": " by day", "night": " by night", None: ""}
SUMMARY_CHOICES = {
    "fewest": "Fewest changes that cost a point",
    "smallest": "Smallest largest change that costs a point",
    "most_points": "Most points lost",
}


def print_rating(console: Console, rating: Rating) -> None:
    """Print the verdict, the points of every test, the robustness layers that hold, and the tests not simulated."""
    print_answer(console, rating.study, rating.no_verdict, rating.sentences())


def rating_parts(rating: Rating) -> list[str | WholeTable]:
    """The sentences and tables that `print_rating` prints."""
    return [rating_in_words(rating), _build_points_table(rating), _build_layers_table(rating), not_simulated(rating)]


def rating_in_words(rating: Rating) -> str:
    """The rating in a sentence: how many points the variant loses and in which test; without a variant, the original's
    points.
    """
    maximum = max_points(rating.protocol)
    variant = rating.variant
    if variant is None:
        return (
            f"The original vehicle earns {rating.original.points:.2f} of the {maximum:g} points of the tests that "
            "are simulated."
        )
    of_original_points = (
        f"of the {rating.original.points:.2f} points that the original earns (of {maximum:g} that are simulated)"
    )
    losses = ", ".join(f"{loss:.2f} of them in {test_in_words(test)}" for test, loss in lost_by_test(rating)[:1])
    result = (
        f"loses {rating.lost:.2f} {of_original_points}" + (f", {losses}" if losses else "")
        if rating.lost >= 0
        else f"earns {-rating.lost:.2f} points more, {variant.points:.2f} instead {of_original_points}"
    )
    return f"With {_changes_in_words(rating, variant)} the vehicle {result}."


def lost_by_test(rating: Rating) -> list[tuple[RatedTest, float]]:
    """Tests in which the variant has fewer points than the original, the largest loss first."""
    if rating.variant is None:
        return []
    pairs = zip(rating.original.tests, rating.variant.tests, strict=True)
    losses = [(before, round(before.total - after.total, 9)) for before, after in pairs]
    return sorted(((test, loss) for test, loss in losses if loss > 0), key=lambda test_and_loss: -test_and_loss[1])


def colour_changes_in_words(rating: Rating) -> list[tuple[str, str]]:
    """Tests with matrix cells whose colour the variant changes, each with a text on the colours and on speeds of the
    vehicle.
    """
    tests: dict[str, dict[str, list[str]]] = {}
    before, after = rating.original, rating.vehicles[-1]
    for number in np.flatnonzero(before.scores.colours[0] != after.scores.colours[0]).tolist():
        cell = rating.protocol.cells[number]
        if not cell.is_robustness_cell:
            colours = f"{before.colour(number) or 'unknown'} to {after.colour(number) or 'unknown'}"
            tests.setdefault(cell.matrix.name, {}).setdefault(colours, []).append(f"{cell.vut_speed:g}")
    return [
        (
            test,
            "; ".join(
                f"{colours} at {join_phrases(dict.fromkeys(speeds))} km/h ({number_of(len(speeds), 'cell')})"
                for colours, speeds in groups.items()
            ),
        )
        for test, groups in tests.items()
    ]


def not_simulated(rating: Rating) -> str:
    """Sentences on the tests and robustness layers without points."""
    points_by_test = rating.protocol.points_not_simulated
    tests = ", ".join(f"{test} {points:g}" for test, points in points_by_test.items())
    open_points = sum(
        test.matrix.points[2] * [*test.layers.values()].count(None) / len(test.layers) for test in rating.original.tests
    )
    return (
        f"Not simulated, neither passed nor failed: {tests}; {sum(points_by_test.values()):g} points. "
        f"Robustness layers that are neither simulated nor claimed: {open_points:.2f} points of the simulated tests."
    )


def test_in_words(test: RatedTest) -> str:
    return f"{test.matrix.test_name}{LIGHT_WORDS[test.matrix.light]}"


def _changes_in_words(rating: Rating, variant: RatedVehicle) -> str:
    characteristics = CharacteristicSet.of(rating.study)
    changes = [
        (
            f"{characteristic.short_name} "
            f"{float(characteristic.text(variant.setting[characteristic.name])):g}{characteristic.suffix}"
        )
        for characteristic in characteristics
        if variant.setting[characteristic.name] != characteristic.original
    ]
    return join_phrases(changes) if changes else "no change at all"


def _build_points_table(rating: Rating) -> WholeTable:
    """Points of every test as standard + extended + robustness = total."""
    names = [vehicle.name for vehicle in rating.vehicles]
    table = WholeTable(
        "test",
        right=[*names, *(["lost"] if rating.variant else []), "of"],
        title="Points: standard + extended + robustness = total",
    )
    for test_of_each in zip(*(vehicle.tests for vehicle in rating.vehicles), strict=True):
        original_test = test_of_each[0]
        lost = round(original_test.total - test_of_each[-1].total, 2)
        table.add_row(
            original_test.matrix.name,
            *(_format_sum(test.points) for test in test_of_each),
            *([f"{lost:.2f}" if lost else ""] if rating.variant else []),
            f"{sum(original_test.matrix.points):.2f}",
        )
    table.add_section()
    totals = [[sum(test.points[kind] for test in vehicle.tests) for kind in range(3)] for vehicle in rating.vehicles]
    table.add_row(
        "all",
        *map(_format_sum, totals),
        *([f"{rating.lost:.2f}"] if rating.variant else []),
        f"{max_points(rating.protocol):g}",
    )
    return table


def _format_sum(points: Sequence[float]) -> str:
    return f"{'+'.join(f'{value:.2f}' for value in points)} = {sum(points):.2f}"


def _build_layers_table(rating: Rating) -> WholeTable:
    """The layers that are simulated or claimed, the same by day and night; a variant has a row only where it differs
    from the original.
    """
    table = WholeTable(
        "test", "vehicle", "layers that hold", "layers that fail", "claimed layers", title="Robustness layers"
    )
    for test_of_each in zip(*(vehicle.tests for vehicle in rating.vehicles), strict=True):
        name = test_of_each[0].matrix.test_name
        original_layers = test_of_each[0].layers
        claimed = rating.original.rater.claims.get(name, ())
        for vehicle, test in zip(rating.vehicles, test_of_each, strict=True):
            if test.matrix.light != "night" and (vehicle is rating.original or test.layers != original_layers):
                simulated = {layer: holds for layer, holds in test.layers.items() if layer not in claimed}
                held, failed = (
                    ", ".join(layer for layer, holds in simulated.items() if holds is is_held)
                    for is_held in (True, False)
                )
                table.add_row(name, vehicle.name, held, failed, ", ".join(claimed))
    return table


def print_matrices(console: Console, rating: Rating) -> None:
    """Print every matrix: for each cell a letter, a colour, and the impact speed [km/h] or the time to collision at the
    warning [s].
    """
    cell_numbers = rating.protocol.matrix_cell_numbers
    for matrix in rating.protocol.matrices:
        meaning = "impact location [%]" if matrix.impact_locations else "speed of the target"
        columns = [f"{value:g}" for value in matrix.column_values]
        table = WholeTable("VUT", "target", right=columns, title=f"{matrix.name}: speeds [km/h], {meaning}")
        for row_number, row in enumerate(matrix.rows):
            keys = [(matrix.name, row_number, column) for column in range(len(row.range_letters))]
            cells = [_format_cell(rating, cell_numbers[key]) if key in cell_numbers else Text("") for key in keys]
            target = "" if row.target_speed is None else f"{row.target_speed:g}"
            table.add_row(_format_vut_speed(matrix, row_number), target, *cells)
        console.print(table)
    comparison = "; original>variant where they differ" if rating.variant else ""
    print_text(
        console,
        f"{LEGEND}. The number is the relative speed of the impact [km/h]; in rows with "
        f"FCW it is the time to collision at the warning [s]{comparison}.",
    )


def _format_vut_speed(matrix: CellMatrix, row_number: int) -> str:
    return f"{matrix.rows[row_number].vut_speed:g}{' FCW' if matrix.is_rated_by_warning(row_number) else ''}"


def _letter(vehicle: RatedVehicle, cell_number: int) -> str:
    """The colour of a cell as a letter, small in the extended range."""
    letter = (vehicle.colour(cell_number) or "?")[0]
    return letter if vehicle.protocol.cells[cell_number].range_or_layer == EXTENDED else letter.upper()


def _format_cell(rating: Rating, cell_number: int) -> Text:
    """The letters of a cell, of both vehicles where they differ, and what was measured with the last of them."""
    differs = len({vehicle.colour(cell_number) for vehicle in rating.vehicles}) > 1
    vehicles = rating.vehicles if differs else rating.vehicles[:1]
    styles = [TERMINAL_STYLES.get(vehicle.colour(cell_number) or "", "") for vehicle in vehicles]
    letters = [_letter(vehicle, cell_number) for vehicle in vehicles]
    text = Text(">").join(map(Text, letters, styles))
    is_warning = rating.protocol.cells[cell_number].judged_by == WARNING
    value = vehicles[-1].measured(cell_number)[is_warning]
    if value is not None and (is_warning or vehicles[-1].colour(cell_number) != "green"):
        text.append(f"{value:.{int(value < 10)}f}", style=styles[-1])
    return text


def matrices_figure(rating: Rating) -> Figure:
    """All matrices of every vehicle, side by side; small letters: extended range, asterisk: another colour than the
    original's.
    """
    points = "; ".join(f"{vehicle.name}: {vehicle.points:.2f} points" for vehicle in rating.vehicles)
    arrangement = " (original left, variant right)" if rating.variant else ""
    title = f"{rating.study.name}: {points} of {max_points(rating.protocol):g}{arrangement}"
    figure, axes = new_panels(title, len(rating.protocol.matrices), 4, (3.75, 2.6), 15.0, 0.0)
    for axis, matrix in zip(axes, rating.protocol.matrices, strict=True):
        _draw_matrix(axis, rating, matrix)
    figure.supxlabel(
        f"impact location [% of the width], or speed of the target [km/h] in CCCscp and CMCscp; {LEGEND}; "
        "asterisk: colour differs from the original's",
        fontsize=FONT_SIZE,
    )
    figure.supylabel("speed of the vehicle under test [km/h]", fontsize=FONT_SIZE)
    return figure


def _draw_matrix(axis: Axes, rating: Rating, matrix: CellMatrix) -> None:
    import seaborn as sns
    from matplotlib.colors import ListedColormap

    headings = [*(f"{value:g}" for value in matrix.column_values), ""]  # "": a gap after each vehicle
    cell_numbers = rating.protocol.matrix_cell_numbers
    colours = np.full((len(matrix.rows), len(headings) * len(rating.vehicles)), np.nan)
    letters = np.full(colours.shape, "", dtype="U2")
    for row, column in np.ndindex(colours.shape):
        vehicle_number, cell_column = divmod(column, len(headings))
        vehicle = rating.vehicles[vehicle_number]
        cell_number = cell_numbers.get((matrix.name, row, cell_column))
        if cell_number is not None:
            differs = vehicle.colour(cell_number) != rating.original.colour(cell_number)
            colours[row, column] = vehicle.scores.colours[0, cell_number]
            letters[row, column] = _letter(vehicle, cell_number) + "*" * differs
    palette = ListedColormap(["#808080", *(f"#{rating.protocol.colours[colour]}" for colour in COLOURS)])
    rows = [_format_vut_speed(matrix, row) for row in range(len(matrix.rows))]
    frame = pd.DataFrame(colours, rows, headings * len(rating.vehicles))
    sns.heatmap(
        frame, annot=letters, fmt="", cmap=palette, vmin=-1, vmax=len(COLOURS) - 1, cbar=False, linewidths=0.6, ax=axis
    )
    axis.grid(False)
    axis.tick_params(labelsize=FONT_SIZE - 2, length=0, rotation=0)
    totals = " / ".join(
        f"{test.total:.2f}" for vehicle in rating.vehicles for test in vehicle.tests if test.matrix is matrix
    )
    axis.set_title(escape_dollars(f"{matrix.name}: {totals} of {sum(matrix.points):g}"), fontsize=FONT_SIZE)


def summarise_rated_solutions(
    study: Study, solutions: pd.DataFrame, original: Evaluations, directory: str
) -> list[str]:
    """Summarise the solutions of a rated study in lines, the last with commands for the next steps.

    `directory` is the results directory in these commands; the other parameters are those of
    `safevar_sumo.analysis.explain.compute.summarise_failures`, which calls this function for rated studies.
    """
    points_column = RATING_POINTS.name
    original_points = float(original.column(points_column)[0])
    unsafe = Unsafe.default(record(original, 0), solutions["outcome"])
    has_loss = unsafe.rows(solutions)
    if not has_loss.any():
        return [
            f"No solution loses a point of the original's {original_points:.2f}.",
            f"Points against each characteristic: {question_command('tolerance', directory)}",
        ]
    characteristics = CharacteristicSet.of(study)
    lines = [
        f"The original vehicle earns {original_points:.2f} points. {int(has_loss.sum())} of "
        f"{number_of(len(solutions), 'solution')} lose at least one point."
    ]
    handle = None
    for choice, title in SUMMARY_CHOICES.items():
        handle = choose_handle(solutions, unsafe, choice, study.name)
        row = solutions.iloc[row_of_handle(solutions, handle)]
        setting = {characteristic: float(row[characteristic]) for characteristic in characteristics.names}
        loss = original_points - row[points_column]
        lines.append(f"{title}: {handle} loses {loss:.2f} points with {list_of_changes(characteristics, setting)}.")
    return [
        *lines,
        f"Which cells change colour: {question_command('rating', directory)} --solution {quote(str(handle))} --matrix; "
        f"which changes cause it: {question_command('explain', directory)}",
    ]
