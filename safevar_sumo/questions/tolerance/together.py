"""Joint limits: the largest box that holds with the study's own parameter set, under falsification,
which each other set in turn cuts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.between import MovingTest
from safevar_sumo.questions.box import Box, Proof
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS
from safevar_sumo.questions.models import Model, Models
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.questions.tolerance.extension import Extension
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.questions.tolerance.search import BoxSearch
from safevar_sumo.questions.tolerance.specified import broken_specification
from safevar_sumo.questions.tolerance.validation import Validation, Validator
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Limit

MAX_SIMULATIONS = 1_500_000
"""Number of simulations, each at all points of a matrix, after which a search ends with the next
box that passes.
"""
MAX_BOXES, EXPLORED, MAX_GROWTHS = 150, 2, 2
"""Maximum number of boxes that are tested; of those that a random search seeks; and of times that
limits move out.
"""
CLEARANCE, RETREAT, RETREAT_OF_SET = 0.8, 0.4, 0.05
"""Share of the least move of a limit by which it keeps off a failure that a search found between
corners, where the response is not monotone; by how much more after each box that failed; and after
each that failed with another parameter set, whose failures are approached.
"""
MAX_CUTS = 40
"""Largest number of times that the failures with one parameter set are cut off a box."""
OTHER_SHARE = 0.2
"""Share of a falsification's simulations with which one meets another parameter set, and each test
that moves, though never less than `LEAST_SIMULATIONS`.
"""
CONFIRMATIONS, CONFIRMATIONS_OF_SET = 3, 1
"""Number of further falsifications of the box that is to be printed with the study's own parameter
set, and with another one.
"""


class LimitsTogether(NamedTuple):
    """The largest box that was found, by relative volume, in which characteristics reach the limits
    specified for them.

    Attributes
    ----------
    specified
        The specified limits, all other characteristics as in the original.
    members
        The models in which the box holds.
    broken
        By the number of a parameter set in which the specified limits themselves are unsafe, the
        worst setting and the model at the points where it is.
    room
        Which characteristics could have room, shape (n,): those that vary and have no limit on both
        sides.
    searched
        The models that the search of the box had to survive.
    failures_alone
        Unsafe settings that were met, in which one characteristic is changed, shape (K, n).
    box
        The limits as printed; None if none were found.
    proof
        The upper bound of the box's unsafe share, with the study's own parameter set.
    validations
        What the box passed with each parameter set, by the set's number.
    boxes
        Number of boxes that were tried.
    beyond
        By side and column, an unsafe setting just beyond the box; all its other values are in the
        box.
    """

    specified: Box
    members: tuple[Model, ...]
    broken: Mapping[int, tuple[Model, FloatArray]]
    room: BoolArray
    searched: tuple[Model, ...]
    failures_alone: FloatArray
    box: Box | None = None
    proof: Proof | None = None
    validations: Mapping[int, Validation] = {}
    boxes: int = 0
    beyond: Mapping[tuple[int, int], FloatArray] = {}

    @property
    def least(self) -> Interval:
        """The least that the falsification found [m]: over all parameter sets, and with the study's
        own; undefined without one.
        """
        own = self.members[0].unsafe
        values = {
            model.fit: model.unsafe.value(self.validations[model.fit].least)
            for model in self.members
            if model.fit in self.validations and np.isfinite(self.validations[model.fit].least)
        }
        return own.worst(values.values(), default=np.nan), values.get(0, np.nan)

    @property
    def numbers(self) -> JsonObject:
        """What an answer says of them in numbers."""
        proof = self.proof
        passed = [*self.validations.values()] if self.box is not None else []
        attacked = sum(each.attacked for each in passed) if passed else None
        at_all_points = sum(each.at_all_points for each in passed)
        return {
            "box": self.box is not None,
            "samples": None if proof is None else proof.samples,
            "failures": None if proof is None else proof.failures,
            "at_most": None if proof is None else proof.at_most,
            "not_simulated": None if proof is None else proof.not_simulated,
            "fits": len(self.members),
            "attacked": None if attacked is None else at_all_points,
            "attacked_at_worst_points": None if attacked is None else attacked - at_all_points,
            "attacked_between": None if not passed else sum(each.between for each in passed),
            "least_attacked": self.least[0] if passed else None,
            "boxes": int(self.box is not None),
        }


class JointSearch:
    """The search for the largest box by relative volume in which `columns` vary, in which those of
    `limits` reach their limits: it is found with the study's own parameter set, and each further
    set cuts it.

    Attributes
    ----------
    found
        What was found so far.
    met
        The models that the last search had to survive.

    Notes
    -----
    A random search seeks the largest box that is safe at known corners, within what is safe alone.
    Causes of what is unsafe, as few changes as possible, are further corners, and the box is sought
    anew until no search finds anything. Then some corners, and a search for counterexamples, test
    it: between the tests of a matrix and at them. What they find becomes part of what later boxes
    must survive; after `EXPLORED` boxes, failures are only cut off. Of a box that passes, each
    limit moves out as far as it can go, at most `MAX_GROWTHS` times, and what fails then is cut off
    until a box passes. The last box has to pass further searches for counterexamples, all corners,
    and settings drawn at random. After `MAX_BOXES` boxes or `MAX_SIMULATIONS` simulations the
    largest that passed is the last, or none is found.

    A further parameter set meets the box with corners and searches of its own, and what fails is
    cut off. Nothing moves out any more, and nothing depends on sets that follow: with more sets,
    limits are never wider.

    Up to a larger value of a parameter, the box stays within an `outer` one, found up to a smaller
    value: limits are never wider then, either. What failed there stays known.
    """

    def __init__(
        self,
        models: Models,
        tests: Mapping[int, Sequence[MovingTest]],
        columns: Sequence[int],
        limits: Mapping[str, Limit],
        budget: int,
        outer: LimitsTogether | None = None,
    ) -> None:
        self.own = models.own._replace(
            evaluator=models.own.evaluator.for_study(models.own.evaluator.study, verified=0)
        )
        self._tests = tests
        self._columns = columns
        self._limits = limits
        self._budget = budget
        self._search = BoxSearch(self.own, columns, limits, _nothing(self.own))
        specified = self._search.printed(self._search.fixed)
        self.found = LimitsTogether(
            specified,
            (self.own,),
            broken_specification(specified, models.members, tests),
            np.asarray(self._search.is_free.any(axis=0)),
            (self.own,),
            self._search.failures_alone,
        )
        self._outer = outer
        if outer is not None:
            self.found = self.found._replace(
                broken={**outer.broken, **self.found.broken}, searched=(self.own, *outer.searched)
            )
        self.met: Sequence[Model] = ()
        self._validators = list[Validator]()
        """Of the study's own set, then of those in which something failed."""

    def find(self, scans: Sequence[OneAtATimeScan], unsafe_settings: FloatArray) -> None:
        """Search the largest box with the study's own set that holds none of `unsafe_settings`,
        shape (K, n).
        """
        nothing = self.found._replace(box=None)
        if self.own.fit in nothing.broken:
            return
        # Points at which nothing fails cost as much as the others; the test of a box adds those at
        # which it fails.
        first = self.own
        if len(unsafe_settings):
            first = self.own.at_worst_points(unsafe_settings, "worst points")
        search = BoxSearch(first, self._columns, self._limits, unsafe_settings)
        self._search = search
        if self._outer is not None:
            # Without joint limits there are none here: no free side has any room.
            search.stay_within(self._outer.box or self._outer.specified)
            search.know(*(row[np.newaxis] for row in self._outer.beyond.values()))
        start = _start_of(search, self._columns, scans)
        extension = Extension(search)
        evaluator = self.own.evaluator
        validator = self._validator(self.own, self._budget)
        self._validators = [validator]
        passed: Validation | None = None
        growths = most_growths = evaluator.scaled(MAX_GROWTHS)
        retreat, failed = RETREAT / evaluator.account.effort, 0
        outer = search.printed(start)
        for number in range(1, MAX_BOXES + 1):
            evaluator.phases.begin_round(number, MAX_BOXES)
            if number <= max(evaluator.scaled(EXPLORED), 1) and growths == most_growths:
                outer = search.printed(search.best(start))
            box = extension.cut(outer, CLEARANCE + retreat * failed)
            if search.holds_failure(box):  # of the specified limits, which do not move
                break
            is_over = number == MAX_BOXES or evaluator.simulated > evaluator.scaled(MAX_SIMULATIONS)
            # A box that is no larger than the one that passed ends the search, if that one passes
            # all other tests.
            if passed and (is_over or search.is_no_larger(box, passed.box)):
                validation = validator.complete(passed, number, evaluator.scaled(CONFIRMATIONS))
                if not validation.failures:
                    validation = validator.prove(validation, number)
                if not validation.failures:
                    nothing = nothing._replace(
                        box=validation.box, proof=validation.proof, validations={0: validation}
                    )
                    break
            else:
                validation = validator.validate(box, number)
            if not validation.failures:
                # The limits of a box that passed move out as far as they can go.
                passed, outer, failed = validation, box, 0
                if growths and not is_over:
                    growths -= 1
                    outer = extension.of(box)
                continue
            _learn(search, validation)
            failed += 1
            if passed and search.holds_failure(passed.box):
                passed = None
            if is_over and not passed:
                break
        self.found = nothing._replace(boxes=number)
        self._note(search.models)
        # At the worst phases of encounters the own set cuts it, too.
        if self.own.in_phases is not None and evaluator.account.effort >= 1:
            self.cut(self.own, _nothing(self.own))

    def cut(self, model: Model, unsafe_settings: FloatArray) -> None:
        """Cut the box until it holds with a further parameter set, too, and holds none of
        `unsafe_settings`, shape (K, n).
        """
        outer = self.found.box
        if model.fit in self.found.broken or outer is None:
            return
        search = self._search
        search.know(unsafe_settings)
        budget = budget_of_set(model.evaluator, self._budget)
        validator = self._validator(model, budget, with_phases=True)
        extension = Extension(search)
        met = list[Model]()
        avoided = list[FloatArray]()
        for attempt in range(MAX_CUTS):
            box = extension.cut(outer, RETREAT_OF_SET * (attempt + 1), avoided)
            validation, proof = self._pass(validator, box, attempt)
            if not validation.failures:
                # The search of the own set has tested more.
                first = self.found.validations.get(model.fit, validation)
                validation = first._replace(least=min(first.least, validation.least))
                passed = {**self.found.validations, model.fit: validation}
                members = self.found.members
                if model.fit not in [member.fit for member in members]:
                    members = (*members, model)
                self.found = self.found._replace(
                    members=members, box=box, proof=proof, validations=passed
                )
                break
            met += [failures.model for failures in validation.failures]
            causes_of_each = _learn(search, validation)
            for failures, causes in zip(validation.failures, causes_of_each, strict=True):
                nearest = search.approach(causes, failures.model)
                # Windows of phases are narrow and deep: one limit moves until they close.
                if failures.model.at_worst_phase:
                    avoided.append(nearest)
            if validator not in self._validators:
                self._validators.append(validator)
        else:
            self.give_up()
        self.found = self.found._replace(boxes=self.found.boxes + attempt + 1)
        self._note([validator.model, *met])

    def give_up(self) -> None:
        """Leave no joint limits."""
        self.found = self.found._replace(box=None)

    def _pass(
        self, validator: Validator, box: Box, attempt: int
    ) -> tuple[Validation, Proof | None]:
        """Test a box with a further parameter set; where it is smaller than the one before, also in
        the sets in which something failed: its corners are new to them.
        """
        validation = validator.validate(box, attempt)
        if not validation.failures:
            validation = validator.complete(validation, attempt, CONFIRMATIONS_OF_SET)
        proof = self.found.proof
        if validation.failures or box is self.found.box:
            return validation, proof
        for other in self._validators:
            rechecked = other.recheck(box, attempt)
            if rechecked.failures:
                return rechecked, proof
        proved = self._validators[0].prove(Validation(box), attempt)
        return validation._replace(failures=proved.failures), proved.proof

    def _validator(self, model: Model, budget: int, *, with_phases: bool = False) -> Validator:
        budgets = budget, budget_of_set(model.evaluator, budget) if model.fit == 0 else budget
        return Validator(model, self._tests[model.fit], budgets, with_phases=with_phases)

    def _note(self, models: Sequence[Model]) -> None:
        """Note what was met, and what is beyond the box."""
        self.met = models
        box = self.found.box
        search = self._search
        if box is not None and not _has_room(search, box):
            self.give_up()
        self.found = self.found._replace(
            searched=(*self.found.searched, *models),
            failures_alone=search.failures_alone,
            beyond={} if box is None else Extension(search).beyond(box),
        )


def budget_of_set(evaluator: Evaluator, budget: int) -> int:
    """Number of simulations of a falsification with another parameter set, or in a test that
    moves.
    """
    return max(round(OTHER_SHARE * budget), evaluator.scaled(LEAST_SIMULATIONS))


def _nothing(model: Model) -> FloatArray:
    return np.zeros((0, len(model.characteristics)))


def _learn(search: BoxSearch, validation: Validation) -> list[FloatArray]:
    """Take failures, and the models in which they are, into a search; the causes of each."""
    causes = list[FloatArray]()
    for failures in validation.failures:
        search.join(failures.model)
        search.know(failures.settings)
        causes.append(search.learn(failures.settings, failures.model))
    return causes


def _start_of(
    search: BoxSearch, columns: Sequence[int], scans: Sequence[OneAtATimeScan]
) -> FloatArray:
    """The box of what is safe alone; its corner where every characteristic has gone towards its
    smaller margin becomes the first that the search knows.
    """
    start = search.longest.copy()
    corner = np.zeros(len(search.original))
    # Parameters of the scenario, which come last, have no scan.
    for column, scan in zip(columns, scans, strict=False):
        original = search.original[column]
        low, high = scan.safe or (original, original)
        safe_alone = np.minimum(start[:, column], (original - low, high - original))
        start[:, column] = np.where(search.is_free[:, column], safe_alone, start[:, column])
        low_degree, high_degree = np.nan_to_num(
            [scan.degree(end) for end in (low, high)], nan=np.inf
        )
        corner[column] = -1.0 if low_degree < high_degree else 1.0
    search.corners.append(corner)
    return start


def _has_room(search: BoxSearch, box: Box) -> bool:
    """Whether a box leaves any characteristic room, if one may vary."""
    is_open = search.is_free & search.characteristics.of_vehicle
    return not is_open.any() or bool((search.sides_of(box)[is_open] > 0).any())
