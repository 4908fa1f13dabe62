"""The tables of a study: vehicle, ADS, scenario, weather, metrics and search; and the folders of its files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct

from safevar_sumo.errors import unknown_name
from safevar_sumo.shipped import STUDIES
from safevar_sumo.study.characteristics import (
    CharacteristicTable,
    Constraint,
    Correlation,
    Distribution,
    Limit,
    PositiveNumber,
)

PositiveInt = Annotated[int, Meta(ge=1, le=10_000_000)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Parameters = dict[str, Any]
Tables = Mapping[str, Any]
"""A study's tables, as in a file."""
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*\Z"
Name = Annotated[
    str, Meta(pattern=NAME_PATTERN, description="letters, digits, _, . and -, the first a letter or digit")
]
SAFETY_DEGREE: Final = "safety_degree"
"""Column and key of the safety degree."""
OBJECTIVES = (SAFETY_DEGREE, "f_diff", "f_num_diff")
"""Objectives of the published study."""
FMU_KEYS = ("kind", "inputs", "outputs")
"""Keys of a model's table that only FMUs use, except the first one: an ADS that is no FMU may have a `kind`."""
DESCRIPTION_KEYS = ("meaning", "counterpart")
"""Keys that describe a characteristic to people; no result depends on them."""


class ModelTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `model` by its name, or by `package.module:Name`, and its `parameters`.

    An ADS of the `kind` `traci` is a controller written for SUMO's TraCI; an ADS of the kind `fmu` is an FMU, named by
    its path: `inputs` and `outputs` are the FMU's variables by the quantity they receive or return. `files` are data
    files, or folders of them, that a model of your own reads, relative to the study's file.
    """

    model: str
    parameters: Parameters = {}
    kind: Literal["", "traci", "fmu"] = ""
    inputs: dict[str, str] = {}
    outputs: dict[str, str] = {}
    files: list[str] = []


class VehicleTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle under test: its `model`, the model's `parameters`, and the `characteristics` that vary.

    `files` are data files, or folders of them, that a model of your own reads, relative to the study's file.
    """

    model: str
    characteristics: dict[str, CharacteristicTable]
    parameters: Parameters = {}
    files: list[str] = []


class Weather(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weather as data: its `name`, and its effects on the road and on the sensors.

    `road_friction` and `visibility` are factors relative to the dry, clear case [-]; on a `wet` road worn treads lose
    further friction. `recognition_delay` is the additional time that the sensors need to recognise a road user [s], for
    every ADS; the reaction time of an ADS is one of its parameters. `light` decides only whether a rating darkens the
    weather for its tests by night.
    """

    name: str
    road_friction: Annotated[float, Meta(gt=0, le=1.5)]
    visibility: Annotated[float, Meta(gt=0, le=1.5)]
    recognition_delay: Annotated[float, Meta(ge=0, le=5)] = 0.0
    light: Literal["day", "night"] = "day"
    wet: bool = False


class MetricsTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Thresholds of the safety metrics.

    `ttc_threshold` is TTC* [s]; `sampling_interval` [s] is the time between two samples that
    TET, TIT and aveDece are computed from (a whole multiple of the simulation's step; by default the step).
    `also` names further metrics: metrics of the package, such as `max_jerk`, or users' metrics as
    `package.module:Name`.
    """

    ttc_threshold: PositiveNumber
    sampling_interval: PositiveNumber | None = None
    also: list[str] = []


class SearchTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The search: `runs` runs of each of the `algorithms`, each with `evaluations` simulations, in generations of
    `population`; `seed` is the seed of all random numbers.

    A batch of simulations longer than `time_limit` [s] counts as hung. The search minimises `objectives`, and drives
    metrics in their unsafe direction. `parameters` hold the parameters of algorithms by label; a file has them in
    tables such as [search.nsga2].
    """

    algorithms: Annotated[list[str], Meta(min_length=1)]
    population: Annotated[int, Meta(ge=2, le=100_000)]
    evaluations: PositiveInt
    runs: Annotated[int, Meta(ge=1, le=100_000)]
    seed: Seed
    time_limit: Annotated[float, Meta(gt=0, le=86400)] = 300.0
    objectives: Annotated[list[str], Meta(min_length=2, max_length=6)] = msgspec.field(
        default_factory=lambda: list(OBJECTIVES)
    )
    parameters: dict[str, Parameters] = {}

    @property
    def labels(self) -> dict[str, str]:
        """Names of the study's algorithms by their labels in results (see `label_of`)."""
        return {label_of(name): name for name in self.algorithms}


def label_of(algorithm: str) -> str:
    """Label of an algorithm in results: the Name of `package.module:Name`."""
    return algorithm.rpartition(":")[2]


class MatrixTest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A test of a matrix: its `name`, and a scenario at every combination of the values in `over`, in each of the
    `weathers`.

    `parameters` are added to those of the study's scenario; a test with a `model` of its own has only its own
    parameters. A weather is a name or a table.
    """

    name: Annotated[str, Meta(min_length=1)]
    model: str = ""
    parameters: Parameters = {}
    over: dict[str, Annotated[list[Any], Meta(min_length=1)]] = {}
    weathers: list[str | Weather] = []


class RatingTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A manufacturer's `claims` for a rating: for each test, the robustness layers that cannot be simulated here, such
    as glare.
    """

    claims: dict[str, list[str]] = {}


class MatrixTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The test points at which every setting is simulated: those of `tests`, or all cells of a `protocol`, which then
    rates every setting.

    `aggregate` combines the points' safety degrees: `worst` takes the lowest one.
    """

    tests: list[MatrixTest] = []
    protocol: Literal["", "euro_ncap_2026"] = ""
    aggregate: Literal["worst"] = "worst"


class FreeParameter(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A parameter that may change: its bounds `lower` and `upper` in `unit`, and its `meaning`.

    The search measures distances of values as differences, or with `log` as ratios, for positive quantities of unknown
    magnitude.
    """

    lower: float
    upper: float
    unit: str
    meaning: str
    log: bool = False


class RepairTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a repair of the ADS may change and has to keep.

    `parameters` may change, by name; a file has them directly under [repair]. Without any, those that come with a
    shipped ADS may change. `promise` holds limits by characteristic that the user promises to keep, or is "all" for the
    whole domain; by default the study's limits. `benign` are tests in which nobody needs to brake.
    """

    parameters: dict[str, FreeParameter] = {}
    promise: dict[str, Limit] | Literal["all"] = {}
    benign: list[MatrixTest] = []


class Origin(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a study comes from; results do not depend on it.

    `called` is the study's path as given on the command line, empty if the study was given by its name; `point` is the
    point of the matrix to which the study was reduced, empty for a whole study; `places` are the folders of its file
    and of the files that it extends, where user code is looked up first; `files` are those of these files that are not
    shipped; `remarks` are for the user.
    """

    called: str = ""
    point: str = ""
    places: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


class Study(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A complete study, as in its TOML file; `load_study` reads one.

    `title` is its heading, `weather` a shipped weather by its name, or a table;
    `matrix` are the test points at which the study is simulated, if there are several;
    `rating` are the user's claims for a rating;
    `step_length` is the simulation's time step [s], by default the time step in the network's options;
    `published` are the original vehicle's metrics in the published study, by name, as far as known;
    `repeatability` are standard deviations of repeats of one setting in the published study;
    `spread` are sets of values of parameters, by their keys in the file, such as `ads.parameters.corridor`, that fit
    the published data equally well, a list for each parameter, the study's own value first; `model_error` is the
    model's further error, by metric, for a vehicle that differs from the original by the full width of a domain;
    `variation` and `correlations` state how characteristics vary in the world, by name: uniformly by default;
    `constraints` are conditions that the characteristics of one vehicle satisfy together; `limits` are the values, by
    name, up to which characteristics may wear in service; `repair` states what a repair of the ADS may change.
    """

    # A new key that changes no result of a campaign also belongs in KEYS_WITHOUT_EFFECT_ON_RESULTS of
    # results/manifest.py. Any other new key becomes part of the identity of results: let `evaluation_keys` there omit
    # its default, so that older results keep their identity.
    name: Name
    title: str
    scenario: ModelTable
    weather: str | Weather
    vehicle: VehicleTable
    ads: ModelTable
    metrics: MetricsTable
    search: SearchTable
    matrix: MatrixTable | None = None
    rating: RatingTable = RatingTable()
    step_length: Annotated[float, Meta(ge=0.001, le=1)] | None = None
    published: dict[str, float] = {}
    repeatability: dict[str, Annotated[float, Meta(gt=0, le=1e6)]] = {}
    spread: dict[str, list[float]] = {}
    model_error: dict[str, Annotated[float, Meta(ge=0, le=1e6)]] = {}
    variation: dict[str, Distribution] = {}
    correlations: list[Correlation] = []
    constraints: list[Constraint] = []
    limits: dict[str, Limit] = {}
    repair: RepairTable = RepairTable()
    origin: Origin = Origin()

    @property
    def source(self) -> str:
        """The study's name in errors: its file, or its own name if it has no file."""
        return self.origin.called or f"study {self.name!r}"


def tables_of(study: Study) -> Parameters:
    """A study as plain tables, without its origin and without keys that it does not use."""
    tables: Parameters = msgspec.to_builtins(study)
    del tables["origin"]
    for name in ("constraints", "limits", "repair"):
        if not tables[name]:
            del tables[name]  # so that results from before these tables existed stay the same bytes
    for name in ("ads", "scenario"):
        if tables[name]["kind"] != "fmu":
            tables[name] = {key: value for key, value in tables[name].items() if key not in FMU_KEYS[1:]}
    return tables


StudyLike = str | Path | Tables | Study
"""A study as its name, the path of its file, its tables, or a `Study`."""


def study_names() -> list[str]:
    """Names of the shipped studies."""
    return sorted(path.stem for path in STUDIES.glob("*.toml"))


def study_path(study: str) -> Path:
    """The file of a study given by name or path.

    Raises
    ------
    InputError
        If there is neither such a study nor such a file.
    """
    if study in study_names():
        return STUDIES / f"{study}.toml"
    if os.path.exists(study):
        return Path(study)
    problem = f"there is no study or file {study!r}"
    raise unknown_name("study", problem, study, study_names(), ", or the path of a study file (TOML)")
