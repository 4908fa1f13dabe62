"""A rating as text on the terminal, and its matrices as a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from safevar_sumo.analysis.figures import FONT, escape_dollars, new_figure
from safevar_sumo.analysis.rating.compute import RatedTest, RatedVehicle, Rating, max_points
from safevar_sumo.analysis.words import join_phrases, number_of
from safevar_sumo.protocol import COLOURS, CellMatrix
from safevar_sumo.terminal import WholeTable, print_heading, print_text
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOUR_LETTERS = {colour: colour[0].upper() for colour in COLOURS}
LEGEND = ", ".join(f"{letter} {colour}" for colour, letter in COLOUR_LETTERS.items())
TERMINAL_STYLES = {
    "green": "black on green",
    "yellow": "black on bright_yellow",
    "orange": "black on dark_orange",
    "brown": "white on dark_red",
    "red": "white on red",
}
DARK_COLOURS = ("green", "brown", "red")
"""Colours of cells whose text is white."""
LIGHT_WORDS = {"day": " by day", "night": " by night", None: ""}
FIGURE_COLUMNS = 4


def print_rating(console: Console, rating: Rating) -> None:
    """Print the verdict, the points of every test, the robustness layers that hold, and the tests not simulated."""
    print_heading(console, rating.study.title, rating.no_verdict)
    print_text(console, rating_in_words(rating))
    console.print(_build_points_table(rating))
    console.print(_build_layers_table(rating))
    print_text(console, not_simulated(rating))


def rating_in_words(rating: Rating) -> str:
    """The rating in a sentence: how many points the variant loses and in which test; without a variant, the original's
    points.
    """
    maximum, variant = max_points(rating.protocol), rating.variant
    if variant is None:
        return (
            f"The original vehicle earns {rating.original.points:.2f} of the {maximum:g} points of the tests that "
            "are simulated."
        )
    changes = _changes_in_words(rating, variant)
    of_original_points = (
        f"of the {rating.original.points:.2f} points that the original earns (of {maximum:g} that are simulated)"
    )
    if not rating.lost:
        return f"With {changes} the vehicle keeps all {of_original_points}."
    if rating.lost < 0:
        return (
            f"With {changes} the vehicle earns {-rating.lost:.2f} points more, {variant.points:.2f} instead "
            f"{of_original_points}."
        )
    losses = lost_by_test(rating)
    test, loss = losses[0]
    share = (
        "all" if math.isclose(loss, rating.lost, abs_tol=1e-6) else "most" if loss > rating.lost / 2 else f"{loss:.2f}"
    )
    return (
        f"With {changes} the vehicle loses {rating.lost:.2f} {of_original_points}, {share} of them in "
        f"{test_in_words(test)}."
    )


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
    tests: dict[str, dict[tuple[str, str], list[str]]] = {}
    for cell, before, after in rating.colour_changes():
        if not cell.is_robustness_cell:
            colours = before or "unknown", after or "unknown"
            tests.setdefault(cell.matrix.name, {}).setdefault(colours, []).append(f"{cell.vut_speed:g}")
    return [
        (
            test,
            "; ".join(
                f"{before} to {after} at {join_phrases(dict.fromkeys(speeds))} km/h ({number_of(len(speeds), 'cell')})"
                for (before, after), speeds in groups.items()
            ),
        )
        for test, groups in tests.items()
    ]


def not_simulated(rating: Rating) -> str:
    """Sentences on the tests and robustness layers without points."""
    points_by_test = rating.protocol.points_not_simulated
    tests = ", ".join(f"{test} {points:g}" for test, points in points_by_test.items())
    text = f"Not simulated, neither passed nor failed: {tests}; {sum(points_by_test.values()):g} points."
    if rating.unclaimed_points:
        text += (
            f" Robustness layers that are neither simulated nor claimed: {rating.unclaimed_points:.2f} points of "
            "the simulated tests."
        )
    return text


def test_in_words(test: RatedTest) -> str:
    return f"{test.matrix.test_name}{LIGHT_WORDS[test.matrix.light]}"


def _changes_in_words(rating: Rating, variant: RatedVehicle) -> str:
    characteristics = CharacteristicSet.of(rating.study.vehicle.characteristics)
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
        original_test, lost = test_of_each[0], round(test_of_each[0].total - test_of_each[-1].total, 2)
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
        claimed = rating.original.claims.get(test_of_each[0].matrix.test_name, ())
        for vehicle, test in zip(rating.vehicles, test_of_each, strict=True):
            if test.matrix.light != "night" and (vehicle is rating.original or test.layers != test_of_each[0].layers):
                held_layers, failed_layers = (
                    [layer for layer, holds in test.layers.items() if holds is expected and layer not in claimed]
                    for expected in (True, False)
                )
                table.add_row(
                    test.matrix.test_name,
                    vehicle.name,
                    ", ".join(held_layers),
                    ", ".join(failed_layers),
                    ", ".join(claimed),
                )
    return table


def print_matrices(console: Console, rating: Rating) -> None:
    """Print every matrix: for each cell a letter, a colour, and the impact speed [km/h] or the time to collision at the
    warning [s].
    """
    for matrix in rating.protocol.matrices:
        columns = [f"{location:g} %" for location in matrix.impact_locations] or [
            f"{speed:g}" for speed in matrix.target_speeds
        ]
        column_meaning = "impact location" if matrix.impact_locations else "speed of the target"
        headings = ["VUT", *(["target"] if matrix.impact_locations else [])]
        table = WholeTable(*headings, right=columns, title=f"{matrix.name}: speeds [km/h], {column_meaning}")
        for row_number, row in enumerate(matrix.rows):
            cells = [
                _format_cell(rating, matrix, row_number, column) if row.has_cell(column) else Text("")
                for column in range(len(row.range_letters))
            ]
            table.add_row(
                _format_vut_speed(matrix, row_number),
                *([] if row.target_speed is None else [f"{row.target_speed:g}"]),
                *cells,
            )
        console.print(table)
    compared = "; original>variant where they differ" if rating.variant else ""
    print_text(
        console,
        f"{LEGEND}; small letters: extended range. The number is the relative speed of the impact [km/h]; in rows with "
        f"FCW it is the time to collision at the warning [s]{compared}.",
    )


def _format_vut_speed(matrix: CellMatrix, row_number: int) -> str:
    return f"{matrix.rows[row_number].vut_speed:g}{' FCW' if matrix.is_rated_by_warning(row_number) else ''}"


def _format_cell(rating: Rating, matrix: CellMatrix, row_number: int, column: int) -> Text:
    cell_number = rating.protocol.matrix_cell_numbers[matrix.name, row_number, column]
    differs = len({vehicle.colour(cell_number) for vehicle in rating.vehicles}) > 1
    text = Text()
    for index, vehicle in enumerate(rating.vehicles if differs else rating.vehicles[:1]):
        text.append(">" if index else "")
        is_last = index == len(rating.vehicles) - 1 or not differs
        style = TERMINAL_STYLES.get(vehicle.colour(cell_number) or "", "")
        text.append(_format_cell_of_vehicle(vehicle, cell_number, with_value=is_last), style=style)
    return text


def _format_cell_of_vehicle(vehicle: RatedVehicle, cell_number: int, *, with_value: bool) -> str:
    cell, colour = vehicle.protocol.cells[cell_number], vehicle.colour(cell_number)
    cell_data = vehicle.cell_to_dict(cell_number)
    value = cell_data["warning_ttc"] if cell.judged_by == "warning" else cell_data["relative_impact_speed"]
    capital = "?" if colour is None else COLOUR_LETTERS[colour]
    letter = capital.lower() if cell.range_or_layer == "extended" else capital
    shows_value = with_value and value is not None and (colour != "green" or cell.judged_by == "warning")
    return f"{letter}{value:.1f}" if shows_value and value < 10 else f"{letter}{value:.0f}" if shows_value else letter


def matrices_figure(rating: Rating) -> Figure:
    """All matrices of every vehicle; cells of the extended range are hatched, cells with another colour than the
    original's framed.
    """
    matrices = rating.protocol.matrices
    rows = math.ceil(len(matrices) / FIGURE_COLUMNS)
    figure, axes = new_figure(points_title(rating), rows, FIGURE_COLUMNS, (15, 2.6 * rows))
    for axis in axes.flat[len(matrices) :]:
        axis.set_axis_off()
    for axis, matrix in zip(axes.flat, matrices, strict=False):
        _draw_matrices(axis, rating, matrix)
    figure.supxlabel(
        f"impact location [% of the width], or speed of the target [km/h] in CCCscp and CMCscp; {LEGEND}; "
        "hatched: extended "
        "range; thick frame: colour differs from the original's",
        fontsize=FONT,
    )
    figure.supylabel("speed of the vehicle under test [km/h]", fontsize=FONT)
    return figure


def points_title(rating: Rating) -> str:
    points = "; ".join(f"{vehicle.name}: {vehicle.points:.2f} points" for vehicle in rating.vehicles)
    arrangement = " (original left, variant right)" if rating.variant else ""
    return f"{rating.study.name}: {points} of {max_points(rating.protocol):g}{arrangement}"


def _draw_matrices(axis: Axes, rating: Rating, matrix: CellMatrix) -> None:
    """Draw a matrix for each vehicle, side by side."""
    from matplotlib.patches import Rectangle

    columns = max(len(row.range_letters) for row in matrix.rows)
    column_values = matrix.impact_locations or matrix.target_speeds
    ticks: list[tuple[float, str]] = []
    for index, vehicle in enumerate(rating.vehicles):
        offset = index * (columns + 0.6)
        ticks += [(offset + column + 0.5, f"{value:g}") for column, value in enumerate(column_values)]
        for cell_number, cell in enumerate(rating.protocol.cells):
            if cell.matrix is not matrix or cell.is_robustness_cell:
                continue
            colour, is_extended = vehicle.colour(cell_number), cell.range_or_layer == "extended"
            differs = index > 0 and colour != rating.original.colour(cell_number)
            fill_colour = f"#{rating.protocol.colours[colour]}" if colour else "#808080"
            text_colour = "white" if colour in DARK_COLOURS or colour is None else "black"
            axis.add_patch(
                Rectangle(
                    (offset + cell.column, cell.row),
                    width=1,
                    height=1,
                    facecolor=fill_colour,
                    edgecolor="white",
                    linewidth=0.6,
                    hatch="///" if is_extended else None,
                )
            )
            if differs:
                axis.add_patch(
                    Rectangle(
                        (offset + cell.column + 0.08, cell.row + 0.08),
                        width=0.84,
                        height=0.84,
                        fill=False,
                        edgecolor="black",
                        linewidth=1.8,
                    )
                )
            axis.text(
                offset + cell.column + 0.5,
                cell.row + 0.5,
                COLOUR_LETTERS.get(colour or "", "?"),
                ha="center",
                va="center",
                fontsize=FONT - 2,
                color=text_colour,
                bbox={"facecolor": fill_colour, "edgecolor": "none", "pad": 0.8},
            )
    axis.set_xlim(0, len(rating.vehicles) * (columns + 0.6) - 0.6)
    axis.set_ylim(len(matrix.rows), 0)
    axis.set_xticks([position for position, _ in ticks], [text for _, text in ticks], fontsize=FONT - 3)
    row_names = [_format_vut_speed(matrix, row_number) for row_number in range(len(matrix.rows))]
    axis.set_yticks([k + 0.5 for k in range(len(row_names))], row_names, fontsize=FONT - 2)
    axis.grid(visible=False)
    totals = " / ".join(
        f"{test.total:.2f}" for vehicle in rating.vehicles for test in vehicle.tests if test.matrix is matrix
    )
    axis.set_title(escape_dollars(f"{matrix.name}: {totals} of {sum(matrix.points):g}"), fontsize=FONT)
