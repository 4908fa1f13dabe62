"""Settings that a run ends with, simulated once more as if there were no others: what leaks in rare states alone shows there."""

from __future__ import annotations

from concurrent.futures import Future

from safevar_sumo.campaign.run import Run
from safevar_sumo.computing import PersistentPool, packed, refuse_difference, reproducing
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study, foreign_names


class Rechecking:
    """Runs that have ended, and settings of theirs under way, each alone and with other people's models loaded afresh.

    Attributes
    ----------
    under_way
        By what computes it, a run and what it holds of a setting.
    """

    def __init__(self, study: Study, results: ResultsDirectory, pool: PersistentPool) -> None:
        self._study, self._pool = study, pool
        self._work = packed(study, results.manifest, afresh=True) if foreign_names(study) else None
        self.under_way: dict[Future[Evaluations], tuple[Run, Evaluations]] = {}

    def ask(self, run: Run) -> bool:
        """Have settings of a run simulated once more; whether there are any, and models that are not ours."""
        if self._work is None:
            return False
        samples = run.samples()
        for known in samples:
            self.under_way[self._pool.submit(self._work, known.settings)] = run, known
        return bool(samples)

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
