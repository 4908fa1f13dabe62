"""What a worker does with a share of a study's runs: search, simulate in batches over its runs, write their journals,
verify their results.

The worker may die at any moment: the next one continues from the journals. It meets again what killed the first one,
and so it is told why the first one died: the attempts of that round count as failed without a repetition.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from safevar_sumo.campaign.batches import refuse_difference, refuse_unlike_sumo
from safevar_sumo.campaign.evaluation import Evaluate, pack_study, refuse_changed_files, system_of, task_of
from safevar_sumo.campaign.pool import Report, RunKey, Share, WorkerLostError
from safevar_sumo.campaign.retrying import Retries, reproduction_command
from safevar_sumo.campaign.run import Run, make_search, random_generator_of
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import MANIFEST, PATIENCE, Journal, JournalBusyError, journal_file, journal_head
from safevar_sumo.search import Problem
from safevar_sumo.study import user_code_names
from safevar_sumo.sumo.matrix import MAX_COPIES
from safevar_sumo.vehicles import region_of


def carry_out_share(share: Share, report: Report, evaluate: Evaluate) -> None:
    """Carry out a share of a study's runs; `evaluate` evaluates its batches.

    Raises
    ------
    SafevarError
        If a journal cannot be written, the study is at fault, or a result is another one by itself or in SUMO.
    """
    _Carrier(share, report, evaluate).carry_out()


class _Carrier:
    def __init__(self, share: Share, report: Report, evaluate: Evaluate) -> None:
        self._share, self._report, self._evaluate, self._task = share, report, evaluate, task_of(share.work)
        self._study, system = self._task.study, system_of(share.work)
        self._retries = Retries(self._study)
        self._deaths = {setting: list(reasons) for setting, reasons in share.deaths.items()}
        self._files = dict(self._task.inputs.get("sources", {}))
        """Digests of the files that user code has read so far."""
        self._new_files: dict[str, str] = {}
        """Files that user code has read and that no journal holds yet."""
        self._characteristics, search = system.characteristics, self._study.search
        self._problem = Problem(
            characteristics=system.characteristics,
            original=share.original,
            evaluations=search.evaluations,
            population=search.population,
            scoring=system.measuring.scoring,
            region=region_of(self._study),
        )

    def carry_out(self) -> None:
        """Carry out all runs, together as far as their searches go."""
        if not (self._share.directory / MANIFEST).exists():
            raise InputError(
                "out", f"a worker does not see {self._share.directory}", "a directory on a disk that all workers share"
            )
        runs = self._begin()
        try:
            while runs:
                ended = [run for run in runs if run.is_finished or run.advance()]
                self._verify(ended)
                for run in ended:
                    self._report(run.finish())
                runs = [run for run in runs if run not in ended]
                self._simulate(runs)
                self._report([run.progress for run in runs])
        finally:
            for run in runs:
                run.close()

    def _begin(self) -> list[Run]:
        """Open the journals and begin the searches of all runs that no other process carries out."""
        runs, deadline = list[Run](), time.monotonic() + PATIENCE
        try:
            for key in self._share.keys:
                path = journal_file(self._share.directory, str(key))
                try:
                    journal = Journal(
                        path, journal_head(self._share.identity, str(key), self._characteristics.names), deadline
                    )
                except JournalBusyError:
                    self._report(key)
                    continue
                if journal.content.tail_size:
                    self._report(
                        f"{path}: the last {journal.content.tail_size} bytes were torn; what they held is "
                        "simulated again"
                    )
                search = make_search(key, self._study, self._problem, self._note_files)
                runs.append(Run(key, search, journal, self._problem.evaluations, retry=self._share.retry_failed))
        except BaseException:
            for run in runs:
                run.close()
            raise
        return runs

    def _note_files(self, files: Mapping[str, str]) -> None:
        """Note files that user code has read, which the next line of a journal then names; refuses files that have
        changed.
        """
        refuse_changed_files([name for name, digest in files.items() if self._files.get(name, digest) != digest])
        new_files = {name: digest for name, digest in files.items() if name not in self._files}
        self._files |= new_files
        self._new_files |= new_files

    def _simulate(self, runs: Sequence[Run]) -> None:
        """Simulate and journal the settings that the runs wait for, in equal batches."""
        owners = [run for run in runs for _ in range(len(run.missing_settings))]
        if not owners:
            return
        settings = np.concatenate([run.missing_settings for run in runs])
        for start, end in _parts(len(owners), self._share.batch):
            for evaluations in self._retries.evaluate(
                lambda batch: self._compute(self._share.work, batch), settings[start:end]
            ):
                self._note_files(evaluations.files)
                owners_of_rows = owners[start : start + len(evaluations)]
                for run in dict.fromkeys(owners_of_rows):
                    run.receive(
                        evaluations.take([row for row, owner in enumerate(owners_of_rows) if owner is run]),
                        self._new_files,
                    )
                    self._new_files = {}
                start += len(evaluations)

    def _compute(self, work: bytes, settings: FloatArray) -> Evaluations:
        """Evaluate a batch, unless an earlier worker died of this attempt."""
        setting = settings.tobytes() if len(settings) == 1 else b""
        if self._deaths.get(setting):
            raise WorkerLostError(self._deaths[setting].pop(0))
        self._report(setting)
        return self._evaluate(work, settings)

    def _verify(self, runs: Sequence[Run]) -> None:
        """Simulate settings of ended runs again: one by one with user code loaded afresh, and in SUMO if the runs used
        recorded scenes.
        """
        runs = [run for run in runs if not run.is_finished]
        if user_code_names(self._study):
            for run in runs:
                self._verify_isolation(run)
        if self._share.sumo_work:
            self._verify_in_sumo(runs)

    def _verify_isolation(self, run: Run) -> None:
        work = pack_study(self._study, self._task.inputs, engine=self._task.engine, afresh=True)
        for expected in run.sample_evaluations(self._generator("recheck", run.key)):
            (isolated,) = self._retries.evaluate(lambda batch: self._compute(work, batch), expected.settings)
            refuse_difference(
                self._study, str(run.key), expected, isolated, reproduction_command(self._study, expected.settings[0])
            )

    def _verify_in_sumo(self, runs: Sequence[Run]) -> None:
        samples = [run.sample_for_sumo(self._generator("verify", run.key)) for run in runs]
        if not any(map(len, samples)):
            return
        recorded = Evaluations.concatenate(samples)
        in_sumo = self._evaluate_all(self._share.sumo_work, recorded.settings)
        if self._share.recorded_work:  # SUMO repeats a few cells of a rating; the runs have no values of single cells
            recorded = self._evaluate_all(self._share.recorded_work, recorded.settings)
        refuse_unlike_sumo(self._study, recorded, in_sumo)
        for run, end, sample in zip(
            runs, np.cumsum([len(sample) for sample in samples]).tolist(), samples, strict=True
        ):
            failed_rows = [row for row in range(end - len(sample), end) if in_sumo.failed[row]]
            if failed_rows:
                self._report(
                    f"run {run.key}: {len(failed_rows)} of {len(sample)} settings could not be verified in SUMO: "
                    f"{in_sumo.reason(failed_rows[0])}"
                )

    def _evaluate_all(self, work: bytes, settings: FloatArray) -> Evaluations:
        """Evaluate settings for a verification, in batches that SUMO can simulate at once."""
        return Evaluations.concatenate(
            [
                evaluations
                for start, end in _parts(len(settings), MAX_COPIES)
                for evaluations in self._retries.evaluate(lambda batch: self._compute(work, batch), settings[start:end])
            ]
        )

    def _generator(self, purpose: str, key: RunKey) -> np.random.Generator:
        """The random generator that draws the settings of a run to simulate again."""
        return random_generator_of(self._study, key._replace(algorithm=f"{purpose} {key.algorithm}"))


def _parts(number: int, size: int) -> Iterator[tuple[int, int]]:
    """Starts and ends of equal parts of `number` settings, with at most `size` settings each."""
    parts = math.ceil(number / size)
    for part in range(parts):
        yield number * part // parts, number * (part + 1) // parts
