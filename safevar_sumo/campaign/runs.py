"""The runs of a study: their names, algorithms and random numbers. A `Run` is a search under way,
with the evaluations that it has got so far.
"""

from __future__ import annotations

import math
import zlib
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from safevar_sumo.errors import InputError, about, unknown_name
from safevar_sumo.metrics import METRICS, Scoring
from safevar_sumo.plugins import Lookup, Member, instance_of
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import Journal, run_name
from safevar_sumo.search import (
    ALGORITHMS,
    DESCRIPTIONS,
    PYMOO_ALGORITHMS,
    Algorithm,
    Problem,
    Search,
    pymoo_algorithm,
)
from safevar_sumo.study import PYMOO, SearchTable, Study, label_of
from safevar_sumo.sumo.system import System

REPEATED = 10
"""After a search, SUMO simulates at most one in so many of the simulations again. (The unsafe
solutions come in addition.)
"""
MAX_REPEATED = 300
"""Largest number of settings that SUMO simulates again."""


class RunKey(NamedTuple):
    """The name of a run: the label of its algorithm, and the number of the run, from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return run_name(self.algorithm, self.run)


class RunResult(NamedTuple):
    """A finished run.

    Attributes
    ----------
    solutions
        The valid settings that the search returned.
    sample
        Evaluations that SUMO may simulate again: one in `REPEATED` of the simulated settings, drawn
        at random, and at most `MAX_REPEATED`.
    discarded
        Number of returned settings that are not valid; 0 if an earlier command finished the run.
    """

    key: RunKey
    solutions: Evaluations
    sample: Evaluations
    discarded: int = 0


def all_runs(study: Study) -> list[RunKey]:
    """The keys of all runs of a study."""
    search = study.search
    return [
        RunKey(label, number)
        for label in search.labels
        for number in range(search.runs)
    ]


def algorithm_of(label: str, study: Study) -> Algorithm:
    """Create an algorithm, with its parameters from the study. `label` is its label in results.

    Raises
    ------
    InputError
        If no algorithm has this label, violates the contract, or refuses its parameters.
    """
    with about(study.source):
        search = study.search
        name = search.labels.get(label, label)
        key = f"search.{label}"
        parameters_of = {
            label_of(table): parameters
            for table, parameters in search.parameters.items()
        }
        if len(search.labels) < len(search.algorithms):
            raise InputError(
                "",
                f"search.algorithms = {search.algorithms}: two have the same name",
                "algorithms with different names",
            )
        for table in search.parameters:
            if not (
                table in PYMOO_ALGORITHMS
                or table in ALGORITHMS
                or label_of(table) in search.labels
            ):
                legal = dict.fromkeys(
                    (*SearchTable.__struct_fields__, *DESCRIPTIONS, *search.labels)
                )
                raise unknown_name(
                    "",
                    f"search.{table}: there is no such key and no such algorithm",
                    table,
                    PYMOO_ALGORITHMS if table.startswith(PYMOO) else legal,
                )

        lookup = Lookup.of(study)
        if PYMOO + name in PYMOO_ALGORITHMS:
            raise InputError("", f"search.algorithms = {name!r}", f"'{PYMOO}{name}'")
        if name.startswith(PYMOO):
            member = Member(pymoo_algorithm(name))
            key = f"search.{name!r}"
        else:
            member = lookup.class_of(
                {**DESCRIPTIONS, **ALGORITHMS}, name, "search.algorithms", Algorithm
            )

        parameters = lookup.with_paths(member, parameters_of.get(label, {}), key)
        algorithm: Algorithm = instance_of(
            member, parameters, f"search.algorithms: {name!r}", key
        )
        return algorithm


def check_algorithms(study: Study, system: System) -> None:
    """Refuse a study that cannot be searched.

    Raises
    ------
    InputError
        If a run has less evaluations than a population, or an algorithm cannot be used.
    """
    search = study.search
    if search.population > search.evaluations:
        excess = (
            f"search.population = {search.population} is more than search.evaluations ="
            f" {search.evaluations}"
        )
        raise InputError(study.source, excess, "a run of at least one population")
    problem = problem_of(
        study, system, Evaluations.none(len(system.characteristics), METRICS)
    )
    for name in search.labels:
        algorithm = algorithm_of(name, study)
        with system.modules.active(), about(study.source):
            algorithm.try_out(problem)


def problem_of(study: Study, system: System, original: Evaluations) -> Problem:
    """The problem that the searches of a study have to solve."""
    return Problem(
        region=system.region,
        original=original,
        evaluations=study.search.evaluations,
        population=study.search.population,
        scoring=system.measuring.scoring,
    )


def random_generator_of(study: Study, key: RunKey) -> Generator:
    """The random generator of a run. It is independent of the generators of other runs."""
    sequence = np.random.SeedSequence(
        study.search.seed, spawn_key=(zlib.crc32(key.algorithm.encode()), key.run)
    )
    return Generator(np.random.PCG64(sequence))


class Run:
    """A search under way, with its evaluations so far. A journal keeps the evaluations on disk.

    Parameters
    ----------
    budget
        Number of evaluations that the search may request.
    scoring
        Decides which settings of the search's result are valid.

    Attributes
    ----------
    solutions
        The valid part of the search's result. The attribute exists after the search has ended.
    is_finished
        Whether the journal has the result of the search.
    """

    solutions: Evaluations

    def __init__(
        self,
        key: RunKey,
        search: Search,
        journal: Journal,
        budget: int,
        scoring: Scoring,
    ) -> None:
        self.key = key
        self._search = search
        self._journal = journal
        self._budget = budget
        self._scoring = scoring
        self._discarded = 0
        self._content = journal.content
        self._journaled = set(journal.content.positions)
        settings = journal.content.evaluations.settings
        self._row_of = {setting.tobytes(): row for row, setting in enumerate(settings)}
        self._request = settings[:0]
        self._asked = 0
        """Number of settings in all requests before this request."""
        self._missing = dict[bytes, int]()
        """For each setting of this request without a known evaluation: its first position in the
        run.
        """
        self.is_finished = self._has_ended = budget in journal.content.solutions
        if self.is_finished:
            self.solutions = journal.content.take_positions(
                journal.content.solutions[budget]
            )

    def look_up(self) -> FloatArray:
        """Answer the requests of the search, as long as all evaluations are known. Return the
        distinct settings that are missing, shape (k, n). k is 0 after the end of the search.
        """
        # A generator can only be started with None.
        answer = None
        while not (self._missing or self._has_ended):
            if len(self._request):
                answer = self._content.evaluations.take(
                    [self._row_of[setting.tobytes()] for setting in self._request]
                )
                self._asked += len(answer)
            try:
                self._request = self._search.send(answer)  # type: ignore[arg-type]
            except StopIteration as end:
                self.solutions = end.value.take(self._scoring.valid(end.value))
                self._discarded = len(end.value) - len(self.solutions)
                self._has_ended = True
                break

            for position, setting in enumerate(self._request, self._asked):
                if setting.tobytes() not in self._row_of:
                    self._missing.setdefault(setting.tobytes(), position)
        return np.asarray(
            self._request[np.array(list(self._missing.values()), int) - self._asked]
        )

    def receive(self, evaluations: Evaluations) -> None:
        """Write the evaluations of missing settings to the journal, and keep them."""
        positions = [
            self._missing.pop(setting.tobytes()) for setting in evaluations.settings
        ]
        if not self._journaled.isdisjoint(positions):
            raise InputError(
                self._journal.path,
                "holds other settings than this search requests",
                "another `out`",
            )
        self._journal.append(positions, evaluations)
        earlier = self._content.evaluations
        self._row_of |= {
            setting.tobytes(): row
            for row, setting in enumerate(evaluations.settings, len(earlier))
        }
        self._content = self._content._replace(
            positions=[*self._content.positions, *positions],
            evaluations=Evaluations.concatenate([earlier, evaluations]),
        )

    def finish(self, rng: Generator) -> RunResult:
        """Write the result of a search that has ended to the journal, and close the journal."""
        if not self.is_finished:
            positions = [
                self._content.positions[self._row_of[setting.tobytes()]]
                for setting in self.solutions.settings
            ]
            self._journal.finish(positions, self._budget)
        self.close()

        requested = self._content.requested_within(self._budget)[1]
        simulated = np.flatnonzero(~requested.failed & ~requested.infeasible)
        number = min(math.ceil(len(simulated) / REPEATED), MAX_REPEATED)
        sample = requested.take(rng.permutation(simulated)[:number])
        return RunResult(self.key, self.solutions, sample, self._discarded)

    @property
    def failures(self) -> Evaluations:
        """The evaluations of settings that could not be simulated."""
        return self._content.evaluations.take(self._content.evaluations.failed)

    def close(self) -> None:
        """Close the journal, so that another process may continue the run."""
        self._journal.close()
