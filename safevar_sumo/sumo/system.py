"""The parts of a study, ready to simulate: models, points, measures and constraints. `assemble`
checks that the parts fit each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec

from safevar_sumo.ads import Ads
from safevar_sumo.errors import InputError, check_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.plugins import ONE_AT_A_TIME, Lookup, Modules, user_errors
from safevar_sumo.records import TIME_ROUNDING, FloatArray, Nominal
from safevar_sumo.scenarios import (
    VUT,
    Point,
    Scenario,
    TrackScenario,
    WorldScenario,
    weather_of,
)
from safevar_sumo.scenarios.base import Mover, Part
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import MetricsTable, Study, user_code_names
from safevar_sumo.study.encounters import DecidingMetric
from safevar_sumo.sumo.bodies import SceneWorld
from safevar_sumo.sumo.encounters import check_domains, encounter, original_encounter
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.measuring import Measuring, measuring_of, own_criterion
from safevar_sumo.sumo.models import create_driven, create_scenario, matrix_points
from safevar_sumo.sumo.network import copied_network, network_for
from safevar_sumo.sumo.network_check import check_network
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.recording import Scenes
from safevar_sumo.sumo.simulated_study import check_matrix
from safevar_sumo.sumo.traci_controller import TraciController
from safevar_sumo.sumo.vehicle_check import check_plausible, check_units
from safevar_sumo.vehicles import (
    VEHICLES,
    CharacteristicSet,
    FeasibleRegion,
    Vehicle,
    calibration_drive,
    region_of,
)


@dataclass(frozen=True, kw_only=True)
class System:
    """A study's models, points, metrics and constraints, ready to simulate.

    - `source` is the name of the study in errors.
    - `scenes` has the recorded scenes of all points. A system that is reduced to fewer points
      shares them.
    - `metrics_table` has the thresholds of the metrics in `measuring`.
    - `deciding` is the metric that decides which point of a matrix is the worst; None if the safety
      degree decides.
    - A simulation that takes longer than `time_limit` [s] counts as hung.
    - Settings are simulated at `points`: the points of the matrix, or the study's only scenario.
    - A user's simulator simulates each setting `repeats` times.
    - `criterion` is the criterion for unsafe that the study states (default: a collision).
    - With `skips_failed`, a setting on which a user's simulator fails gets the outcome
      `simulator-error`. Otherwise such a failure is an error.
    - `command` simulates the original vehicle of the study.
    - With `in_sumo` SUMO moves the vehicles, also where recorded scenes suffice.
    - `modules` are the modules of the study's user code.
    - With `sees_nobody` the ADS sees no other actor, and a run ends at the place of the encounter.
    """

    characteristics: CharacteristicSet
    vehicle: Vehicle
    ads: Ads
    points: tuple[Point, ...]
    metrics_table: MetricsTable
    nominal: Nominal
    measuring: Measuring
    region: FeasibleRegion
    source: str
    scenes: Scenes
    time_limit: float
    sees_nobody: bool = False
    in_sumo: bool = False
    deciding: DecidingMetric | None
    repeats: int
    command: str
    skips_failed: bool
    criterion: Unsafe
    modules: Modules

    @contextmanager
    def user_code(self) -> Iterator[None]:
        """Within the block, user code of this system runs: with its own modules, and with errors
        that name the study.
        """
        with self.modules.active(), user_errors(self.source):
            yield

    @property
    def matrix(self) -> tuple[Point, ...]:
        """The points of a matrix, which have names; none in a study with a single scenario."""
        return tuple(point for point in self.points if point.name)

    @property
    def scenarios(self) -> list[Scenario]:
        """The scenario of each point."""
        return [point.scenario for point in self.points]

    @property
    def networks(self) -> list[str]:
        """The different networks of the points, in their order."""
        return list(dict.fromkeys(scenario.network for scenario in self.scenarios))

    @property
    def has_tracks(self) -> bool:
        """Whether vehicles drive among bodies on tracks, at all points."""
        return all(isinstance(scenario, TrackScenario) for scenario in self.scenarios)

    @property
    def mover(self) -> Mover:
        """The mover of the vehicles: SUMO, or a user's simulator. It is the same at all points."""
        return self.points[0].scenario.mover

    def require(self, part: Part, question: str) -> None:
        """Refuse a question that needs a part, such as a driving system, that the mover lacks.

        Raises
        ------
        InputError
            The error states why the mover lacks this part.
        """
        if reason := self.mover.lacks.get(part):
            raise InputError(
                self.source,
                f"{question} needs {part}, and scenario.model is {self.mover.kind}: {reason}",
                "a study with a vehicle and a driving system",
            )

    @property
    def meets_nobody(self) -> bool:
        """Whether nobody else is on the road at any point, so that nothing can collide."""
        return all(scenario.brakes_fully for scenario in self.scenarios)

    @property
    def step(self) -> float:
        """Time step of the simulations [s]; 0 if the mover has its own time step."""
        if self.mover.has_own_step:
            return 0.0
        return self.scenes.step_of(self.points[0].scenario)

    @cached_property
    def contact(self) -> float:
        """The safety degree at which bodies touch [m]: 0 if it is a distance between bumpers, half
        the sum of both lengths if it is a distance between middles.
        """
        scenario = self.points[0].scenario
        if not scenario.centre_to_centre:
            return 0.0
        assert isinstance(scenario, WorldScenario)

        recording = self.scenes.of(scenario)
        with ExitStack() as stack:
            stack.enter_context(self.user_code())
            world: SceneWorld
            if isinstance(recording, str):
                network = copied_network(network_for(scenario), 1)
                world = stack.enter_context(open_world(network, 1, self.scenes.step))
                world.enter(None)
            else:
                world = RecordedWorld(recording, 1)
            scene, _ = scenario.observe(world, world.step_length, world.begin(scenario))
            return (world.vehicle_length(VUT) + float(scene.obstacle_length)) / 2

    def with_contact(self, unsafe: Unsafe) -> Unsafe:
        """The criterion; if it is a clearance, with the safety degree at which bodies touch."""
        if unsafe.below is None:
            return unsafe
        return replace(unsafe, contact=self.contact)

    def split(self, settings: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Split N settings, shape (N, n), into the values of the vehicles, shape (N, k), and the
        values of their encounters: the n - k scenario parameters that the study searches.
        """
        is_of_vehicle = self.characteristics.of_vehicle
        return settings[:, is_of_vehicle], settings[:, ~is_of_vehicle]

    def at_encounters(self, encounters: FloatArray) -> System:
        """The system in N encounters, shape (N, n - k): its points have arrays as the parameters
        that the study searches. There may be several points if the study searches only the phase.
        A system of a study that searches no scenario parameters is returned as it is.
        """
        if not encounters.shape[1]:
            return self
        values = self.characteristics.scenario.columns(encounters)
        points = tuple(encounter(point, values) for point in self.points)
        return replace(
            self, points=points, characteristics=self.characteristics.vehicle
        )

    def at(self, point: Point) -> System:
        """The system reduced to one point."""
        return replace(
            self, points=(point._replace(name="", parameters={}, constraints=()),)
        )


def simulate_command(study: Study) -> str:
    """The command that simulates the original vehicle of a study; if the study was reduced to a
    point, at this point.
    """
    return f"{PROGRAM_COMMAND} simulate {study.words}"


def assemble(study: Study) -> System:
    """Load the study's models and create them with their parameters.

    Raises
    ------
    InputError
        The error names the study, the key, the value and the legal values.
    """
    with user_errors(study.source), ONE_AT_A_TIME:
        # User code is loaded anew: a system must not share state with another, nor have old code.
        modules = Modules.begin(study.origin.places)
        modules.is_used = bool(user_code_names(study))
        with modules.active():
            return _assemble(study)


def _original_points(study: Study, lookup: Lookup, single: Point) -> tuple[Point, ...]:
    """The points of a study whose encounters are ranges, each in its original encounter; () for
    other studies. `single` is the only point of a study without a matrix.

    Ranges that the study states are checked even if the study uses listed encounters.
    """
    study_in_ranges = with_ranges(study) if study.states_ranges else study
    points = (
        matrix_points(study_in_ranges, lookup) or (single,)
        if study_in_ranges.ranges
        else ()
    )
    check_domains(study_in_ranges, points)
    if not study.ranges:
        return ()
    for name in study.scenario.over:
        if name not in study.axes:
            raise InputError(
                "",
                f"over.{name}: the weathers of each test set {name}, too",
                "a range, or values in the weathers",
            )
    return tuple(original_encounter(point, study.ranges) for point in points)


def _assemble(study: Study) -> System:
    lookup = Lookup.of(study)
    scenario = create_scenario(study.scenario, lookup)
    vehicle, ads = create_driven(study, lookup, scenario)
    check_units(study, vehicle)
    check_plausible(study, vehicle)
    _check_sensors(study, vehicle, ads)

    matrix = matrix_points(study, lookup)
    check_matrix(scenario, matrix)
    scenarios = (scenario, *(point.scenario for point in matrix))
    has_stops = any(member.brakes_fully for member in scenarios)
    measuring = measuring_of(study, lookup, has_stops=has_stops)
    _check_metrics(study, measuring)
    for network in dict.fromkeys(member.network for member in scenarios):
        if network:
            check_network(network)
            _check_step(study.step_length)
    if not (matrix or study.ranges):
        scenario.check()

    single = Point(scenario, weather_of(study.weather))
    points = _original_points(study, lookup, single) or matrix or (single,)

    region = region_of(study)
    nominal = calibration_drive(vehicle, region.characteristics.vehicle)
    if study.vehicle.model not in {*VEHICLES, ""}:
        # Errors of a user's vehicle must not depend on whether the ADS reads the tables.
        nominal.tables()
    system = System(
        characteristics=region.characteristics,
        vehicle=vehicle,
        ads=ads,
        points=points,
        metrics_table=study.metrics,
        nominal=nominal,
        measuring=measuring,
        region=region,
        source=study.source,
        scenes=Scenes(study.step_length, lookup.modules),
        time_limit=study.search.time_limit,
        deciding=study.deciding,
        repeats=study.scenario.repeats,
        command=simulate_command(study),
        criterion=own_criterion(study),
        skips_failed=study.search.failed == "skip",
        modules=lookup.modules,
    )
    if not study.ranges or study.scenario.margin is None:
        return system

    # An encounter counts only if the original vehicle keeps the margin there.
    limit = study.scenario.margin + system.contact
    scoring = msgspec.structs.replace(measuring.scoring, safe_original=limit)
    return replace(system, measuring=measuring._replace(scoring=scoring))


def _check_step(step: float | None) -> None:
    """Refuse a time step [s] that SUMO, which counts whole milliseconds, would round."""
    if step is not None and abs(step - round(step, 3)) > TIME_ROUNDING:
        raise InputError(
            "",
            f"step_length = {step:g}",
            "a multiple of 0.001 s: SUMO counts time in whole milliseconds",
        )


def _check_sensors(study: Study, vehicle: Vehicle, ads: Ads) -> None:
    """Refuse a user's vehicle without sensors beside a controller that reads SUMO: such a
    controller would see everything.
    """
    has_none = (
        study.vehicle.model not in VEHICLES and type(vehicle).sensors is Vehicle.sensors
    )
    if isinstance(ads, TraciController) and has_none:
        raise InputError(
            "",
            f"vehicle.model = {study.vehicle.model!r} has no method sensors, and a controller of"
            " TraCI bypasses sense",
            "a method sensors(prepared) that returns safevar_sumo.vehicles.Sensors(latency, reach,"
            " scale), or None",
        )


def _check_metrics(study: Study, measuring: Measuring) -> None:
    """Refuse names of metrics that the study does not measure."""
    metrics = [metric.name for metric in measuring.scoring.metrics]
    for key in ("published", "repeatability", "model_error"):
        for name in getattr(study, key):
            check_name("", f"{key}.{name} is no metric", name, metrics)
    if deciding := study.deciding:
        name = deciding.name
        problem = f"matrix.aggregate = {str(deciding)!r}: {name} is no metric"
        check_name("", problem, name, metrics)
