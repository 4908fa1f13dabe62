"""Limits that may be used together: a box that holds in all fits, under attack, and of which no limit can move out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.attack import Attack, attack
from safevar_sumo.questions.box import MAX_CORNERS, Box, Judgement, Proof, proof_size, prove
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model, Models, with_points_between
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.questions.tolerance.search import SEARCH_STAGE, BoxSearch
from safevar_sumo.questions.tolerance.settlement import Settlement
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Limit

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
MAX_BOXES, MAX_GROWTHS = 40, 12
"""Maximum number of boxes that are tested; and of tests of one whose limits have moved out."""
KNOWN = 32
"""Number of the worst corners of the study's own fit with which an attack begins; of each other fit an eighth."""
PROMISE_POINTS = 256
"""Number of Sobol points, and of corners, at which specified limits are tested, all others as in the original."""
TEST_STAGE = "test of the limits together"


class LimitsTogether(NamedTuple):
    """The largest box that was found, by relative volume, in which characteristics reach the limits specified for them.

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
    proof, attack
        Of the box; of the promise without one.
    least
        The least that the attack found [m]: over all fits, and with the study's own.
    between, between_left_out
        Numbers of points between those of the study's matrix that the attack met, and of those that do not count.
    boxes
        Number of boxes that were tried.
    beyond
        By side and column, an unsafe setting just beyond the box; all its other values are in the box.
    corners
        The least that the corners keep with each fit [m].
    room
        Which characteristics could have room, shape (n,): those that vary and have no limit on both sides.
    searched
        The models that the search of the box had to survive, then all others in which it was tested.
    failures_alone
        Unsafe settings that were met, in which one characteristic is changed, shape (K, n).
    """

    promise: Box
    box: Box | None
    broken: Mapping[int, FloatArray]
    members: tuple[Model, ...]
    proof: Proof | None
    attack: Attack | None
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
        proof, found = self.proof, self.attack
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


class _Failures(NamedTuple):
    """Unsafe settings, shape (K, n), and the model at the points where they are."""

    model: Model
    settings: FloatArray


class _Test(NamedTuple):
    """What the test of a box gave: failures, or the proof, the attack and its models."""

    failures: list[_Failures]
    corners: Mapping[int, float]
    judges: Sequence[Model] = ()
    attack: Attack | None = None
    proof: Proof | None = None
    left_out: int = 0


class _BoxTest:
    """The test of boxes: all corners with each fit, those first in which earlier boxes failed, an attack over all fits,
    and settings drawn at random. Progress is shown by the evaluator of the question.
    """

    def __init__(self, models: Sequence[Model], budget: int, evaluator: Evaluator) -> None:
        self.models, self.budget, self.evaluator = models, budget, evaluator
        self.seed = models[0].evaluator.study.search.seed
        self.tests, self._first = 0, {0}

    def of(self, box: Box, attempt: int) -> _Test:
        """Test a box; the first part that finds failures ends it."""
        corners = box.corners(self.seed, attempt)
        of_fits = len(corners) + (len(self.models) - 1) * min(len(corners), MAX_CORNERS)
        with self.evaluator.stage(TEST_STAGE, of_fits + self.budget + proof_size(self.tests + 1, MAX_UNSAFE_SHARE)):
            return self._of(box, corners, attempt)

    def _of(self, box: Box, corners: FloatArray, attempt: int) -> _Test:
        of_each, lefts = corners[:MAX_CORNERS], dict[int, FloatArray]()
        failures = self._failing_corners(of_each, self._first, lefts)
        if failures:
            return _Test(failures, {})
        orders = {number: np.argsort(left, kind="stable") for number, left in lefts.items()}
        worst = [
            of_each[orders.get(number, orders[0])[: KNOWN if number == 0 else KNOWN // 8]]
            for number in range(len(self.models))
        ]
        test = self._attack(box, worst, attempt)
        failures = test.failures or self._failing_corners(of_each, {*range(len(self.models))} - self._first, lefts)
        own = self.models[0]
        if not failures and len(corners) > MAX_CORNERS:  # corners of a study that searches its scenario
            others = corners[MAX_CORNERS:]
            failures = list(filter(None, [_failures(own, others, own.left(others, TEST_STAGE))]))
        if failures:
            return test._replace(failures=failures)
        least = {
            model.fit: model.unsafe.value(float(lefts[row].min(initial=np.inf)))
            for row, model in enumerate(self.models)
        }
        return self._prove(box, test._replace(corners=least), attempt)

    def _failing_corners(self, corners: FloatArray, numbers: set[int], lefts: dict[int, FloatArray]) -> list[_Failures]:
        """The unsafe corners in some models, which are the first in later tests; `lefts` takes what all leave."""
        for number in sorted(numbers):
            lefts[number] = self.models[number].left(corners, TEST_STAGE)
        failing = [number for number in sorted(numbers) if lefts[number].min(initial=np.inf) < 0]
        self._first |= {*failing}
        found = [_failures(self.models[number], corners, lefts[number]) for number in failing]
        return [each for each in found if each]

    def _attack(self, box: Box, worst: Sequence[FloatArray], attempt: int) -> _Test:
        own, judges, left_out = self.models[0], list[Model](), list[int]()
        if not self.budget:
            return _Test([], {}, self.models)
        for model in self.models:
            denser, number = with_points_between(model, own.unsafe, np.random.default_rng((self.seed, 5, attempt)))
            judges.append(denser)
            left_out.append(number)
        rng = np.random.default_rng((self.seed, 4, attempt))
        lefts: list[Callable[[FloatArray], FloatArray]] = [partial(model.left, stage=TEST_STAGE) for model in judges]
        found = attack(box, lefts, worst, self.budget, rng)
        failures = [
            _failures(model, found.settings[found.judges == number], found.left[found.judges == number])
            for number, model in enumerate(judges)
        ]
        return _Test([each for each in failures if each], {}, judges, found, left_out=left_out[0])

    def _prove(self, box: Box, test: _Test, attempt: int) -> _Test:
        self.tests += 1
        own = self.models[0]
        model = test.judges[0] if test.judges else own

        def judge(settings: FloatArray) -> Judgement:
            evaluations = model.evaluate(settings, TEST_STAGE)
            failed = ~evaluations.valid & ~evaluations.infeasible
            return Judgement(model.left_by(evaluations) < 0, failed, ~evaluations.infeasible)

        rng = np.random.default_rng((self.seed, 1, attempt))
        proof, unsafe = prove(lambda number: box.draw(number, rng), judge, MAX_UNSAFE_SHARE, self.tests)
        failures = _failures(model, unsafe, np.full(len(unsafe), -1.0))
        return test._replace(proof=proof, failures=[failures] if failures else [])


def _failures(model: Model, settings: FloatArray, left: FloatArray) -> _Failures | None:
    """The settings that leave less than nothing, and the model at the points where they do; None if none does."""
    unsafe = settings[left < 0]
    return _Failures(model.at_worst_points(unsafe, TEST_STAGE), unsafe) if len(unsafe) else None


def broken_promises(promise: Box, models: Sequence[Model]) -> dict[int, FloatArray]:
    """The worst setting of a promise in each fit in which it is unsafe."""
    seed = models[0].evaluator.study.search.seed
    settings = np.concatenate(
        [promise.corners(seed, 0)[:MAX_CORNERS], promise.spread_and_corners(PROMISE_POINTS, seed)]
    )
    settings = np.unique(settings, axis=0)
    broken = dict[int, FloatArray]()
    for model in models:
        left = model.left(settings, "specified limits with each fit")
        if left.min() < 0:
            broken[model.fit] = settings[np.argmin(left)]
    return broken


def find_limits_together(
    models: Models,
    columns: Sequence[int],
    limits: Mapping[str, Limit],
    scans: Sequence[OneAtATimeScan],
    unsafe_settings: FloatArray,
    budget: int,
    inner: Box | None = None,
) -> LimitsTogether:
    """The largest box by relative volume in which `columns` vary, in which those of `limits` reach their limits, and
    that holds none of `unsafe_settings`, shape (K, n); around an `inner` box, if that passes its test.

    Notes
    -----
    A random search seeks the largest box that is safe at known corners, within what is safe alone. Causes of what is
    unsafe, as few changes as possible, are further corners, and the box is sought anew until no search finds anything.
    Then all corners with each fit, an attack with `budget` simulations over all fits, and settings drawn at random test
    it. What they find becomes part of what later boxes must survive, in that fit. At last each limit, as it is printed,
    moves out as far as it can go, and the box is tested again; a failure then moves one limit in.
    """
    own = models.own._replace(evaluator=models.own.evaluator.for_study(models.own.evaluator.study, verified=0))
    # Points at which nothing fails cost as much as the others; the test of a box adds those at which it fails.
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
    if own.fit in broken:
        return nothing
    start = _start(search, columns, scans)
    test = _BoxTest(members, budget, models.own.evaluator)
    for number in range(1, MAX_BOXES + 1):
        with test.evaluator.stage(SEARCH_STAGE):
            sides = search.best(start) if inner is None or number > 1 else search.sides_of(inner)
        if sides is None:
            return _without_box(nothing, search, number)
        box = search.printed(sides)
        found = test.of(box, number)
        if not found.failures:
            return _grown(nothing, search, test, box, found, number)
        with test.evaluator.stage(SEARCH_STAGE):
            _learn(search, found)
    return _without_box(nothing, search, MAX_BOXES)


def _without_box(nothing: LimitsTogether, search: BoxSearch, boxes: int) -> LimitsTogether:
    """No limits together, and what the search met."""
    searched = (*nothing.members, *search.models)
    return nothing._replace(boxes=boxes, searched=searched, failures_alone=search.failures_alone)


def _learn(search: BoxSearch, test: _Test) -> None:
    """Take failures, and the models in which they are, into a search."""
    for failures in test.failures:
        search.join(failures.model)
        search.unsafe_settings = np.concatenate([search.unsafe_settings, failures.settings])
        search.learn(failures.settings)


def _grown(
    nothing: LimitsTogether, search: BoxSearch, test: _BoxTest, box: Box, found: _Test, number: int
) -> LimitsTogether:
    """The limits together from a box that passed its test, whose limits have moved out as far as they can; where what
    grew fails its tests, the box itself.
    """
    settlement = Settlement(search)
    with test.evaluator.stage(SEARCH_STAGE):
        wider = settlement.of(box)
    for growth in range(1, MAX_GROWTHS + 1):
        volumes = [search.log_volume(search.sides_of(each)) for each in (box, wider)]
        if volumes[1] <= volumes[0]:
            break
        found_wider = test.of(wider, number + growth)
        with test.evaluator.stage(SEARCH_STAGE):
            if found_wider.failures:
                _learn(search, found_wider)
                wider = settlement.cut(wider)
            else:
                box, found = wider, found_wider
                wider = settlement.of(box)
    return _result(nothing, search, settlement, box, found, number)


def _start(search: BoxSearch, columns: Sequence[int], scans: Sequence[OneAtATimeScan]) -> FloatArray:
    """The box of what is safe alone; its corner where every characteristic has gone towards its smaller margin becomes
    the first that the search knows.
    """
    start, corner = search.longest.copy(), np.zeros(len(search.original))
    for column, scan in zip(columns, scans, strict=False):  # parameters of the scenario, which come last, have no scan
        original = search.original[column]
        low, high = scan.safe or (original, original)
        safe_alone = np.minimum(start[:, column], (original - low, high - original))
        start[:, column] = np.where(search.is_free[:, column], safe_alone, start[:, column])
        low_degree, high_degree = np.nan_to_num([scan.degree(end) for end in (low, high)], nan=np.inf)
        corner[column] = -1.0 if low_degree < high_degree else 1.0
    search.corners.append(corner)
    return start


def _result(
    nothing: LimitsTogether, search: BoxSearch, settlement: Settlement, box: Box, test: _Test, number: int
) -> LimitsTogether:
    """The limits together from a box that passed its test; a box that leaves no characteristic any room is none."""
    of_vehicle = search.characteristics.of_vehicle
    is_open = search.is_free & of_vehicle
    has_room = not is_open.any() or bool((search.sides_of(box)[is_open] > 0).any())
    least = [np.nan, np.nan]
    if test.attack is not None:
        judges = [test.judges[judge] for judge in test.attack.judges]
        values = [model.unsafe.value(left) for model, left in zip(judges, test.attack.left.tolist(), strict=True)]
        of_own = [value for value, model in zip(values, judges, strict=True) if model.fit == 0]
        worst = nothing.members[0].unsafe.worst
        least = [worst(values, default=np.nan), worst(of_own, default=np.nan)]
    points = [len(model.evaluator.study.matrix.tests) for model in test.judges[:1] if model.evaluator.study.matrix]
    own_tests = nothing.members[0].evaluator.study.matrix
    return nothing._replace(
        box=box if has_room else None,
        proof=test.proof,
        attack=test.attack,
        least=(least[0], least[1]),
        between=sum(points) - (len(own_tests.tests) if own_tests else 0),
        between_left_out=test.left_out,
        boxes=number,
        beyond=settlement.beyond(box),
        corners=test.corners,
        searched=(*nothing.members, *search.models, *test.judges),
        failures_alone=search.failures_alone,
    )
