"""The contract of a scenario in a simulator of the user's own, which moves the vehicle under test
and drives it, too.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from safevar_sumo.plugins import SHARE, Contract, Legal, Returned, UserCode, quoted
from safevar_sumo.records import FloatArray, NamedValues, Outcome, Trace
from safevar_sumo.scenarios.base import Mover, Scenario
from safevar_sumo.study import SAFETY_DEGREE

OWN_SIMULATOR = Mover(
    "a simulator of the user's own",
    takes_long=True,
    is_exact=False,
    has_own_step=True,
    lacks={
        "SUMO": "it takes no other engine",
        "recorded scenes": "its own simulator moves the vehicle",
        "roads": "it has no road to export",
        "sumo-gui": "it has no scene for sumo-gui",
        "a driving system": "nothing of its driving system can be changed here",
        "a picture": "a picture needs the position in its trace",
        "a trace": "it states metrics alone",
        "weather": "it moves and drives the vehicle in a weather of its own",
    },
)
"""A class with `simulate`, which drives one vehicle after another; see `Simulator`."""
SPEED = Legal(0.0, 1000.0)
TIME, OUTCOME, IMPACT_SPEED, STRUCK_SPEED = (
    "time",
    "outcome",
    "impact_speed",
    "struck_speed",
)
SAMPLED = {TIME: Legal(0.0), "speed": SPEED, "separation": Legal(0.0, infinite=True)}
"""What a trace has at each sample."""
ALSO_SAMPLED = {
    "gap": Legal(infinite=True),
    "obstacle_speed": Legal(),
    "brake": SHARE,
    "throttle": SHARE,
    "position": Legal(),
}
"""What a trace may have at each sample."""
OF_COLLISION = {IMPACT_SPEED: SPEED, STRUCK_SPEED: Legal()}
"""What a collision has besides, and may have."""
OUTCOMES = [outcome.value for outcome in list(Outcome)[:6]]
"""How a run may end: all but failures of the simulator and settings that are not simulated."""
ENDS_APART = (Outcome.PASSED, Outcome.STOPPED, Outcome.TIMEOUT)
"""Outcomes of runs in which nothing was touched."""
StatedRun = Mapping[str, Any]
"""What a simulator states of a run, by the names of quantities and metrics."""
MOST_DECELERATION = 20.0
"""Largest change of the speed in a second that every trace may have [m/s^2]."""
SLACK, CREEPS = 0.1, 1.0
"""Rounding of distances and speeds [m, m/s]; a speed up to which a vehicle has stopped [m/s]."""
FACTOR = 1.5
"""Least factor between speed and way that is no error of sampling."""
FIRST_SLACK = 0.05
"""What the ways of the first step may differ besides [m]."""
STEP_TOLERANCE = 1e-6
"""Largest difference between two time steps of a trace [s]."""


def check_result(code: UserCode, method: str, result: Any, setting: Any) -> StatedRun:
    """Refuse a result that lacks a quantity, has an unknown one, or has illegal numbers.

    Arrays have float elements afterwards. A result without `time` is one of a rig that logs no
    trace: names of its metrics are checked where the study's are known.
    """
    if not isinstance(result, Mapping):
        raise code.wrong(
            method, quoted(result), f"a mapping with {', '.join(SAMPLED)}, {OUTCOME}"
        )
    check = _checked_metrics
    names = [SAFETY_DEGREE]
    if TIME in result:
        check = _checked_trace
        names = list(SAMPLED)
    for name in (*names, OUTCOME):
        if name not in result:
            raise code.wrong(
                method,
                f"a result without {name}",
                f"{', '.join(SAMPLED)} of each sample, and {OUTCOME}; or, without a trace,"
                f" {OUTCOME}, {SAFETY_DEGREE} and metrics by name",
            )
    outcome = str(result[OUTCOME])
    if outcome not in OUTCOMES:
        raise code.wrong(
            method, f"{OUTCOME} = {quoted(result[OUTCOME])}", ", ".join(OUTCOMES)
        )
    return {
        **check(code, method, result, outcome == Outcome.COLLISION),
        OUTCOME: outcome,
    }


def _checked_trace(
    code: UserCode, method: str, result: StatedRun, has_collided: bool
) -> StatedRun:
    """The columns of a trace, each of shape (T,), and what it says of a collision."""
    sampled = SAMPLED | ALSO_SAMPLED
    legal_keys = {**sampled, **OF_COLLISION, OUTCOME: None}
    for name in result:
        if name not in legal_keys:
            raise code.wrong(
                method, f"a trace with {name!r}", f"keys among {', '.join(legal_keys)}"
            )
    shape = np.shape(result[TIME])
    columns = {}
    for name, legal in sampled.items():
        if name in result:
            values = code.check_numbers(method, name, result[name], shape, legal)
            columns[name] = values.astype(float)
    steps = np.zeros(0)
    if len(shape) == 1:
        steps = np.diff(columns[TIME])
    if not len(steps) or np.ptp(steps) > STEP_TOLERANCE or steps[0] <= 0:
        raise code.wrong(
            method, f"{TIME} = {quoted(result[TIME])}", "at least 2 times, equal steps"
        )
    if not has_collided and not np.isfinite(columns["separation"]).any():
        raise code.wrong(method, "separation = inf", "a finite number at some time")

    numbers = NamedValues()
    if has_collided:
        if IMPACT_SPEED not in result:
            raise code.wrong(
                method,
                f"a collision without {IMPACT_SPEED}",
                "the speed at impact [m/s]",
            )
        ends = {name: result.get(name, 0.0) for name in OF_COLLISION}
        numbers = _numbers(code, method, ends, OF_COLLISION)
    if contradiction := _contradiction(
        str(result[OUTCOME]), columns, numbers, steps[0]
    ):
        raise code.wrong(
            method,
            contradiction,
            "an end that the trace allows within one of its steps",
        )
    return {**columns, **numbers}


def _contradiction(
    outcome: str,
    columns: Mapping[str, FloatArray],
    ends: NamedValues,
    step: float,
) -> str:
    """What a trace says of the end of its run that its samples exclude, by more than may happen
    within one step [s]; "" if nothing.
    """
    speed, separation = columns["speed"], columns["separation"]
    braked = max(float(np.abs(np.diff(speed)).max()), MOST_DECELERATION * step)
    if outcome == Outcome.COLLISION:
        # What it struck moves as fast as the trace says of anybody.
        obstacle_speeds = [ends[STRUCK_SPEED], *columns.get("obstacle_speed", ())]
        finite = separation[np.isfinite(separation)]
        reach = (speed.max() + braked + np.abs(obstacle_speeds).max()) * step
        reach += float(np.abs(np.diff(finite)).max(initial=0.0))
        if finite.size and finite.min() > reach + SLACK:
            return f"a collision at a separation of {finite.min():.3g} m"
        impact = ends[IMPACT_SPEED]
        if np.abs(speed - impact).min() > braked + SLACK:
            return f"{IMPACT_SPEED} = {impact:.3g} after a speed of {speed[-1]:.3g}"
        return ""
    if outcome in ENDS_APART and separation.min() <= 0:
        return f"{outcome!r} with a separation of 0"
    if outcome == Outcome.STOPPED and speed[-1] > max(braked, CREEPS):
        return f"{outcome!r} at a speed of {speed[-1]:.3g}"
    return ""


def unit_contradiction(trace: Trace) -> str:
    """Where the first run of a trace, or its first step, moves by another factor than its speed
    says, as with km/h for m/s; "" if it does not, or has neither a position nor a gap.
    """
    active = trace.active[:, 0]
    if active.sum() < 2:
        return ""
    speed, gap = trace.speed[active, 0], trace.gap[active, 0]
    position, obstacle_speed = (
        trace.position[active, 0],
        trace.obstacle_speed[active, 0],
    )
    # Nobody is seen at an infinite gap.
    gap = np.where(np.isfinite(gap), gap, np.nan)
    driven = float(np.sum(speed[1:] + speed[:-1]) * trace.step / 2)
    ways = {"position": np.ptp(position)}
    if (obstacle_speed == 0).all() and (np.diff(gap) <= 0).all():
        ways["gap"] = np.ptp(gap)
    for name, way in ways.items():
        is_apart = abs(way - driven) > max(speed.max() * trace.step, 1.0)
        if is_apart and max(way, driven) > FACTOR * min(way, driven):
            return f"speed and {name} disagree: {driven:.3g} m and {way:.3g} m of way"

    # Towards somebody who moves, the first step alone tells the factor.
    closing = speed - obstacle_speed
    for name, rate, column in (("position", speed, position), ("gap", closing, -gap)):
        (way,), (low, *_, high) = np.diff(column[:2]), np.sort(rate[:2]) * trace.step
        slack = (FACTOR - 1) * max(abs(low), abs(high)) + FIRST_SLACK
        if way < low - slack or way > high + slack:
            return f"speed and {name} disagree in the first step: {high:.3g} m and {way:.3g} m"
    return ""


def _checked_metrics(
    code: UserCode, method: str, result: StatedRun, has_collided: bool
) -> StatedRun:
    """The metrics of a run without a trace; NaN is one that is undefined."""
    values = {name: value for name, value in result.items() if name != OUTCOME}
    legal = dict.fromkeys(values, Legal(infinite=True, undefined=True))
    legal[SAFETY_DEGREE] = Legal(0.0)
    if has_collided:
        legal |= {**OF_COLLISION, SAFETY_DEGREE: Legal(highest=0.0)}
    return _numbers(code, method, values, legal)


def _numbers(
    code: UserCode, method: str, values: StatedRun, legal: Mapping[str, Legal]
) -> NamedValues:
    return {
        name: float(code.check_numbers(method, name, value, (), legal[name]))
        for name, value in values.items()
    }


class Simulator(Scenario):
    """A scenario in a simulator of the user's own. A class needs no base class: it has `simulate`
    and `UNITS`. Its fields are the parameters of `scenario.parameters`; those marked by `searched`
    may be searched.

    Attributes
    ----------
    UNITS
        Units of the vehicle's characteristics by name.
    OPTIONAL
        Characteristics that a study may leave out, and whose original value may be 0.
    worker
        What `open_worker` returned in this process.
    """

    __slots__ = ()
    RETURNS: ClassVar[Contract] = {"simulate": Returned(then=check_result)}
    mover: ClassVar[Mover] = OWN_SIMULATOR
    UNITS: ClassVar[Mapping[str, str]]
    OPTIONAL: ClassVar[tuple[str, ...]] = ()
    worker: ClassVar[Any] = None
    network: str = ""
    duration: float = 60.0

    @abstractmethod
    def simulate(self, setting: Mapping[str, float]) -> StatedRun:
        """Simulate one vehicle in this scenario.

        `setting` has the value of each characteristic in its unit. The result depends on it and on
        the fields alone, bit for bit, unless the study says how often each run is repeated.

        It has, at T samples in equal steps, `time` [s], `speed` [m/s] and `separation`, the least
        distance of the vehicle's body from any other [m]; and `outcome`, a value of `Outcome`. It
        may have `gap` along the path to who is ahead [m], infinite without anybody, and his
        `obstacle_speed` along the path [m/s]; the pedals `brake` and `throttle` [-]; `position`
        along the path [m]. On a collision it has `impact_speed`, the vehicle's own speed [m/s], and
        may have `struck_speed`, that of what it struck along its path [m/s].

        Without a trace it has `outcome`, `safety_degree` and any of the study's metrics by name.
        """

    @classmethod
    def open_worker(cls, worker: int) -> Any:
        """Open what is slow to start, once in a process: the objects of the class find it as
        `self.worker`. Processes that simulate on one machine at the same time have different
        numbers, from 0; one that replaces a dead one has its number.
        """
        return None

    @classmethod
    def close_worker(cls, handle: Any) -> None:
        """End what `open_worker` returned; nothing by default."""

    def close(self) -> None:
        """End the simulator when its process ends; nothing by default."""
