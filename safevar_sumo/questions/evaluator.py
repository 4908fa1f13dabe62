"""The evaluator simulates settings for all questions about a study. A setting has the values of a
vehicle, and of its encounter if the study searches encounters (in ranges, or at all phases).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.campaign.batches import (
    ask_why_no_verdict,
    compile_vehicle,
    evaluate_all,
    opened_by,
    repeat_first_batches,
    spare,
)
from safevar_sumo.campaign.evaluation import (
    EVERYTHING,
    VERIFIED_SETTINGS,
    Selection,
    Task,
    carry_out,
    evaluate_settings,
    system_of,
)
from safevar_sumo.campaign.inputs import code_of
from safevar_sumo.campaign.pool import Pool, open_pool
from safevar_sumo.errors import InputError, SimulationError, about
from safevar_sumo.metrics import F_SAFE, METRICS, Unsafe
from safevar_sumo.questions.between import in_phases
from safevar_sumo.questions.budget import (
    MEASURED,
    QUICK_EFFORTS,
    QUICK_SECONDS,
    Budget,
    print_price_of_list,
    seconds_of_simulation,
)
from safevar_sumo.questions.case import Results, Subject
from safevar_sumo.questions.progress import Phases
from safevar_sumo.questions.sampling import sobol_settings
from safevar_sumo.questions.tally import Tally
from safevar_sumo.records import (
    BoolArray,
    Evaluations,
    FloatArray,
    NamedValues,
    Outcome,
)
from safevar_sumo.results.store import record, refuse_other_original
from safevar_sumo.study import ORIGINAL_DEGREE, Study
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import Progress, show_no_progress
from safevar_sumo.vehicles import region_of

CRITERION_SETTINGS = 1024
"""Number of settings over the whole domain that decide the default criterion: a collision if any
setting collides, else a safety degree.
"""
FIRST_SETTINGS = 64
"""Number of these settings that are simulated first: one collision among them decides already."""
ENCOUNTERS = 16
"""Largest number of critical encounters in which vehicles drive, if encounters are ranges."""
FRESH_RUNS = 20
"""Least number of fresh runs of a vehicle, if the number of simulations is not limited."""
CANDIDATES = 512
"""Number of encounters over the domain from which the critical encounters are chosen."""


class Evaluator:
    """Evaluates settings of one study (without the filter of the study's search), and draws
    settings that cover the study's domain.

    Attributes
    ----------
    simulated
        Number of settings simulated so far. Equal settings in one call are simulated only once.
    budget, tally, phases
        How much the question may simulate, what came out of its simulations, and its progress.
        Evaluators of other studies for this question share them.

    Examples
    --------
    >>> with open_evaluator(read_study("smoke")) as evaluator:
    ...     vehicles = evaluator.feasible_settings(4)
    ...     evaluations = evaluator.evaluate(vehicles, "some vehicles")
    >>> evaluations.f_safe.round(1)
    array([2.4, 2.1, 2.9, 2.2])
    """

    def __init__(
        self,
        study: Study,
        pool: Pool,
        progress: Progress = show_no_progress,
        verified: int = VERIFIED_SETTINGS,
    ) -> None:
        self.study = study
        with about(study.source):
            self.region = region_of(study)
        self.characteristics = self.region.characteristics
        self._pool = pool
        self._verified = verified
        self.simulated = 0
        self._stays = dict[tuple[Selection, bytes], bool]()
        """Whether the original vehicle never moves, by selection and encounter."""
        self.budget = Budget()
        self.tally = Tally()
        self.phases = Phases(progress)

    @property
    def seed(self) -> int:
        """The study's seed."""
        return self.study.search.seed

    @cached_property
    def system(self) -> System:
        """The models of the study, assembled."""
        return assemble(self.study)

    @cached_property
    def code(self) -> dict[str, str]:
        """The digests, by name, of the study's user code and of the files that this code opens."""
        return code_of(self.study, opened_by(self.study, self._pool))

    @cached_property
    def in_phases(self) -> Evaluator | None:
        """An evaluator whose settings have the phase as last value; None if there is no phase."""
        study = in_phases(self.study, self.system)
        if study == self.study:
            return None
        return self.for_study(study, verified=0)

    def evaluate(
        self, settings: FloatArray, stage: str, *, ignore_constraints: bool = False
    ) -> Evaluations:
        """Evaluate M settings, shape (M, n). Progress is shown for `stage`.

        Settings that violate a constraint of the study are not simulated, and get the outcome
        `infeasible`, unless `ignore_constraints` is true. If encounters are ranges, settings in
        whose encounter the original vehicle is not safe get this outcome, too.
        """
        if ignore_constraints:
            return self._simulate_shown(settings, stage, self._verified)
        return self.evaluate_selection(settings, EVERYTHING, stage, self._verified)

    def evaluate_selection(
        self, rows: FloatArray, selection: Selection, stage: str, verified: int = 0
    ) -> Evaluations:
        """Evaluate M settings as `selection` says: only at some points, or with values of P
        parameters of the ADS. A row has a setting and these P values, shape (M, n + P).

        Settings that violate a constraint are not simulated. With a part of the points, encounters
        in which the original vehicle is not safe count, too.
        """
        n = len(self.characteristics)
        is_feasible = self.region.feasible(rows[:, :n])
        if is_feasible.all():
            return self._simulate_shown(rows, stage, verified, selection)
        infeasible = rows[~is_feasible]
        changes = self.characteristics.change_objectives(infeasible[:, :n])
        not_simulated = Evaluations.undefined(
            infeasible, Outcome.INFEASIBLE, METRICS, **changes
        )
        if not is_feasible.any():
            return not_simulated
        simulated = self._simulate_shown(rows[is_feasible], stage, verified, selection)
        evaluations = Evaluations.concatenate([simulated, not_simulated])
        # Restore the order of the settings.
        return evaluations.take(np.argsort(np.argsort(~is_feasible, kind="stable")))

    @property
    def has_repeats(self) -> bool:
        """Whether runs of the same vehicle differ, so that each vehicle has several runs."""
        return self.study.scenario.repeats > 1

    def evaluate_anew(self, settings: FloatArray) -> Evaluations:
        """Evaluate M settings of a simulator whose runs differ, shape (M, n), in fresh runs: no
        kept result is read. A setting has at least as many runs as the study repeats, and at least
        `FRESH_RUNS` if a quarter of the simulations that are left suffices for this number.
        """
        repeats = self.study.scenario.repeats
        runs = self.number_of_fresh_runs(len(settings))
        self.budget.spend(len(settings) * self._each * runs // repeats)
        scenario = replace_in(self.study.scenario, repeats=runs)
        task = Task(study=replace_in(self.study, scenario=scenario))
        parts = np.array_split(settings, min(len(settings), 4 * self._pool.workers))
        jobs = [(task, part) for part in parts]
        fresh_runs = Evaluations.concatenate(
            carry_out(evaluate_settings, jobs, self._pool)
        )
        counted = self._without_unsafe_originals(fresh_runs)
        return self._without_standing(counted, EVERYTHING)

    def number_of_fresh_runs(self, settings: int) -> int:
        """The number of fresh runs of each setting, if so many settings are evaluated anew."""
        repeats = self.study.scenario.repeats
        runs = max(repeats, FRESH_RUNS)
        left = self.settings_left
        if left is not None and left * repeats < 4 * runs * settings:
            return repeats
        return runs

    def confirmed(self, evaluations: Evaluations, unsafe: Unsafe) -> BoolArray:
        """Which of M evaluated settings are unsafe, shape (M,). If runs differ, a setting must also
        be unsafe in fresh runs: otherwise the unluckiest of many safe settings would count. Without
        enough simulations for fresh runs, a setting does not count.
        """
        is_unsafe = unsafe.of(evaluations)
        rows = np.flatnonzero(is_unsafe)
        if not self.has_repeats or not len(rows):
            return is_unsafe
        is_unsafe[:] = False
        if self.settings_left is None or len(rows) <= self.settings_left:
            fresh_runs = self.evaluate_anew(evaluations.settings[rows])
            is_unsafe[rows] = unsafe.of(fresh_runs)
        return is_unsafe

    def begin(
        self,
        settings: NamedValues,
        minimum: int = 1,
        *,
        of_list: bool = False,
        is_most: bool = False,
    ) -> None:
        """Begin a question.

        Parameters
        ----------
        settings
            The usual number of settings of each stage, times the effort.
        minimum
            The least number of settings with which there is an answer.
        of_list
            Whether the question is about a list of vehicles: then it prints how long it takes even
            if a simulation is short.
        is_most
            Whether no more settings than those of all stages may be simulated.
        """
        expected = sum(settings.values())
        budget = self.budget
        system = self.system
        pool = self._pool
        if budget.is_question:
            number = minimum + MEASURED * system.mover.takes_long
            budget.require(budget.spent + number * self._each)
            if system.mover.takes_long:
                if budget.stated is not None:
                    pool.spare = spare(budget.stated, budget.minimum)
                opened_by(self.study, pool)
            seconds = seconds_of_simulation(self.study, system, pool)
            budget.open(
                expected * self._each, seconds, pool.checked, at_once=pool.workers
            )
            if seconds is not None:
                budget.spend(MEASURED * self._each)
            elif of_list and not budget.is_few:
                simulations = expected * len(system.points)
                print_price_of_list(self.study, system, pool, simulations)
        left = self.settings_left
        share = 1.0 if left is None else left / expected
        planned = {name: share * number for name, number in settings.items()}
        if is_most:
            budget.most = budget.spent + int(expected * self._each)
        self.phases.plan(planned, len(system.points), budget.left)

    @property
    def settings_left(self) -> int | None:
        """For how many settings few simulations still suffice; None if they are not few."""
        return self.budget.settings_left(self._each)

    def allow(
        self, simulations: int | None, questions: int, *, quick: bool = False
    ) -> None:
        """Make the budget of the question. It includes the check of a simulator's class.
        `questions` questions share the time. A quick question searches less.
        """
        effort = 1.0
        if quick:
            durations = [
                np.max(point.scenario.duration) for point in self.system.points
            ]
            seconds = sum(durations)
            if self.study.ranges:
                seconds *= ENCOUNTERS
            effort = float(np.clip(QUICK_SECONDS / seconds, *QUICK_EFFORTS))
        self.budget = Budget(simulations, quick, effort, questions, is_question=True)
        self._pool.spare = None
        if simulations is not None and self.system.mover.takes_long:
            self._pool.spare = spare(simulations, 0)
        self._pool.checked = 0

    def of_stage(self, usual: int, part: int = 1) -> int:
        """The number of settings of a stage (`Budget.of_stage`)."""
        # If runs differ, each unsafe setting is simulated again.
        price = (1 + self.has_repeats) * self._each
        return self.budget.of_stage(usual, price, part)

    @property
    def _each(self) -> int:
        return simulations_of_setting(self.system)

    def _simulate_shown(
        self,
        settings: FloatArray,
        stage: str,
        verified: int,
        selection: Selection = EVERYTHING,
    ) -> Evaluations:
        """Evaluate settings, show progress, and count the simulations."""
        if not len(settings):
            return Evaluations.none(len(self.characteristics), METRICS)
        total = len(np.unique(settings, axis=0))
        self.budget.spend(total * self._each)
        points = len(selection.of(system_of(self.study)).points)
        self.phases.begin_part(stage, points * total)
        evaluations = evaluate_all(
            self.study,
            settings,
            self._pool,
            lambda number: self.phases.add(points * number),
            verified,
            selection,
            begin=self._compile,
        )
        self.simulated += total
        counted = evaluations
        if selection == EVERYTHING:
            counted = self._without_unsafe_originals(evaluations)
        counted = self._without_standing(counted, selection)
        self.tally.count(evaluations, counted.standing)
        return counted

    def _compile(self) -> None:
        compile_vehicle(self.study, self._pool, self.phases.say)

    def _without_standing(
        self, evaluations: Evaluations, selection: Selection
    ) -> Evaluations:
        """The evaluations, with undefined metrics of vehicles that never moved, although the
        original vehicle moves in the same encounter. Such a vehicle has the largest safety degree,
        and has not been tested. Where the original vehicle stands, too, standing is right.
        """
        stands = evaluations.outcome == Outcome.NEVER_MOVED
        settings = evaluations.settings[:, : len(self.characteristics)]
        if stands.any():
            stands[stands] = ~self._original_stays(settings[stands], selection)
            evaluations = evaluations.keep_only(~stands, Outcome.NEVER_MOVED)
            evaluations = replace(evaluations, stands=stands)
        of_vehicle = self.characteristics.of_vehicle
        changed = (settings != self.characteristics.original)[:, of_vehicle].any(axis=1)
        self.tally.has_moved |= bool((changed & evaluations.valid).any())
        self.tally.standing |= {
            row.tobytes() for row in settings[stands][:, of_vehicle]
        }
        return evaluations

    def _original_stays(self, settings: FloatArray, selection: Selection) -> BoolArray:
        """In the encounters of which of M settings, shape (M, n), the original vehicle never moves,
        shape (M,). It drives with the study's own driving system. With too few simulations left,
        the original vehicle counts as one that moves.
        """
        originals = self.characteristics.with_original_vehicle(settings)
        selection = replace_in(selection, parameters=())
        keys = [(selection, row.tobytes()) for row in originals]
        rows = {key: row for row, key in enumerate(keys) if key not in self._stays}
        price = len(rows) * self._each
        if rows and price <= self.budget.left:
            self.budget.spend(price)
            unknown = originals[list(rows.values())]
            runs = evaluate_all(
                self.study, unknown, self._pool, verified=0, selection=selection
            )
            stays = runs.outcome == Outcome.NEVER_MOVED
            self._stays |= dict(zip(rows, stays.tolist(), strict=True))
        return np.array([self._stays.get(key, False) for key in keys])

    def _without_unsafe_originals(self, evaluations: Evaluations) -> Evaluations:
        """The evaluations, with undefined results (outcome `infeasible`, metrics NaN) of settings
        in whose encounter the original vehicle is not safe.
        """
        scoring = self.system.measuring.scoring
        if scoring.safe_original is None:
            return evaluations
        is_left_out = scoring.violation(evaluations) > 0
        metrics = {
            name: np.where(is_left_out, np.nan, values)
            for name, values in evaluations.metrics.items()
        }
        metrics[ORIGINAL_DEGREE] = evaluations.column(ORIGINAL_DEGREE)
        counts = ~is_left_out | evaluations.failed
        return replace(
            evaluations,
            outcome=np.where(counts, evaluations.outcome, Outcome.INFEASIBLE.value),
            metrics=metrics,
        )

    def evaluate_over_encounters(
        self, settings: FloatArray, unsafe: Unsafe, stage: str
    ) -> Evaluations:
        """Evaluate M settings, shape (M, n). If encounters are ranges, each vehicle drives in the
        original encounter and all critical ones: the worst by the criterion is its evaluation.
        """
        if not len(self.characteristics.scenario):
            return self.evaluate(settings, stage)
        of_vehicle = self.characteristics.of_vehicle
        encounters = np.concatenate(
            [self.characteristics.original_settings, self.critical_encounters]
        )
        pairs = np.where(of_vehicle, settings[:, None], encounters)
        evaluations = self.evaluate(pairs.reshape(-1, settings.shape[1]), stage)
        robustness = unsafe.robustness(evaluations)
        # An unsafe encounter comes first, then one in which the vehicle never moved.
        robustness = np.where(evaluations.standing, 0.0, robustness)
        robustness = robustness.reshape(-1, len(encounters))
        first_rows = np.arange(len(settings)) * len(encounters)
        return evaluations.take(first_rows + robustness.argmin(axis=1))

    @cached_property
    def critical_encounters(self) -> FloatArray:
        """Settings of the original vehicle in the `ENCOUNTERS` encounters in which it is least
        safe, shape (k, n). They are chosen among many; there are none if encounters are listed.
        """
        valid = self._originals.take(self._originals.valid)
        # `argsort` puts NaN last.
        least_safe_first = np.argsort(valid.f_safe, kind="stable")
        return valid.settings[least_safe_first[:ENCOUNTERS]]

    @cached_property
    def share_left_out(self) -> float:
        """Share of encounters over the domain with an unsafe original; 0 if they are listed."""
        is_possible = self.region.feasible(self._originals.settings)
        if not is_possible.any():
            return 0.0
        return float(np.mean(~self._originals.valid[is_possible]))

    @cached_property
    def _originals(self) -> Evaluations:
        """Evaluations of the original in encounters over the domain; none if they are listed."""
        if not len(self.characteristics.scenario):
            return Evaluations.none(len(self.characteristics), METRICS)
        # An eighth of few simulations chooses encounters: the others are for vehicles in them.
        settings = sobol_settings(self.characteristics, self.of_stage(CANDIDATES, 8))
        originals = self.characteristics.with_original_vehicle(settings)
        return self.evaluate(originals, "encounters of the original")

    def feasible_settings(self, number: int) -> FloatArray:
        """`number` settings, shape (number, n), that cover the feasible domain evenly."""
        total = 0

        def draw_next(count: int) -> FloatArray:
            """The next `count` settings of the Sobol sequence."""
            nonlocal total
            total += count
            return sobol_settings(self.characteristics, total)[-count:]

        return self.region.draw_feasible(draw_next, number)

    def evaluate_original(self) -> Evaluations:
        """Evaluation of the original vehicle.

        Raises
        ------
        SimulationError
            If the original vehicle cannot be simulated.
        InputError
            If encounters are ranges, and the original vehicle is not safe in the original
            encounter.
        """
        settings = self.characteristics.original_settings
        evaluations = self.evaluate(settings, "original vehicle")
        # The original vehicle satisfies the constraints: then its encounter does not count.
        if evaluations.infeasible[0]:
            raise InputError(
                self.study.source,
                "encounters: the original vehicle is not safe in the encounter of the original"
                " values",
                "original values with which it is, as in all results",
            )
        if not evaluations.valid[0]:
            raise SimulationError(
                f"study {self.study.name!r} cannot be simulated with the original vehicle:"
                f" {evaluations.outcome[0]}"
            )
        return evaluations

    def refuse_other_original(self, case: Results) -> None:
        """Refuse results if the simulator drives the original vehicle in another way now. Without
        deterministic runs at all points this cannot be compared, and nothing is refused.
        """
        study = case.study
        if not case.has_runs or study.scenario.repeats > 1 or study.origin.point:
            return
        if not self.system.mover.is_exact:
            jobs = [(Task(study=study), self.characteristics.original_settings)]
            self.budget.spend(self._each)
            (evaluations,) = carry_out(evaluate_settings, jobs, self._pool)
            refuse_other_original(
                Path(case.name), case.original_metrics, record(evaluations)
            )

    @cached_property
    def no_verdict(self) -> str:
        """The reason why simulations tell nothing about the ADS, as the first sentence of every
        answer; "" if simulations tell something.
        """
        return ask_why_no_verdict(self.study, self._pool, begin=self._compile)

    def choose_criterion(
        self,
        stated: Unsafe | None,
        source: Subject,
        original: Evaluations | None = None,
    ) -> Unsafe:
        """The stated criterion. Without one, the criterion of results with solutions; else the
        default, by settings over the whole domain of the study.

        Raises the errors of `checked` and `Unsafe.default_among`.
        """
        if stated is None and not isinstance(source, Study) and len(source.solutions):
            stated = source.unsafe
        if stated is not None:
            return self.checked(stated)
        self.check_measured()
        original = original or self.evaluate_original()
        stage = "settings over the whole domain"
        settings = self.feasible_settings(CRITERION_SETTINGS)
        # Most of few simulations should serve the question, and not the choice of a criterion.
        evaluations = self.evaluate(settings[: self.of_stage(FIRST_SETTINGS, 8)], stage)
        if not evaluations.collided.any() and not self.budget.is_few:
            evaluations = self.evaluate(settings, stage)
        return Unsafe.default_among(evaluations, original)

    def use(self, unsafe: Unsafe) -> None:
        """Use a criterion in the question. The tally counts the settings that meet it. Raises the
        errors of `checked`.
        """
        self.checked(unsafe)
        if not unsafe.is_collision:
            self.tally.criterion = unsafe
        if unsafe.bound:
            self.check_measured(unsafe.measure)

    def checked(self, unsafe: Unsafe) -> Unsafe:
        """The criterion, with the safety degree at which bodies of the study touch. Raises an
        InputError if the criterion is a distance to others, but nobody else is on the road.
        """
        if unsafe.measure == F_SAFE.name:
            self.check_measured()
        return self.system.with_contact(unsafe)

    def check_measured(self, measure: str = F_SAFE.name) -> None:
        """Refuse a metric that needs an encounter, such as a distance, if nobody else is on the
        road.
        """
        if not self.system.meets_nobody:
            return
        if np.isnan(self.evaluate_original().column(measure)[0]):
            raise InputError(
                "unsafe",
                "nobody else is on the road, so that no vehicle collides or is too close",
                'a metric with a limit, such as "stopping_distance > 100"',
            )

    def with_step(self, step: float) -> Evaluator:
        """An evaluator of the same study with another time step [s]."""
        # The study's sampling interval may be no multiple of the new step.
        return self.for_study(
            replace_in(
                self.study,
                step_length=step,
                metrics=replace_in(self.study.metrics, sampling_interval=None),
            )
        )

    def end(self) -> None:
        """Repeat the first simulations of user code: other results than before are an error."""
        repeat_first_batches(self.study, self._pool)
        self.phases.log_end()

    def for_study(self, study: Study, *, verified: int | None = None) -> Evaluator:
        """An evaluator of another study for the same question, on the same pool. In addition,
        `verified` settings are simulated in SUMO.
        """
        if verified is None:
            verified = self._verified
        evaluator = Evaluator(study, self._pool, verified=verified)
        evaluator.budget = self.budget
        evaluator.tally = self.tally
        evaluator.phases = self.phases
        return evaluator


@contextmanager
def open_evaluator(
    study: Study,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
    cluster: str | None = None,
) -> Iterator[Evaluator]:
    """An evaluator that simulates on `pool`. Without a pool it starts `jobs` worker processes (by
    default one for each core), or uses the workers of the cluster at the address `cluster`.

    Raises
    ------
    InputError
        If the study's models cannot be assembled.
    """
    if pool is not None:
        yield Evaluator(study, pool, progress)
        return
    # An error of the study is raised before workers start.
    assemble(study)
    with open_pool(jobs, cluster) as new_pool:
        yield Evaluator(study, new_pool, progress)
