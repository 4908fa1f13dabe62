"""MetaDrive as a simulator of the user's: its learned driver
comes to a car that stands in a curve.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from metadrive.engine.engine_utils import BaseEngine, close_engine
from metadrive.envs import MetaDriveEnv
from metadrive.examples.ppo_expert import numpy_expert
from shapely.geometry import Polygon

CURVE = {
    "id": "C",
    "pre_block_socket_index": 0,
    "dir": 1,
    "radius": 40.0,
    "angle": 120.0,
}
START = {"spawn_lane_index": (">>", ">>>", 0), "spawn_longitude": 35.0}
CONFIG = {
    "log_level": 50,
    "traffic_density": 0.0,
    "crash_vehicle_done": False,
    "num_buffering_objects": 0,  # a body that is used again keeps a part of its state
    "map_config": {"type": "pg_map_file", "config": [{}, {**CURVE, "length": 60.0}]},
    "random_spawn_lane_index": False,
    "agent_configs": {"default_agent": START},
    "vehicle_config": {"vehicle_model": "static_default"},
}


@dataclass
class LearnedDriver:
    UNITS: ClassVar = {"wheel_friction": "-", "max_brake_force": "-", "mass": "kg"}
    LIBRARIES: ClassVar = ("metadrive-simulator",)

    @classmethod
    def open_worker(cls, worker: int) -> Any:
        BaseEngine.try_pull_asset = staticmethod(lambda: None)  # nothing is drawn
        return MetaDriveEnv(CONFIG)

    def simulate(self, setting: Mapping[str, float]) -> Mapping[str, Any]:
        self.worker.reset()
        ego = self.worker.agent
        ego.config.update({"max_brake_force": setting["max_brake_force"]})
        ego.body.setMass(setting["mass"])
        for wheel in ego.wheels:
            wheel.setFrictionSlip(setting["wheel_friction"])
        ego.set_velocity(ego.heading, 8.0)
        place = {"spawn_lane_index": (">>>", "1C0_0_", 0), "spawn_longitude": 20.0}
        traffic = self.worker.engine.traffic_manager
        standing = Polygon(
            traffic.spawn_object(type(ego), vehicle_config=place).bounding_box
        )

        rows, is_hit = [], False
        while not is_hit and len(rows) < 80:
            gap = Polygon(ego.bounding_box).distance(standing)
            rows.append((0.1 * len(rows), ego.speed, gap))
            action = numpy_expert.expert(ego, deterministic=True)
            is_hit = self.worker.step(action)[-1]["crash"]
        time, speed, gap = np.array(rows).T
        trace = {
            "time": time,
            "speed": speed,
            "separation": gap,
            "impact_speed": speed[-1],
        }
        ending = "collision" if is_hit else "stopped" if speed[-1] < 0.3 else "timeout"
        return {**trace, "outcome": ending}

    @classmethod
    def close_worker(cls, handle: Any) -> None:
        close_engine()
