"""The search for limits: limits of each characteristic alone, and joint limits (limits that hold at
the same time). One parameter set of the vehicle model is searched after another.

A case is a vehicle (n values), the number of a world, and k places; see
`safevar_sumo.questions.tolerance.oracle`. A box is given by its sides; see
`safevar_sumo.questions.tolerance.boxes`.
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
"""Largest number of boxes that are tested with randomly drawn vehicles."""
NEAR = 0.05
"""`BoxEffort.retreat` of the search for the nearest values with which the specified limits hold."""
QUICK_GENERATIONS = 2
"""Number of generations of a search that only shows where failures are."""
OWN_SET_STAGE = "limits with the study's own parameter set"
OTHER_SETS_STAGE = "limits in each further parameter set"
"""Phases of progress; the second phase has a round for each set."""


class FoundLimits(NamedTuple):
    """The limits that were found.

    Attributes
    ----------
    alone
        The limits of each characteristic alone.
    boxes
        What all boxes share. Specified limits are sides that are not free.
    failures
        The failures that became known during the search for joint limits.
    broken
        For the number of each parameter set in which the specified limits are unsafe: an unsafe
        case within these limits.
    sides
        The sides of the box of the joint limits; None if there are no joint limits.
    attacks
        For the number of each parameter set: how the joint limits were searched.
    proof
        The upper bound of the unsafe share within the joint limits.
    proofs
        Number of boxes for which such a bound was computed.
    breaches
        For a side: an unsafe case just beyond the joint limit of this side.
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
        """The sides of the box with the specified limits, in which nothing else varies."""
        return self.boxes.fixed


def find_limits(task: Asked, wider: FoundLimits | None = None) -> FoundLimits:
    """Find the limits in all parameter sets, within `wider` limits if these are given.

    First the limits with the study's own set are found. Then each other set may only make the
    limits narrower. Therefore a further set never makes them wider.
    """
    phases = task.oracle.phases
    with phases.stage(OWN_SET_STAGE):
        limits = _with_own_set(task, wider)
    with phases.stage(OTHER_SETS_STAGE):
        own_sides = limits.sides
        try:
            for number, fit in enumerate(task.fits[1:], 1):
                phases.begin_round(number, len(task.fits) - 1, is_known=True)
                limits = _with_set(task, limits, fit)
            if limits.sides is not None and np.any(limits.sides != own_sides):
                # A narrower box has other corners, and is tested anew.
                settled = Settled(limits.sides, limits.failures)
                corners = _corner_search(task)
                limits = _with_settled(task, limits, settled, [corners], 0)
        except Exhausted:
            # The simulations did not suffice for this set: the answer then claims no joint limits
            # at all.
            failures = Failures(task.nothing, task.nothing)
            limits = limits._replace(sides=None, failures=failures)
        if limits.sides is None or task.effort.share >= 1:
            return limits
        return limits._replace(breaches=_breaches(task, limits, limits.sides))


def no_limits(task: Asked) -> FoundLimits:
    """The limits around an unsafe original vehicle: no characteristic may change."""
    alone = Alone(task.original, task.original)
    failures = Failures(task.nothing, task.nothing)
    return FoundLimits(alone, task.boxes(task.domain), failures)


def _with_own_set(task: Asked, wider: FoundLimits | None) -> FoundLimits:
    """The limits with the study's own parameter set, within `wider` limits if these are given."""
    alone = Alone(task.lower, task.upper) if wider is None else wider.alone
    suffices = task.effort.cases >= LEAST_CASES
    try:
        alone = alone_with_own_set(task, alone)
    except Exhausted:
        suffices = False
    longest = task.sides(alone.lower, alone.upper)
    broken: Mapping[int, FloatArray] = {}
    if wider is not None:
        broken = wider.broken
        sides = wider.specified if wider.sides is None else wider.sides
        longest = np.minimum(longest, sides)
    boxes = task.boxes(longest)
    # Vehicles to avoid are known failures: a failure needs an encounter, and any one will do.
    encounter = task.star.lower[np.newaxis, boxes.space.size :]
    avoided = product_of(task.avoided, encounter)
    limits = FoundLimits(alone, boxes, Failures(avoided, task.nothing), broken)
    if not suffices:
        return limits
    try:
        limits = _with_broken(task, limits, 0)
        return limits if 0 in limits.broken else _with_largest_box(task, limits)
    except Exhausted:
        return limits


def alone_with_own_set(task: Asked, limits: Alone) -> Alone:
    """The limits of each characteristic alone, within known limits. A limit ends before values that
    cannot be simulated, too.
    """
    oracle = task.oracle
    effort = task.effort
    star = task.star
    parts = effort.box.parts
    hardest = oracle.hardest(effort.encounters)
    limits = scan_alone(
        # For the scan, a case that cannot be simulated is unsafe.
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

    # A case that could not be simulated is no example of an unsafe vehicle.
    cases = list(limits.breaches.values())
    rows = np.array(cases).reshape(-1, task.nothing.shape[1])
    breaches = compress(limits.breaches.items(), oracle(rows) < 0)
    return limits._replace(breaches=dict(breaches))


def _with_broken(
    task: Asked,
    limits: FoundLimits,
    fit: int,
) -> FoundLimits:
    """Search the specified limits for an unsafe case with a parameter set, while all other
    characteristics are as in the original. If there is one, the returned limits have it in
    `broken`.
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
    """Limits with the largest box that passes all searches and the test with random vehicles.

    The search that proposes boxes drives at phase 0 alone. It tests each new box at the positions
    of former failures. A position with another phase would say little about the next box, because
    the worst phase changes from box to box.
    """
    effort = task.effort
    boxes = limits.boxes
    settled = Settled(boxes.longest, limits.failures)
    if boxes.effort.explored:
        quick, thorough = task.searches(
            Stream.JOINT_LIMITS,
            0,
            [QUICK_GENERATIONS * effort.generation, effort.cases],
            phases=False,
        )
        settled = find_largest_box(
            boxes,
            limits.failures,
            quick,
            thorough,
            Stream.LARGER_BOXES.generator(task.seed),
        )
    search = task.search(Stream.VALIDATION, 0)
    searches = [search] * (1 + effort.confirmations)
    # Few simulations begin with a corner, as a box that is far too large fails there at once.
    searches.insert(int(effort.share < 1), _corner_search(task))
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
    """The limits, made narrower so that they hold in a further parameter set, too."""
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
    """Limits with a part of a box that passes the searches with a parameter set. With the study's
    own set, this part must also pass the test with random vehicles. The limits have no joint limits
    if no part passes.
    """
    boxes = limits.boxes
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
        if fit == 0 and not np.array_equal(settled.sides, sides):
            # The searches include the corners, and this box has others.
            settled = settled._replace(sides=sides)
            continue
        if fit == 0 and task.effort.share < 1:
            number = limits.proofs + 1
            proof, unsafe = _prove(task, boxes.cases_in(sides), number)
            limits = limits._replace(proof=proof, proofs=number)
            if len(unsafe):
                failures = learn(boxes, settled.failures, unsafe, sides)
                settled = settled._replace(failures=failures)
                continue
        if boxes.is_free.any() and not sides[boxes.is_free].any():
            # The box leaves no room to any characteristic that may vary.
            break
        attacks = {fit: settled.attack, **limits.attacks}
        return limits._replace(sides=sides, attacks=attacks)
    return limits._replace(sides=None, failures=settled.failures, proof=None)


def _alone_before(task: Asked, limits: FoundLimits) -> Alone:
    """The limits alone, moved so that known failures with a single change lie beyond them. The
    search for joint limits found these failures.
    """
    alone = limits.alone
    cases = limits.failures.cases
    vehicles = cases[:, : len(task.original)]
    is_single = np.count_nonzero(vehicles != task.original, axis=1) == 1
    is_inside = ((vehicles >= alone.lower) & (vehicles <= alone.upper)).all(axis=1)
    return limits_before(
        task.oracle,
        task.star,
        alone,
        cases[is_single & is_inside],
        task.effort.box.parts,
    )


def _within_alone(
    task: Asked,
    limits: FoundLimits,
    sides: FloatArray,
) -> FloatArray:
    """The sides of joint limits, shortened so that no side is longer than the limit alone."""
    boxes = limits.boxes
    alone = limits.alone
    shorter = np.minimum(sides, task.sides(alone.lower, alone.upper))
    return boxes.printed(np.where(boxes.is_free, shorter, sides))


def _corner_search(task: Asked) -> CaseSearch:
    """A search that simulates the corners of a box, each in all listed encounters. If the box has
    more than `Effort.corners` corners, the search draws so many of them.
    """
    listed = task.oracle.listed()
    limit = task.effort.corners
    rng = Stream.FIRST_CORNERS.generator(task.seed)

    def search(space: Space, start: FloatArray) -> Counterexamples:
        lower = space.lower[: space.size]
        upper = space.upper[: space.size]
        is_open = lower < upper
        # A bit of a corner's number says whether a value that varies is at its upper end.
        bits = is_open * 2 ** np.cumsum(is_open) // 2
        number = 1 + bits.sum()
        corners = np.arange(min(number, limit))
        if number > limit:
            corners = rng.integers(number, size=limit)
            # The first corner is the one towards which most former failures lie. A value that none
            # of them changed is at the end of the longer side.
            votes = np.sign(start[:, : space.size] - task.original).sum(axis=0)
            longer = lower + upper - 2 * task.original
            corners[0] = bits @ (np.where(votes, votes, longer) > 0)
        is_high = corners[:, np.newaxis] & bits
        cases = product_of(np.where(is_high, upper, lower), listed)
        nothing = Counterexamples(start[:0], np.zeros(0))
        results = nothing.after(cases, task.oracle(cases))
        # Corners do not count as cases of the search for counterexamples.
        return results._replace(simulated=0)

    return search


def _prove(
    task: Asked,
    space: Space,
    number: int,
) -> tuple[Proof, FloatArray]:
    """Test a box with randomly drawn vehicles in the listed encounters. Returns the upper bound of
    the share of unsafe vehicles, and the unsafe cases of the test. `number` counts the tests.
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
    """For each joint limit, an unsafe case in which one value is just beyond its limit, and all
    other values are within their limits. A limit has no case if none is found.
    """
    boxes = limits.boxes
    failures = limits.failures
    budget = min(QUICK_GENERATIONS * task.effort.generation, task.effort.cases)
    search = task.search(Stream.EXTENSION, 0, budget)
    breaches = dict[Side, FloatArray]()
    for side, column in np.argwhere(sides < task.domain).tolist():
        item = task.oracle.vehicle.members[column]
        move = max(LEAST_MOVE * boxes.width[column], 10.0**-item.digits)
        wider = sides.copy()
        longest = task.domain[side, column]
        wider[side, column] = min(sides[side, column] + move, longest)
        cases = failures.inside(boxes, wider)
        if not len(cases):
            # Search the outermost slice of the wider box, in which this value is at its new end.
            space = boxes.cases_in(wider)
            ends = np.stack([space.lower, space.upper])
            ends[:, column] = ends[side, column]
            slice_ = space._replace(lower=ends[0], upper=ends[1])
            cases = search(slice_, failures.at_places(boxes, wider)).unsafe
        if len(cases):
            breaches[side, column] = cases[0]
    return breaches


def nearest_limits(task: Asked, limits: FoundLimits) -> FloatArray:
    """For each specified limit, the value nearest to it with which all specified limits hold, shape
    (2, n). Only this limit moves; the other limits stay as specified. The value is NaN if nothing
    is specified, or if no such value was found.
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
