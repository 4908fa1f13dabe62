"""The algorithms of pymoo behind the contract of our own."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.api.running import run
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.questions.research_questions.answer import tables
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.results import read_manifest
from safevar_sumo.results.manifest import write_manifest
from safevar_sumo.search.pymoo import PYMOO_ALGORITHMS, pymoo_algorithm
from safevar_sumo.study import ORIGINAL_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.formulas import carried_out
from tests.support.in_process import SLOW, InlinePool
from tests.support.searches import POPULATION, begun, built, sphere
from tests.support.standard_problems import PROBLEMS, result_of, standard_problem


def test_arguments_reach_the_algorithm() -> None:
    """Das and Dennis's directions: C(p + 2, 2) for p partitions and three objectives."""
    sizes = {
        number: len(next(begun(built("pymoo:NSGA3", **arguments), 1, 300)))
        for number, arguments in (
            (91, {}),
            (15, {"ref_dirs": 4}),
            (2, {"ref_dirs": [[1.0, 0, 0], [0, 0, 1.0]]}),
        )
    }
    assert sizes == {91: 91, 15: 15, 2: 2}
    assert [len(asked) for asked in begun(built("pymoo:GA"), 1, 60)][:3] == [
        POPULATION
    ] * 3, "the study's population"
    assert [len(asked) for asked in begun(built("pymoo:GA", pop_size=9), 1, 60)][
        :3
    ] == [9] * 3


@pytest.mark.parametrize(
    "name",
    [
        "pymoo:GA",
        *(
            pytest.param(f"pymoo:{name}", marks=SLOW)
            for name in ("CMAES", "NSGA2", "MOEAD")
        ),
    ],
)
def test_an_encounter_in_which_the_original_is_not_safe_is_infeasible(
    name: str,
) -> None:
    """The original vehicle is safe in the upper half of the first domain: there the sphere, which
    an algorithm for one objective minimises alone, is 1/4 or more.
    """

    def formula(sun: CharacteristicSet, settings: FloatArray) -> Evaluations:
        evaluations = sphere(sun, settings)
        share = (settings[:, 0] - sun.lower[0]) / (sun.upper[0] - sun.lower[0])
        return dataclasses.replace(
            evaluations, metrics={**evaluations.metrics, ORIGINAL_DEGREE: share}
        )

    scoring = msgspec.structs.replace(PUBLISHED_SCORING, safe_original=0.5)
    *_, result = begun(built(name), 1, 3000, formula, scoring)
    assert (result.column(ORIGINAL_DEGREE) >= 0.5).all()
    if PYMOO_ALGORITHMS[name].startswith("soo."):
        assert 0.25 <= result.f_safe[0] < 0.3


@pytest.mark.parametrize("name", ["NSGA2", "NSGA3", "RVEA", "SMSEMOA", "SPEA2"])
def test_a_run_is_that_of_pymoos_own_loop(name: str) -> None:
    """`minimize` with the same seed finds the same settings, to the bit, on DTLZ2."""
    from pymoo.core.problem import Problem as PymooProblem
    from pymoo.optimize import minimize

    standard = PROBLEMS["dtlz2"]
    evaluations = 364
    problem = standard_problem(standard, evaluations, 91)

    class Theirs(PymooProblem):
        def __init__(self) -> None:
            super().__init__(standard.variables, 3, n_ieq_constr=1, xl=1.0, xu=2.0)

        def _evaluate(
            self, x: FloatArray, out: dict[str, FloatArray], *_: object, **__: object
        ) -> None:
            out["F"], out["G"] = standard.objectives(x - 1), np.zeros((len(x), 1))

    ours = result_of(built(f"pymoo:{name}").search(problem, default_rng(3)), problem)
    seed = int(default_rng(3).integers(2**31))
    again = built(f"pymoo:{name}").begin(problem, seed)  # type: ignore[attr-defined]
    again.problem = None  # not begun
    theirs = minimize(Theirs(), again, termination=("n_eval", evaluations), seed=seed)
    assert np.array_equal(ours.settings, theirs.X)


STOPS: JsonObject = {
    "safe_fuzzer": {"generation": 5, "warm_up": 0, "generations_without_improvement": 1}
}
"""Options with which SafeFuzzer ends early."""


def with_pymoo(algorithms: list[str], **search: Any) -> Study:
    return load_study("smoke", search={"algorithms": algorithms, **search})


@pytest.mark.parametrize(
    ("name", "table", "error"),
    [
        ("ES", {"rule": -1.0, "phi": 2.0}, "pymoo:ES: ValueError: negative dimensions"),
        ("NRBO", {"max_iteration": 0}, "pymoo:NRBO: ZeroDivisionError"),
    ],
)
def test_an_option_with_which_pymoo_fails_is_refused_with_its_message(
    name: str, table: JsonObject, error: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as refused:
        run(
            with_pymoo([f"pymoo:{name}"], parameters={f"pymoo:{name}": table}),
            tmp_path / "out",
        )
    assert error in str(refused.value)
    assert str(refused.value).count("\n") == 1


@SLOW
def test_an_algorithm_that_leaves_most_of_its_budget_is_named_unless_it_says_so(
    in_tmp: Path,
) -> None:
    options = {"pymoo:PSO": {"max_velocity_rate": 0.0}, "pymoo:CMAES": {"sigma": -1.0}}
    study = with_pymoo(
        ["pymoo:PSO", "pymoo:CMAES", "safe_fuzzer", "rs"],
        evaluations=60,
        runs=1,
        parameters=options,
    )
    study = load_study(study, search={"parameters": {**options, **STOPS}})
    with pytest.warns(
        UserWarning, match="use less than 90% of the simulations that they may use"
    ) as warned:
        results = run(study, in_tmp / "out", pool=InlinePool())
    counts = results.evaluations.groupby("algorithm").size()
    assert (
        max(counts[name] for name in ("pymoo_PSO", "pymoo_CMAES", "safe_fuzzer"))
        < 54
        < counts["rs"]
    )
    remark = str(warned[-1].message)
    assert (
        f"PSO (pymoo) {counts['pymoo_PSO']} of 60 (equal vehicles are simulated once)"
        in remark
    )
    assert f"CMAES (pymoo) {counts['pymoo_CMAES']} of 60 (it ended early)" in remark
    assert "SafeFuzzer" not in remark
    assert remark in str(tables(results.directory).to_dict())


def test_without_pymoo_the_error_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pymoo.config", None)
    with pytest.raises(InputError, match=r"pip install '\.\[pymoo\]'"):
        pymoo_algorithm("pymoo:GA")


def test_an_algorithm_may_come_later_but_not_with_another_pymoo(tmp_path: Path) -> None:
    carried_out(with_pymoo(["nsga2"], evaluations=30), tmp_path)
    assert "pymoo" not in read_manifest(tmp_path)["versions"]
    both = with_pymoo(["nsga2", "pymoo:GA"], evaluations=30)
    carried_out(both, tmp_path)
    manifest = read_manifest(tmp_path)
    assert manifest["titles"] == {"pymoo_GA": "GA (pymoo)"}
    manifest["versions"]["pymoo"] = "0.1"
    write_manifest(tmp_path, manifest)
    with pytest.raises(InputError, match=r"version of pymoo was '0\.1'"):
        carried_out(both, tmp_path)
