"""Checks of the tables of a study: a study with a user's simulator must not have tables that the
simulator would not use, and another study must have them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import Point, Scenario
from safevar_sumo.scenarios.base import Mover
from safevar_sumo.study import Study
from safevar_sumo.study.encounters import Parameters
from safevar_sumo.vehicles import CharacteristicSet

NOISE = re.compile("noise|noisy|dropout|jitter")
"""Words in the name or the meaning of a characteristic that is noise."""
SEED = "seed"
"""Name of the parameter of a simulator that is the seed of its noise."""
IN_SIMULATOR = (
    "nothing: the simulator moves and drives the vehicle, in a weather of its own"
)


def check_tables(study: Study, mover: Mover) -> None:
    """Refuse tables that a user's simulator would not use, because it moves and drives the vehicle
    itself. Without such a simulator, refuse a study that lacks these tables.

    Raises
    ------
    InputError
        About the first key that is not used, or is missing.
    """
    entries: Parameters = {
        "vehicle.model": study.vehicle.model,
        "vehicle.parameters": study.vehicle.parameters,
        "ads.model": study.ads.model,
        "weather": study.weather,
    }
    if mover.has("a driving system"):
        if study.scenario.repeats > 1:
            raise InputError(
                "",
                f"scenario.repeats = {study.scenario.repeats}: SUMO repeats itself to the bit",
                "no repeats, or a simulator of the user's own",
            )
        if study.search.failed != "stop":
            raise InputError(
                "",
                f"search.failed = {study.search.failed!r} without a simulator of one's own",
                "'stop': settings on which SUMO fails are skipped anyway",
            )
        for key in ("vehicle.model", "ads.model", "weather"):
            if not entries[key]:
                table = key.removesuffix(".model") if key.startswith("ads") else key
                raise InputError(
                    "",
                    f"{table} is missing",
                    "this key, or a scenario.model with simulate(setting), a simulator",
                )
        return

    entries |= {
        "step_length": study.step_length,
        "spread": study.spread,
        "repair": study.repair.parameters,
        "matrix.tests.weathers": next(
            (test.weathers for test in study.tests if test.weathers), []
        ),
    }
    for key, value in entries.items():
        if value:
            text = value if isinstance(value, str | float) else str(value)
            raise InputError(
                "",
                f"{key} = {text!r} beside the simulator of scenario.model",
                IN_SIMULATOR,
            )


def check_matrix(scenario: Scenario, matrix: Sequence[Point]) -> None:
    """Refuse a matrix whose tests have another kind of mover than the study's own scenario.

    Raises
    ------
    InputError
        About the first such test.
    """
    for point in matrix:
        kind = point.scenario.mover.kind
        study_kind = scenario.mover.kind
        if kind != study_kind:
            raise InputError(
                "",
                f"matrix.tests: {point.name!r} is {kind}, and scenario.model is {study_kind}",
                "tests of the kind of scenario.model",
            )


def noise_remarks(
    characteristics: CharacteristicSet, points: Sequence[Point]
) -> list[str]:
    """A remark on characteristics whose name or meaning says that they are noise, if the noise of
    all runs comes from the same seed.
    """
    noisy = [
        item.name
        for item in characteristics
        if NOISE.search(f"{item.name} {item.meaning}".lower())
    ]
    seeds = {getattr(point.scenario, SEED, None) for point in points}
    if not noisy or len(seeds) > 1:
        return []
    source = f"{SEED} = {seeds.pop()}" if None not in seeds else "one seed"
    return [
        f"{' and '.join(noisy)}: noise of {source}, and a limit may be that of this seed alone;"
        f" several seeds are an axis of the matrix, such as over = {{ {SEED} = [1, 2, 3] }}"
    ]
