"""Intel's ad-rss-lib (PyPI ad-rss, LGPL-2.1) as a driving system: its check of a situation and its
response decide when the vehicle brakes.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from safevar_sumo.ads.base import CORRIDOR, ScalarAds, is_in_the_way, library
from safevar_sumo.errors import InputError
from safevar_sumo.records import Observation
from safevar_sumo.shipped import shipped_table

ROLLING_OUT = 1.0
"""Deceleration after a demand to brake, while somebody is in the way [m/s^2]: assumption."""

MAX_NUMBER = 1000.0
"""Largest number of the rule that the library takes."""


class AdRss(ScalarAds):
    """Holds its speed until ad-rss-lib demands longitudinal braking, and then brakes fully while
    the library demands braking. Once the system has braked, the system does not press the
    accelerator again. If the library demands no more braking while somebody is in the system's way,
    the system rolls out with 1 m/s^2.

    The library applies the rule of responsibility-sensitive safety (Shalev-Shwartz, Shammah,
    Shashua 2017) to the situation "same direction, the ego vehicle behind". The system needs the
    extra `ad-rss`. The defaults of its parameters are assumptions.

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
        Half the width of the corridor that the driving system watches [m].
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
        # Numbers that the library refuses it also logs itself, so they are refused before.
        sizes = {
            "response_time": response_time,
            "accel_max": accel_max,
            "brake_max": brake_max,
            "brake_min": brake_min,
        }
        for name, value in sizes.items():
            upper_limit = brake_max if name == "brake_min" else MAX_NUMBER
            if not 0 <= value <= upper_limit or (value == 0 and name != "accel_max"):
                raise InputError(
                    "",
                    f"ads.parameters.{name} = {value:g}",
                    f"a number above 0, up to {upper_limit:g}",
                )
        self.response_time = response_time
        self.accel_max = accel_max
        self.brake_min = brake_min
        self.brake_max = brake_max
        self.min_longitudinal_safety_distance = min_longitudinal_safety_distance
        self.cruise_speed = cruise_speed
        self.corridor = corridor
        self.has_braked = False
        # Both modules register the same converters, of which Python would warn. The types of
        # ad_physics must be known when ad_rss is loaded.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            library("ad_rss", "ad-rss", "ad_physics")
            self._library = library("ad_rss", "ad-rss", "ad_rss")
        self._rule: _Rule | None = None

    def drive(self, observation: Observation) -> tuple[float, float]:
        if self.cruise_speed is None:
            self.cruise_speed = float(observation.speed)
        self._rule = self._rule or _Rule(self._library, self)
        is_blocked = bool(is_in_the_way(observation, self.corridor))
        if is_blocked and self._rule.demands_braking(
            float(observation.speed),
            float(observation.gap),
            float(observation.obstacle_speed),
        ):
            self.has_braked = True
            return 0.0, 1.0
        if self.has_braked:
            if is_blocked:
                return self.pedals(-ROLLING_OUT, observation.speed)
            return 0.0, 0.0
        return self.pedals(self.cruise_speed - observation.speed, observation.speed)


class _Rule:
    """The library's check with the parameters of a driver, and its objects of the situation."""

    def __init__(self, library: Any, driver: AdRss) -> None:
        self._rss = library.rss
        self._physics = library.physics
        # What it refuses is an error here.
        self._rss.core.setLogLevel("off")
        tables = shipped_table("ads/ad_rss.toml")
        self._check = self._rss.core.RssSituationChecking()
        self._resolve = self._rss.core.RssResponseResolving()
        self._rule = {
            "response_time": driver.response_time,
            "alpha_lon.accel_max": driver.accel_max,
            "alpha_lon.brake_min": -driver.brake_min,
            "alpha_lon.brake_min_correct": -driver.brake_min,
            "alpha_lon.brake_max": -driver.brake_max,
            "min_longitudinal_safety_distance": driver.min_longitudinal_safety_distance,
        }
        dynamics = fill(
            self._rss.world.RssDynamics(), {**tables["dynamics"], **self._rule}
        )
        self._situation = self._rss.core.RssSituationSnapshot()
        self._situation.default_ego_vehicle_rss_dynamics = dynamics

        # The ego vehicle is behind another one in the same direction, in its way.
        self._pair = fill(self._rss.core.RelativeConstellation(), tables["pair"])
        for state in (self._pair.ego_state, self._pair.other_state):
            state.dynamics = dynamics
            fill(state, tables["object"])

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
        for state, value in (
            (self._pair.ego_state, speed),
            (self._pair.other_state, leader_speed),
        ):
            velocity = state.structured_object_state.velocity
            velocity.speed_lon_min = velocity.speed_lon_max = physics.Speed(
                max(value, 0.0)
            )
        self._pair.relative_position.longitudinal_distance = physics.Distance(
            max(gap, 0.0)
        )
        self._situation.time_index += 1
        del self._situation.constellations[:]
        self._situation.constellations.append(self._pair)

        states = self._rss.state.RssStateSnapshot()
        response = self._rss.state.ProperResponse()
        is_legal = self._check.checkSituation(self._situation, states)
        if not (is_legal and self._resolve.provideProperResponse(states, response)):
            rule = ", ".join(
                f"{name} = {value:g}" for name, value in self._rule.items()
            )
            raise ValueError(
                f"ad-rss refuses {speed:g} m/s, {gap:g} m behind {leader_speed:g} m/s, with {rule}"
            )
        return bool(response.longitudinal_response.name != "None")


def fill(target: Any, values: Mapping[str, Any]) -> Any:
    """Give values to the attributes of an object of the library, by their dotted names, and return
    the object. A text is the name of a member of an enumeration.
    """
    for path, value in values.items():
        *parents, name = path.split(".")
        owner = target
        for parent in parents:
            owner = getattr(owner, parent)
        kind = type(getattr(owner, name))
        converted = getattr(kind, value) if isinstance(value, str) else kind(value)
        setattr(owner, name, converted)
    return target
