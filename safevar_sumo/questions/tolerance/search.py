"""The limits that a question asks for: of each characteristic alone, and of all at the same time,
in one parameter set of the vehicle model after another.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import Judgement, Proof, prove
from safevar_sumo.questions.cases import CaseSearch, Counterexamples, Space
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.alone import (
    Alone,
    Side,
    limits_before,
    scan_alone,
    search_alone,
)
from safevar_sumo.questions.tolerance.asked import LEAST_CASES, Asked
from safevar_sumo.questions.tolerance.boxes import (
    LEAST_MOVE,
    Boxes,
    Known,
    Settled,
    find_largest_box,
    learn,
    settle,
)
from safevar_sumo.questions.tolerance.oracle import Exhausted, product_of
from safevar_sumo.records import FloatArray

MOST_PROOFS = 20
"""Largest number of boxes that random vehicles meet."""
NEAR = 0.05
"""How much farther a limit that would hold keeps off failures after each value that failed."""
QUICK = 2
"""Generations of a search that only teaches where failures are."""
OWN_SET_STAGE = "limits with the study's own parameter set"
OTHER_SETS_STAGE = "limits in each further parameter set"
"""Phases of progress; the second has a round for each set."""


class Attack(NamedTuple):
    """The cases that searched the limits in a parameter set, and the least that they leave."""

    simulated: int
    least: float


class FoundLimits(NamedTuple):
    """The limits that were found.

    Attributes
    ----------
    broken
        By the number of each parameter set in which the specified limits are unsafe, a case.
    specified, sides
        The boxes of the specified limits, and of the joint ones; None if there are none.
    known
        What failed while the joint limits were sought.
    attacks
        By the number of each parameter set, how the joint limits were searched.
    proof, proofs
        The upper bound of their unsafe share, and how often one was sought.
    beyond
        By side, an unsafe case just beyond a joint limit.
    """

    alone: Alone
    broken: Mapping[int, FloatArray]
    boxes: Boxes
    specified: FloatArray
    known: Known
    sides: FloatArray | None = None
    attacks: Mapping[int, Attack] = {}
    proof: Proof | None = None
    proofs: int = 0
    beyond: Mapping[Side, FloatArray] = {}


def find_limits(asked: Asked, outer: FoundLimits | None = None) -> FoundLimits:
    """The limits in all parameter sets, within outer ones: those of the study's own, which each
    other one in turn cuts, so that more sets never widen them.
    """
    phases = asked.oracle.phases
    with phases.stage(OWN_SET_STAGE):
        limits = _with_own_set(asked, outer)
    with phases.stage(OTHER_SETS_STAGE):
        for number, fit in enumerate(asked.fits[1:], 1):
            phases.begin_round(number, len(asked.fits) - 1, is_known=True)
            limits = _with_set(asked, limits, fit)
    if limits.sides is None or asked.effort.share >= 1:
        return limits
    return limits._replace(beyond=_beyond(asked, limits))


def no_limits(asked: Asked) -> FoundLimits:
    """No limits, around an unsafe original."""
    boxes = asked.boxes(asked.domain)
    alone = Alone(asked.original, asked.original)
    return FoundLimits(
        alone, {}, boxes, boxes.fixed, Known(asked.nothing, asked.nothing)
    )


def _with_own_set(asked: Asked, outer: FoundLimits | None) -> FoundLimits:
    """The limits with the study's own parameter set."""
    alone = Alone(asked.lower, asked.upper) if outer is None else outer.alone
    suffices = asked.effort.own >= LEAST_CASES
    try:
        alone = alone_with_own_set(asked, alone)
    except Exhausted:
        suffices = False
    longest = _sides_of(asked, alone)
    broken: Mapping[int, FloatArray] = {}
    if outer is not None:
        longest = np.minimum(
            longest, outer.boxes.fixed if outer.sides is None else outer.sides
        )
        broken = outer.broken
    boxes = asked.boxes(longest)
    encounter = np.tile(asked.star.lower[boxes.space.size :], (len(asked.avoided), 1))
    known = Known(np.hstack([asked.avoided, encounter]), asked.nothing)
    limits = FoundLimits(alone, broken, boxes, boxes.fixed, known)
    if not suffices:
        return limits
    try:
        limits = _with_broken(asked, limits, 0)
        return limits if 0 in limits.broken else _with_largest_box(asked, limits)
    except Exhausted:
        return limits


def alone_with_own_set(asked: Asked, limits: Alone) -> Alone:
    """The limits of each characteristic alone, within known ones; they end before what cannot be
    simulated, too.
    """
    oracle, effort, star = asked.oracle, asked.effort, asked.star
    hardest = oracle.hardest(effort.encounters)
    parts = effort.box.parts
    limits = scan_alone(oracle.with_failed, star, limits, hardest, effort.values, parts)
    if effort.alone:
        rng = Stream.LIMITS_ALONE.generator(asked.seed, 0)
        search = asked.search(0, effort.alone, rng, phases=False)
        limits = search_alone(oracle, star, limits, search, parts)
    cases = np.array([*limits.beyond.values()]).reshape(-1, asked.nothing.shape[1])
    pairs = zip(limits.beyond.items(), oracle(cases) < 0, strict=True)
    return limits._replace(beyond=dict(pair for pair, fails in pairs if fails))


def _with_broken(asked: Asked, limits: FoundLimits, fit: int) -> FoundLimits:
    """Limits with a case in which the specified ones are unsafe in a parameter set, all others as
    in the original.
    """
    if not limits.specified.any() or fit in limits.broken:
        return limits
    rng = Stream.SPECIFIED_BETWEEN.generator(asked.seed, fit)
    search = asked.search(fit, asked.budget(fit), rng)
    unsafe = search(limits.boxes.cases_in(limits.specified), asked.nothing).unsafe
    return (
        limits._replace(broken={**limits.broken, fit: unsafe[0]})
        if len(unsafe)
        else limits
    )


def _with_largest_box(asked: Asked, limits: FoundLimits) -> FoundLimits:
    """Limits with the largest box that passes all searches and random vehicles.

    The random search knows phase 0 alone, as a place with its phase says little of the next box,
    whose worst phase is another.
    """
    effort, boxes, seed = asked.effort, limits.boxes, asked.seed
    rng = Stream.JOINT_LIMITS.generator(seed)
    quick = asked.search(0, QUICK * effort.generation, rng, phases=False)
    thorough = asked.search(0, effort.own, rng, phases=False)
    steps = Stream.LARGER_BOXES.generator(seed)
    settled = Settled(boxes.longest, limits.known)
    if boxes.effort.explored:
        settled = find_largest_box(boxes, limits.known, quick, thorough, steps)
    own = asked.search(0, effort.own, Stream.VALIDATION.generator(seed))
    searches = [own, *[_corner_search(asked, boxes)] * (effort.corners > 0)]
    searches += [own] * effort.confirmations
    return _with_settled(asked, limits, settled, searches, 0)


def _with_set(asked: Asked, limits: FoundLimits, fit: int) -> FoundLimits:
    """Limits that hold in a further parameter set, too."""
    effort, seed = asked.effort, asked.seed
    rng = Stream.LIMITS_ALONE.generator(seed, fit)
    search = asked.search(fit, effort.alone, rng, phases=False)
    alone = search_alone(
        asked.oracle, asked.star, limits.alone, search, effort.box.parts
    )
    limits = _with_broken(asked, limits._replace(alone=alone), fit)
    if limits.sides is None or fit in limits.broken:
        return limits
    settled = Settled(_within_alone(asked, limits), limits.known)
    search = asked.search(fit, effort.other, Stream.VALIDATION.generator(seed, fit))
    return _with_settled(asked, limits, settled, [search], fit)


def _with_settled(
    asked: Asked,
    limits: FoundLimits,
    settled: Settled,
    searches: list[CaseSearch],
    fit: int,
) -> FoundLimits:
    """Limits with the box within another one that passes searches with a parameter set and, where
    it became smaller, random vehicles.
    """
    boxes = limits.boxes
    before = limits.sides
    proofs = limits.proofs
    proof = limits.proof
    while settled.sides is not None and proofs < MOST_PROOFS:
        settled = settle(boxes, settled.known, settled.sides, searches)
        if settled.sides is None:
            break
        limits = limits._replace(known=settled.known)
        limits = limits._replace(alone=_alone_before(asked, limits))
        sides = _within_alone(asked, limits._replace(sides=settled.sides))
        is_same = before is not None and np.array_equal(before, sides)
        if is_same or asked.effort.share >= 1:
            return _passed(limits, sides, settled, fit)
        proofs += 1
        proof, unsafe = _prove(asked, boxes.cases_in(sides), proofs)
        if not len(unsafe):
            return _passed(
                limits._replace(proof=proof, proofs=proofs), sides, settled, fit
            )
        settled = settled._replace(known=learn(boxes, settled.known, unsafe, sides))
    return limits._replace(sides=None, known=settled.known, proof=None)


def _passed(
    limits: FoundLimits, sides: FloatArray, settled: Settled, fit: int
) -> FoundLimits:
    """Limits with a box that passed; none if it leaves no characteristic room."""
    is_free = limits.boxes.is_free
    if is_free.any() and not sides[is_free].any():
        return limits._replace(sides=None, proof=None)
    attack = Attack(settled.attacked, settled.least)
    return limits._replace(sides=sides, attacks={**limits.attacks, fit: attack})


def _alone_before(asked: Asked, limits: FoundLimits) -> Alone:
    """The limits alone, before what the search for joint limits met with one change."""
    alone = limits.alone
    vehicles = limits.known.cases[:, : len(asked.original)]
    is_single = np.count_nonzero(vehicles != asked.original, axis=1) == 1
    is_inside = ((vehicles >= alone.lower) & (vehicles <= alone.upper)).all(axis=1)
    cases = limits.known.cases[is_single & is_inside]
    return limits_before(asked.oracle, asked.star, alone, cases, asked.effort.box.parts)


def _sides_of(asked: Asked, alone: Alone) -> FloatArray:
    """The sides of limits alone."""
    return np.stack([asked.original - alone.lower, alone.upper - asked.original])


def _within_alone(asked: Asked, limits: FoundLimits) -> FloatArray:
    """The sides of joint limits, none longer than what is safe alone."""
    assert limits.sides is not None
    boxes = limits.boxes
    shorter = np.minimum(limits.sides, _sides_of(asked, limits.alone))
    return boxes.printed(np.where(boxes.is_free, shorter, limits.sides))


def _corner_search(asked: Asked, boxes: Boxes) -> CaseSearch:
    """A search of the corners of a box, each in all listed encounters."""
    listed = asked.oracle.listed()
    most = asked.effort.corners
    rng = Stream.FIRST_CORNERS.generator(asked.seed)

    def search(space: Space, known: FloatArray) -> Counterexamples:
        n = space.size
        lower, upper = space.lower[:n], space.upper[:n]
        is_open = np.flatnonzero(lower < upper)
        size = len(is_open)
        numbers = np.arange(2**size)
        if 2**size > most:
            numbers = rng.integers(2**size, size=most)
        is_high = np.zeros((len(numbers), n), dtype=bool)
        is_high[:, is_open] = numbers[:, np.newaxis] >> np.arange(size) & 1
        cases = product_of(np.where(is_high, upper, lower), listed)
        met = Counterexamples(known[:0], np.zeros(0)).after(cases, asked.oracle(cases))
        return met._replace(simulated=0)

    return search


def _prove(asked: Asked, space: Space, number: int) -> tuple[Proof, FloatArray]:
    """The upper bound of the unsafe share of a box's vehicles in the listed encounters, and its
    unsafe cases.
    """
    listed = asked.oracle.listed()
    n = space.size
    low, width = space.lower[:n], (space.upper - space.lower)[:n]
    rng = Stream.CONFIDENCE_BOUND.generator(asked.seed, number)
    unsafe = list[FloatArray]()

    def judge(vehicles: FloatArray) -> Judgement:
        cases = product_of(vehicles, listed)
        robustness = asked.oracle.measure(cases)
        unsafe.append(cases[robustness < 0])
        of_vehicle = robustness.reshape(len(vehicles), -1)
        is_unsafe = np.any(of_vehicle < 0, axis=1)
        has_failed = np.any(np.isnan(of_vehicle), axis=1) & ~is_unsafe
        counts = ~np.all(np.isposinf(of_vehicle), axis=1)
        return Judgement(
            np.asarray(is_unsafe), np.asarray(has_failed), np.asarray(counts)
        )

    def draw(count: int) -> FloatArray:
        return asked.oracle.feasible(
            lambda more: low + rng.random((more, n)) * width, count
        )

    proof, _ = prove(draw, judge, asked.effort.share, number)
    return proof, unsafe[0]


def _beyond(asked: Asked, limits: FoundLimits) -> dict[Side, FloatArray]:
    """For each joint limit an unsafe case just beyond it, all other values within theirs."""
    boxes, known, sides = limits.boxes, limits.known, limits.sides
    assert sides is not None
    rng = Stream.EXTENSION.generator(asked.seed)
    search = asked.search(0, QUICK * asked.effort.generation, rng)
    beyond = dict[Side, FloatArray]()
    for side, column in np.argwhere(
        (asked.domain > 0) & (sides < asked.domain)
    ).tolist():
        item = asked.oracle.vehicle.members[column]
        move = max(LEAST_MOVE * boxes.width[column], 10.0**-item.digits)
        wider = sides.copy()
        wider[side, column] = min(
            sides[side, column] + move, asked.domain[side, column]
        )
        cases = known.inside(boxes, wider)
        if not len(cases):
            # A slice of the wider box: this value at its end.
            space = boxes.cases_in(wider)
            lower, upper = space.lower.copy(), space.upper.copy()
            lower[column] = upper[column] = (lower, upper)[side][column]
            slice_ = space._replace(lower=lower, upper=upper)
            cases = search(slice_, known.at_places(boxes, wider)).unsafe
        if len(cases):
            beyond[side, column] = cases[0]
    return beyond


def nearest_limits(asked: Asked, limits: FoundLimits) -> FloatArray:
    """The furthest values of each specified limit with which all hold, the others as specified,
    shape (2, n); NaN where there is none.
    """
    nearest = np.full_like(asked.given, np.nan)
    known = Known(asked.nothing, asked.nothing)
    rngs = [Stream.NEAREST_LIMIT.generator(asked.seed, fit) for fit in asked.fits]
    pairs = zip(asked.fits, rngs, strict=True)
    searches = [asked.search(fit, asked.effort.other, rng) for fit, rng in pairs]
    for side, column in np.argwhere(~np.isnan(asked.given)).tolist():
        is_free = np.zeros_like(limits.boxes.is_free)
        is_free[side, column] = True
        item = asked.oracle.vehicle.members[column]
        effort = limits.boxes.effort._replace(retreat=NEAR)
        boxes = limits.boxes._replace(is_free=is_free, effort=effort)
        sides = settle(boxes, known, limits.specified, searches).sides
        if sides is not None:
            end = boxes.ends(sides)[side][column]
            nearest[side, column] = item.rounded(float(end), upwards=side == 0)
    return nearest
