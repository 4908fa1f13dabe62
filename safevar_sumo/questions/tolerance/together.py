"""Limits that may be used together: a box that holds in all fits, under attack, and of which no
limit can move out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import MAX_CORNERS, Box, Proof
from safevar_sumo.questions.falsify import Falsification, enough, falsify
from safevar_sumo.questions.models import Model, Models, judges_of
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.questions.tolerance.search import SEARCH_STAGE, BoxSearch
from safevar_sumo.questions.tolerance.settlement import Settlement
from safevar_sumo.questions.tolerance.trial import Trial, Trials
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
PROMISE_POINTS = 256
"""Number of Sobol points, and of corners, at which specified limits are tested, all others as in
the original.
"""


class LimitsTogether(NamedTuple):
    """The largest box that was found, by relative volume, in which characteristics reach the limits
    specified for them.

    Attributes
    ----------
    promise
        The specified limits, all other characteristics as in the original.
    box
        The limits as printed; None if none were found.
    broken
        Numbers of the fits in which the promise itself is unsafe, and the worst setting of each.
    members
        The models in which the box holds.
    proof, falsification
        Of the box; of the promise without one.
    least
        The least that the falsification found [m]: over all fits, and with the study's own.
    between, between_left_out
        Numbers of points between those of the study's matrix that the falsification met, and of
        those that do not count.
    boxes
        Number of boxes that were tried.
    beyond
        By side and column, an unsafe setting just beyond the box; all its other values are in the
        box.
    corners
        The least that the corners keep with each fit [m].
    room
        Which characteristics could have room, shape (n,): those that vary and have no limit on both
        sides.
    searched
        The models that the search of the box had to survive, then all others in which it was
        tested.
    failures_alone
        Unsafe settings that were met, in which one characteristic is changed, shape (K, n).
    """

    promise: Box
    box: Box | None
    broken: Mapping[int, FloatArray]
    members: tuple[Model, ...]
    proof: Proof | None
    falsification: Falsification | None
    least: tuple[float, float]
    between: int
    between_left_out: int
    boxes: int
    beyond: Mapping[tuple[int, int], FloatArray]
    corners: Mapping[int, float]
    room: BoolArray
    searched: tuple[Model, ...]
    failures_alone: FloatArray

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
            "attacked": None if found is None else found.simulated,
            "least_attacked": None if found is None else self.least[0],
            "boxes": int(self.box is not None),
        }


def broken_promises(promise: Box, models: Sequence[Model]) -> dict[int, FloatArray]:
    """The worst setting of a promise in each fit in which it is unsafe."""
    seed = models[0].evaluator.study.search.seed
    settings = np.concatenate(
        [promise.corners(seed, 0)[:MAX_CORNERS], promise.spread_and_corners(PROMISE_POINTS, seed)]
    )
    settings = np.unique(settings, axis=0)
    models = [model for model in models if not _keeps_its_margin(promise, model)]
    judges = judges_of(models, "specified limits with each fit")
    # Every setting meets each model once.
    known = [settings] * len(models)
    total = len(models) * len(settings)
    found = falsify(promise, judges, known, total, np.random.default_rng(seed))
    return {models[judge].fit: rows[0] for judge, rows in found.failures.items()}


def _keeps_its_margin(promise: Box, model: Model) -> bool:
    """Whether a promise is the original vehicle, in a study whose encounters count where that keeps
    a margin, and nothing but less than it would be unsafe: then no encounter that counts can break
    it.
    """
    members = model.evaluator.characteristics
    is_original = (promise.lower == members.original) & (promise.upper == members.original)
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
    anew until no search finds anything. Then all corners with each fit, a search for
    counterexamples with `budget` simulations over all fits, and settings drawn at random test it.
    What they find becomes part of what later boxes must survive, in that fit; after `EXPLORED`
    boxes, failures are only cut off. Of a box that passes, each limit moves out as far as it can
    go, at most `MAX_GROWTHS` times, and what fails then is cut off until a box passes. The last box
    is confirmed by further searches for counterexamples. After `MAX_BOXES` boxes or
    `MAX_SIMULATIONS` simulations the largest that passed is confirmed, or none is found.
    """
    search, nothing = open_search(models, columns, limits, unsafe_settings)
    if models.own.fit in nothing.broken:
        return nothing
    start = start_of(search, columns, scans)
    trials = Trials(nothing.members, enough(budget), models.own.evaluator)
    settlement = Settlement(search)
    passed: Trial | None = None
    outer: Box | None = None  # the box from which failures are cut off
    growths = MAX_GROWTHS
    failed = 0  # boxes since one passed
    for number in range(1, MAX_BOXES + 1):
        if outer is None or (growths == MAX_GROWTHS and number <= EXPLORED):
            with trials.evaluator.stage(SEARCH_STAGE):
                sides = search.best(start)
            if sides is None:
                break
            outer = search.printed(sides)
        box = settlement.cut(outer, failed)
        # A box that is no larger than the one that passed ends the search, if further searches
        # confirm that one.
        is_over = (
            number == MAX_BOXES
            or sum(each.evaluator.simulated for each in nothing.members) > MAX_SIMULATIONS
        )
        is_last = passed is not None and (
            is_over or volume(search, box) <= volume(search, passed.box)
        )
        trial = (
            trials.confirmed(passed, number) if passed and is_last else trials.whole(box, number)
        )
        if _learn(search, trials, trial):
            is_refuted = passed is not None and bool(
                len(search.unsafe_inside(search.sides_of(passed.box)))
            )
            passed = None if is_refuted else passed
            failed += 1
            if is_over and passed is None:
                break
        elif is_last:
            return result(nothing, settlement, trial, number)
        else:
            passed = trial
            outer = box
            failed = 0
            if growths and not is_over:
                growths -= 1
                with trials.evaluator.stage(SEARCH_STAGE):
                    outer = settlement.of(box)
    return without_box(nothing, search, number)


def volume(search: BoxSearch, box: Box) -> float:
    """The logarithm of a box's volume, as a share of the domain's."""
    return float(search.log_volume(search.sides_of(box)))


def open_search(
    models: Models, columns: Sequence[int], limits: Mapping[str, Limit], unsafe_settings: FloatArray
) -> tuple[BoxSearch, LimitsTogether]:
    """The search for a box, and the answer before it: the promise, and the fits in which it is
    broken.
    """
    own = models.own._replace(
        evaluator=models.own.evaluator.for_study(models.own.evaluator.study, verified=0)
    )
    # Points at which nothing fails cost as much as the others; the test of a box adds those at
    # which it fails.
    first = own.at_worst_points(unsafe_settings, "worst points") if len(unsafe_settings) else own
    search = BoxSearch(first, columns, limits, unsafe_settings)
    promise = search.printed(search.fixed)
    broken = broken_promises(promise, models.members)
    members = tuple(model for model in (own, *models.members[1:]) if model.fit not in broken)
    nothing = LimitsTogether(
        promise,
        None,
        broken,
        members,
        None,
        None,
        (np.nan, np.nan),
        0,
        0,
        0,
        {},
        {},
        np.asarray(search.is_free.any(axis=0)),
        members,
        search.failures_alone,
    )
    return search, nothing


def without_box(nothing: LimitsTogether, search: BoxSearch, boxes: int) -> LimitsTogether:
    """No limits together, and what the search met."""
    searched = (*nothing.members, *search.models)
    return nothing._replace(boxes=boxes, searched=searched, failures_alone=search.failures_alone)


def _learn(search: BoxSearch, trials: Trials, trial: Trial) -> bool:
    """Take failures, and the models in which they are, into a search; whether there are any."""
    with trials.evaluator.stage(SEARCH_STAGE):
        for failures in trial.failures:
            search.join(failures.model)
            search.unsafe_settings = np.concatenate([search.unsafe_settings, failures.settings])
            search.learn(failures.settings, failures.model)
    return bool(trial.failures)


def start_of(
    search: BoxSearch, columns: Sequence[int], scans: Sequence[OneAtATimeScan]
) -> FloatArray:
    """The box of what is safe alone; its corner where every characteristic has gone towards its
    smaller margin becomes the first that the search knows.
    """
    start = search.longest.copy()
    corner = np.zeros(len(search.original))
    for column, scan in zip(
        columns, scans, strict=False
    ):  # parameters of the scenario, which come last, have no scan
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


def result(
    nothing: LimitsTogether, settlement: Settlement, trial: Trial, number: int
) -> LimitsTogether:
    """The limits together from a box that passed its trial; a box that leaves no characteristic any
    room is none.
    """
    search = settlement.search
    box = trial.box
    least = [np.nan, np.nan]
    if trial.falsification is not None:
        judges = [trial.judges[judge] for judge in trial.falsification.judges]
        values = [
            model.unsafe.value(left)
            for model, left in zip(judges, trial.falsification.left.tolist(), strict=True)
        ]
        of_own = [value for value, model in zip(values, judges, strict=True) if model.fit == 0]
        worst = nothing.members[0].unsafe.worst
        least = [worst(values, default=np.nan), worst(of_own, default=np.nan)]
    points = [
        len(model.evaluator.study.matrix.tests)
        for model in trial.judges[:1]
        if model.evaluator.study.matrix
    ]
    own_tests = nothing.members[0].evaluator.study.matrix
    return nothing._replace(
        box=box if has_room(search, box) else None,
        proof=trial.proof,
        falsification=trial.falsification,
        least=(least[0], least[1]),
        between=sum(points) - (len(own_tests.tests) if own_tests else 0),
        between_left_out=trial.left_out,
        boxes=number,
        beyond=settlement.beyond(box),
        corners=trial.corners,
        searched=(*nothing.members, *search.models, *trial.judges),
        failures_alone=search.failures_alone,
    )


def has_room(search: BoxSearch, box: Box) -> bool:
    """Whether a box leaves any characteristic room, if one may vary."""
    is_open = search.is_free & search.characteristics.of_vehicle
    return not is_open.any() or bool((search.sides_of(box)[is_open] > 0).any())
