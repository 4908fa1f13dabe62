"""Joint limits: a box that holds in all parameter sets, under falsification, and of which no limit
can move out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import MAX_CORNERS, Box, Proof
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import Falsification, enough, falsify
from safevar_sumo.questions.models import Model, Models, judges_of
from safevar_sumo.questions.tolerance.extension import Extension
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.questions.tolerance.search import SEARCH_STAGE, BoxSearch
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
SPECIFICATION_POINTS = 256
"""Number of Sobol points, and of corners, at which specified limits are tested, all others as in
the original.
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
        Numbers of the parameter sets in which the specified limits themselves are unsafe, and the
        worst setting of each.
    room
        Which characteristics could have room, shape (n,): those that vary and have no limit on both
        sides.
    searched
        The models that the search of the box had to survive, then all others in which it was
        tested.
    failures_alone
        Unsafe settings that were met, in which one characteristic is changed, shape (K, n).
    box
        The limits as printed; None if none were found.
    proof, falsification, at_all_points
        Of the box; the last is the number of simulations of the falsification that met all points
        of a matrix.
    least
        The least that the falsification found [m]: over all parameter sets, and with the study's
        own.
    between, between_left_out
        Numbers of points between those of the study's matrix that the falsification met, and of
        those that do not count.
    boxes
        Number of boxes that were tried.
    beyond
        By side and column, an unsafe setting just beyond the box; all its other values are in the
        box.
    corners
        The least that the corners keep with each parameter set [m].
    """

    specified: Box
    members: tuple[Model, ...]
    broken: Mapping[int, FloatArray]
    room: BoolArray
    searched: tuple[Model, ...]
    failures_alone: FloatArray
    box: Box | None = None
    proof: Proof | None = None
    falsification: Falsification | None = None
    at_all_points: int = 0
    least: tuple[float, float] = (np.nan, np.nan)
    between: int = 0
    between_left_out: int = 0
    boxes: int = 0
    beyond: Mapping[tuple[int, int], FloatArray] = {}
    corners: Mapping[int, float] = {}

    @property
    def numbers(self) -> JsonObject:
        """What an answer says of them in numbers."""
        proof = self.proof
        found = self.falsification
        return {
            "box": self.box is not None,
            "samples": None if proof is None else proof.samples,
            "failures": None if proof is None else proof.failures,
            "at_most": None if proof is None else proof.at_most,
            "not_simulated": None if proof is None else proof.not_simulated,
            "fits": len(self.members),
            "attacked": None if found is None else self.at_all_points,
            "attacked_at_worst_points": (
                None if found is None else found.simulated - self.at_all_points
            ),
            "least_attacked": None if found is None else self.least[0],
            "boxes": int(self.box is not None),
        }


def broken_specification(specified: Box, models: Sequence[Model]) -> dict[int, FloatArray]:
    """The worst setting of specified limits in each parameter set in which they are unsafe."""
    seed = models[0].evaluator.study.search.seed
    settings = np.concatenate(
        [
            specified.corners(seed, 0)[:MAX_CORNERS],
            specified.spread_and_corners(SPECIFICATION_POINTS, seed),
        ]
    )
    settings = np.unique(settings, axis=0)
    models = [model for model in models if not _keeps_its_margin(specified, model)]
    judges = judges_of(models, "specified limits with each parameter set")
    # Every setting meets each model once.
    known = [settings] * len(models)
    total = len(models) * len(settings)
    found = falsify(specified, judges, known, total, np.random.default_rng(seed))
    return {models[judge].fit: rows[0] for judge, rows in found.failures.items()}


def _keeps_its_margin(specified: Box, model: Model) -> bool:
    """Whether specified limits are the original vehicle, in a study whose encounters count where
    that keeps a margin, and nothing but less than it would be unsafe: then no encounter that counts
    can break them.
    """
    members = model.evaluator.characteristics
    is_original = (specified.lower == members.original) & (specified.upper == members.original)
    if not len(members.scenario) or not is_original[members.of_vehicle].all():
        return False
    return model.unsafe.is_collision and model.unsafe.keep <= model.evaluator.study.scenario.margin


def find_limits_together(
    models: Models,
    columns: Sequence[int],
    limits: Mapping[str, Limit],
    scans: Sequence[OneAtATimeScan],
    unsafe_settings: FloatArray,
    budget: int,
) -> LimitsTogether:
    """The largest box by relative volume in which `columns` vary, in which those of `limits` reach
    their limits, and that holds none of `unsafe_settings`, shape (K, n).

    Notes
    -----
    A random search seeks the largest box that is safe at known corners, within what is safe alone.
    Causes of what is unsafe, as few changes as possible, are further corners, and the box is sought
    anew until no search finds anything. Then some corners, and a search for counterexamples with
    `budget` simulations over all parameter sets, test it. What they find becomes part of what later
    boxes must survive, in that set; after `EXPLORED` boxes, failures are only cut off. Of a box
    that passes, each limit moves out as far as it can go, at most `MAX_GROWTHS` times, and what
    fails then is cut off until a box passes. The last box has to pass further searches for
    counterexamples, all corners with each parameter set, and settings drawn at random. After
    `MAX_BOXES` boxes or `MAX_SIMULATIONS` simulations the largest that passed is the last, or none
    is found.
    """
    search, nothing = _open_search(models, columns, limits, unsafe_settings)
    if models.own.fit in nothing.broken:
        return nothing
    boxes = _Boxes(search, _start_of(search, columns, scans), models.own.evaluator)
    validator = Validator(nothing.members, enough(budget), models.own.evaluator)
    for number in range(1, MAX_BOXES + 1):
        box = boxes.next(number)
        if box is None:
            break
        simulated = sum(model.evaluator.simulated for model in nothing.members)
        is_over = number == MAX_BOXES or simulated > MAX_SIMULATIONS
        # A box that is no larger than the one that passed ends the search, if that one passes all
        # other tests.
        passed = boxes.passed
        is_last = passed is not None and (is_over or boxes.is_no_larger(box))
        if passed and is_last:
            validation = validator.complete(passed, number)
        else:
            validation = validator.validate(box, number)
        if validation.failures:
            boxes.refuse(validation)
            if is_over and boxes.passed is None:
                break
        elif is_last:
            return _result(nothing, boxes.extension, validation, number)
        else:
            boxes.accept(validation, may_grow=not is_over)
    searched = (*nothing.members, *search.models)
    return nothing._replace(boxes=number, searched=searched, failures_alone=search.failures_alone)


class _Boxes:
    """The boxes that are validated: at first the largest that a search finds, then each one without
    the failures that were found in the one before, and from a box that passed on larger ones.

    Attributes
    ----------
    passed
        The validation of the largest box that passed.
    """

    def __init__(self, search: BoxSearch, start: FloatArray, evaluator: Evaluator) -> None:
        self.search = search
        self.extension = Extension(search)
        self.passed: Validation | None = None
        self._start = start
        self._evaluator = evaluator
        self._outer: Box | None = None
        self._growths = MAX_GROWTHS
        self._failed = 0
        """The box from which failures are cut off; how often limits may still move out; number of
        boxes since one passed.
        """

    def next(self, number: int) -> Box | None:
        """The next box; None if no search finds one."""
        is_explored = self._growths == MAX_GROWTHS and number <= EXPLORED
        if self._outer is None or is_explored:
            with self._evaluator.stage(SEARCH_STAGE):
                sides = self.search.best(self._start)
            if sides is None:
                return None
            self._outer = self.search.printed(sides)
        return self.extension.cut(self._outer, self._failed)

    def is_no_larger(self, box: Box) -> bool:
        """Whether a box is no larger than the one that passed."""
        assert self.passed is not None
        search = self.search
        sides = np.stack([search.sides_of(box), search.sides_of(self.passed.box)])
        volumes = search.log_volume(sides)
        return bool(volumes[0] <= volumes[1])

    def refuse(self, validation: Validation) -> None:
        """Take failures, and the models in which they are, into the search."""
        search = self.search
        with self._evaluator.stage(SEARCH_STAGE):
            for failures in validation.failures:
                search.join(failures.model)
                search.unsafe_settings = np.concatenate([search.unsafe_settings, failures.settings])
                search.learn(failures.settings, failures.model)
        if self.passed and len(search.unsafe_inside(search.sides_of(self.passed.box))):
            self.passed = None
        self._failed += 1

    def accept(self, validation: Validation, *, may_grow: bool) -> None:
        """Take a box that passed; its limits move out as far as they can go."""
        self.passed = validation
        self._outer = validation.box
        self._failed = 0
        if self._growths and may_grow:
            self._growths -= 1
            with self._evaluator.stage(SEARCH_STAGE):
                self._outer = self.extension.of(validation.box)


def _open_search(
    models: Models, columns: Sequence[int], limits: Mapping[str, Limit], unsafe_settings: FloatArray
) -> tuple[BoxSearch, LimitsTogether]:
    """The search for a box, and the answer before it: the specified limits, and the parameter sets
    in which they are unsafe.
    """
    own = models.own._replace(
        evaluator=models.own.evaluator.for_study(models.own.evaluator.study, verified=0)
    )
    # Points at which nothing fails cost as much as the others; the test of a box adds those at
    # which it fails.
    first = own.at_worst_points(unsafe_settings, "worst points") if len(unsafe_settings) else own
    search = BoxSearch(first, columns, limits, unsafe_settings)
    specified = search.printed(search.fixed)
    broken = broken_specification(specified, models.members)
    members = tuple(model for model in (own, *models.members[1:]) if model.fit not in broken)
    room = np.asarray(search.is_free.any(axis=0))
    nothing = LimitsTogether(specified, members, broken, room, members, search.failures_alone)
    return search, nothing


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


def _result(
    nothing: LimitsTogether, extension: Extension, validation: Validation, number: int
) -> LimitsTogether:
    """The joint limits from a box that passed its validation; a box that leaves no characteristic
    any room is none.
    """
    search = extension.search
    box = validation.box
    least = [np.nan, np.nan]
    if validation.falsification is not None:
        found = validation.falsification
        models = [validation.models[judge] for judge in found.judges]
        values = [
            model.unsafe.value(robustness)
            for model, robustness in zip(models, found.robustness.tolist(), strict=True)
        ]
        of_own = [value for value, model in zip(values, models, strict=True) if model.fit == 0]
        worst = nothing.members[0].unsafe.worst
        least = [worst(values, default=np.nan), worst(of_own, default=np.nan)]
    points = [
        len(model.evaluator.study.matrix.tests)
        for model in validation.models[:1]
        if model.evaluator.study.matrix
    ]
    own_tests = nothing.members[0].evaluator.study.matrix
    return nothing._replace(
        box=box if _has_room(search, box) else None,
        proof=validation.proof,
        falsification=validation.falsification,
        at_all_points=validation.at_all_points,
        least=(least[0], least[1]),
        between=sum(points) - (len(own_tests.tests) if own_tests else 0),
        between_left_out=validation.left_out,
        boxes=number,
        beyond=extension.beyond(box),
        corners=validation.corners,
        searched=(*nothing.members, *search.models, *validation.models),
        failures_alone=search.failures_alone,
    )


def _has_room(search: BoxSearch, box: Box) -> bool:
    """Whether a box leaves any characteristic room, if one may vary."""
    is_open = search.is_free & search.characteristics.of_vehicle
    return not is_open.any() or bool((search.sides_of(box)[is_open] > 0).any())
