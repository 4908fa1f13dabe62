"""The tables of a study: vehicle, ADS, scenario, weather, metrics and search."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.study import Domain
from safevar_sumo.study.characteristics import (
    CharacteristicTable,
    Constraint,
    Distribution,
    PositiveNumber,
    UnmeasuredValue,
    check_unmeasured,
    check_variation,
    mistake,
)
from safevar_sumo.study.encounters import (
    MatrixTest,
    ModelTable,
    Parameters,
    StudyEncounters,
)
from safevar_sumo.study.limits import Limit, check_limits
from safevar_sumo.study.marks import (
    OF_STUDY,
    OF_SYSTEM,
    OF_VEHICLE_AND_ADS,
    ORDERED,
    PART_OF_SYSTEM,
    WHOLE,
    WITHOUT_EFFECT,
    Table,
    fields_of,
)
from safevar_sumo.study.parameters import FreeParameter

PositiveInt = Annotated[int, Meta(ge=1, le=10_000_000)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Tables = Mapping[str, Any]
"""A study's tables, as in its file."""
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*\Z"
Name = Annotated[
    str,
    Meta(
        pattern=NAME_PATTERN,
        description="letters, digits, _, . and -, the first a letter or digit",
    ),
]
SPREAD_TABLES = ("vehicle.parameters.", "ads.parameters.", "weather.")
"""Prefixes of the parameters that [spread] may list."""
SAFETY_DEGREE: Final = "safety_degree"
"""The name of the safety degree, as a column of results and as a key."""
ORIGINAL_DEGREE: Final = "original_safety_degree"
"""The name of the column with the original vehicle's safety degree in the same encounter. Only
studies with ranges of encounters have this column.
"""
OBJECTIVES = (SAFETY_DEGREE, "f_diff", "f_num_diff")
"""Objectives of a search, as in the published study."""


class VehicleTable(Table, frozen=True, kw_only=True):
    """The table [vehicle] describes the vehicle under test.

    - `model` is the name of the vehicle's model, and `parameters` are the parameters of this model.
    - `characteristics` are the properties of the vehicle that a search changes, by name. The value
      false removes a characteristic that the study inherits from the study named by `extends`.
    - `files` are data files, or folders of data files, that a vehicle model of your own reads. The
      paths of `files` are relative to the study's file.
    """

    model: str = ""
    characteristics: Annotated[dict[str, CharacteristicTable], ORDERED]
    parameters: Parameters = {}
    files: list[str] = []


class MetricsTable(Table, frozen=True, kw_only=True):
    """The table [metrics] sets thresholds of the safety metrics, and adds metrics.

    - `ttc_threshold` [s] is the threshold TTC* of the time to collision.
    - `sampling_interval` [s] is the time between two samples from which the metrics TET, TIT and
      aveDece are computed. The sampling interval is a whole multiple of the simulation's time step.
      By default the sampling interval is one time step.
    - `also` names further metrics: metrics of the package, such as `ttc_min`, or metrics of your
      own as `package.module:Name`.
    """

    ttc_threshold: PositiveNumber
    sampling_interval: PositiveNumber | None = None
    also: list[str] = []

    def __post_init__(self) -> None:
        if len({*self.also}) < len(self.also):
            raise mistake(f"also = {self.also}", "each metric once")


class SearchTable(Table, frozen=True, kw_only=True):
    """The table [search] says how algorithms search for unsafe vehicles.

    - Each of the `algorithms` has `runs` runs. Each run has `evaluations` simulations, in
      generations of `population` vehicles.
    - `seed` is the seed of all random numbers of the search.
    - `time_limit` [s] is the time after which a batch of simulations counts as hung.
    - `failed` is for simulators of your own: with "stop", a vehicle whose simulation fails ends the
      study; with "skip", this vehicle counts as infeasible.
    - `objectives` are what the search minimises. For a metric among the objectives, the search
      looks for its most dangerous values.
    - `reference_point` [-] is the coordinate, in every dimension, of the reference point from which
      the hypervolume is computed. For the hypervolume, objectives are normalised to 0..1.
    - `parameters` are the parameters of the algorithms, by the algorithm's name or label. A study's
      file states the parameters of an algorithm in tables such as [search.nsga2].
    """

    algorithms: Annotated[list[str], Meta(min_length=1), WITHOUT_EFFECT]
    population: Annotated[int, Meta(ge=2, le=100_000)]
    evaluations: Annotated[PositiveInt, WITHOUT_EFFECT]
    runs: Annotated[int, Meta(ge=1, le=100_000), WITHOUT_EFFECT]
    seed: Seed
    time_limit: Annotated[float, Meta(gt=0, le=86400), WITHOUT_EFFECT] = 300.0
    failed: Annotated[Literal["stop", "skip"], WITHOUT_EFFECT] = "stop"
    objectives: Annotated[list[str], Meta(min_length=2, max_length=6)] = msgspec.field(
        default_factory=lambda: list(OBJECTIVES)
    )
    reference_point: Annotated[float, Meta(gt=1, le=100), WITHOUT_EFFECT] = 1.1
    parameters: dict[str, Parameters] = {}

    @property
    def labels(self) -> dict[str, str]:
        """Names of the study's algorithms by their labels in results (see `label_of`)."""
        return {label_of(name): name for name in self.algorithms}


PYMOO = "pymoo:"
"""Prefix of the names of pymoo's algorithms."""


def label_of(algorithm: str) -> str:
    """The label of an algorithm in results: pymoo_NSGA3 for `pymoo:NSGA3`, and Name for
    `package.module:Name`.
    """
    if algorithm.startswith(PYMOO):
        return algorithm.replace(":", "_")
    return algorithm.rpartition(":")[2]


class UnsafeTable(Table, frozen=True, kw_only=True):
    """The table [unsafe] says which vehicles count as unsafe, if a command has no option
    `--unsafe`.

    - `criterion` is written like the value of the option `--unsafe`, such as "collision".
    - `source` names where the criterion comes from, such as a regulation.
    - `not_simulated` lists the parts of this source that no test of the study simulates.
    """

    criterion: str = ""
    source: str = ""
    not_simulated: str = ""

    def __post_init__(self) -> None:
        if self.source and not self.criterion:
            raise mistake(f"source = {self.source!r}", "a criterion beside its source")


class RepairTable(Table, frozen=True, kw_only=True):
    """The table [repair] says what a repair of the driving system may change, and what a repair has
    to keep.

    - `parameters` are the parameters that a repair may change, by name. A study's file states the
      parameters of a repair directly under [repair]. Shipped driving systems name the parameters
      that a repair may change by default.
    - `promise` has the limits of wear, by characteristic, within which a repaired vehicle must be
      safe. The value "all" means the whole domain (range of values). By default the limits are
      those of the table [limits].
    - `benign` are tests in which nobody needs to brake.
    """

    parameters: dict[str, FreeParameter] = {}
    promise: dict[str, Limit] | Literal["all"] = {}
    benign: list[MatrixTest] = []


class Origin(Table, frozen=True, kw_only=True):
    """Where a study comes from. Results do not depend on the origin.

    Attributes
    ----------
    called
        The study's path as typed on the command line; "" if the user typed the study's name.
    point
        The test or test case to which an option reduced the study; "" for a whole study.
    ranges
        Whether the option `--ranges` made the study's encounters ranges.
    up_to
        The text of the option `--up-to`, which cuts off encounters; "" without this option.
    places
        The folders of the study's file and of the files that the study extends. User code is looked
        up in these folders first.
    files
        The files of the study, and the files that the study extends, that are not shipped.
    """

    called: str = ""
    point: str = ""
    ranges: bool = False
    up_to: str = ""
    places: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


class Study(StudyEncounters, frozen=True, kw_only=True):
    """A complete study, with the keys of its TOML file. `load_study` reads a study from its file.

    - `name` and `title` are the study's name and its heading.
    - `weather` is the name of a shipped weather, or a table with a weather of your own.
    - `matrix` has the tests in which the study simulates every vehicle, if the study has several.
    - `encounters` says what vehicles meet: "tests" means the listed tests, and "ranges" means any
      encounter within the ranges of the axes (parameters of encounters).
    - `step_length` [s] is the simulation's time step. By default the time step is that of the
      network's options.
    - `published` has the metrics of the original vehicle in the published study, by name.
    - `repeatability` has, for each metric, the standard deviation between repeats of one vehicle in
      the published study.
    - `spread` has parameter sets that fit the published data equally well: for each parameter a
      list of values, of which the first is the value in the study. A parameter is named by its key
      in the file, such as `ads.parameters.corridor`.
    - `model_error` is the further error of the vehicle model, by metric, for a vehicle that differs
      from the original vehicle by the full width of a domain.
    - `variation` states how characteristics vary between vehicles in the world, by name. By default
      all values of a domain are equally likely.
    - `constraints` are conditions that the characteristics of one vehicle satisfy together.
    - `limits` are the values, by name, up to which characteristics may wear in service.
    - `unmeasured` has the values, by name, that `permit` assumes of characteristics that nobody
      measured in a car. The value of an unmeasured characteristic is a number or a table. A study
      that extends this study does not inherit the table [unmeasured].
    - `repair` states what a repair of the driving system may change.
    - `unsafe` states which vehicles the study calls unsafe.
    """

    # Only keys without the mark WITHOUT_EFFECT are part of the identity of results.
    name: Name
    title: Annotated[str, WITHOUT_EFFECT, OF_SYSTEM]
    vehicle: Annotated[VehicleTable, PART_OF_SYSTEM]
    ads: Annotated[ModelTable, PART_OF_SYSTEM] = ModelTable(model="")
    metrics: MetricsTable
    search: SearchTable
    step_length: Annotated[float, Meta(ge=0.001, le=1)] | None = None
    published: Annotated[dict[str, float], WITHOUT_EFFECT, OF_SYSTEM, WHOLE] = {}
    repeatability: Annotated[
        dict[str, PositiveNumber],
        WITHOUT_EFFECT,
        OF_SYSTEM,
        WHOLE,
    ] = {}
    spread: Annotated[
        dict[str, list[float]], WITHOUT_EFFECT, OF_VEHICLE_AND_ADS, WHOLE
    ] = {}
    model_error: Annotated[
        dict[str, Annotated[float, Meta(ge=0, le=1e6)]],
        WITHOUT_EFFECT,
        OF_VEHICLE_AND_ADS,
        WHOLE,
    ] = {}
    variation: Annotated[dict[str, Distribution], WITHOUT_EFFECT] = {}
    limits: Annotated[dict[str, Limit], WITHOUT_EFFECT] = {}
    unmeasured: Annotated[
        dict[str, float | UnmeasuredValue], WITHOUT_EFFECT, OF_STUDY
    ] = {}
    repair: Annotated[RepairTable, WITHOUT_EFFECT] = RepairTable()
    unsafe: Annotated[UnsafeTable, WITHOUT_EFFECT] = UnsafeTable()
    origin: Origin = Origin()

    def __post_init__(self) -> None:
        rows = self.vehicle.characteristics
        if not rows:
            raise InputError("", "vehicle.characteristics: none", "at least one")
        if self.scenario.kind:
            raise InputError(
                "",
                f"scenario.kind = {self.scenario.kind!r}",
                "no kind: a scenario is no FMU",
            )
        check_variation(self.domains, self.variation)
        check_limits(rows, self.limits, table="limits.")
        check_unmeasured(rows, self.unmeasured_values)
        lengths = {len(values) for values in self.spread.values()}
        if len(lengths) > 1 or 0 in lengths:
            raise InputError(
                "",
                "spread: its lists differ in length or are empty",
                "a list for each parameter, all of one length",
            )
        if 0 in self.published.values():
            raise InputError(
                "", f"published = {self.published}", "numbers other than 0"
            )

    @property
    def shared_constraints(self) -> list[Constraint]:
        """The constraints that every setting has to satisfy: constraints that apply in all tests,
        and whose names are all in the study's `domains`.
        """
        tests = {test.name for test in self.tests} or {""}
        names = self.domains.keys()
        return [
            constraint
            for constraint in self.constraints
            if constraint.sum.keys() <= names
            and tests <= {*(constraint.tests or tests)}
        ]

    @property
    def domains(self) -> Mapping[str, Domain]:
        """The domains that a search varies: the vehicle's characteristics, then parameters of
        encounters.
        """
        return {**self.vehicle.characteristics, **self.ranges}

    @property
    def unmeasured_values(self) -> dict[str, float]:
        """The values of `unmeasured`, without their sources."""
        values = dict[str, Any](self.unmeasured)
        for name, entry in values.items():
            if isinstance(entry, UnmeasuredValue):
                values[name] = entry.value
        return values

    @property
    def source(self) -> str:
        """The study's name in errors: the path that the user typed, or else the name of the
        study.
        """
        return self.origin.called or f"study {self.name!r}"

    @property
    def words(self) -> str:
        """The words by which a command names the study, with the options that reduced the study."""
        words = [self.origin.called or self.name]
        if self.origin.ranges:
            words.append("--ranges")
        if self.origin.point:
            words += ["--point", self.origin.point]
        if self.origin.up_to:
            words += ["--up-to", self.origin.up_to]
        return shlex.join(words)


def tables_of(study: Study) -> Parameters:
    """A study as plain tables, as in a file. The tables lack the study's origin, and all keys with
    default values.
    """
    tables: Parameters = _without_defaults(study)
    tables.pop("origin", None)
    return tables


def _without_defaults(value: Any) -> Any:
    """Convert records to tables at any depth, without keys that have their default values."""
    if isinstance(value, dict):
        return {key: _without_defaults(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_defaults(item) for item in value]
    if not isinstance(value, Table):
        return value
    config = value.__struct_config__
    table = {}
    if config.tag_field is not None:
        table[config.tag_field] = config.tag
    for field in fields_of(type(value)):
        item = getattr(value, field.name)
        default = field.default
        if field.default_factory is not msgspec.NODEFAULT:
            default = field.default_factory()
        if item != default:
            table[field.name] = _without_defaults(item)
    return table


def locate_parameter(tables: Any, name: str) -> tuple[Any, int | str]:
    """The table or list that holds a parameter, and the parameter's key or index. `name` is the
    path of the parameter from `tables`, with dots.

    Raises
    ------
    InputError
        If the study has no such number.
    """
    *path, parameter = name.split(".")
    table = tables
    try:
        for key in path:
            table = table[_key_or_index(table, key)]
        key_or_index = _key_or_index(table, parameter)
        is_number = isinstance(table[key_or_index], int | float)
    except (KeyError, IndexError, ValueError, TypeError):
        # A shipped weather is only a name here: its numbers are looked up later.
        is_number = path[:1] == ["weather"] and isinstance(tables["weather"], str)
        key_or_index = parameter
    if not (is_number and name.startswith(SPREAD_TABLES)):
        legal_tables = ", ".join(prefix.rstrip(".") for prefix in SPREAD_TABLES)
        raise InputError(
            "",
            f"spread.{name!r} is no parameter of the study",
            f"a number that is given under {legal_tables}",
        )
    return table, key_or_index


def _key_or_index(table: Any, name: str) -> int | str:
    """The name as a key of a table, or as an index of a list. An index in another spelling, such as
    01, stays a text: each parameter has only one name.
    """
    if isinstance(table, list) and name == str(int(name)):
        return int(name)
    return name


StudyLike = str | Path | Tables | Study
"""A study as its name, the path of its file, its tables, or a `Study`."""
