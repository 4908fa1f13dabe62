"""Euro NCAP's official calculator, from PyPI, computes equal points and colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.protocol import COLOURS, EURO_NCAP_2026, protocol_of
from safevar_sumo.protocol.rater import Rater
from safevar_sumo.records import CellResults
from tests.rating.calculator import Calculator, fill_drawn_cells, fill_template

pytestmark = pytest.mark.slow
PROTOCOL = protocol_of(EURO_NCAP_2026)
N = len(PROTOCOL.cells)
CLAIMS = {"CCRs": ["Driver input pre-crash", "Illumination (Sun glare)"], "CPNCO": ["Driver input pre-crash", "Type"]}


@pytest.fixture(scope="module")
def calculator(tmp_path_factory: pytest.TempPathFactory) -> Calculator:
    return Calculator.built(tmp_path_factory.mktemp("calculator") / "environment")


@pytest.fixture(scope="module")
def template(calculator: Calculator, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return calculator.template(tmp_path_factory.mktemp("template"))


def agrees(rater: Rater, cells: CellResults, calculator: Calculator, template: Path, place: Path) -> None:
    """Asserts that the calculator's points of every simulated test and its colour of every cell that it draws equal
    this package's.
    """
    place.mkdir(exist_ok=True)
    fill_template(template, place / "predicted.xlsx", rater, cells)
    drawn = calculator.preprocessed(place / "predicted.xlsx", place / "drawn")
    fill_drawn_cells(drawn, place / "measured.xlsx", rater, cells)
    theirs = calculator.scores(place / "measured.xlsx", place / "scored")
    scores = rater.points(cells)
    for test, matrices in PROTOCOL.tests.items():
        ours = sum(scores.tests[matrix.name][0] for matrix in matrices)
        assert theirs.points[test] == pytest.approx(ours, abs=0.01), test
    simulated = {matrix.name for matrix in PROTOCOL.matrices}
    verified = [row for row in theirs.verified if row["Scenario"] in simulated]
    assert verified or scores.total[0] == 0
    for row in verified:
        across, down = map(int, str(row["Test point"]).strip("()").split(","))
        number = PROTOCOL.matrix_cell_numbers[str(row["Scenario"]), across, down]
        assert str(row["Colour"]).lower() == COLOURS[scores.colours[0, number]], row


def test_the_protocols_data_is_what_the_calculator_has(calculator: Calculator) -> None:
    shipped = Path(__file__).parents[2] / "safevar_sumo/protocol/euro_ncap_2026.toml"
    assert calculator.derived() == shipped.read_text(encoding="utf-8")


@pytest.mark.parametrize("seed", range(4))
def test_vehicles_with_any_colours_score_alike(
    seed: int, calculator: Calculator, template: Path, tmp_path: Path
) -> None:
    """Colours at random, with speeds that round to a bound; layers as their cells or at random, some claimed."""
    rng = np.random.default_rng(seed)
    speeds = rng.choice([0.004, 5, 9.996, 10, 15, 20, 25, 30, 40], (1, N))
    impact = np.where(rng.random((1, N)) < rng.choice([0.1, 0.3, 0.7]), speeds, np.nan)
    if seed:
        impact[
            :, [k for k, cell in enumerate(PROTOCOL.cells) if cell.matrix.test_name == "CCRs" and cell.vut_speed <= 20]
        ] = np.nan
    warning = np.where(rng.random((1, N)) < 0.7, 1.9, rng.choice([np.nan, 1.2, 1.696], (1, N)))
    nominal = list(range(N))
    if seed % 2:
        nominal = [PROTOCOL.matrix_cell_numbers[cell.matrix.name, cell.row, cell.column] for cell in PROTOCOL.cells]
    cells, claims = (
        CellResults(impact[:, nominal], warning[:, nominal], np.ones((1, N), dtype=bool)),
        CLAIMS if seed % 3 else {},
    )
    rater = Rater(protocol=PROTOCOL, claims=claims)
    assert rater.points(cells).fails[0] == (seed == 0)
    agrees(rater, cells, calculator, template, tmp_path)
