"""LincolnMkz2017 of CARLA 0.9.10: NVIDIA PhysX 3.4, PxVehicleDrive4W, along its path.

The equations and the order of integration, in `carla_step.py`, come from `PxVehicleUpdate.cpp` and
`PxVehicleDefaultTireShader` (PhysX 3.4). One equivalent wheel represents the four. A step computes
the tyre force from the slip at its beginning, then engine, clutch and wheels implicitly and in
closed form, so that the stiff clutch does not limit the step.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.plugins.process import defer_interrupts
from safevar_sumo.records import (
    GRAVITY,
    TIME_ROUNDING,
    BoolArray,
    Command,
    FloatArray,
    FloatOrArray,
    Observation,
    clip_to_share,
)
from safevar_sumo.study import PositiveProportion
from safevar_sumo.vehicles.base import (
    LEVEL,
    MASS,
    SECONDS,
    WHEELS,
    Characteristics,
    Plausible,
    Positive,
    Sensors,
    Slope,
    SumoType,
    Vehicle,
)

if TYPE_CHECKING:
    from safevar_sumo.vehicles.carla_step import Car, CarlaState, Law

RPM = 2 * math.pi / 60  # rad/s per r/min
ENGINE_INERTIA = 1.0  # kg m^2; PxVehicleEngineData.mMOI, CARLA's default
WHEEL_MASS = 20.0  # kg each; PxVehicleWheelData.mMass
AIR_DENSITY = 1.2  # kg/m^3
FRONTAL_AREA = 2.2  # m^2, of the LincolnMkz2017
# m/s; below this speed the tyres hold a braked vehicle (PxVehicle sticky tires).
HOLD_SPEED = 0.03
SUBSTEP = 1 / 60  # s, the longest substep; CARLA 0.9.10 (MaxSubstepDeltaTime)
NEWTON_STEPS = 8  # from 1 to a cube root near 1; the last steps change nothing


class _Prepared(NamedTuple):
    """Constants of N vehicles in a run, in SI units; arrays have the shape (N,).

    `rows`, shape (16, N), are the fields of `car` as one array, for the compiled step. `pull` is
    the force of a slope against the direction of travel [N]. `assumed_height` is the camera's
    assumed height over its actual height [-].
    """

    substeps: int
    law: Law
    car: Car
    rows: FloatArray
    mass: FloatArray
    shift_time: FloatArray
    pull: FloatArray
    assumed_height: FloatArray


class Carla(Vehicle, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle of the studies `sun` and `rain`: CARLA's LincolnMkz2017.

    Parameters
    ----------
    tyre_friction
        Friction coefficient of a tyre on a dry road per unit of tireFric [-].
    longitudinal_stiffness
        Longitudinal stiffness of a tyre, over gravity [N s^2/m per unit slip]
        (PxVehicleTireData.mLongitudinalStiffnessPerUnitGravity).
    slip_offset
        Speed added to the denominator of a slip [m/s] (0.1 in PxVehicle's `computeTireSlips`).
    engine_torque
        Engine torque relative to that of CARLA's default car [-].
    throttle_rise, throttle_fall, brake_rise, brake_fall
        Rates of the pedals [1/s] (PxVehiclePadSmoothingData: 6 up, 10 down).
    shift_up, shift_down
        Engine speeds over max_rpm above and below which the gearbox shifts [-]
        (PxVehicleAutoBoxData: 0.65 and 0.5).
    shift_latency
        Minimum time between the beginnings of two shifts [s] (PxVehicleAutoBoxData: 2).
    camera_height, camera_design_radius
        Height of the camera above the road [m] with wheels of the design radius [m]. Wheels of
        another radius change the height, and measured gaps scale by the assumed height over the
        actual height.
    """

    UNITS = {
        "max_rpm": "r/min",
        "dampRateFullT": "kg m^2/s",
        "dampRateZeroT_CE": "kg m^2/s",
        "dampRateZeroT_CD": "kg m^2/s",
        "gearSwitchTime": "s",
        "clutchStrength": "kg m^2/s",
        "mass": "kg",
        "dragCoeff": "-",
        "tireFric": "-",
        "dampRate": "kg m^2/s",
        "radius": "cm",
        "maxBrakeTorque": "N m",
    }
    PLAUSIBLE = {
        "max_rpm": Plausible(300, 30_000),
        "dampRateFullT": Plausible(0.001, 50),
        "dampRateZeroT_CE": Plausible(0.001, 50),
        "dampRateZeroT_CD": Plausible(0.001, 50),
        "gearSwitchTime": SECONDS,
        "clutchStrength": Plausible(0.01, 1000),
        "mass": MASS,
        "dragCoeff": Plausible(0.01, 5),
        "tireFric": Plausible(0.05, 20),
        "dampRate": Plausible(0.001, 50),
        "radius": Plausible(10, 100),
        "maxBrakeTorque": Plausible(20, 50_000),
        "shift_latency": SECONDS,
    }
    # m/s; highest speed in simulations of the published settings of sun and rain.
    FITTED_UP_TO: ClassVar[float] = 6.5

    tyre_friction: Positive
    longitudinal_stiffness: Positive
    slip_offset: Positive
    engine_torque: Positive
    throttle_rise: Positive = 6.0
    throttle_fall: Positive = 10.0
    brake_rise: Positive = 6.0
    brake_fall: Positive = 10.0
    shift_up: PositiveProportion = 0.65
    shift_down: PositiveProportion = 0.5
    shift_latency: Positive = 2.0
    camera_height: Annotated[float, Meta(ge=0.1, le=10)]
    camera_design_radius: Annotated[float, Meta(ge=0.1, le=1)] = 0.355

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        water: FloatOrArray = 0.0,
    ) -> _Prepared:
        # Numba takes longer to load than a simulation: studies of other vehicles do not load it.
        from safevar_sumo.vehicles.carla_step import TYRE_STEPS, Car

        c = characteristics
        radius = c["radius"] / 100
        grip = (
            c["tireFric"]
            * (self.tyre_friction * road_friction)
            * c["mass"]
            * slope.down
        )
        substeps = math.ceil(step / SUBSTEP - TIME_ROUNDING)
        substep = step / substeps
        tyre_step = substep / TYRE_STEPS

        car = Car(
            radius=radius,
            wheel_inertia=WHEELS * 0.5 * WHEEL_MASS * radius * radius / tyre_step,
            wheel_damping=WHEELS * c["dampRate"],
            brake_torque=WHEELS * c["maxBrakeTorque"],
            grip=grip,
            slip_stiffness=WHEELS * GRAVITY * self.longitudinal_stiffness / (3 * grip),
            clutch=c["clutchStrength"],
            engine_limit=c["max_rpm"] * RPM,
            damping_full=c["dampRateFullT"],
            damping_engaged=c["dampRateZeroT_CE"],
            damping_neutral=c["dampRateZeroT_CD"],
            shift_end=c["gearSwitchTime"] - TIME_ROUNDING,
            air_drag=0.5 * AIR_DENSITY * FRONTAL_AREA * c["dragCoeff"],
            speed_by_force=tyre_step / c["mass"],
            speed_by_slope=np.zeros_like(radius) + slope.back * tyre_step,
            standstill=HOLD_SPEED,
        )

        # The speed at which a slope moves the wheels counts as standstill, too.
        pull = c["mass"] * slope.back
        creep_speed, _ = self._rim_at(car, np.abs(pull), np.zeros_like(radius))
        car = car._replace(standstill=HOLD_SPEED + creep_speed)
        return _Prepared(
            substeps=substeps,
            law=self._law(substep, tyre_step),
            car=car,
            rows=np.array(car),
            mass=c["mass"],
            shift_time=c["gearSwitchTime"],
            pull=pull,
            assumed_height=self.camera_height
            / (self.camera_height + (radius - self.camera_design_radius)),
        )

    def _law(self, substep: float, tyre_step: float) -> Law:
        """The constants of all vehicles for these lengths of a substep and of a tyre step [s]."""
        from safevar_sumo.vehicles.carla_step import Law

        return Law(
            substep=substep,
            throttle_rise=self.throttle_rise * substep,
            throttle_fall=self.throttle_fall * substep,
            brake_rise=self.brake_rise * substep,
            brake_fall=self.brake_fall * substep,
            engine_inertia=ENGINE_INERTIA / tyre_step,
            engine_torque=self.engine_torque,
            shift_up=self.shift_up,
            shift_down=self.shift_down,
            shift_latency=self.shift_latency,
            slip_offset=self.slip_offset,
        )

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        from safevar_sumo.vehicles.carla_step import OVERALL_RATIOS, TORQUE_PEAK

        car = prepared.car
        mass = prepared.mass
        drive = self.engine_torque * TORQUE_PEAK * OVERALL_RATIOS[1] / car.radius
        lag = prepared.law.substep * prepared.substeps + 1 / self.brake_rise
        return SumoType(
            mass=mass,
            accel=np.minimum(drive, car.grip) / mass,
            decel=np.minimum(car.brake_torque / car.radius, car.grip) / mass,
            max_speed=np.asarray(car.engine_limit / OVERALL_RATIOS[-1] * car.radius),
            actuator_lag=np.full_like(mass, lag),
        )

    def at_rest(self, prepared: _Prepared) -> CarlaState:
        from safevar_sumo.vehicles.carla_step import CarlaState

        return CarlaState(*np.zeros((len(CarlaState._fields), len(prepared.mass))))

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> CarlaState:
        """The steady state, with the pedals that hold the speed: in every equation of `roll` the
        rate of change is 0.

        The gearbox has shifted up to the gear for this speed. If the engine is so slow in this gear
        that the gearbox would shift down, its last shift has just ended, so that it must wait.
        """
        from safevar_sumo.vehicles.carla_step import (
            OVERALL_RATIOS,
            CarlaState,
            full_torque,
        )

        p = prepared.car
        rim, force = self._rim_at(p, prepared.pull, speed)
        wheel_speed = rim / p.radius
        resistance = p.wheel_damping * wheel_speed + p.radius * force

        def engine_in(ratio: FloatOrArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """The torque through the clutch, the torque that remains for the brake [N m], and the
            engine speed [rad/s], in a gear of this overall ratio.
            """
            # Downhill the engine brakes, and the brake supplies the rest. Then the engine's speed
            # is w_e = G w_w + m / k_c with the clutch torque m = -c_e w_e (symbols as in `roll`).
            engine_drag = (
                -p.damping_engaged
                * ratio
                * wheel_speed
                / (1 + p.damping_engaged / p.clutch)
            )
            clutch_torque = np.maximum(resistance / ratio, engine_drag)
            engine_speed = np.minimum(
                ratio * wheel_speed + clutch_torque / p.clutch, p.engine_limit
            )
            return (
                clutch_torque,
                ratio * (engine_drag - resistance / ratio),
                engine_speed,
            )

        gear = np.ones_like(speed)
        for ratio in OVERALL_RATIOS[1:-1]:
            _, _, engine_speed = engine_in(ratio)
            gear += engine_speed > self.shift_up * p.engine_limit
        ratios = np.take(OVERALL_RATIOS, gear.astype(np.intp))
        clutch_torque, brake_torque, engine_speed = engine_in(ratios)
        brake = clip_to_share(brake_torque / p.brake_torque)
        throttle_torque = (
            full_torque(p, prepared.law, engine_speed)
            - (p.damping_full - p.damping_engaged) * engine_speed
        )
        torque = p.damping_engaged * engine_speed + clutch_torque
        throttle = torque / np.maximum(throttle_torque, 1.0)
        throttle = np.where(brake > 0, 0.0, np.minimum(throttle, 1.0))
        shifts_down = (gear > 1) & (engine_speed < self.shift_down * p.engine_limit)
        since_shift = np.where(shifts_down, prepared.shift_time, self.shift_latency)
        return CarlaState(
            speed, wheel_speed, engine_speed, gear, gear, since_shift, throttle, brake
        )

    def hold_gear(
        self, prepared: _Prepared, state: CarlaState, holds: BoolArray
    ) -> CarlaState:
        """Hold the gear of the vehicles for which `holds`, shape (N,), is true, as a selector lever
        does. The gearbox may shift as soon as the gear is released.
        """
        since_shift = np.where(
            state.since_shift < 0, self.shift_latency, state.since_shift
        )
        return state._replace(since_shift=np.where(holds, -np.inf, since_shift))

    def _rim_at(
        self, p: Car, pull: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The rim speed at which the tyre force balances air drag and the pull of a slope [m/s],
        and this tyre force, at most the grip [N].
        """
        force = np.minimum(
            np.maximum(p.air_drag * speed * speed + pull, -p.grip), p.grip
        )
        grip_share = np.abs(force) / p.grip
        root = np.ones_like(speed)
        # root^3 = 1 - force / grip; see `tyre_force`.
        for _ in range(NEWTON_STEPS):
            root = root - (root * root * root - 1 + grip_share) / (3 * root * root)
        stiff_speed = p.slip_stiffness * speed + self.slip_offset * (1 - root)
        driving_rim = stiff_speed / (p.slip_stiffness - 1 + root)
        braking_rim = speed - (speed + self.slip_offset) * (1 - root) / p.slip_stiffness
        return np.where(force < 0, braking_rim, driving_rim), force

    def sensors(self, prepared: _Prepared) -> Sensors:
        return Sensors.perfect(len(prepared.mass))._replace(
            scale=prepared.assumed_height
        )

    def sense(
        self, prepared: _Prepared, state: CarlaState, observation: Observation
    ) -> tuple[Observation, CarlaState]:
        """The gap as the camera measures it: the wheel radius sets the height of the camera."""
        return observation._replace(
            gap=observation.gap * prepared.assumed_height
        ), state

    @defer_interrupts()
    def compile(self, *, only_load: bool = False) -> bool:
        from safevar_sumo.vehicles.carla_step import Car, CarlaState, advance
        from safevar_sumo.vehicles.compiled import is_compiled

        def step() -> None:
            cars = np.ones((len(Car._fields), 1))
            states = np.zeros((len(CarlaState._fields), 1))
            advance(cars, self._law(1.0, 1.0), states, np.zeros((2, 1)), 1)

        if only_load:
            return is_compiled(step)
        step()
        return True

    def advance(
        self, prepared: _Prepared, state: CarlaState, command: Command
    ) -> CarlaState:
        from safevar_sumo.vehicles.carla_step import CarlaState, advance

        states = np.array(state)
        commands = np.array(command, float)
        advance(prepared.rows, prepared.law, states, commands, prepared.substeps)
        return CarlaState(*states)
