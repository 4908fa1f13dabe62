"""The tables of a study: vehicle, ADS, scenario, weather, metrics and search."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.study.characteristics import (
    CharacteristicTable,
    Constraint,
    Correlation,
    Distribution,
    Domain,
    Limit,
    PositiveNumber,
    UnmeasuredValue,
    check_constraints,
    check_limits,
    check_unmeasured,
    check_variation,
    mistake,
)
from safevar_sumo.study.marks import (
    OF_MATRIX,
    OF_SCENARIO,
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
from safevar_sumo.study.parameters import FreeParameter, searched

PositiveInt = Annotated[int, Meta(ge=1, le=10_000_000)]
WORST = "worst"
"""The aggregate of a matrix by which the least safety degree decides."""
BY_EXCESS = "impact_excess >"
"""The aggregate of a matrix in which impacts may be allowed."""
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Parameters = dict[str, Any]
Tables = Mapping[str, Any]
"""A study's tables, as in a file."""
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*\Z"
Name = Annotated[
    str,
    Meta(
        pattern=NAME_PATTERN, description="letters, digits, _, . and -, the first a letter or digit"
    ),
]
SPREAD_TABLES = ("vehicle.parameters.", "ads.parameters.", "weather.")
"""Prefixes of the parameters that may stand in [spread]."""
SAFETY_DEGREE: Final = "safety_degree"
"""Column and key of the safety degree."""
ORIGINAL_DEGREE: Final = "original_safety_degree"
"""Column of the original vehicle's safety degree in the same encounter, in a study that searches
its scenario.
"""
OBJECTIVES = (SAFETY_DEGREE, "f_diff", "f_num_diff")
"""Objectives of the published study."""


class ModelTable(Table, frozen=True, kw_only=True):
    """A `model` by its name, or by `package.module:Name`, and its `parameters`.

    An ADS of the `kind` `traci` is a controller written for SUMO's TraCI; an ADS of the kind `fmu`
    is an FMU, named by its path: `inputs` and `outputs` are the FMU's variables by the quantity
    they receive or return. `files` are data files, or folders of them, that a model of your own
    reads, relative to the study's file.
    """

    model: str
    parameters: Parameters = {}
    kind: Literal["", "traci", "fmu"] = ""
    inputs: dict[str, str] = {}
    outputs: dict[str, str] = {}
    files: list[str] = []

    def __post_init__(self) -> None:
        if self.kind != "fmu" and (self.inputs or self.outputs):
            raise mistake(
                f"{self.model!r} is no FMU, but has inputs or outputs",
                'kind = "fmu", or no such keys',
            )


ORIGINAL_MARGIN = 0.3
"""Distance that the original vehicle must keep in an encounter that is searched, unless the study
says another [m].
"""


class ScenarioTable(ModelTable, frozen=True, kw_only=True):
    """The scenario: its `model` and `parameters`; and those of its parameters, and of the
    weather's, that are searched together with the vehicle, under `search` by name.

    The original vehicle drives in the same encounter as each variant, and must keep at least
    `margin` [m] between bodies there: otherwise the encounter does not count, as it shows nothing
    of the variant. A simulator of the user's own that is not deterministic simulates each setting
    `repeats` times: the share of unsafe runs, the worst run, and means of metrics count.
    """

    search: Annotated[dict[str, Domain], ORDERED] = {}
    margin: Annotated[float, Meta(ge=0, le=100)] = ORIGINAL_MARGIN
    repeats: Annotated[int, Meta(ge=1, le=1000)] = 1

    def __post_init__(self) -> None:
        if self.margin != ORIGINAL_MARGIN and not self.search:
            raise mistake(
                f"margin = {self.margin:g}, and nothing is searched",
                "a table search beside it, or no margin",
            )


class VehicleTable(Table, frozen=True, kw_only=True):
    """The vehicle under test: its `model`, the model's `parameters`, and the `characteristics` that
    vary; false in place of one leaves out that of the study that is extended.

    `files` are data files, or folders of them, that a model of your own reads, relative to the
    study's file.
    """

    model: str = ""
    characteristics: Annotated[dict[str, CharacteristicTable], ORDERED]
    parameters: Parameters = {}
    files: list[str] = []


class Weather(Table, frozen=True, kw_only=True):
    """Weather as data: its `name`, and its effects on the road and on the sensors.

    `road_friction` and `visibility` are factors relative to the dry, clear case [-]. `water` is its
    depth on the road [mm], whose effect the vehicle `worn` computes: it takes `road_friction` as
    the grip of the same road when dry. `recognition_delay` is the additional time that the sensors
    need to recognise a road user [s], for every ADS; the reaction time of an ADS is one of its
    parameters. `light` decides only whether a rating darkens the weather for its tests by night.
    """

    name: str
    road_friction: Annotated[
        float,
        Meta(gt=0, le=1.5),
        searched(0.1, 1.2, "-", "road friction, factor on the tyres' friction"),
    ]
    visibility: Annotated[
        float,
        Meta(gt=0, le=1.5),
        searched(0.05, 1.5, "-", "visibility, factor on the range of the sensors"),
    ]
    recognition_delay: Annotated[
        float,
        Meta(ge=0, le=5),
        searched(0.0, 2.0, "s", "additional time that the sensors need in this weather"),
    ] = 0.0
    light: Literal["day", "night"] = "day"
    water: Annotated[float, Meta(ge=0, le=20)] = 0.0


class MetricsTable(Table, frozen=True, kw_only=True):
    """Thresholds of the safety metrics.

    `ttc_threshold` is TTC* [s]; `sampling_interval` [s] is the time between two samples that TET,
    TIT and aveDece are computed from (a whole multiple of the simulation's step; by default the
    step). `also` names further metrics: metrics of the package, such as `max_jerk`, or users'
    metrics as `package.module:Name`.
    """

    ttc_threshold: PositiveNumber
    sampling_interval: PositiveNumber | None = None
    also: list[str] = []

    def __post_init__(self) -> None:
        if len({*self.also}) < len(self.also):
            raise mistake(f"also = {self.also}", "each metric once")


class SearchTable(Table, frozen=True, kw_only=True):
    """The search: `runs` runs of each of the `algorithms`, each with `evaluations` simulations, in
    generations of `population`; `seed` is the seed of all random numbers.

    A batch of simulations longer than `time_limit` [s] counts as hung. A setting on which a
    simulator of the user's own fails stops the study, or with `failed` = "skip" is infeasible. The
    search minimises `objectives`, and drives metrics in their unsafe direction. `reference_point`
    is each coordinate of the hypervolume's reference point, for objectives normalised to 0..1 [-].
    `parameters` hold the parameters of algorithms by name or label; a file has them in tables such
    as [search.nsga2].
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
    """Label of an algorithm in results: pymoo_NSGA3 for `pymoo:NSGA3`, the Name of any other
    `package.module:Name`.
    """
    return (
        algorithm.replace(":", "_") if algorithm.startswith(PYMOO) else algorithm.rpartition(":")[2]
    )


class MatrixTest(Table, frozen=True, kw_only=True):
    """A test of a matrix: its `name`, and a scenario at every combination of the values in `over`,
    in each of the `weathers`.

    `parameters` are added to those of the study's scenario; a test with a `model` of its own has
    only its own parameters. A weather is a name or a table. An impact is allowed up to a relative
    speed of `allowed_impact_speed` [km/h], by which the metric `impact_excess` counts.
    """

    name: Annotated[str, Meta(min_length=1)]
    model: str = ""
    parameters: Parameters = {}
    over: Annotated[dict[str, Annotated[list[Any], Meta(min_length=1)]], ORDERED] = {}
    weathers: list[str | Weather] = []
    allowed_impact_speed: Annotated[float, Meta(ge=0, le=250)] = 0.0

    def __post_init__(self) -> None:
        for name in self.parameters.keys() & self.over.keys():
            raise mistake(f"{name} is in parameters and in over", "one of them")


class RatingTable(Table, frozen=True, kw_only=True):
    """A manufacturer's `claims` for a rating: for each test, the robustness layers that cannot be
    simulated here, such as glare.
    """

    claims: dict[str, list[str]] = {}


class MatrixTable(Table, frozen=True, kw_only=True):
    """The test points at which every setting is simulated: those of `tests`, or all cells of a
    `protocol`, which then rates every setting.

    `aggregate` says at which point a setting counts: `worst` at that with the lowest safety degree,
    `drac >` at that with the largest value of this metric, `ttc_min <` with the smallest. With a
    `point`, by its name, only this one is simulated, and nothing is rated.
    """

    tests: list[MatrixTest] = []
    protocol: Literal["", "euro_ncap_2026"] = ""
    point: str = ""
    aggregate: Annotated[str, Meta(pattern=r"^(worst|[A-Za-z][A-Za-z0-9_]{0,63} [<>])\Z")] = WORST

    def __post_init__(self) -> None:
        if bool(self.tests) == bool(self.protocol):
            raise mistake(
                f"{len(self.tests)} tests and protocol = {self.protocol!r}", "tests, or a protocol"
            )
        if self.aggregate != BY_EXCESS and any(test.allowed_impact_speed for test in self.tests):
            problem = f"aggregate = {self.aggregate!r}, and a test allows an impact"
            raise mistake(problem, f"{BY_EXCESS!r}, or no allowed_impact_speed")


class UnsafeTable(Table, frozen=True, kw_only=True):
    """What a study calls unsafe, unless `--unsafe` says otherwise: a `criterion` as of that option,
    its `source`, such as a regulation, and the parts of this source that are `not_simulated`.
    """

    criterion: str = ""
    source: str = ""
    not_simulated: str = ""


class RepairTable(Table, frozen=True, kw_only=True):
    """What a repair of the ADS may change and has to keep.

    `parameters` may change, by name; a file has them directly under [repair]. Without any, those
    that come with a shipped ADS may change. `promise` holds limits by characteristic that the user
    promises to keep, or is "all" for the whole domain; by default the study's limits. `benign` are
    tests in which nobody needs to brake.
    """

    parameters: dict[str, FreeParameter] = {}
    promise: dict[str, Limit] | Literal["all"] = {}
    benign: list[MatrixTest] = []


class Origin(Table, frozen=True, kw_only=True):
    """Where a study comes from; results do not depend on it.

    `called` is the study's path as given on the command line, empty if the study was given by its
    name; `point` is the point of the matrix to which the study was reduced, empty for a whole
    study; `places` are the folders of its file and of the files that it extends, where user code is
    looked up first; `files` are those of these files that are not shipped.
    """

    called: str = ""
    point: str = ""
    places: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


class Study(Table, frozen=True, kw_only=True):
    """A complete study, as in its TOML file; `load_study` reads one.

    `title` is its heading, `weather` a shipped weather by its name, or a table; `matrix` are the
    test points at which the study is simulated, if there are several; `rating` are the user's
    claims for a rating; `step_length` is the simulation's time step [s], by default the time step
    in the network's options; `published` are the original vehicle's metrics in the published study,
    by name, as far as known; `repeatability` are standard deviations of repeats of one setting in
    the published study; `spread` are sets of values of parameters, by their keys in the file, such
    as `ads.parameters.corridor`, that fit the published data equally well, a list for each
    parameter, the study's own value first; `model_error` is the model's further error, by metric,
    for a vehicle that differs from the original by the full width of a domain; `variation` and
    `correlations` state how characteristics vary in the world, by name: uniformly by default;
    `constraints` are conditions that the characteristics of one vehicle satisfy together; `limits`
    are the values, by name, up to which characteristics may wear in service; `unmeasured` are the
    values, by name, of characteristics that were not measured in a vehicle, each a number or a
    table: a study that extends this one does not inherit them; `repair` states what a repair of the
    ADS may change; `wider` names a study of the same vehicle in a wider scope, in which limits are
    tried as well; `unsafe` is what the study calls so.
    """

    # A key without the mark WITHOUT_EFFECT is part of the identity of results.
    name: Name
    title: Annotated[str, WITHOUT_EFFECT, OF_SYSTEM]
    scenario: Annotated[ScenarioTable, PART_OF_SYSTEM, OF_SCENARIO]
    weather: Annotated[str | Weather, PART_OF_SYSTEM] = ""
    vehicle: Annotated[VehicleTable, PART_OF_SYSTEM]
    ads: Annotated[ModelTable, PART_OF_SYSTEM] = ModelTable(model="")
    metrics: MetricsTable
    search: SearchTable
    matrix: Annotated[MatrixTable | None, PART_OF_SYSTEM, OF_SCENARIO] = None
    rating: Annotated[RatingTable, OF_SCENARIO, OF_MATRIX] = RatingTable()
    step_length: Annotated[float, Meta(ge=0.001, le=1)] | None = None
    published: Annotated[dict[str, float], WITHOUT_EFFECT, OF_SYSTEM, WHOLE] = {}
    repeatability: Annotated[
        dict[str, Annotated[float, Meta(gt=0, le=1e6)]], WITHOUT_EFFECT, OF_SYSTEM, WHOLE
    ] = {}
    spread: Annotated[dict[str, list[float]], WITHOUT_EFFECT, OF_VEHICLE_AND_ADS, WHOLE] = {}
    model_error: Annotated[
        dict[str, Annotated[float, Meta(ge=0, le=1e6)]], WITHOUT_EFFECT, OF_VEHICLE_AND_ADS, WHOLE
    ] = {}
    variation: Annotated[dict[str, Distribution], WITHOUT_EFFECT] = {}
    correlations: Annotated[list[Correlation], WITHOUT_EFFECT] = []
    constraints: list[Constraint] = []
    limits: Annotated[dict[str, Limit], WITHOUT_EFFECT] = {}
    unmeasured: Annotated[dict[str, float | UnmeasuredValue], WITHOUT_EFFECT, OF_STUDY] = {}
    repair: Annotated[RepairTable, WITHOUT_EFFECT] = RepairTable()
    wider: Annotated[str, WITHOUT_EFFECT, OF_STUDY] = ""
    unsafe: Annotated[UnsafeTable, WITHOUT_EFFECT] = UnsafeTable()
    origin: Origin = Origin()

    def __post_init__(self) -> None:
        rows = self.vehicle.characteristics
        if not rows:
            raise InputError("", "vehicle.characteristics: none", "at least one")
        if self.scenario.kind:
            raise InputError(
                "", f"scenario.kind = {self.scenario.kind!r}", "no kind: a scenario is no FMU"
            )
        self._check_search()
        check_variation(self.domains, self.variation, self.correlations)
        check_constraints(self.domains, self.constraints)
        check_limits(rows, self.limits, table="limits.")
        check_unmeasured(rows, self.unmeasured_values)
        if len({len(values) for values in self.spread.values()}) > 1 or not all(
            self.spread.values()
        ):
            problem = "spread: its lists differ in length or are empty"
            raise InputError("", problem, "a list for each parameter, all of one length")
        if 0 in self.published.values():
            raise InputError("", f"published = {self.published}", "numbers other than 0")

    def _check_search(self) -> None:
        """Refuse searched parameters that something else sets, too."""
        # Neither a protocol, nor a characteristic, nor a fixed value, nor a test.
        tests = [] if self.matrix is None else self.matrix.tests
        for name in self.scenario.search:
            key = f"scenario.search.{name}"
            if self.matrix is not None and self.matrix.protocol:
                raise InputError(
                    "", f"{key}: the cells of {self.matrix.protocol} are fixed", "matrix.tests"
                )
            if name in self.vehicle.characteristics:
                raise InputError(
                    "", f"{key}: a characteristic of the vehicle has this name", "a unique name"
                )
            if name in self.scenario.parameters:
                value = self.scenario.parameters[name]
                legal = "one of the two: a value, or a domain"
                raise InputError(
                    "", f"{key}: scenario.parameters.{name} = {value!r} fixes it", legal
                )
            for test in tests:
                if name in (*test.parameters, *test.over):
                    problem = f"{key}: test {test.name!r} of the matrix sets {name}, too"
                    raise InputError("", problem, "a domain, or values in the tests")

    @property
    def domains(self) -> dict[str, Domain]:
        """What a search varies: the vehicle's characteristics, then parameters of the scenario."""
        return {**self.vehicle.characteristics, **self.scenario.search}

    @property
    def unmeasured_values(self) -> dict[str, float]:
        """The values of `unmeasured`, without their sources."""
        return {
            name: one.value if isinstance(one, UnmeasuredValue) else one
            for name, one in self.unmeasured.items()
        }

    @property
    def source(self) -> str:
        """The study's name in errors: its file, or its own name if it has no file."""
        return self.origin.called or f"study {self.name!r}"


def tables_of(study: Study) -> Parameters:
    """A study as plain tables as in a file, without its origin and without keys that have their
    default values.
    """
    tables: Parameters = _without_defaults(study)
    tables.pop("origin", None)
    return tables


def _without_defaults(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_defaults(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_without_defaults(inner) for inner in value]
    if not isinstance(value, Table):
        return value
    config = value.__struct_config__
    table = {} if config.tag_field is None else {config.tag_field: config.tag}
    for field in fields_of(type(value)):
        inner = getattr(value, field.name)
        default = (
            field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
        )
        if inner != default:
            table[field.name] = _without_defaults(inner)
    return table


def locate_parameter(tables: Any, name: str) -> tuple[Any, int | str]:
    """The table or list that holds a parameter of a study, and the parameter's key or index in it.

    Raises
    ------
    InputError
        If the study has no such number.
    """
    *path, last = name.split(".")
    table = tables
    try:
        for key in path:
            table = table[_key_or_index(table, key)]
        key_or_index = _key_or_index(table, last)
        is_number = isinstance(table[key_or_index], int | float)
    except (KeyError, IndexError, ValueError, TypeError):
        is_number = path[:1] == ["weather"] and isinstance(
            tables["weather"], str
        )  # a shipped one, looked up later
        key_or_index = last
    if not (is_number and name.startswith(SPREAD_TABLES)):
        expected = (
            "a number that is given under"
            f" {', '.join(prefix.rstrip('.') for prefix in SPREAD_TABLES)}"
        )
        raise InputError("", f"spread.{name!r} is no parameter of the study", expected)
    return table, key_or_index


def _key_or_index(table: Any, name: str) -> int | str:
    """The key in a table, or the index in a list; an index has one spelling, so that each parameter
    has one name.
    """
    return int(name) if isinstance(table, list) and name == str(int(name)) else name


StudyLike = str | Path | Tables | Study
"""A study as its name, the path of its file, its tables, or a `Study`."""
