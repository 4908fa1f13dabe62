"""Derive `safevar_sumo/protocol/euro_ncap_2026.toml` from the official calculator, in an
environment that has the calculator.

`python calibration/euro_ncap.py > safevar_sumo/protocol/euro_ncap_2026.toml` after
`pip install euroncap-rating-2026 'pandas<3'`.
"""

from __future__ import annotations

from importlib.metadata import version
from importlib.resources import files

import openpyxl
from euroncap_rating_2026 import common
from euroncap_rating_2026.crash_avoidance import data_model, matrix_processing, robustness_layer

KEY = data_model.StageSubelementKey.FC
NOT_SIMULATED = ("CCFhos", "CCFhol", "CCFtap", "CMFtap", "CPTA", "CBTA")
MASK = {matrix_processing.TestRange.STANDARD: "S", matrix_processing.TestRange.EXTENDED: "E"}


HEADER = """\
# Euro NCAP's crash avoidance, frontal collisions, protocol v1.2 (July 2026): matrices, points \
and robustness layers.
# Derived by calibration/euro_ncap.py from euroncap-rating-2026 {0} (PyPI, Apache-2.0):
# its template ca_template.xlsx and its modules crash_avoidance.data_model, matrix_processing, \
robustness_layer. Do not edit.
# range_letters: one for each column, S standard, E extended, - no cell; has_function_choice: \
the manufacturer chooses
# AEB or FCW.

calculator_version = "{0}\""""
BANDS = """
# From which relative speed at impact [km/h] a cell has a colour, by the speed of the vehicle \
under test [km/h], the last
# row for all faster ones; and from which time to collision at the warning [s]. \
Measured values have two decimals.
[starts_by_vut_speed]"""
BEST_FIRST = ["green", "yellow", "orange", "brown", "red"]


def number(text: object) -> float:
    value = float(str(text).removesuffix(" km/h"))
    return int(value) if value.is_integer() else value


def quoted(values: object) -> str:
    return (
        "["
        + ", ".join(f'"{value}"' if isinstance(value, str) else f"{value:g}" for value in values)
        + "]"
    )


def block(sheet, frame, name: str) -> list[str]:
    """A matrix of a prediction sheet as TOML."""
    extent = matrix_processing.get_matrix_indices(frame, name)
    # A choice of function is taken as AEB up to CCRs and CMRs, where AEB is assessed either way,
    # and as FCW for CPLA and CBLA.
    top, left, n_rows, n_columns = (
        extent["start_row"] + 2,
        extent["start_col"] + 1,
        extent["n_rows"],
        extent["n_cols"],
    )
    headings = {sheet.cell(top - 2, column).value: column for column in range(2, left + 1)}
    test, _, light = name.partition(" ")
    column_key, convert = "target_speed", number
    if "Impact location" in headings:
        column_key, convert = "impact_location", lambda share: round(100 * share)
    columns = [convert(sheet.cell(top - 1, left + k).value) for k in range(n_columns)]
    points = {(p.row, p.col): p for p in matrix_processing.get_test_matrix(frame, name, KEY)}
    rows = []
    for k in range(n_rows):
        function = (
            sheet.cell(top + k, headings["Function"]).value if "Function" in headings else "AEB"
        )
        speeds = f"vut_speed = {number(sheet.cell(top + k, 1).value)}"
        if column_key == "impact_location":
            speeds += (
                f", target_speed = {number(sheet.cell(top + k, headings['Target speed']).value)}"
            )
        mask = "".join(
            MASK[points[k, j].test_range] if (k, j) in points else "-" for j in range(n_columns)
        )
        choice = "" if function else ", has_function_choice = true"
        rows.append(f'  {{ {speeds}, range_letters = "{mask}"{choice} }},')
    total = data_model.TOTAL_SCORES[name]
    kinds = ("Standard", "Extended", "Robustness")
    points = ", ".join(f"{total[kind] or 0:g}" for kind in kinds)
    return [
        "",
        "[[matrices]]",
        f'test_name = "{test}"',
        *([f'light = "{light}"'] if light else []),
        f'measure = "{measure(name)}"',
        f'sheet = "{sheet.title}"',
        f'first_cell = "{sheet.cell(top, left).coordinate}"',
        *(
            [f'function_column = "{sheet.cell(top, headings["Function"]).column_letter}"']
            if "Function" in headings
            else []
        ),
        f"points = [{points}]",
        f"{column_key}s = {quoted(columns)}",
        "rows = [",
        *rows,
        "]",
    ]


def measure(name: str) -> str:
    return {"mitigation or avoidance": "mitigation", "avoidance": "avoidance"}[
        data_model.get_criteria_for_test(name).value
    ]


def bands(test: str, attributes: dict[str, str], colours: list[str]) -> str:
    """Lower limits of the colours of a measured value, from the calculator's colours at each
    hundredth.
    """
    limits = []
    for hundredth in range(6001):
        point = matrix_processing.TestPoint(
            0, 0, common.PredictionColor.GREY, matrix_processing.TestRange.STANDARD, attributes
        )
        colour = matrix_processing.ComputedTestPoint(
            point, test, hundredth / 100
        ).measured_color.value
        if not limits or limits[-1][0] != colour:
            limits.append((colour, hundredth / 100))
    assert [colour for colour, _ in limits] == [
        colour for colour in colours if colour in dict(limits)
    ]
    return "{ " + ", ".join(f"{colour} = {start:g}" for colour, start in limits) + " }"


def main() -> None:
    path = files("data").joinpath("ca_template.xlsx")
    book, frames = openpyxl.load_workbook(str(path)), common.read_excel_file_to_dfs(str(path))
    print(HEADER.format(version("euroncap-rating-2026")))
    colours = {
        colour.value: "".join(f"{round(255 * part):02X}" for part in rgb)
        for colour, rgb in common.PREDICTION_COLOR_MAP.items()
    }
    print("colours = { " + ", ".join(f'{name} = "{colours[name]}"' for name in BEST_FIRST) + " }")
    print(BANDS)
    for vut in (10, 20, 30, 40, 50):
        print(f"{vut} = {bands('CCRs', {'VUT speed': f'{vut} km/h'}, BEST_FIRST)}")
    assert bands("CCRs", {"VUT speed": "130 km/h"}, BEST_FIRST) == bands(
        "CCRs", {"VUT speed": "50 km/h"}, BEST_FIRST
    )
    print("[starts_by_measure]")
    print(f"avoidance = {bands('CCCscp', {'VUT speed': '50 km/h'}, BEST_FIRST)}")
    print(
        f"warning = {bands('CBLA', {'VUT speed': '50 km/h', 'Function': 'FCW'}, BEST_FIRST[::-1])}"
    )
    lines = [
        "",
        "# Points of every test of the stage: standard, extended, robustness.",
        "[points_by_test]",
    ]
    scenario: dict[str, list[float]] = {}
    for row in book["Scenario Scores"].iter_rows(min_row=2, values_only=True):
        name = row[4] or name  # noqa: F821
        scenario.setdefault(name, []).append(row[7])
    lines += [
        f'"{name}" = [{", ".join(f"{value:g}" for value in [*points, 0, 0][:3])}]'
        for name, points in scenario.items()
    ]
    simulated_tests = []
    for part, names in data_model.STAGE_SUBELEMENT_TO_LOADCASES["FC"].items():
        for name in names:
            test = data_model.SUBTEST_TO_TEST_DICT.get(name, name)
            if test not in NOT_SIMULATED:
                lines += block(book[f"FC - {part} pred."], frames[f"FC - {part} pred."], name)
                simulated_tests.append((test, part))
    for test, part in dict.fromkeys(simulated_tests):
        lines += layers(book[f"FC - {part} robust. pred."], test)
    print("\n".join(lines))


def layers(sheet, test: str) -> list[str]:
    """The robustness layers of a test as TOML."""
    lines = []
    column = next(cell.column for cell in sheet[1] if cell.value == test)
    conditions_by_layer = robustness_layer.ROBUSTNESS_LAYER_TO_VERIFICATION_CONDITION
    for row in range(2, sheet.max_row + 1):
        cell, layer = sheet.cell(row, column), sheet.cell(row, 2).value
        if cell.fill.fill_type and cell.fill.fgColor.tint:
            pairs = next(
                (
                    conditions_by_layer[key].get(test, [])
                    for key in conditions_by_layer
                    if key.value == layer
                ),
                [],
            )
            pairs = [pairs] if isinstance(pairs, tuple) else pairs
            conditions = [
                f'{{ text = "{text}", criterion = "{kind.value}" }}' for text, kind in pairs
            ]
            lines += [
                "",
                "[[layers]]",
                f'test_name = "{test}"',
                f'name = "{layer}"',
                f'sheet = "{sheet.title}"',
                f'claim_cell = "{cell.coordinate}"',
                f"conditions = [{', '.join(conditions)}]",
            ]
    return lines


if __name__ == "__main__":
    main()
