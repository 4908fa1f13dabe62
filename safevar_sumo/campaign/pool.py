"""What a pool of workers does: it computes batches for questions, and carries shares of a study's runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import NamedTuple, Protocol

from safevar_sumo.campaign.keys import RunKey
from safevar_sumo.errors import SafevarError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import Failure


class WorkerLostError(SafevarError):
    """The process that computed a batch died, or exceeded the time limit and ended itself."""


class PoolLostError(SafevarError):
    """The pool cannot compute any more batches."""


class Share(NamedTuple):
    """A share of a study's runs, which one worker carries out.

    Attributes
    ----------
    work
        The packed study, whose batches have at most `batch` settings of several runs.
    sumo_work, recorded_work
        Packed studies that verify results in SUMO; `sumo_work` is empty if SUMO simulates everything anyway,
        `recorded_work` if the results of the runs are comparable themselves.
    keys
        The runs.
    directory, identity
        The directory of the journals, which the worker must see, and the digest of the study's identity.
    original
        The original vehicle's evaluation.
    retry_failed
        Whether settings are simulated again that failed before.
    deaths
        Why a worker died, for each attempt in the round of batches in which an earlier worker died with this share; by
        setting, or b"" for a batch of several settings.
    """

    work: bytes
    sumo_work: bytes
    recorded_work: bytes
    batch: int
    keys: tuple[RunKey, ...]
    directory: Path
    identity: str
    original: Evaluations
    retry_failed: bool
    deaths: Mapping[bytes, tuple[str, ...]] = {}


class RunProgress(NamedTuple):
    """The state of a run.

    Attributes
    ----------
    asked
        Number of requested evaluations.
    replayed
        Number of requested evaluations that the journal held when the worker began.
    collisions
        Number of distinct settings that collided.
    best
        The lowest safety degree [m or -m/s]; None before the first valid evaluation.
    """

    key: RunKey
    asked: int
    replayed: int
    collisions: int
    best: float | None


class RunResult(NamedTuple):
    """A finished run: its state, its solutions, settings that could not be simulated, and the number of invalid
    tests.
    """

    progress: RunProgress
    solutions: Evaluations
    failures: list[Failure]
    invalid_tests: int


class Attempt(NamedTuple):
    """A worker begins to compute a batch: of one setting, or of several if `setting` is b""."""

    setting: bytes


class Busy(NamedTuple):
    """Another process carries out a run."""

    key: RunKey


Message = Attempt | list[RunProgress] | RunResult | Busy | str
"""What a worker reports of its share: an attempt; the state of all runs after a round of batches; a result; or a
warning.
"""
Report = Callable[[Message], None]


class Pool(Protocol):
    """Workers; a future may fail with `WorkerLostError`, `PoolLostError` or an error of its batch or share."""

    @property
    def workers(self) -> int:
        """Number of batches or shares that are computed at the same time."""

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        """Evaluate k filtered settings of n characteristics, shape (k, n), of a packed study."""

    def carry(self, share: Share, report: Report) -> Future[None]:
        """Carry out a share of a study's runs; `report` is called with every message, and ends the share by an
        exception.
        """
