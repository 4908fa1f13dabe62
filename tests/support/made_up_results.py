"""Made-up results of three characteristics, whose values one can count by hand."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.case import Results, build_case
from safevar_sumo.records import JsonObject
from safevar_sumo.study import CharacteristicTable, Study

ORIGINAL = {"safety_degree": 2.0, "tet": 1.0, "tit": 0.5, "ave_dece": 6.0}
CHARACTERISTICS = {
    "mass": CharacteristicTable(unit="kg", original=1000, lower=800, upper=1400),
    "grip": CharacteristicTable(unit="-", original=2, lower=1, upper=3),
    "lag": CharacteristicTable(unit="s", original=0.1, lower=0.05, upper=0.5),
}
UNCHANGED = (1000.0, 2.0, 0.1)


def made_up_study(
    algorithms: Sequence[str] = ("nsga2", "rs"),
    runs: int = 2,
    characteristics: Mapping[str, CharacteristicTable] = CHARACTERISTICS,
    **changes: Any,
) -> Study:
    smoke = load_study("smoke")
    vehicle = replace(smoke.vehicle, characteristics=dict(characteristics))
    search = replace(
        smoke.search, algorithms=list(algorithms), runs=runs, evaluations=100
    )
    return replace(
        smoke, **{"name": "made-up", "vehicle": vehicle, "search": search, **changes}
    )


def row(
    algorithm: str = "nsga2",
    run: int = 0,
    values: Sequence[float] = UNCHANGED,
    sd: float = 1.0,
    tet: float | None = 1.5,
    tit: float | None = 0.75,
    ave_dece: float | None = 5.0,
    f_diff: float | None = None,
) -> JsonObject:
    """A solution; a safety degree of 0 or less is a collision, without TET and TIT."""
    crash = sd <= 0
    changes = [
        abs(value - original) / original
        for value, original in zip(values, UNCHANGED, strict=True)
    ]
    return {
        "algorithm": algorithm,
        "run": run,
        **dict(zip(CHARACTERISTICS, values, strict=True)),
        "f_safe": sd,
        "f_diff": max(changes) if f_diff is None else f_diff,
        "f_num_diff": sum(change > 0 for change in changes),
        "safety_degree": sd,
        "tet": None if crash else tet,
        "tit": None if crash else tit,
        "ave_dece": ave_dece,
        "outcome": "collision" if crash else "stopped",
    }


def frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    numbers = [
        *CHARACTERISTICS,
        "f_safe",
        "f_diff",
        "safety_degree",
        "tet",
        "tit",
        "ave_dece",
    ]
    return pd.DataFrame(rows, columns=list(row())).astype(dict.fromkeys(numbers, float))


def made_up(
    *rows: Mapping[str, Any],
    original: dict[str, Any] = ORIGINAL,
    study: Study | None = None,
    evaluations: Sequence[Mapping[str, Any]] = (),
    finished: Sequence[tuple[str, int]] | None = None,
    has_runs: bool = True,
) -> Results:
    """A case with these solutions; unless `finished` is given, the finished runs are those with a
    solution.
    """
    done = (
        list(dict.fromkeys((one["algorithm"], one["run"]) for one in rows))
        if finished is None
        else finished
    )
    seen = frame(evaluations)
    seen.insert(2, "evaluation", [one["evaluation"] for one in evaluations])
    return build_case(
        study or made_up_study(),
        original,
        frame(rows),
        seen,
        done if has_runs else (),
        has_runs=has_runs,
    )


RUNS = 12


def three_algorithms() -> Results:
    """The second finds more severe solutions than the first, the third as the first; run 3 of the
    third finds none.
    """
    study = made_up_study(algorithms=["nsga2", "rs", "safe_fuzzer"], runs=RUNS)
    rng = np.random.default_rng(1)
    rows = []
    for (name, worse), run in itertools.product(
        (("nsga2", 0.0), ("rs", 1.0), ("safe_fuzzer", 0.0)), range(RUNS)
    ):
        if (name, run) != ("safe_fuzzer", 3):
            rows += [
                row(
                    name,
                    run,
                    (900.0, 1.5, 0.1),
                    sd=2 - worse - share - 0.2 * rng.random(),
                    f_diff=0.3 * share + 0.05 * rng.random(),
                )
                for share in (0.2, 0.5, 0.8)
            ]
    return made_up(
        *rows,
        study=study,
        finished=list(itertools.product(("nsga2", "rs", "safe_fuzzer"), range(RUNS))),
    )
