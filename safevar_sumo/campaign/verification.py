"""Parts of a run done once more: in SUMO itself what was driven in a recorded scene, and alone what other people's code had a part in."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from safevar_sumo.campaign.batcher import Batcher
from safevar_sumo.campaign.keys import RunKey, run_generator
from safevar_sumo.campaign.run import Observer, Run
from safevar_sumo.errors import ForeignError
from safevar_sumo.plugins import forget_foreign
from safevar_sumo.protocol.rater import driven_in_sumo
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.search import Search
from safevar_sumo.study import Study, foreign_names
from safevar_sumo.sumo import Engine, assemble, evaluate
from safevar_sumo.sumo.matrix import LARGEST_WORLD
from safevar_sumo.workers.evaluation import packed
from safevar_sumo.workers.identity import networks_of
from safevar_sumo.workers.isolation import refuse_difference, refuse_unlike_sumo
from safevar_sumo.workers.retrying import RetryingPool, reproducing

LEGAL = ("what a run asks for depends on its problem, its evaluations and `rng` alone: nothing kept in a class or a module between runs, "
         "no clock, no random numbers of its own")


class Verification:
    """Runs that have ended, and settings of theirs under way: alone and with other people's models loaded afresh, then in SUMO."""

    def __init__(self, study: Study, results: ResultsDirectory, pool: RetryingPool, begun: Callable[[RunKey], Search],
                 engine: Engine, observer: Observer) -> None:
        self._study, self._pool, self._begun, self._observer = study, pool, begun, observer
        self._alone = packed(study, results.inputs, engine=engine, afresh=True) if foreign_names(study) else b""
        self._is_recorded = engine is Engine.RECORDED
        self._driven = driven_in_sumo(study, assemble(study).weather)
        inputs = results.inputs if self._driven is study else {**results.inputs, "network": networks_of(assemble(self._driven))}
        self._in_sumo = Batcher(pool, packed(self._driven, inputs, engine=Engine.LIBSUMO), LARGEST_WORLD)
        self._leaks: dict[Future[Evaluations], tuple[Run, Evaluations]] = {}
        self._unverified: dict[Run, tuple[Evaluations, int]] = {}
        """What runs hold of settings that are driven in SUMO, and how many of them have not come back."""

    @property
    def under_way(self) -> list[Future[Evaluations]]:
        """What is being computed."""
        return [*self._leaks, *self._in_sumo.under_way]

    def send(self) -> None:
        """Have SUMO drive what pays now."""
        self._in_sumo.send()

    def ask(self, run: Run) -> bool:
        """Have settings of a run simulated once more; whether there are any to verify.

        Raises
        ------
        ForeignError
            If it is the last run of an algorithm from outside, and the same run, alone and loaded afresh, asks for other settings.
        """
        self._refuse_unrepeatable(run)
        rng = run_generator(self._study, run.key._replace(algorithm=f"recheck {run.key.algorithm}"))
        for known in run.samples(rng) if self._alone else ():
            self._leaks[self._pool.submit(self._alone, known.settings)] = run, known
        return self._is_alone(run) or self._ask_sumo(run)

    def _ask_sumo(self, run: Run) -> bool:
        """Have settings of a run driven in SUMO, once nothing leaks between them; whether there are any."""
        rng = run_generator(self._study, run.key._replace(algorithm=f"verify {run.key.algorithm}"))
        known = run.solutions_and_others(rng) if self._is_recorded else None
        if not known:
            return False
        if self._driven is not self._study:  # SUMO drives settings in a few of a rating's cells
            known = evaluate(assemble(self._driven), known.settings)
        self._unverified[run] = known, len(known)
        self._in_sumo.ask(run, known.settings)
        return True

    def _is_alone(self, run: Run) -> bool:
        return any(run is other for other, _ in self._leaks.values())

    def _is_verified(self, run: Run, in_sumo: Evaluations) -> bool:
        """Hold what has come back from SUMO against what a run holds of it; whether that was all."""
        known, left = self._unverified.pop(run)
        rows = {row.tobytes(): i for i, row in enumerate(known.settings)}
        refuse_unlike_sumo(self._study, known.take([rows[row.tobytes()] for row in in_sumo.settings]), in_sumo)
        failed = np.flatnonzero(in_sumo.failed).tolist()
        if failed:
            self._observer.warned(f"run {run.key}: {len(failed)} of {len(known)} settings could not be verified in SUMO: "
                                  f"{in_sumo.reason(failed[0])}")
        if left > len(in_sumo):
            self._unverified[run] = known, left - len(in_sumo)
        return run not in self._unverified

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

    def take(self, done: Future[Evaluations]) -> list[Run]:
        """The runs of settings of which those were the last ones.

        Raises
        ------
        InputError
            If a setting's result is another one alone, or in SUMO.
        """
        if done in self._in_sumo.under_way:
            return [run for run, in_sumo in self._in_sumo.take(done) if self._is_verified(run, in_sumo)]
        run, known = self._leaks.pop(done)
        reproduction = reproducing(self._study, known.settings[0])
        refuse_difference(self._study, {f"in run {run.key}": known, "alone": done.result()}, reproduction)
        return [] if self._is_alone(run) or self._ask_sumo(run) else [run]
