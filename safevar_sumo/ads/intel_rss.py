"""Intel's ad-rss-lib (PyPI ad-rss, LGPL-2.1) as a driving system: its check of a situation and its
response decide when the vehicle brakes.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import reduce
from typing import Any

from safevar_sumo.ads.base import CORRIDOR, ScalarAds, is_in_the_way
from safevar_sumo.errors import InputError
from safevar_sumo.records import Observation
from safevar_sumo.shipped import shipped_table

RULE = ("response_time", "accel_max", "brake_min", "brake_max", "min_longitudinal_safety_distance")
"""The parameters of the rule."""
ROLLING_OUT = 1.0
"""Deceleration after a demand to brake, while somebody is in the way [m/s^2]: assumption."""
SITUATION = shipped_table("ads/ad_rss.toml")
"""What the library asks for besides the parameters of its longitudinal rule, in SI units."""


class AdRss(ScalarAds):
    """Holds its speed until ad-rss-lib demands longitudinal braking, and then brakes fully as long
    as it does. It does not press the accelerator again, and rolls out with 1 m/s^2 while somebody
    is in its way.

    The library applies the rule of responsibility-sensitive safety (Shalev-Shwartz, Shammah,
    Shashua 2017) to the situation "same direction, the ego vehicle behind". Needs the extra
    `ad-rss`. Defaults are assumptions.

    Parameters
    ----------
    response_time
        Response time in the rule [s].
    accel_max, brake_min
        Acceleration of the own vehicle within the response time, and deceleration with which it
        brakes at least afterwards, in the rule [m/s^2].
    brake_max
        Deceleration of the leader in the rule [m/s^2].
    min_longitudinal_safety_distance
        Distance that is kept in addition [m].
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    corridor
        Half the width of the corridor that it watches [m].
    """

    def __init__(
        self,
        response_time: float = 0.5,
        accel_max: float = 3.5,
        brake_min: float = 4.0,
        brake_max: float = 8.0,
        min_longitudinal_safety_distance: float = 1.0,
        cruise_speed: float | None = None,
        corridor: float = CORRIDOR,
    ) -> None:
        self.response_time = response_time
        self.accel_max = accel_max
        self.brake_min = brake_min
        self.brake_max = brake_max
        self.min_longitudinal_safety_distance = min_longitudinal_safety_distance
        self.cruise_speed = cruise_speed
        self.corridor = corridor
        self.has_braked = False
        self._rss = _imported()
        self._rule: _Rule | None = None

    def drive(self, seen: Observation) -> tuple[float, float]:
        if self.cruise_speed is None:
            self.cruise_speed = float(seen.speed)
        if self._rule is None:
            numbers = {name: getattr(self, name) for name in RULE}
            self._rule = _Rule(self._rss, numbers)
        is_blocked = bool(is_in_the_way(seen, self.corridor))
        if is_blocked and self._rule.demands_braking(
            float(seen.speed), float(seen.gap), float(seen.obstacle_speed)
        ):
            self.has_braked = True
            return 0.0, 1.0
        if self.has_braked:
            return self.pedals(-ROLLING_OUT, seen.speed) if is_blocked else (0.0, 0.0)
        return self.pedals(self.cruise_speed - seen.speed, seen.speed)


def _imported() -> Any:
    """The library; raises an InputError without the extra."""
    try:
        with warnings.catch_warnings():  # about converters that both modules register
            warnings.simplefilter("ignore")
            import ad_physics  # noqa: F401  (the types of the next one)
            import ad_rss
    except ImportError:
        raise InputError(
            "",
            "ads.model = 'ad_rss' needs ad-rss, for CPython 3.11 to 3.13 on Linux (x86-64)",
            "in the checkout: pip install '.[ad-rss]'",
        ) from None
    ad_rss.rss.core.setLogLevel("off")  # what it refuses is an error here
    return ad_rss


class _Rule:
    """The library's check with the `numbers` of a rule, and its objects of the situation."""

    def __init__(self, library: Any, numbers: Mapping[str, float]) -> None:
        self._rss, self._physics = library.rss, library.physics
        self._numbers = numbers
        self._check = self._rss.core.RssSituationChecking()
        self._resolve = self._rss.core.RssResponseResolving()
        self._time_index = 0
        self._dynamics = self._dynamics_of(numbers)
        self._situation = self._rss.core.RssSituationSnapshot()
        self._situation.default_ego_vehicle_rss_dynamics = self._dynamics
        self._pair = self._behind()

    def demands_braking(self, speed: float, gap: float, leader_speed: float) -> bool:
        """Whether the library demands longitudinal braking at a speed [m/s] and a gap [m] behind a
        leader.

        Raises
        ------
        ValueError
            If the library refuses the numbers.
        """
        # Describe the situation: the objects are the library's, the list of pairs holds copies.
        physics = self._physics
        for state, value in ((self._pair.ego_state, speed), (self._pair.other_state, leader_speed)):
            velocity = state.structured_object_state.velocity
            velocity.speed_lon_min = velocity.speed_lon_max = physics.Speed(max(value, 0.0))
        self._pair.relative_position.longitudinal_distance = physics.Distance(max(gap, 0.0))
        self._time_index += 1
        self._situation.time_index = self._time_index
        del self._situation.constellations[:]
        self._situation.constellations.append(self._pair)

        # Let the library judge it, and respond.
        states = self._rss.state.RssStateSnapshot()
        response = self._rss.state.ProperResponse()
        is_legal = self._check.checkSituation(self._situation, states)
        if not (is_legal and self._resolve.provideProperResponse(states, response)):
            raise ValueError(
                f"ad-rss refuses {speed:g} m/s, {gap:g} m behind {leader_speed:g} m/s, with"
                f" {', '.join(f'{name} = {value:g}' for name, value in self._numbers.items())}"
            )
        return bool(response.longitudinal_response.name != "None")

    def _dynamics_of(self, rule: Mapping[str, float]) -> Any:
        longitudinal = {
            "alpha_lon.accel_max": rule["accel_max"],
            "alpha_lon.brake_max": -rule["brake_max"],
            "alpha_lon.brake_min": -rule["brake_min"],
            "alpha_lon.brake_min_correct": -rule["brake_min"],
        }
        kept = {name: rule[name] for name in ("response_time", "min_longitudinal_safety_distance")}
        return filled(
            self._rss.world.RssDynamics(), {**longitudinal, **kept, **SITUATION["dynamics"]}
        )

    def _behind(self) -> Any:
        """The ego vehicle behind another one in the same direction, in its way."""
        core = self._rss.core
        world = self._rss.world
        pair = core.RelativeConstellation()
        for state, kind in ((pair.ego_state, "EgoVehicle"), (pair.other_state, "OtherVehicle")):
            state.object_type = getattr(world.ObjectType, kind)
            state.dynamics = self._dynamics
            filled(state, SITUATION["object"])
        place = {
            "constellation_id": 1,
            "object_id": 1,
            "constellation_type": world.ConstellationType.SameDirection,
            "relative_position.longitudinal_position": core.LongitudinalRelativePosition.AtBack,
            "relative_position.lateral_position": core.LateralRelativePosition.Overlap,
            "relative_position.lateral_distance": 0.0,
        }
        return filled(pair, place)


def filled(target: Any, values: Mapping[str, Any]) -> Any:
    """An object of the library after its attributes, by their dotted names, got these values."""
    for path, value in values.items():
        *owners, name = path.split(".")
        owner = reduce(getattr, owners, target)
        setattr(owner, name, type(getattr(owner, name))(value))
    return target
