"""A whole study beside a published one: matched, cell beside cell, concluded by rule, and looked for in published
rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from safevar_sumo.reference.agreement import rank_correlation
from safevar_sumo.reference.conclusions import (
    DIFFERS,
    HOLDS,
    IN_DIRECTION,
    UNDECIDED,
    compare_tables,
    draw_conclusions,
    judge_test,
)
from safevar_sumo.study import load_study
from safevar_sumo.sumo import simulate
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.system import assemble
from tests.research_questions.made_up import UNCHANGED, made_up, row


@pytest.mark.parametrize(
    ("here", "published", "verdict"),
    [
        ((0.00, 1e-9), (0.42, 1e-9), IN_DIRECTION),  # large here, small there: only the sign agrees
        ((0.05, 1e-9), (0.20, 1e-9), HOLDS),
        ((0.80, 1e-9), (0.20, 1e-9), DIFFERS),
        ((0.53, 0.3), (0.48, 0.4), HOLDS),  # negligible on both sides, wherever they lie
        ((0.53, 0.3), (0.60, 0.4), IN_DIRECTION),
        ((0.40, 0.3), (0.60, 0.4), HOLDS),  # no difference on either side
        ((0.60, 1e-9), (0.60, 0.4), IN_DIRECTION),
        ((0.40, 1e-9), (0.60, 0.4), DIFFERS),
    ],
)
def test_a_test_holds_in_direction_magnitude_and_significance(
    here: tuple[float, float], published: tuple[float, float], verdict: str
) -> None:
    assert judge_test(*here, *published) == verdict


def rows(algorithm: str, changed: tuple[int, ...], safety: float, collisions: int = 0) -> Iterator[dict[str, Any]]:
    """Forty solutions that change the first of these characteristics always, the second in half of the cases, the
    third in a quarter.
    """
    for k in range(40):
        changes = [changed[place] for place in range(len(changed)) if k % 2**place == 0]
        values = [value * (0.9 if i in changes else 1.0) for i, value in enumerate(UNCHANGED)]
        yield row(algorithm, values=values, sd=-1.0 if k < collisions else safety + 0.001 * k)


def test_what_differs_is_marked_by_the_rules() -> None:
    one, other = (
        made_up(*rows("rs", (0, 1), 1.9), *nsga2)
        for nsga2 in (rows("nsga2", (0, 1, 2), 1.0, collisions=20), rows("nsga2", (2, 1), 1.5))
    )
    conclusions = draw_conclusions(compare_tables([one], [other]))
    verdicts = {(one.question, one.statement.split(":")[0]): one.verdict for one in conclusions}
    assert verdicts["RQ1", "RS, safety_degree"] == HOLDS
    assert verdicts["RQ1", "NSGA-II, safety_degree"] == HOLDS, "more unsafe than the original on both sides"
    assert verdicts["collisions", "NSGA-II"] == DIFFERS, "20 here, none there"
    assert verdicts["collisions", "RS"] == HOLDS, "none on either side"
    assert verdicts["RQ3.1", "most critical solutions change 1 characteristics"] == HOLDS
    assert verdicts["RQ3.2", "changed most often"] == DIFFERS
    assert verdicts["RQ3.3", "avgSD_cS"] == UNDECIDED, "nothing collides there"
    assert verdicts["RQ3.3", "avgSD_mD"] in (HOLDS, IN_DIRECTION)


PUBLISHED_EFFECTS = {
    "tireFric": 1.2,
    "mass": -0.8,
    "maxBrakeTorque": 0.6,
    "dampRateZeroT_CE": 0.4,
    "radius": 0.4,
    "max_rpm": 0.2,
    "dampRateZeroT_CD": 0.2,
}
"""Linear effect on the safety degree over a whole domain in the published random search in sun [m]."""


@pytest.mark.parametrize(
    ("study", "within"),
    [
        ("sun", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.055}),
        ("lgsvl", {"safety_degree": 0.05, "tet": 0.05, "tit": 0.05, "ave_dece": 0.05}),
        ("rain", {"safety_degree": 0.40 / 2.2, "tet": 0.05, "tit": 0.15, "ave_dece": 0.05}),
    ],
)
def test_the_original_vehicle_is_as_near_to_the_published_one_as_is_said(study: str, within: dict[str, float]) -> None:
    """Rain's published vehicle is one simulation, 0.3 to 0.4 m above its own neighbours."""
    read = load_study(study)
    system = assemble(read)
    settings = system.characteristics.original[np.newaxis]
    here = score(system, settings, simulate(system, settings)).metrics
    for name, share in within.items():
        assert here[name][0] == pytest.approx(read.published[name], rel=share), name


@pytest.mark.parametrize("study", ["sun", "rain"])
def test_vehicles_come_in_the_order_of_the_published_effects(study: str) -> None:
    """Spearman's rho over 150 vehicles with the published linear effects, which know nothing of what saturates or comes
    together.
    """
    system = assemble(load_study(study))
    characteristics = system.characteristics
    width = characteristics.upper - characteristics.lower
    settings = np.random.default_rng(14).uniform(characteristics.lower, characteristics.upper, (150, len(width)))
    effects = np.array([PUBLISHED_EFFECTS.get(name, 0.0) for name in characteristics.names])
    here = score(system, settings, simulate(system, settings)).f_safe
    assert rank_correlation(((settings - characteristics.original) / width) @ effects, here) > 0.55
