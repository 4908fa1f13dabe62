"""What `repair` found: plain values, from which the answer is told without any simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Proof
from safevar_sumo.questions.repair.problem import Parameter, Promise
from safevar_sumo.records import NamedValues
from safevar_sumo.study import Study


class Price(NamedTuple):
    """What new values of parameters cost the original vehicle, compared with today's values.

    Attributes
    ----------
    largest_deceleration
        The largest deceleration of the vehicle with the new values [m/s^2].
    benign_scenes
        Number of scenes in which nobody needs to brake.
    needless_braking, needless_braking_today
        Number of benign scenes in which the vehicle brakes with the new values, and with today's;
        None without a benign scene.
    metres_earlier, seconds_earlier, most_at
        How much earlier the vehicle brakes [m], [s], and the name of the point: that with the most
        metres. None if the vehicle brakes nowhere; `most_at` also if the point has no name.
    metres_earlier_mean
        How much earlier the vehicle brakes on average over the points at which it brakes [m].
    """

    largest_deceleration: float
    benign_scenes: int
    needless_braking: int | None = None
    needless_braking_today: int | None = None
    metres_earlier: float | None = None
    seconds_earlier: float | None = None
    most_at: str | None = None
    metres_earlier_mean: float | None = None


class Repair(NamedTuple):
    """A change of parameters with which no search found an unsafe vehicle.

    Attributes
    ----------
    values
        The new value of each parameter that changes, by name.
    size
        The largest change of a parameter, as a share of its range.
    proof
        The test with vehicles that were sampled afterwards.
    price
        What the change costs.
    """

    values: NamedValues
    size: float
    proof: Proof
    price: Price

    @property
    def cost(self) -> tuple[float, float, float]:
        """The key that orders repairs: needless braking, then earlier braking, then the size."""
        price = self.price
        return price.needless_braking or 0, price.metres_earlier or 0.0, self.size


@dataclass(frozen=True, kw_only=True)
class Found:
    """The repairs that were found, and the wear that no driving system can keep safe.

    Attributes
    ----------
    study
        The study.
    unsafe
        The criterion of an unsafe vehicle.
    promise
        The worn vehicles that must be safe.
    parameters
        The parameters of the driving system that may change.
    repairs
        The repairs, the cheapest first; none if no repair is necessary, or none was found.
    proof_today
        The test of today's parameters; None if a vehicle is unsafe with them.
    worst_today
        The value of the criterion's measure with today's parameters, for the least safe promised
        vehicle that was tried and that a driving system can keep safe.
    not_repairable
        The wear that no driving system can keep safe: values by name, an item for each cause.
    sets
        Number of parameter sets of the vehicle model in which changes were tested.
    sets_holding
        Number of these sets in which the repairs (or today's parameters) hold.
    broken_sets
        The numbers of the sets in which one of the repairs does not hold.
    simulations
        Number of settings that were simulated.
    is_rough
        Whether less was searched than usual.
    phases
        The remark on the moments at which encounters began; "" if none is needed.
    """

    study: Study
    unsafe: Unsafe
    promise: Promise
    parameters: Sequence[Parameter]
    repairs: Sequence[Repair]
    proof_today: Proof | None
    worst_today: float
    not_repairable: Sequence[NamedValues]
    sets: int
    sets_holding: int
    broken_sets: Sequence[int]
    simulations: int
    is_rough: bool
    phases: str

    @property
    def proof(self) -> Proof | None:
        """The test of the first repair, or of today's parameters; None if neither holds."""
        return self.repairs[0].proof if self.repairs else self.proof_today
