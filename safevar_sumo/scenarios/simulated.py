"""The contract of a scenario in a simulator of the user's own. Such a simulator moves the vehicle
under test, and has its driving system inside.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from safevar_sumo.plugins import SHARE, Contract, Legal, Returned, UserCode, quoted
from safevar_sumo.records import FloatArray, NamedValues, Outcome, significant
from safevar_sumo.scenarios.base import Mover, Scenario
from safevar_sumo.scenarios.trace_ways import contradiction_of_speeds
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
"""The mover of a class with a method `simulate`, which simulates one vehicle after another; see
`Simulator`.
"""
SPEED = Legal(0.0, 1000.0)
TIME = "time"
OUTCOME = "outcome"
IMPACT_SPEED = "impact_speed"
STRUCK_SPEED = "struck_speed"
SAMPLED = {TIME: Legal(0.0), "speed": SPEED, "separation": Legal(0.0, infinite=True)}
"""Columns that a trace must have, with a value for each sample."""
ALSO_SAMPLED = {
    "gap": Legal(infinite=True),
    "obstacle_speed": Legal(),
    "brake": SHARE,
    "throttle": SHARE,
    "position": Legal(),
}
"""Columns that a trace may have, with a value for each sample."""
OF_COLLISION = {IMPACT_SPEED: SPEED, STRUCK_SPEED: Legal()}
"""Numbers that only the result of a collision has. `struck_speed` may be left out."""
OUTCOMES = [outcome.value for outcome in list(Outcome)[:6]]
"""How a run may end, in the words of a result. Only this package gives the other outcomes."""
ENDS_APART = (Outcome.PASSED, Outcome.STOPPED, Outcome.TIMEOUT)
"""Outcomes of runs in which the vehicle touches nothing."""
StatedRun = Mapping[str, Any]
"""The result of a run as a simulator returns it: values by the names of quantities and metrics."""
MOST_DECELERATION = 20.0
"""Largest deceleration that a trace may show in any case [m/s^2]. A trace with a harder braking may
show this braking, too.
"""
ROUNDING_SLACK = 0.1
"""Largest rounding error of distances [m] and of speeds [m/s]."""
CREEPS = 1.0
"""Speed below which a vehicle has stopped [m/s]."""
STEP_TOLERANCE = 1e-6
"""Largest difference between two time steps of a trace [s]."""


def check_result(code: UserCode, method: str, result: Any, setting: Any) -> StatedRun:
    """Refuse a result that lacks a quantity, has an unknown quantity, or has illegal numbers.

    The returned result has arrays of floats. A result without `time` comes from a simulator that
    keeps no trace. Its metrics are checked later, where the study's metrics are known.
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
    """Check a result with a trace. Return its columns, each of shape (T,), and the numbers of a
    collision.
    """
    columns = _checked_columns(code, method, result)
    times = columns[TIME]
    if not _has_equal_steps(times):
        raise code.wrong(
            method, f"{TIME} = {quoted(result[TIME])}", "at least 2 times, equal steps"
        )
    if not has_collided and not np.isfinite(columns["separation"]).any():
        raise code.wrong(method, "separation = inf", "a finite number at some time")
    step = float(times[1] - times[0])
    if wrong_speeds := contradiction_of_speeds(columns, step):
        raise code.wrong(
            method, f"a trace whose {wrong_speeds.problem}", wrong_speeds.expected
        )

    numbers = NamedValues()
    if has_collided:
        numbers = _checked_collision(code, method, result)
    if contradiction := _contradiction(str(result[OUTCOME]), columns, numbers, step):
        raise code.wrong(
            method,
            contradiction,
            "an end that the trace allows within one of its steps",
        )
    return {**columns, **numbers}


def _checked_columns(
    code: UserCode, method: str, result: StatedRun
) -> dict[str, FloatArray]:
    """Check the names, shapes and numbers of a trace's columns. Return the columns, each in the
    shape of `time`.
    """
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
    return columns


def _has_equal_steps(times: FloatArray) -> bool:
    """Whether the times [s] are a row of at least two times, which increase in equal steps."""
    if times.ndim != 1 or len(times) < 2:
        return False
    steps = np.diff(times)
    return bool(np.ptp(steps) <= STEP_TOLERANCE and steps[0] > 0)


def _checked_collision(code: UserCode, method: str, result: StatedRun) -> NamedValues:
    """Check the numbers of a collision, and return them. A struck body whose speed is not stated
    stands.
    """
    if IMPACT_SPEED not in result:
        raise code.wrong(
            method, f"a collision without {IMPACT_SPEED}", "the speed at impact [m/s]"
        )
    numbers = {name: result.get(name, 0.0) for name in OF_COLLISION}
    return _numbers(code, method, numbers, OF_COLLISION)


def _contradiction(
    outcome: str,
    columns: Mapping[str, FloatArray],
    ends: NamedValues,
    step: float,
) -> str:
    """The contradiction between the stated end of a run and its samples, in words; "" if they
    agree. Within one step [s], samples may change as fast as anywhere in the trace.
    """
    speed = columns["speed"]
    separation = columns["separation"]
    braked = max(np.abs(np.diff(speed)).max(), MOST_DECELERATION * step)
    if outcome == Outcome.COLLISION:
        # The struck body may be as fast as any obstacle in the trace.
        obstacle_speeds = [ends[STRUCK_SPEED], *columns.get("obstacle_speed", ())]
        finite = separation[np.isfinite(separation)]
        reach = (speed.max() + braked + np.abs(obstacle_speeds).max()) * step
        reach += np.abs(np.diff(finite)).max(initial=0.0)
        if finite.size and finite.min() > reach + ROUNDING_SLACK:
            return f"a collision at a separation of {significant(finite.min(), 3)} m"
        impact = ends[IMPACT_SPEED]
        if np.abs(speed - impact).min() > braked + ROUNDING_SLACK:
            last_speed = significant(speed[-1], 3)
            return f"{IMPACT_SPEED} = {significant(impact, 3)} after a speed of {last_speed}"
        return ""
    if outcome in ENDS_APART and separation.min() <= 0:
        return f"{outcome!r} with a separation of 0"
    if outcome == Outcome.STOPPED and speed[-1] > max(braked, CREEPS):
        return f"{outcome!r} at a speed of {significant(speed[-1], 3)}"
    return ""


def _checked_metrics(
    code: UserCode, method: str, result: StatedRun, has_collided: bool
) -> StatedRun:
    """Check a result without a trace, and return its metrics. An undefined metric is NaN."""
    values = {name: value for name, value in result.items() if name != OUTCOME}
    legal = dict.fromkeys(values, Legal(infinite=True, undefined=True))
    legal[SAFETY_DEGREE] = Legal(0.0)
    if has_collided:
        legal |= {**OF_COLLISION, SAFETY_DEGREE: Legal(highest=0.0)}
    return _numbers(code, method, values, legal)


def _numbers(
    code: UserCode, method: str, values: StatedRun, legal: Mapping[str, Legal]
) -> NamedValues:
    """Check single numbers, and return them as floats."""
    return {
        name: float(code.check_numbers(method, name, value, (), legal[name]))
        for name, value in values.items()
    }


class Simulator(Scenario):
    """Base of a scenario in a simulator of the user's own. A user's class need not derive from it:
    it must have `simulate` and `UNITS`. The fields of the class are the parameters that a study
    states under `scenario.parameters`. A study may search fields that are marked by `searched`.

    Attributes
    ----------
    UNITS
        The units of the vehicle's characteristics, by name.
    OPTIONAL
        Characteristics that a study may leave out.
    worker
        The object that `open_worker` returned in this process.
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

        `setting` has the value of each characteristic in its unit. The result depends only on the
        setting and on the fields, bit for bit. (Only a study that states `repeats` allows other
        results.)

        The result has `outcome`, a value of `Outcome`, and the following values at T samples in
        equal steps.

        - Always: `time` [s], `speed` [m/s], and `separation`, the least distance between the
          vehicle's body and any other body [m].
        - Optionally: `gap`, the distance along the path to the obstacle ahead [m], infinite without
          an obstacle; `obstacle_speed` along the path [m/s]; the pedals `brake` and `throttle` [-];
          `position` along the path [m].

        After a collision the result also has `impact_speed`, the vehicle's own speed [m/s]. It may
        have `struck_speed`, the speed of the struck body along the vehicle's path [m/s].

        A result without a trace has `outcome`, `safety_degree`, and any metrics of the study by
        name.
        """

    @classmethod
    def open_worker(cls, worker: int) -> Any:
        """Open what takes long to start, such as the simulator, once in a process. Objects of the
        class find the returned object as `self.worker`.

        `worker` is the number of this process. Processes of one command that simulate on one
        machine at the same time have different numbers, from 0 on. A process that replaces a dead
        process gets its number.
        """
        return None

    @classmethod
    def close_worker(cls, handle: Any) -> None:
        """Close the object that `open_worker` returned; nothing by default."""

    def close(self) -> None:
        """End the simulator when its process ends; nothing by default."""
