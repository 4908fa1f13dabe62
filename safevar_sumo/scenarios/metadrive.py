"""MetaDrive's learned driver meets a standing car (PyPI metadrive-simulator, Apache 2.0).

MetaDrive moves the vehicle by the rigid-body physics of Bullet. Its driver is a neural network that
was trained by reinforcement learning (PPO); the weights are a part of the library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.random import Generator, default_rng

from safevar_sumo.errors import missing_extra
from safevar_sumo.records import FloatArray, Outcome
from safevar_sumo.scenarios.simulated import Simulator
from safevar_sumo.shipped import shipped_table
from safevar_sumo.study import searched

RANGE = 50.0
"""Range of the lidar that the driver was trained with [m]."""


@dataclass
class LearnedDriver(Simulator):
    """A car stands in the vehicle's lane in a curve, and MetaDrive's learned driver drives.

    The vehicle is 5 m before the curve at the start. One that leaves the road counts as collided.
    Needs the extra `metadrive`.

    Parameters
    ----------
    distance
        Distance of the standing car's middle from the beginning of the curve [m].
    start_speed
        Speed of the vehicle at the start [m/s].
    curve
        Direction of the curve, `left` or `right`.
    seed
        Seed of the lidar's noise and dropouts.
    duration
        Length of a run [s].
    """

    UNITS: ClassVar[Mapping[str, str]] = {
        "wheel_friction": "-",
        "max_brake_force": "-",
        "max_engine_force": "-",
        "mass": "kg",
        "lidar_range": "m",
        "lidar_noise": "m",
        "lidar_dropouts": "-",
    }
    OPTIONAL = ("lidar_noise", "lidar_dropouts")
    LIBRARIES = ("metadrive-simulator",)

    distance: Annotated[
        float, searched(5.0, 50.0, "m", "distance of the standing car in the curve")
    ] = 20.0
    start_speed: float = 8.0
    curve: Literal["left", "right"] = "right"
    seed: int = 1
    duration: float = 8.0

    def __post_init__(self) -> None:
        if find_spec("metadrive") is None:
            raise missing_extra("", "the learned driver needs MetaDrive", "metadrive")

    @classmethod
    def open_worker(cls, worker: int) -> Any:
        """What returns MetaDrive's environment for a curve."""
        return environment

    @classmethod
    def close_worker(cls, handle: Any) -> None:
        """End MetaDrive's engine."""
        from metadrive.engine.engine_utils import close_engine

        close_engine()

    def simulate(self, setting: Mapping[str, float]) -> Mapping[str, Any]:
        """Drive one vehicle with a setting of the characteristics in `UNITS`."""
        scene = self.worker(self.curve)
        from metadrive.examples.ppo_expert import numpy_expert
        from shapely.geometry import Polygon

        # The vehicle with its characteristics, and the standing car in the same lane.
        scene.reset()
        ego = scene.agent
        ego.config.update(dict(setting), allow_add_new_key=True)  # its forces
        ego.body.setMass(setting["mass"])
        for wheel in ego.wheels:
            wheel.setFrictionSlip(setting["wheel_friction"])
        ego.set_velocity(ego.heading, self.start_speed)
        standing = scene.engine.traffic_manager.spawn_object(
            type(ego),
            vehicle_config={
                "spawn_lane_index": (">>>", "1C0_0_", 0),
                "spawn_longitude": self.distance,
            },
        )
        standing.set_static(True)
        obstacle = Polygon(standing.bounding_box)

        # MetaDrive's driver, who gets what a worn lidar sees.
        seen = scene.observations["default_agent"].observe(ego)
        random = default_rng(self.seed)
        numpy_expert._expert_observation = SimpleNamespace(
            observe=lambda ego: worn(seen, setting, random)
        )

        # One row for each decision, of which MetaDrive asks for 10 per second, until the vehicle
        # hits something or leaves the road.
        rows: list[Any] = []
        is_hit = False
        for time in np.arange(0.0, self.duration, 0.1):
            if is_hit:
                break
            separation = Polygon(ego.bounding_box).distance(obstacle)
            action = numpy_expert.expert(ego, deterministic=True)
            brake = min(max(-action[1], 0.0), 1.0)
            rows.append((time, ego.speed, separation, separation, 0.0, brake))
            seen, _, _, _, info = scene.step(action)
            is_hit = info["crash"] or info["out_of_road"]

        # The trace, and how the run ended; a vehicle creeps a little, as the lidar's noise has it.
        trace = dict(
            zip(
                ("time", "speed", "separation", "gap", "obstacle_speed", "brake"),
                np.array(rows).T,
                strict=True,
            )
        )
        if is_hit and not info["crash"]:  # the edge of the road is a body, too
            trace["separation"][-1] = 0.0
        outcome = Outcome.STOPPED if ego.speed < 0.3 else Outcome.TIMEOUT
        outcome = Outcome.COLLISION if is_hit else outcome
        return {**trace, "outcome": outcome, "impact_speed": trace["speed"][-1]}


def environment(curve: str) -> Any:
    """MetaDrive's environment on a road with a curve, without traffic.

    MetaDrive's engine exists once in a process. It keeps its environment itself, as another class
    may use it, too.
    """
    from metadrive.engine.engine_utils import BaseEngine, close_engine
    from metadrive.envs import MetaDriveEnv
    from metadrive.examples.ppo_expert import numpy_expert

    has, scene = getattr(BaseEngine.singleton, "scene", ("", None))
    if has == curve:
        return scene
    close_engine()

    # Nothing is drawn, so that MetaDrive need not download its pictures.
    BaseEngine.try_pull_asset = staticmethod(lambda: None)
    numpy_expert._expert_weights = dict(np.load(numpy_expert.ckpt_path))
    config = shipped_table("scenarios/metadrive.toml")
    config["map_config"]["config"][1]["dir"] = int(curve == "right")
    scene = MetaDriveEnv(config)
    scene.reset()
    BaseEngine.singleton.scene = curve, scene
    return scene


def worn(seen: FloatArray, setting: Mapping[str, float], random: Generator) -> FloatArray:
    """What the driver sees with a worn lidar, shape (275,), in place of what he would see.

    After 19 numbers on itself and its way come the places and speeds of four other cars, and the
    distances along 240 beams as shares of the full range.
    """
    cars, beams = seen[19:35].reshape(4, 4), seen[35:]

    # Nothing is seen beyond the range.
    reach = setting["lidar_range"] / RANGE
    cars[np.hypot(*(2 * cars[:, :2] - 1).T) > reach] = 0.0
    beams[beams > reach] = 1.0

    # Each beam has a draw in each step, whatever the setting.
    beams += random.normal(0.0, setting["lidar_noise"] / RANGE, 240)
    beams[random.uniform(size=240) < setting["lidar_dropouts"]] = 0.0
    np.clip(beams, 0.0, 1.0, out=beams)
    return seen
