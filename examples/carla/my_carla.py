"""CARLA as a simulator of the user's: a car stands ahead, and
CARLA's own traffic manager drives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import carla
import numpy as np

STEP = 0.05


@dataclass
class StandingCar:
    UNITS: ClassVar[Mapping[str, str]] = {
        "mass": "kg",
        "max_brake_torque": "N m",
        "tire_friction": "-",
    }
    LIBRARIES: ClassVar[tuple[str, ...]] = ("carla",)
    version: ClassVar[str] = "0.9.16"  # of the server

    distance: float = 50.0
    town: str = "Town04"
    start: int = 0
    seed: int = 1
    duration: float = 20.0
    worker: ClassVar[tuple[carla.Client, int]]

    @classmethod
    def open_worker(cls, worker: int) -> tuple[carla.Client, int]:
        # Each worker has its server, which takes three ports, and its traffic manager.
        client = carla.Client("localhost", 2000 + 3 * worker)
        client.set_timeout(60.0)
        return client, 8000 + worker

    def simulate(self, setting: Mapping[str, float]) -> Mapping[str, Any]:
        # A new world for each run, in steps of equal length.
        client, port = self.worker
        world = client.load_world(self.town)
        settings = world.get_settings()
        settings.synchronous_mode = True
        settings.fixed_delta_seconds = STEP
        world.apply_settings(settings)
        manager = client.get_trafficmanager(port)
        manager.set_synchronous_mode(True)
        manager.set_random_device_seed(self.seed)

        # The vehicle with its characteristics, and a car that stands ahead in its lane.
        blueprint = world.get_blueprint_library().find("vehicle.lincoln.mkz_2020")
        place = world.get_map().get_spawn_points()[self.start]
        ahead = (
            world.get_map()
            .get_waypoint(place.location)
            .next(self.distance)[0]
            .transform
        )
        ahead.location.z = place.location.z
        ego = world.spawn_actor(blueprint, place)
        standing = world.spawn_actor(blueprint, ahead)
        assert isinstance(ego, carla.Vehicle)
        assert isinstance(standing, carla.Vehicle)
        ego.apply_physics_control(worn(ego.get_physics_control(), setting))
        standing.apply_control(carla.VehicleControl(hand_brake=True))
        touched: list[carla.SensorData] = []
        sensor = world.spawn_actor(
            world.get_blueprint_library().find("sensor.other.collision"),
            carla.Transform(),
            ego,
        )
        assert isinstance(sensor, carla.Sensor)
        sensor.listen(touched.append)
        ego.set_autopilot(
            True, manager.get_port()
        )  # your driving system in place of this line

        # One row for each step, until the vehicle hits something.
        lengths = ego.bounding_box.extent.x + standing.bounding_box.extent.x
        rows: list[tuple[float, ...]] = []
        for time in np.arange(0.0, self.duration, STEP):
            apart = ego.get_location().distance(standing.get_location()) - lengths
            speed = ego.get_velocity().length()
            rows.append((time, speed, max(apart, 0.0), ego.get_control().brake))
            world.tick()
            if touched:
                break
        trace = dict(
            zip(("time", "speed", "separation", "brake"), np.array(rows).T, strict=True)
        )
        if touched:
            return {**trace, "outcome": "collision", "impact_speed": trace["speed"][-1]}
        return {
            **trace,
            "outcome": "stopped" if trace["speed"][-1] < 0.1 else "timeout",
        }


def worn(physics: carla.VehiclePhysicsControl, setting: Mapping[str, float]) -> Any:
    # The types of the client call these values read-only. They are not.
    wheels = physics.wheels
    for wheel in wheels:
        wheel.max_brake_torque = setting["max_brake_torque"]  # type: ignore[misc]
        wheel.tire_friction = setting["tire_friction"]  # type: ignore[misc]
    physics.wheels = wheels  # type: ignore[misc]
    physics.mass = setting["mass"]  # type: ignore[misc]
    return physics
