"""Two vehicle models with delayed sensors and brakes.

`SumoVehicle` has the parameters of a SUMO vType. `WornVehicle` is a car with worn tyres and brakes,
a payload and degraded sensors.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace

from safevar_sumo.records import FloatArray, FloatOrArray, Observation
from safevar_sumo.vehicles.base import (
    FRICTION,
    LEVEL,
    MASS,
    SECONDS,
    Characteristics,
    Plausible,
    Positive,
    Prepared,
    Slope,
    SumoType,
)
from safevar_sumo.vehicles.sensors import DELAYED, SensingState, SensingVehicle
from safevar_sumo.vehicles.wet_road import WET_FRICTION, lift_of, lifted_friction

TANGENT_DECIMALS = 12
"""Decimals to which a tangent is rounded, because the last bits of tangents differ between
machines.
"""
UNLIMITED_RANGE = 1e6
"""Range of the sensors of a study without the characteristic `sensorRange` [m]."""
RELEASED_BRAKE = 1e-6
"""Largest position of a SUMO vehicle's brake pedal that counts as released [-]: while a delayed
command fades out, a tiny remainder of it must not keep the engine from driving.
"""


class _PreparedSumo(NamedTuple):
    """Constants of N vehicles in a run, in SI units, shape (N,); see `SensingVehicle`. `grip` is
    the largest acceleration that the tyres can transmit [m/s^2].
    """

    step: float
    mass: FloatArray
    drive: FloatArray
    brake: FloatArray
    decel: FloatArray
    grip: FloatOrArray
    max_speed: FloatArray
    actuator_lag: FloatArray
    tau: FloatArray
    sensor_range: FloatArray
    latency: FloatArray
    brake_delay: FloatArray
    brake_gain: FloatArray
    slope: Slope


class SumoVehicle(
    SensingVehicle, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True
):
    """A SUMO vehicle type: greatest accelerations, top speed, and delays of sensors and actuators.

    The characteristic `tau` is the time headway that SUMO's car-following models keep, if one of
    these models drives.

    Parameters
    ----------
    reference_mass
        Mass to which accel and decel refer [kg]; at another mass the forces stay the same.
    tyre_friction
        Friction coefficient of the tyres on a dry road [-]; no acceleration exceeds this
        coefficient times g.
    """

    UNITS = {
        "mass": "kg",
        "accel": "m/s^2",
        "decel": "m/s^2",
        "maxSpeed": "m/s",
        "tau": "s",
        "actuatorLag": "s",
        "sensorRange": "m",
        "reactionTime": "s",
        "brakeDelay": "s",
        "brakeGain": "-",
    }
    PLAUSIBLE = {
        "mass": MASS,
        "accel": Plausible(0.1, 30),
        "decel": Plausible(0.5, 30),
        "maxSpeed": Plausible(1, 150),
        "tau": SECONDS,
        "actuatorLag": SECONDS,
        "sensorRange": Plausible(0.5, 2000),
        "reactionTime": SECONDS,
        "brakeDelay": SECONDS,
        "brakeGain": Plausible(0.01, 10),
        "reference_mass": MASS,
        "tyre_friction": FRICTION,
    }

    reference_mass: Annotated[float, Meta(gt=0)] = 1500.0
    tyre_friction: Annotated[float, Meta(gt=0)] = 0.9

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        water: FloatOrArray = 0.0,
    ) -> _PreparedSumo:
        # Forces stay the same at another mass, so that accelerations change with the mass.
        c = characteristics
        mass_ratio = self.reference_mass / c["mass"]
        decel = c["decel"] * mass_ratio
        return _PreparedSumo(
            step=step,
            mass=c["mass"],
            drive=c["accel"] * mass_ratio,
            brake=c["brakeGain"] * decel,
            decel=decel,
            grip=self.tyre_friction * road_friction * slope.down,
            max_speed=c["maxSpeed"],
            actuator_lag=c["actuatorLag"],
            tau=c["tau"],
            sensor_range=c["sensorRange"],
            latency=c["reactionTime"],
            brake_delay=c["brakeDelay"],
            brake_gain=c["brakeGain"],
            slope=slope,
        )

    def sumo_type(self, prepared: _PreparedSumo) -> SumoType:
        return SumoType(
            mass=prepared.mass,
            accel=np.minimum(prepared.drive, prepared.grip),
            decel=np.minimum(prepared.decel, prepared.grip),
            max_speed=prepared.max_speed,
            actuator_lag=prepared.actuator_lag,
            tau=prepared.tau,
        )

    def _acceleration(
        self,
        p: _PreparedSumo,
        state: SensingState,
        throttle: FloatArray,
        brake: FloatArray,
    ) -> FloatArray:
        """The acceleration, which follows the pedals with the actuator lag T: da/dt = (target - a)
        / T, by an implicit step.
        """
        is_braking = brake > RELEASED_BRAKE
        commanded = np.where(
            is_braking, -brake * p.brake_gain * p.decel, throttle * p.drive
        )
        target = np.minimum(np.maximum(commanded, -p.grip), p.grip)
        share = p.step / (p.actuator_lag + p.step)
        acceleration = state.acceleration + (target - state.acceleration) * share
        # The lag delays braking itself, but the engine stops driving at once.
        return np.where(is_braking, np.minimum(acceleration, 0.0), acceleration)


class _PreparedWorn(NamedTuple):
    """Constants of N vehicles in a run, in SI units, shape (N,); see `SensingVehicle`.

    `grip` is the friction coefficient at rest, `lift` says how fast it falls with speed (k in
    wet_road.py) [s^2/m^2]. `front_load` and `rear_load` are the axles' shares of the weight at rest
    [-]. `tangent` is the tangent of the sensors' angle, `dropout` the share of lost frames [-];
    each is None if the study lacks the characteristic.
    """

    step: float
    mass: FloatArray
    drive: FloatArray
    brake: FloatArray
    grip: FloatOrArray
    lift: FloatArray
    max_speed: float
    front_load: FloatArray
    rear_load: FloatArray
    brake_delay: FloatArray
    sensor_range: FloatArray
    latency: FloatArray
    slope: Slope
    tangent: FloatArray | None
    dropout: FloatArray | None


class WornVehicle(
    SensingVehicle, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True
):
    """A car with two axles that never lock: each axle brakes up to the friction that its load
    allows.

    Parameters
    ----------
    kerb_mass, kerb_centre, wheelbase, centre_height
        The empty car: mass [kg], distance of the centre of mass from the front axle, wheelbase,
        height of the centre of mass [m].
    drive_force, brake_force, front_share
        Largest forces of engine and brakes [N], and the front axle's share of the brake force [-].
    tyre_friction
        Friction coefficient on a dry road of new and worn tyres [-]: the mean of the roads of
        published stops.
    water_lift, road_texture
        Constants a [s^2/m^2 mm^0.5] and b [mm] of the friction on a wet road (wet_road.py), fitted
        to published stops.
    max_speed
        Top speed [m/s].
    frame_seed
        Seed of the pattern of lost frames; that of the study's search.

    Notes
    -----
    A study without `sensorRange` and `sensorLatency` has perfect sensors. With a `sensorAngle` the
    lateral place of what is seen is off by its gap times the tangent of the angle, above 0 away
    from the side that it comes from. Of the sensors' frames the share `sensorDropout` is lost, the
    same frames in all vehicles: then the driving system sees the last one again.

    The friction coefficient mu on a dry road is `tyre_friction` times the weather's
    `road_friction`, whatever the tread. Under water this is the grip at rest, and mu falls with
    speed, water and lost tread, step by step (wet_road.py).

    Brakes act on the command of `brakeResponse` ago, a dead time without lag. The deceleration a is
    the smallest of F / m (brake force and mass), mu g, and, for each axle, the a at which that axle
    reaches its limit while the other axle brakes with its share. With the centre of mass at the
    height h and the distance x behind the front axle, and the wheelbase L, the limits are mu m (g
    (L - x) + a h) / L at the front axle and mu m (g x - a h) / L at the rear axle. On a slope, g
    stands for the component of gravity onto the road, and the component along the road acts in
    addition to a. The vehicle never rolls back.
    """

    UNITS = {
        "treadDepth": "mm",
        "brakeTorque": "-",
        "brakeResponse": "s",
        "payload": "kg",
        "payloadCentre": "m",
        "sensorRange": "m",
        "sensorLatency": "s",
        "sensorAngle": "deg",
        "sensorDropout": "-",
    }
    OPTIONAL = ("sensorRange", "sensorLatency", "sensorAngle", "sensorDropout")
    PLAUSIBLE = {
        "treadDepth": Plausible(0.1, 50),
        "brakeTorque": Plausible(0.01, 10),
        "brakeResponse": SECONDS,
        "payload": Plausible(0.1, 60_000),
        "payloadCentre": Plausible(0.05, 20),
        "sensorRange": Plausible(0.5, 2000),
        "sensorLatency": SECONDS,
        "sensorAngle": Plausible(-45, 45),
        "sensorDropout": Plausible(0, 0.99),
        "kerb_mass": MASS,
        "kerb_centre": Plausible(0.1, 10, "m"),
        "wheelbase": Plausible(0.5, 12, "m"),
        "centre_height": Plausible(0.05, 4, "m"),
        "drive_force": Plausible(100, 500_000, "N"),
        "brake_force": Plausible(200, 1_000_000, "N"),
        "tyre_friction": FRICTION,
        "max_speed": Plausible(1, 150, "m/s"),
    }

    kerb_mass: Positive = 1500.0
    kerb_centre: Positive = 1.2
    wheelbase: Positive = 2.7
    centre_height: Positive = 0.55
    drive_force: Positive = 3900.0
    brake_force: Positive = 16500.0
    front_share: Annotated[float, Meta(gt=0, lt=1)] = 0.7
    tyre_friction: Positive = WET_FRICTION["worn"]["tyre_friction"]
    water_lift: Positive = WET_FRICTION["worn"]["water_lift"]
    road_texture: Positive = WET_FRICTION["worn"]["road_texture"]
    max_speed: Positive = 55.56
    frame_seed: Annotated[int, Meta(ge=0)] = 0

    def seeded(self, seed: int) -> WornVehicle:
        """The vehicle whose pattern of lost frames follows from the seed."""
        return replace(self, frame_seed=seed)

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        water: FloatOrArray = 0.0,
    ) -> _PreparedWorn:
        c = characteristics
        mass = self.kerb_mass + c["payload"]
        moment = self.kerb_mass * self.kerb_centre + c["payload"] * c["payloadCentre"]
        rear_load = moment / mass / self.wheelbase
        tread_depth = np.maximum(c["treadDepth"], 0.0)
        tangent = None
        if "sensorAngle" in c:
            exact_tangent = np.tan(np.radians(c["sensorAngle"]))
            tangent = np.asarray(np.round(exact_tangent, TANGENT_DECIMALS), float)
        return _PreparedWorn(
            step=step,
            mass=mass,
            drive=self.drive_force / mass,
            brake=c["brakeTorque"] * (self.brake_force / mass),
            grip=self.tyre_friction * road_friction,
            lift=lift_of(water, tread_depth, self.water_lift, self.road_texture),
            max_speed=self.max_speed,
            front_load=1 - rear_load,
            rear_load=rear_load,
            brake_delay=c["brakeResponse"],
            sensor_range=c.get("sensorRange", UNLIMITED_RANGE + 0 * mass),
            latency=c.get("sensorLatency", 0 * mass),
            slope=slope,
            tangent=tangent,
            dropout=c.get("sensorDropout"),
        )

    def sense(
        self, prepared: Prepared, state: SensingState, observation: Observation
    ) -> tuple[Observation, SensingState]:
        """The observation of sensors that look aside and lose frames, and the state afterwards."""
        sensed, state = SensingVehicle.sense(self, prepared, state, observation)

        if prepared.tangent is not None:
            distance = np.where(np.isfinite(sensed.gap), sensed.gap, 0.0)
            lateral = sensed.lateral + distance * prepared.tangent
            sensed = sensed._replace(lateral=lateral)
        if prepared.dropout is None:
            return sensed, state

        frame = np.stack([getattr(sensed, name) for name in DELAYED])
        if state.frame is not None:
            number = round(observation.time / prepared.step)
            rng = np.random.default_rng([self.frame_seed, number])
            frame = np.where(rng.random() < prepared.dropout, state.frame, frame)
        sensed = sensed._replace(**dict(zip(DELAYED, frame, strict=True)))
        return sensed, state._replace(frame=frame)

    def sumo_type(self, prepared: _PreparedWorn) -> SumoType:
        p = prepared
        full_pedal = np.ones_like(prepared.mass)
        grip = lifted_friction(p.grip, p.lift, 0 * full_pedal)
        return SumoType(
            p.mass,
            np.minimum(p.drive, grip * p.slope.down),
            self._deceleration(p, full_pedal, grip),
            self.max_speed * full_pedal,
            p.brake_delay + p.step,
        )

    def _acceleration(
        self,
        p: _PreparedWorn,
        state: SensingState,
        throttle: FloatArray,
        brake: FloatArray,
    ) -> FloatArray:
        # Friction depends on speed: that in the middle of the step, by the last acceleration.
        speed = state.speed + 0.5 * p.step * (state.acceleration - p.slope.back)
        grip = lifted_friction(p.grip, p.lift, speed)
        drive = np.minimum(throttle * p.drive, grip * p.slope.down)
        return np.where(brake > 0, -self._deceleration(p, brake, grip), drive)

    def _deceleration(
        self, p: _PreparedWorn, pedal: FloatArray, grip: FloatArray
    ) -> FloatArray:
        """Deceleration by the brakes of both axles together [m/s^2]. `grip` is the friction
        coefficient at the current speed.
        """
        demand = pedal * p.brake
        grip_limit = grip * p.slope.down
        lever = grip * (self.centre_height / self.wheelbase)
        front = self.front_share * demand
        rear = (1 - self.front_share) * demand
        rear_limit = (front + grip_limit * p.rear_load) / (1 + lever)
        front_limit = (rear + grip_limit * p.front_load) / (1 - lever)
        limit_of_axles = np.minimum(rear_limit, front_limit)
        return np.minimum(np.minimum(demand, grip_limit), limit_of_axles)
