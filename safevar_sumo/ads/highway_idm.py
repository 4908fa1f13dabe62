"""highway-env's IDMVehicle (PyPI highway-env, MIT) as a driving system: its own `acceleration` is
the acceleration that it commands.
"""

from __future__ import annotations

from safevar_sumo.ads.base import CORRIDOR, ScalarAds, is_in_the_way, library
from safevar_sumo.records import Observation

ROAD_LENGTH = 10_000.0
"""Length of the straight road on which highway-env's vehicles are [m]."""


class HighwayIdm(ScalarAds):
    """Drives with the acceleration of `IDMVehicle` in the library highway-env: behind an obstacle
    in the way, or on a free road.

    The driver has the numbers of the library highway-env: an acceleration of at most 6 m/s^2
    (comfortable: 3 and -5 m/s^2), a headway of 1.5 s and a gap of 5 m at standstill. The driver
    needs the extra `highway-env`.

    Parameters
    ----------
    target_speed
        The speed that the driver wishes [m/s], by default the initial speed.
    corridor
        Half the width of the corridor that the driving system watches [m].
    """

    def __init__(
        self, target_speed: float | None = None, corridor: float = CORRIDOR
    ) -> None:
        roads = library("highway_idm", "highway-env", "highway_env.road.road")
        vehicles = library("highway_idm", "highway-env", "highway_env.vehicle.behavior")
        self.target_speed = target_speed
        self.corridor = corridor
        network = roads.RoadNetwork.straight_road_network(
            1, length=ROAD_LENGTH, speed_limit=None
        )
        road = roads.Road(network, record_history=False)
        self._me = vehicles.IDMVehicle(road, [0.0, 0.0])
        self._front = vehicles.IDMVehicle(road, [0.0, 0.0])

    def drive(self, observation: Observation) -> tuple[float, float]:
        me = self._me
        front = self._front
        me.speed = float(observation.speed)
        if self.target_speed is None:
            self.target_speed = me.speed
        me.target_speed = self.target_speed
        leader = None
        # Distances of the library are between the middles of its own vehicles.
        if is_in_the_way(observation, self.corridor):
            front.position[0] = observation.gap + (me.LENGTH + front.LENGTH) / 2
            front.speed = float(observation.obstacle_speed)
            leader = front
        wish = me.acceleration(me, leader)
        acceleration = min(max(wish, -me.ACC_MAX), me.ACC_MAX)
        return self.pedals(acceleration, observation.speed)
