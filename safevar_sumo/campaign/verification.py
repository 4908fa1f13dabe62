"""Parts of a run done once more: in SUMO itself what was driven in a recorded scene, and alone what other people's code had a part in."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

import numpy as np

from safevar_sumo.campaign.keys import RunKey, run_generator
from safevar_sumo.campaign.run import Observer, Run
from safevar_sumo.errors import ForeignError
from safevar_sumo.plugins import forget_foreign
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.search import Search
from safevar_sumo.study import Study, foreign_names
from safevar_sumo.sumo import Engine
from safevar_sumo.workers.evaluation import packed
from safevar_sumo.workers.isolation import refuse_difference, refuse_unlike_sumo
from safevar_sumo.workers.retrying import RetryingPool, reproducing

Refusal = Callable[[Evaluations, Evaluations], None]
"""Refuses two evaluations of settings that differ."""
LEGAL = ("what a run asks for depends on its problem, its evaluations and `rng` alone: nothing kept in a class or a module between runs, "
         "no clock, no random numbers of its own")


class Verification:
    """Runs that have ended, and settings of theirs under way: in SUMO, or alone and with other people's models loaded afresh.

    Attributes
    ----------
    under_way
        By what computes it, a run and what it holds of a setting.
    """

    def __init__(self, study: Study, results: ResultsDirectory, pool: RetryingPool, begun: Callable[[RunKey], Search],
                 engine: Engine, observer: Observer) -> None:
        self._study, self._pool, self._begun, self._observer = study, pool, begun, observer
        self._alone = packed(study, results.inputs, engine=engine, afresh=True) if foreign_names(study) else None
        self._in_sumo = packed(study, results.inputs, engine=Engine.LIBSUMO) if engine is Engine.RECORDED else None
        self._asked: set[Run] = set()
        self.under_way: dict[Future[Evaluations], tuple[Run, Evaluations, Refusal]] = {}

    def ask(self, run: Run) -> bool:
        """Have settings of a run simulated once more; whether there are any to verify.

        Raises
        ------
        ForeignError
            If it is the last run of an algorithm from outside, and the same run, alone and loaded afresh, asks for other settings.
        """
        self._refuse_unrepeatable(run)
        rng = run_generator(self._study, run.key._replace(algorithm=f"recheck {run.key.algorithm}"))
        for known in [] if self._alone is None else run.samples(rng):
            self._submit(self._alone, run, known, partial(self._refuse_leak, run.key))
        return self._is_under_way(run) or self._ask_sumo(run)

    def _ask_sumo(self, run: Run) -> bool:
        """Have settings of a run driven in SUMO, once nothing leaks between them; whether there are any."""
        rng = run_generator(self._study, run.key._replace(algorithm=f"verify {run.key.algorithm}"))
        known = None if self._in_sumo is None or run in self._asked else run.solutions_and_others(rng)
        self._asked.add(run)
        if not known:
            return False
        self._submit(self._in_sumo, run, known, partial(self._refuse_unlike_sumo, run.key))
        return True

    def _submit(self, work: bytes | None, run: Run, known: Evaluations, refuse: Refusal) -> None:
        assert work is not None
        self.under_way[self._pool.submit(work, known.settings)] = run, known, refuse

    def _is_under_way(self, run: Run) -> bool:
        return any(run is other for other, *_ in self.under_way.values())

    def _refuse_unlike_sumo(self, key: RunKey, known: Evaluations, in_sumo: Evaluations) -> None:
        refuse_unlike_sumo(self._study, known, in_sumo)
        failed = np.flatnonzero(in_sumo.failed).tolist()
        if failed:
            self._observer.warned(f"run {key}: {len(failed)} of {len(known)} settings could not be verified in SUMO: "
                                  f"{in_sumo.reason(failed[0])}")

    def _refuse_leak(self, key: RunKey, known: Evaluations, alone: Evaluations) -> None:
        refuse_difference(self._study, {f"in run {key}": known, "alone": alone}, reproducing(self._study, known.settings[0]))

    def _refuse_unrepeatable(self, run: Run) -> None:
        name = self._from_outside(run.key)
        if name and run.key.run == self._study.search.runs - 1:
            forget_foreign()
            if not run.is_repeated_by(self._begun(run.key)):
                raise self._unrepeatable(name, run.key)

    def _from_outside(self, key: RunKey) -> str:
        """What the study calls the algorithm of a run; "" for one of ours."""
        name = self._study.search.labels.get(key.algorithm, "")
        return name if ":" in name else ""

    def _unrepeatable(self, name: str, key: RunKey) -> ForeignError:
        problem = f"search.algorithms: {name!r} asks for other settings when run {key.run} is repeated alone"
        return ForeignError(f"study {self._study.name!r}", problem, LEGAL)

    def take(self, done: Future[Evaluations]) -> Run | None:
        """The run of settings, if those were its last ones.

        Raises
        ------
        InputError
            If a setting's result is another one alone, or in SUMO.
        """
        run, known, refuse = self.under_way.pop(done)
        refuse(known, done.result())
        if self._is_under_way(run) or self._ask_sumo(run):
            return None
        self._asked.discard(run)
        return run
