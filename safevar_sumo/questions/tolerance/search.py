"""The limits that a question asks for: of each characteristic alone, and of all at the same time,
in one parameter set of the vehicle model after another.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import compress
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.boundary import (
    Alone,
    Side,
    limits_before,
    scan_alone,
    search_alone,
)
from safevar_sumo.questions.box import Proof, prove
from safevar_sumo.questions.cases import CaseSearch, Counterexamples, Space
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.asked import LEAST_CASES, Asked
from safevar_sumo.questions.tolerance.boxes import (
    LEAST_MOVE,
    Attack,
    Boxes,
    Failures,
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


class FoundLimits(NamedTuple):
    """The limits that were found.

    Attributes
    ----------
    broken
        By the number of each parameter set in which the specified limits are unsafe, a case.
    failures
        What failed while the joint limits were sought.
    sides
        The box of the joint limits; None if there are none.
    attacks
        By the number of each parameter set, how the joint limits were searched.
    proof, proofs
        The upper bound of their unsafe share, and how often it was sought.
    breaches
        By side, an unsafe case just beyond a joint limit.
    """

    alone: Alone
    boxes: Boxes
    failures: Failures
    broken: Mapping[int, FloatArray] = {}
    sides: FloatArray | None = None
    attacks: Mapping[int, Attack] = {}
    proof: Proof | None = None
    proofs: int = 0
    breaches: Mapping[Side, FloatArray] = {}

    @property
    def specified(self) -> FloatArray:
        """The box of the specified limits."""
        return self.boxes.fixed


def find_limits(task: Asked, wider: FoundLimits | None = None) -> FoundLimits:
    """The limits in all parameter sets, within wider ones: those of the study's own, which the
    others in turn cut, so that more sets never widen them.
    """
    phases = task.oracle.phases
    with phases.stage(OWN_SET_STAGE):
        limits = _with_own_set(task, wider)
    with phases.stage(OTHER_SETS_STAGE):
        for number, fit in enumerate(task.fits[1:], 1):
            phases.begin_round(number, len(task.fits) - 1, is_known=True)
            try:
                limits = _with_set(task, limits, fit)
            except Exhausted:
                # Nothing is claimed of a set that was not searched to the end.
                nothing = task.nothing
                limits = limits._replace(
                    sides=None, failures=Failures(nothing, nothing)
                )
                break
    if limits.sides is None or task.effort.share >= 1:
        return limits
    return limits._replace(breaches=_breaches(task, limits, limits.sides))


def no_limits(task: Asked) -> FoundLimits:
    """No limits, around an unsafe original."""
    alone = Alone(task.original, task.original)
    failures = Failures(task.nothing, task.nothing)
    return FoundLimits(alone, task.boxes(task.domain), failures)


def _with_own_set(task: Asked, wider: FoundLimits | None) -> FoundLimits:
    """The limits with the study's own parameter set."""
    alone = Alone(task.lower, task.upper) if wider is None else wider.alone
    suffices = task.effort.cases >= LEAST_CASES
    try:
        alone = alone_with_own_set(task, alone)
    except Exhausted:
        suffices = False
    longest = task.sides(alone.lower, alone.upper)
    if wider is not None:
        sides = wider.specified if wider.sides is None else wider.sides
        longest = np.minimum(longest, sides)
    boxes = task.boxes(longest)
    encounter = task.star.lower[np.newaxis, boxes.space.size :]
    avoided = product_of(task.avoided, encounter)
    limits = FoundLimits(alone, boxes, Failures(avoided, task.nothing))
    if wider is not None:
        limits = limits._replace(broken=wider.broken)
    if not suffices:
        return limits
    try:
        limits = _with_broken(task, limits, 0)
        return limits if 0 in limits.broken else _with_largest_box(task, limits)
    except Exhausted:
        return limits


def alone_with_own_set(task: Asked, limits: Alone) -> Alone:
    """The limits of each characteristic alone, within known ones; they end before what cannot be
    simulated, too.
    """
    oracle = task.oracle
    effort = task.effort
    star = task.star
    parts = effort.box.parts
    hardest = oracle.hardest(effort.encounters)
    limits = scan_alone(
        partial(oracle, failed=-np.inf),
        star,
        limits,
        hardest,
        effort.values,
        parts,
    )
    if effort.alone:
        search = task.search(
            Stream.LIMITS_ALONE,
            0,
            effort.alone,
            phases=False,
        )
        limits = search_alone(
            oracle,
            star,
            limits,
            search,
            parts,
        )

    # Cases that could not be simulated show nothing.
    cases = [*limits.breaches.values()]
    rows = np.array(cases).reshape(-1, task.nothing.shape[1])
    breaches = compress(limits.breaches.items(), oracle(rows) < 0)
    return limits._replace(breaches=dict(breaches))


def _with_broken(
    task: Asked,
    limits: FoundLimits,
    fit: int,
) -> FoundLimits:
    """Limits with a case in which the specified ones are unsafe in a parameter set, all others as
    in the original.
    """
    if not limits.specified.any() or fit in limits.broken:
        return limits
    search = task.search(Stream.SPECIFIED_BETWEEN, fit)
    space = limits.boxes.cases_in(limits.specified)
    unsafe = search(space, task.nothing).unsafe
    if not len(unsafe):
        return limits
    return limits._replace(broken={**limits.broken, fit: unsafe[0]})


def _with_largest_box(task: Asked, limits: FoundLimits) -> FoundLimits:
    """Limits with the largest box that passes all searches and random vehicles.

    The random search knows phase 0 alone, because a place with its phase says little of the next
    box, whose worst phase is another.
    """
    effort = task.effort
    boxes = limits.boxes
    settled = Settled(boxes.longest, limits.failures)
    if boxes.effort.explored:
        budgets = QUICK * effort.generation, effort.cases
        quick, thorough = task.searches(
            Stream.JOINT_LIMITS,
            0,
            budgets,
            phases=False,
        )
        rng = Stream.LARGER_BOXES.generator(task.seed)
        settled = find_largest_box(
            boxes,
            limits.failures,
            quick,
            thorough,
            rng,
        )
    search = task.search(Stream.VALIDATION, 0)
    searches = [search] * (1 + effort.confirmations)
    if effort.corners:
        searches.insert(1, _corner_search(task))
    return _with_settled(
        task,
        limits,
        settled,
        searches,
        0,
    )


def _with_set(
    task: Asked,
    limits: FoundLimits,
    fit: int,
) -> FoundLimits:
    """Limits that hold in a further parameter set, too."""
    effort = task.effort
    search = task.search(
        Stream.LIMITS_ALONE,
        fit,
        effort.alone,
        phases=False,
    )
    alone = search_alone(
        task.oracle,
        task.star,
        limits.alone,
        search,
        effort.box.parts,
    )
    limits = _with_broken(task, limits._replace(alone=alone), fit)
    if limits.sides is None or fit in limits.broken:
        return limits
    sides = _within_alone(task, limits, limits.sides)
    settled = Settled(sides, limits.failures)
    searches = [task.search(Stream.VALIDATION, fit)]
    return _with_settled(
        task,
        limits,
        settled,
        searches,
        fit,
    )


def _with_settled(
    task: Asked,
    limits: FoundLimits,
    settled: Settled,
    searches: list[CaseSearch],
    fit: int,
) -> FoundLimits:
    """Limits with the box within another one that passes searches with a parameter set and, where
    it became smaller, its corners and random vehicles with the study's own set.
    """
    boxes = limits.boxes
    former = limits.sides
    while settled.sides is not None and limits.proofs < MOST_PROOFS:
        settled = settle(
            boxes,
            settled.failures,
            settled.sides,
            searches,
        )
        if settled.sides is None:
            break
        limits = limits._replace(failures=settled.failures)
        limits = limits._replace(alone=_alone_before(task, limits))
        sides = _within_alone(task, limits, settled.sides)
        unsafe = task.nothing
        is_same = former is not None and np.array_equal(former, sides)
        # The searches drove the corners of another box, or none.
        has_corners = fit == 0 and np.array_equal(settled.sides, sides)
        if task.effort.corners and not is_same and not has_corners:
            unsafe = _corner_search(task)(boxes.cases_in(sides), unsafe).unsafe
        if not (is_same or len(unsafe)) and task.effort.share < 1:
            number = limits.proofs + 1
            proof, unsafe = _prove(task, boxes.cases_in(sides), number)
            limits = limits._replace(proof=proof, proofs=number)
        if len(unsafe):
            failures = learn(boxes, settled.failures, unsafe, sides)
            settled = settled._replace(failures=failures)
            continue
        if boxes.is_free.any() and not sides[boxes.is_free].any():
            # It leaves no characteristic room.
            break
        attacks = {**limits.attacks, fit: settled.attack}
        return limits._replace(sides=sides, attacks=attacks)
    return limits._replace(sides=None, failures=settled.failures, proof=None)


def _alone_before(task: Asked, limits: FoundLimits) -> Alone:
    """The limits alone, before what the search for joint limits met with a single change."""
    alone = limits.alone
    cases = limits.failures.cases
    vehicles = cases[:, : len(task.original)]
    is_single = np.count_nonzero(vehicles != task.original, axis=1) == 1
    is_inside = ((vehicles >= alone.lower) & (vehicles <= alone.upper)).all(axis=1)
    unsafe = cases[is_single & is_inside]
    parts = task.effort.box.parts
    return limits_before(
        task.oracle,
        task.star,
        alone,
        unsafe,
        parts,
    )


def _within_alone(
    task: Asked,
    limits: FoundLimits,
    sides: FloatArray,
) -> FloatArray:
    """The sides of joint limits, none longer than what is safe alone."""
    boxes = limits.boxes
    alone = limits.alone
    shorter = np.minimum(sides, task.sides(alone.lower, alone.upper))
    return boxes.printed(np.where(boxes.is_free, shorter, sides))


def _corner_search(task: Asked) -> CaseSearch:
    """A search of the corners of a box, each in all listed encounters."""
    listed = task.oracle.listed()
    limit = task.effort.corners
    rng = Stream.FIRST_CORNERS.generator(task.seed)

    def search(space: Space, start: FloatArray) -> Counterexamples:
        lower = space.lower[: space.size]
        upper = space.upper[: space.size]
        columns = np.flatnonzero(lower < upper)
        number = 2 ** len(columns)
        corners = np.arange(min(number, limit))
        if number > limit:
            corners = rng.integers(number, size=limit)
        vehicles = np.tile(lower, (len(corners), 1))
        is_high = corners[:, np.newaxis] >> np.arange(len(columns)) & 1
        vehicles[:, columns] = np.where(is_high, upper[columns], lower[columns])
        cases = product_of(vehicles, listed)
        results = Counterexamples(start[:0], np.zeros(0))
        results = results.after(cases, task.oracle(cases))
        return results._replace(simulated=0)

    return search


def _prove(
    task: Asked,
    space: Space,
    number: int,
) -> tuple[Proof, FloatArray]:
    """The upper bound of the unsafe share of a box's vehicles in the listed encounters, and its
    unsafe cases.
    """
    oracle = task.oracle
    listed = oracle.listed()
    lower = space.lower[: space.size]
    width = space.upper[: space.size] - lower
    rng = Stream.CONFIDENCE_BOUND.generator(task.seed, number)
    unsafe = list[FloatArray]()

    def judge(vehicles: FloatArray) -> FloatArray:
        cases = product_of(vehicles, listed)
        robustness = oracle(cases, np.nan)
        unsafe.append(cases[robustness < 0])
        return robustness.reshape(len(vehicles), -1)

    def draw(count: int) -> FloatArray:
        return lower + rng.random((count, space.size)) * width

    proof = prove(
        lambda count: oracle.feasible(draw, count),
        judge,
        task.effort.share,
        number,
    )
    return proof, unsafe[0]


def _breaches(
    task: Asked,
    limits: FoundLimits,
    sides: FloatArray,
) -> dict[Side, FloatArray]:
    """For each joint limit an unsafe case just beyond it, all other values within theirs."""
    boxes = limits.boxes
    failures = limits.failures
    search = task.search(Stream.EXTENSION, 0, QUICK * task.effort.generation)
    breaches = dict[Side, FloatArray]()
    for side, column in np.argwhere(sides < task.domain).tolist():
        item = task.oracle.vehicle.members[column]
        move = max(LEAST_MOVE * boxes.width[column], 10.0**-item.digits)
        wider = sides.copy()
        longest = task.domain[side, column]
        wider[side, column] = min(sides[side, column] + move, longest)
        cases = failures.inside(boxes, wider)
        if not len(cases):
            # A slice of the wider box: this value at its end.
            space = boxes.cases_in(wider)
            ends = np.stack([space.lower, space.upper])
            ends[:, column] = ends[side, column]
            slice_ = space._replace(lower=ends[0], upper=ends[1])
            cases = search(slice_, failures.at_places(boxes, wider)).unsafe
        if len(cases):
            breaches[side, column] = cases[0]
    return breaches


def nearest_limits(task: Asked, limits: FoundLimits) -> FloatArray:
    """The furthest values of each specified limit with which all hold, the others as specified,
    shape (2, n); NaN where there is none.
    """
    nearest = np.full_like(task.specification, np.nan)
    failures = Failures(task.nothing, task.nothing)
    budget = task.effort.cases_of_set
    searches = [task.search(Stream.NEAREST_LIMIT, fit, budget) for fit in task.fits]
    for side, column in np.argwhere(~np.isnan(task.specification)).tolist():
        is_free = np.zeros_like(limits.boxes.is_free)
        is_free[side, column] = True
        effort = limits.boxes.effort._replace(retreat=NEAR)
        boxes = limits.boxes._replace(is_free=is_free, effort=effort)
        sides = settle(
            boxes,
            failures,
            limits.specified,
            searches,
        ).sides
        if sides is not None:
            end = boxes.ends(sides)[side][column]
            item = task.oracle.vehicle.members[column]
            nearest[side, column] = item.rounded(float(end), upwards=side == 0)
    return nearest
