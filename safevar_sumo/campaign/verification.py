"""Simulates settings of a run again: one by one if the study has user code, then in SUMO if the run used recorded scenes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from safevar_sumo.campaign.batcher import Batcher
from safevar_sumo.campaign.keys import RunKey, random_generator_of
from safevar_sumo.campaign.run import Observer, Run
from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins import unload_user_modules
from safevar_sumo.protocol.rater import study_for_sumo_check
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.search import Search
from safevar_sumo.study import Study, user_code_names
from safevar_sumo.sumo import Engine, assemble, evaluate
from safevar_sumo.sumo.matrix import MAX_COPIES
from safevar_sumo.workers.evaluation import pack_study
from safevar_sumo.workers.identity import network_digests
from safevar_sumo.workers.isolation import refuse_difference
from safevar_sumo.workers.retrying import RetryingPool, reproduction_command
from safevar_sumo.workers.sumo_check import refuse_unlike_sumo

EXPECTED_REQUESTS = (
    "requests that depend only on the run's problem, evaluations and `rng`: nothing kept in a class or a module between runs, no "
    "clock, no random numbers of its own")


class Verification:
    """Simulates settings of ended runs again: first one by one, with user code reloaded; then in SUMO."""

    def __init__(self, study: Study, results: ResultsDirectory, pool: RetryingPool, begin_search: Callable[[RunKey], Search],
                 engine: Engine, observer: Observer) -> None:
        self._study, self._pool, self._begin_search, self._observer = study, pool, begin_search, observer
        self._isolated_work = pack_study(study, results.inputs, engine=engine, afresh=True) if user_code_names(study) else b""
        self._uses_recorded_scenes = engine is Engine.RECORDED
        self._sumo_study = study_for_sumo_check(study, assemble(study).weather)
        inputs = results.inputs if self._sumo_study is study else {**results.inputs, "network": network_digests(assemble(self._sumo_study))}
        self._sumo_batcher = Batcher(pool, pack_study(self._sumo_study, inputs, engine=Engine.LIBSUMO), MAX_COPIES)
        self._isolated_checks: dict[Future[Evaluations], tuple[Run, Evaluations]] = {}
        """By batch of one setting: the run, and the setting's evaluation in that run."""
        self._unverified: dict[Run, tuple[Evaluations, int]] = {}
        """By run: the evaluations to verify in SUMO, and the number of settings that SUMO has not simulated yet."""

    @property
    def under_way(self) -> list[Future[Evaluations]]:
        """Batches that are being computed."""
        return [*self._isolated_checks, *self._sumo_batcher.under_way]

    def send(self) -> None:
        """Send batches for SUMO; see `Batcher.send`."""
        self._sumo_batcher.send()

    def begin(self, run: Run) -> bool:
        """Begin to verify a run; returns whether there are settings to verify.

        Raises
        ------
        UserCodeError
            If a reloaded user algorithm requests other settings when it repeats its last run.
        """
        self._refuse_unrepeatable(run)
        rng = random_generator_of(self._study, run.key._replace(algorithm=f"recheck {run.key.algorithm}"))
        for expected in run.sample_evaluations(rng) if self._isolated_work else ():
            self._isolated_checks[self._pool.submit(self._isolated_work, expected.settings)] = run, expected
        return self._awaits_isolated_checks(run) or self._begin_in_sumo(run)

    def _begin_in_sumo(self, run: Run) -> bool:
        """Begin to verify a run in SUMO; returns whether there are settings to verify."""
        rng = random_generator_of(self._study, run.key._replace(algorithm=f"verify {run.key.algorithm}"))
        expected = run.sample_for_sumo(rng) if self._uses_recorded_scenes else None
        if not expected:
            return False
        if self._sumo_study is not self._study:  # SUMO repeats a few cells of a rating; the run has no values of single cells
            expected = evaluate(assemble(self._sumo_study), expected.settings)
        self._unverified[run] = expected, len(expected)
        self._sumo_batcher.add(run, expected.settings)
        return True

    def _awaits_isolated_checks(self, run: Run) -> bool:
        """Whether single settings of a run are still under way."""
        return any(run is checked_run for checked_run, _ in self._isolated_checks.values())

    def _verify(self, run: Run, sumo_evaluations: Evaluations) -> bool:
        """Compare evaluations from SUMO with those of a run; returns whether the run is verified completely."""
        expected, settings_left = self._unverified.pop(run)
        row_of = {setting.tobytes(): row for row, setting in enumerate(expected.settings)}
        recorded = expected.take([row_of[setting.tobytes()] for setting in sumo_evaluations.settings])
        refuse_unlike_sumo(self._study, recorded, sumo_evaluations)
        failed_rows = np.flatnonzero(sumo_evaluations.failed).tolist()
        if failed_rows:
            self._observer.warned(f"run {run.key}: {len(failed_rows)} of {len(expected)} settings could not be verified in SUMO: "
                                  f"{sumo_evaluations.reason(failed_rows[0])}")
        if settings_left > len(sumo_evaluations):
            self._unverified[run] = expected, settings_left - len(sumo_evaluations)
        return run not in self._unverified

    def _refuse_unrepeatable(self, run: Run) -> None:
        name = self._user_algorithm(run.key)
        if name and run.key.run == self._study.search.runs - 1:  # only the last run of each algorithm is repeated
            unload_user_modules()
            if not run.is_repeated_by(self._begin_search(run.key)):
                raise self._repetition_error(name, run.key)

    def _user_algorithm(self, key: RunKey) -> str:
        """The name of a run's algorithm if it is user code, else ""."""
        name = self._study.search.labels.get(key.algorithm, "")
        return name if ":" in name else ""

    def _repetition_error(self, name: str, key: RunKey) -> UserCodeError:
        problem = f"search.algorithms: {name!r} requests other settings when run {key.run} is repeated alone"
        return UserCodeError(f"study {self._study.name!r}", problem, EXPECTED_REQUESTS)

    def collect(self, batch: Future[Evaluations]) -> list[Run]:
        """Compare a computed batch with the runs; returns the runs whose verification it completes.

        Raises
        ------
        InputError
            If a setting has another result by itself, or in SUMO.
        """
        if batch in self._sumo_batcher.under_way:
            return [run for run, sumo_evaluations in self._sumo_batcher.collect(batch) if self._verify(run, sumo_evaluations)]
        run, expected = self._isolated_checks.pop(batch)
        command = reproduction_command(self._study, expected.settings[0])
        refuse_difference(self._study, str(run.key), expected, batch.result(), command)
        return [] if self._awaits_isolated_checks(run) or self._begin_in_sumo(run) else [run]
