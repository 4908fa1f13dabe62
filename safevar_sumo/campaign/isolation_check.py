"""Parts of a run done once more as if there were nothing else: what leaks in rare states alone, or from run to run, shows there."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from safevar_sumo.campaign.keys import RunKey, run_generator
from safevar_sumo.campaign.run import Run
from safevar_sumo.errors import ForeignError
from safevar_sumo.plugins import forget_foreign
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.search import Search
from safevar_sumo.study import Study, foreign_names
from safevar_sumo.workers.evaluation import packed
from safevar_sumo.workers.isolation import refuse_difference
from safevar_sumo.workers.retrying import RetryingPool, reproducing

LEGAL = ("what a run asks for depends on its problem, its evaluations and `rng` alone: nothing kept in a class or a module between runs, "
         "no clock, no random numbers of its own")


class IsolationCheck:
    """Runs that have ended, and settings of theirs under way, each alone and with other people's models loaded afresh.

    Attributes
    ----------
    under_way
        By what computes it, a run and what it holds of a setting.
    """

    def __init__(self, study: Study, results: ResultsDirectory, pool: RetryingPool, begun: Callable[[RunKey], Search]) -> None:
        self._study, self._pool, self._begun = study, pool, begun
        self._work = packed(study, results.inputs, afresh=True) if foreign_names(study) else None
        self._begun_twice: set[str] = set()
        self.under_way: dict[Future[Evaluations], tuple[Run, Evaluations]] = {}

    def search(self, key: RunKey) -> Search:
        """The search of a run.

        Raises
        ------
        ForeignError
            If it is the first of an algorithm from outside, and asks for other settings at once when it is begun again.
        """
        name = self._from_outside(key)
        if name and name not in self._begun_twice:
            self._begun_twice.add(name)
            if not np.array_equal(next(self._begun(key)), next(self._begun(key))):
                raise self._unrepeatable(name, key)
        return self._begun(key)

    def ask(self, run: Run) -> bool:
        """Have settings of a run simulated once more; whether there are any, and models that are not ours.

        Raises
        ------
        ForeignError
            If it is the last run of an algorithm from outside, and the same run, alone and loaded afresh, asks for other settings.
        """
        self._refuse_unrepeatable(run)
        if self._work is None:
            return False
        samples = run.samples(run_generator(self._study, run.key._replace(algorithm=f"recheck {run.key.algorithm}")))
        for known in samples:
            self.under_way[self._pool.submit(self._work, known.settings)] = run, known
        return bool(samples)

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
        """The run of a setting, if that was its last one.

        Raises
        ------
        ForeignError
            If the setting's result is another one alone.
        """
        run, known = self.under_way.pop(done)
        again = reproducing(self._study, known.settings[0])
        refuse_difference(self._study, {f"in run {run.key}": known, "alone": done.result()}, again)
        return None if any(run is other for other, _ in self.under_way.values()) else run
