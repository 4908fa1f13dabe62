"""Creates the objects that a study names: its vehicle, its driving system, its scenario, and the
points of its matrix.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from safevar_sumo.ads import (
    ADS,
    MAX_INSTANCES,
    Ads,
    Fmu,
    FmuAds,
    PerVehicleAds,
    ScalarAds,
)
from safevar_sumo.errors import InputError, about, subject
from safevar_sumo.output import file_beside
from safevar_sumo.plugins import Lookup, Member, UserCode, instance_of
from safevar_sumo.records import KMH_PER_MS
from safevar_sumo.scenarios import (
    SCENARIO_BASES,
    SCENARIOS,
    Point,
    Scenario,
    TrackScenario,
    weather_of,
)
from safevar_sumo.scenarios.base import check_fields
from safevar_sumo.scenarios.tracks import LEGAL_FIELDS
from safevar_sumo.study import (
    Constraint,
    MatrixTest,
    ModelTable,
    Study,
    VehicleTable,
    user_code_names,
)
from safevar_sumo.sumo.network import is_network, is_shipped
from safevar_sumo.sumo.simulated_study import check_tables
from safevar_sumo.sumo.traci_controller import (
    Controller,
    TraciController,
    substitute_traci,
)
from safevar_sumo.vehicles import VEHICLES, SimulatedVehicle, Vehicle

CONTROLLER_FORMS = (
    "a function step(traci, vehicle_id) with the body of a script's loop, or a class with that"
    " method"
)
"""The legal forms of a controller written for TraCI."""


def create_shipped_models(study: Study) -> None:
    """Create the shipped models of a study, only to find errors: models refuse parameters that they
    do not have. Raises an InputError.
    """
    with about(study.source):
        lookup = Lookup.of(study)
        if study.scenario.model in SCENARIOS:
            check_tables(study, SCENARIOS[study.scenario.model].mover)
        for kind, shipped, table in (
            ("vehicle", VEHICLES, study.vehicle),
            ("ads", ADS, study.ads),
            ("scenario", SCENARIOS, study.scenario),
        ):
            if table.model in shipped and not getattr(table, "kind", ""):
                _, create = _class_and_creator(kind, shipped, table, lookup)
                create()
        if not user_code_names(study):
            matrix_points(study, lookup)


def _create_traci_controller(table: ModelTable, lookup: Lookup) -> Ads:
    """The ADS of a controller written for TraCI: a function `step(traci, vehicle_id)` or a class
    with that method.
    """
    name = f"ads.model = {table.model!r}"
    with substitute_traci():
        member = lookup.find({}, table.model, "ads.model")
        controller = member.target
        parameters = lookup.with_paths(member, table.parameters, "ads.parameters")
        is_class = inspect.isclass(controller)
        step: Any = controller
        arguments = ["traci", "vehicle_id"]
        keywords = parameters
        if is_class:
            # The parameters belong to the class, and its method `step` also takes the instance.
            step = getattr(controller, "step", None)
            arguments = ["self", *arguments]
            keywords = {}
        try:
            # The names stand for values: only the signature is compared.
            inspect.signature(step).bind(*arguments, **keywords)
        except (TypeError, ValueError) as error:
            raise InputError(
                "",
                f"{name} cannot be called as step(traci, vehicle_id) with {parameters}: {error}",
                CONTROLLER_FORMS,
            ) from None

        # Each vehicle gets its own controller, because controllers may keep values between steps.
        create: Callable[[], Controller]
        if is_class:
            create = partial(instance_of, member, parameters, name, "ads.parameters")
            # Create one controller now, so that wrong parameters are found before a simulation.
            create()
        else:
            create = partial(partial, controller, **parameters)
    return TraciController(create)


def matrix_points(study: Study, lookup: Lookup) -> tuple[Point, ...]:
    """The points of a study's matrix; raises an error if several points share a name."""
    points: list[Point] = []
    shared = study.shared_constraints
    constraints = [
        constraint for constraint in study.constraints if constraint not in shared
    ]
    for test in study.tests:
        with about(f"{subject()}: test {test.name!r}"):
            points += _points_of(test, study, constraints, lookup)

    for name, count in Counter(point.name for point in points).items():
        if count > 1:
            raise InputError(
                "",
                f"matrix.tests: {count} points are {name!r}",
                "unique names of tests, and each value once",
            )
    return tuple(points)


def _points_of(
    test: MatrixTest,
    study: Study,
    test_constraints: Sequence[Constraint],
    lookup: Lookup,
) -> Iterator[Point]:
    """The points of a test of the study's matrix. `test_constraints` are the constraints that hold
    only in tests; all other constraints hold for every setting.
    """
    model = test.model or study.scenario.model
    shared = study.scenario.parameters if model == study.scenario.model else {}
    lists = study.lists_of(test)
    ranges = study.ranges_of(test)
    constraints = tuple(
        constraint
        for constraint in test_constraints
        if test.name in (constraint.tests or [test.name])
    )
    for number, alone in enumerate(study.points_of(test)):
        over = {name: alone.axes[name].at[0] for name in lists}
        # Neighbouring points are the weathers of one encounter: they share the scenario.
        if number % max(len(test.weathers), 1) == 0:
            table = ModelTable(
                model=model, parameters={**shared, **test.parameters, **over}
            )
            scenario = create_scenario(table, lookup)
            if not ranges:
                scenario.check()
            _check_listed(
                {**table.parameters, **dict.fromkeys(ranges, None)}, constraints
            )
        (weather,) = (
            weather_of(weather) for weather in alone.weathers or [study.weather]
        )
        words = [test.name, *(f"{key} {value}" for key, value in over.items())]
        words += [weather.name] if scenario.mover.has("weather") else []
        parameters = {"test": test.name, **over, "weather": weather.name}
        yield Point(
            scenario=scenario,
            weather=weather,
            name=", ".join(words),
            parameters=parameters,
            allowed_impact_speed=test.allowed_impact_speed / KMH_PER_MS,
            ranges=ranges,
            constraints=constraints if ranges else (),
        )


def _check_listed(values: Mapping[str, Any], constraints: Sequence[Constraint]) -> None:
    """Refuse a listed encounter, given by values of parameters, that violates a constraint."""
    numbers = {
        name: value for name, value in values.items() if isinstance(value, int | float)
    }
    for constraint in constraints:
        if not constraint.allows(numbers):
            values_in_words = ", ".join(
                f"{name} = {numbers[name]:g}" for name in constraint.sum
            )
            raise InputError(
                "",
                f"{values_in_words} violates the constraint of {constraint.quantity}",
                "encounters that the constraints allow",
            )


def _locate_network(scenario: Scenario, folders: Sequence[str]) -> Scenario:
    """The scenario with the path of its network, if the network is a folder or a file in one of the
    study's `folders`. A shipped network keeps its name.

    A folder with XML files has priority, because a results directory beside the study may have the
    same name as the network.
    """
    candidates = [Path(folder, scenario.network) for folder in folders]
    paths = [path for path in candidates if is_network(path)]
    if not (paths and scenario.mover.has("roads")) or is_shipped(scenario.network):
        return scenario
    paths_with_sources = [
        path for path in paths if path.is_file() or any(path.glob("*.xml"))
    ]
    network = str((paths_with_sources or paths)[0])
    if isinstance(scenario, msgspec.Struct):
        return msgspec.structs.replace(scenario, network=network)
    vars(scenario)["network"] = network
    return scenario


def _class_and_creator(
    kind: str,
    shipped: Mapping[str, type],
    table: ModelTable | VehicleTable,
    lookup: Lookup,
    *bases: type,
) -> tuple[Member, Callable[[], Any]]:
    """The class that the `table` of a study names, and a function that creates an instance of it
    with the table's parameters. `kind` is the name of the table, such as "vehicle".
    """
    traci = f'with ads.kind = "traci" {CONTROLLER_FORMS}' if kind == "ads" else ""
    member = lookup.class_of(
        shipped, table.model, f"{kind}.model", *bases, otherwise=traci
    )
    parameters = lookup.with_paths(member, table.parameters, f"{kind}.parameters")
    name = f"{kind}.model = {table.model!r}"
    return member, partial(instance_of, member, parameters, name, f"{kind}.parameters")


def create_vehicle(table: VehicleTable, lookup: Lookup) -> Vehicle:
    """The vehicle that a study names, with its parameters; raises an InputError."""
    member, create = _class_and_creator("vehicle", VEHICLES, table, lookup, Vehicle)
    vehicle: Vehicle = create()
    if member.code is not None and not isinstance(
        getattr(vehicle, "UNITS", None), Mapping
    ):
        raise member.code.wrong(
            "__init__",
            "an object without UNITS",
            "units of the characteristics by name",
        )
    return vehicle


def create_scenario(table: ModelTable, lookup: Lookup) -> Scenario:
    """A scenario that a study names, with its parameters; raises an InputError."""
    member, create = _class_and_creator(
        "scenario", SCENARIOS, table, lookup, *SCENARIO_BASES
    )
    scenario: Scenario = create()
    if member.code is not None:
        further = LEGAL_FIELDS if isinstance(scenario, TrackScenario) else {}
        check_fields(member.code, scenario, **further)
    return _locate_network(scenario, lookup.folders)


def create_ads(table: ModelTable, lookup: Lookup) -> Ads:
    """The driving system that a study names, with its parameters; raises an InputError."""
    if table.kind == "traci":
        return _create_traci_controller(table, lookup)

    if table.kind == "fmu":
        path = file_beside(table.model, lookup.folders)
        if not path:
            raise InputError(
                "",
                f"ads.model = {table.model!r}: there is no such file",
                "the path of an FMU",
            )
        code = UserCode(f"ads.model = {table.model!r}")
        fleet = PerVehicleAds(partial(FmuAds, Fmu(path, table, code)), code)
        fleet.max_vehicles = MAX_INSTANCES
        return fleet

    # Each vehicle gets its own ScalarAds. One is created here, to find wrong parameters at once.
    member, create = _class_and_creator("ads", ADS, table, lookup, ScalarAds, Ads)
    ads: Ads = create()
    if not isinstance(ads, ScalarAds):
        return ads
    return PerVehicleAds(
        create, member.code or UserCode(f"ads.model = {table.model!r}")
    )


def create_driven(
    study: Study, lookup: Lookup, scenario: Scenario
) -> tuple[Vehicle, Ads]:
    """The vehicle and the driving system of a study. With a user's simulator, the vehicle has only
    characteristics, and the driving system does nothing. Raises an InputError.
    """
    check_tables(study, scenario.mover)
    if scenario.mover.has("a driving system"):
        vehicle = create_vehicle(study.vehicle, lookup).seeded(study.search.seed)
        return vehicle, create_ads(study.ads, lookup)
    units = getattr(scenario, "UNITS", None)
    if not isinstance(units, Mapping):
        code = UserCode(f"scenario.model = {study.scenario.model!r}", type(scenario))
        raise code.wrong(
            "__init__",
            "an object without UNITS",
            "UNITS: units of the vehicle's characteristics by name",
        )
    # The simulator moves and drives the vehicle: these two objects only fill their places.
    return SimulatedVehicle(units, tuple(getattr(scenario, "OPTIONAL", ()))), Ads()  # type: ignore[abstract]
