"""A study: which vehicle, driven by which ADS, in which scenario and weather, searched how."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import tomli_w
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.shipped import STUDIES
from safevar_sumo.variation import Correlation, Distribution

Positive = Annotated[float, Meta(gt=0, le=1e6)]
PositiveInt = Annotated[int, Meta(ge=1)]
Weight = Annotated[float, Meta(ge=0, le=1e6)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Parameters = dict[str, Any]
LARGEST = 1e12
"""Of what a characteristic may be, in its unit."""
REPLACED = ("calibration", "published")
"""Tables that a study does not inherit in part from the one that it extends."""
OBJECTIVES = ("safety_degree", "f_diff", "f_num_diff")
"""What the published study minimises."""
T = TypeVar("T")


class CharacteristicTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One row of the characteristics table; the quantities are in `unit`, a change counts `weight` times in f_diff."""

    unit: str
    original: float
    lower: float
    upper: float
    weight: Positive = 1.0


class ModelTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A model by its name, or by `package.module:Name`, and its parameters."""

    model: str
    parameters: Parameters = {}


class VehicleTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle under test: its model, the model's parameters, and what may vary."""

    model: str
    characteristics: dict[str, CharacteristicTable]
    parameters: Parameters = {}


class Weather(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weather as data: what it does to the road and to the sensors.

    `road_friction` and `visibility` are factors on the dry, clear case [-]; `recognition_delay` is by how much later
    than in clear weather an ADS makes somebody out [s].
    """

    name: str
    road_friction: Annotated[float, Meta(gt=0, le=1.5)]
    visibility: Annotated[float, Meta(gt=0, le=1.5)]
    recognition_delay: Annotated[float, Meta(ge=0, le=5)] = 0.0


class MetricsTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Thresholds of the safety metrics.

    `ttc_threshold` is TTC* [s]; `sampling_interval` [s] is the time between two samples that
    TET, TIT and aveDece are computed from (a whole multiple of the simulation's step; by default the step).
    `also` names further metrics as `package.module:Name`.
    """

    ttc_threshold: Positive
    sampling_interval: Positive | None = None
    also: list[str] = []


class SearchTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is searched with: `runs` runs of every algorithm, each with `evaluations` simulations.

    A batch of simulations that takes longer than `time_limit` [s] is taken for hung. `objectives` are minimised, a
    metric in its unsafe direction. `parameters` are those of algorithms, by their labels; in a file they stand in tables
    such as [search.nsga2].
    """

    algorithms: Annotated[list[str], Meta(min_length=1)]
    population: Annotated[int, Meta(ge=2)]
    evaluations: PositiveInt
    runs: PositiveInt
    seed: Seed
    time_limit: Annotated[float, Meta(gt=0, le=86400)] = 300.0
    objectives: Annotated[list[str], Meta(min_length=2, max_length=6)] = msgspec.field(default_factory=lambda: list(OBJECTIVES))
    parameters: dict[str, Parameters] = {}

    @property
    def labels(self) -> dict[str, str]:
        """What the algorithms are called in results, and how the study names them: of `package.module:Name` the Name."""
        return {label_of(name): name for name in self.algorithms}


def label_of(algorithm: str) -> str:
    """What an algorithm is called in results: of `package.module:Name` the Name."""
    return algorithm.rpartition(":")[2]


class MatrixTest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A test of a matrix: its scenario at every combination of the values in `over`, in every one of the weathers.

    `parameters` are added to those of the study's scenario; with another `model` they stand alone.
    """

    name: Annotated[str, Meta(min_length=1)]
    model: str = ""
    parameters: Parameters = {}
    over: dict[str, Annotated[list[Any], Meta(min_length=1)]] = {}
    weathers: list[str] = []


class MatrixTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Several scenario points in which every setting is simulated.

    `aggregate` is what becomes of their safety degrees: that of the point in which the setting comes off worst, or the mean.
    """

    tests: Annotated[list[MatrixTest], Meta(min_length=1)]
    aggregate: Literal["worst", "mean"] = "worst"


class FreeParameter(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A parameter that may be calibrated: its bounds in `unit`, and what it means."""

    lower: float
    upper: float
    unit: str
    meaning: str


class Origin(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a study comes from; no part of what it is.

    `called` is the path that names it on the command line, if its name does not; `places` are the folders of its file and
    of those that it extends, in which its plug-ins are looked up first.
    """

    called: str = ""
    places: tuple[str, ...] = ()


class FitTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How free parameters are found: what counts for how much, which rows are used, and from where the search starts.

    The loss is `original` * mean_m(w_m (miss / (`tolerance` * published))^2) of the original vehicle
    + mean over the files of sum_m(w_m (`rank` (1 - rho) + mean |error| / standard deviation)) + `collisions` * share of rows that
    collide on one side alone, w_m being `weights` by metric. Of every `hold_out` rows one is used for nothing but to be reported.
    `trials` sets of parameters are tried, in generations of `population`: half of them in searches from `starts` random places in
    the bounds, the rest from the better of what these found and the study's own values. `seed` is the seed of all that.
    """

    trials: PositiveInt = 1200
    seed: Annotated[int, Meta(ge=0, le=2**31)] = 1
    starts: Annotated[int, Meta(ge=0, le=1000)] = 0
    population: Annotated[int, Meta(ge=4, le=1000)] = 14
    hold_out: Annotated[int, Meta(ge=2, le=1000)] = 2
    tolerance: Annotated[float, Meta(gt=0, le=1)] = 0.05
    original: Weight = 1.0
    rank: Weight = 5.0
    collisions: Weight = 10.0
    weights: dict[str, Weight] = msgspec.field(
        default_factory=lambda: {"safety_degree": 1.0, "tet": 0.3, "tit": 0.3, "ave_dece": 0.5})


class Study(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole study as its TOML file gives it; `load_study` reads one.

    `matrix` are the scenario points that it is simulated in, if there is more than the one scenario;
    `step_length` is the simulation's time step [s], by default the one of the network's options;
    `published` are the original vehicle's metrics in the published study, by name, as far as there are any;
    `repeatability` are standard deviations of repeats of one setting there;
    `calibration` tells which parameters are free, by their keys in the file, such as `ads.parameters.corridor`, `fit` how they are found;
    `variation` and `correlations` tell how characteristics vary in the world, by name: uniformly where nothing is said.
    """

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*\Z")]
    title: str
    scenario: ModelTable
    weather: str | Weather
    vehicle: VehicleTable
    ads: ModelTable
    metrics: MetricsTable
    search: SearchTable
    matrix: MatrixTable | None = None
    step_length: Annotated[float, Meta(ge=0.001, le=1)] | None = None
    published: dict[str, float] = {}
    repeatability: dict[str, Annotated[float, Meta(gt=0, le=1e6)]] = {}
    fit: FitTable = msgspec.field(default_factory=FitTable)
    calibration: dict[str, FreeParameter] = {}
    variation: dict[str, Distribution] = {}
    correlations: list[Correlation] = []
    origin: Origin = Origin()


def tables_of(study: Study) -> dict[str, Any]:
    """A study as plain tables, without where it comes from: what two equal studies have in common."""
    tables: dict[str, Any] = msgspec.to_builtins(study)
    del tables["origin"]
    return tables


StudyLike = str | Path | Mapping[str, Any] | Study
"""A study by its name, the path of its file, its tables, or itself."""


def study_names() -> list[str]:
    """Names of the studies that come with the package."""
    return sorted(path.stem for path in STUDIES.glob("*.toml"))


def study_path(study: str) -> Path:
    """The file of a study that is given by its name or by a path.

    Raises
    ------
    InputError
        If there is neither such a study nor such a file.
    """
    if study in study_names():
        return STUDIES / f"{study}.toml"
    path = Path(study)
    if is_file(path):
        return path
    legal = f"{one_of(study_names())}, or the path of a study file (TOML)"
    raise InputError("study", f"there is no study or file {study!r}", legal)


def is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long, say
        return False


def load_study(study: StudyLike, **changes: Any) -> Study:
    """Read a study strictly.

    Parameters
    ----------
    study
        Its name, the path of its file, its tables as they would stand in a file, or a study that is to be changed.
    changes
        Keys that override the study's, table by table as in a file that extends it:
        `weather="fog"`, `search={"runs": 2}`.

    Raises
    ------
    InputError
        Naming file, key, value and what is legal.
    """
    source, raw, places = _given(study)
    called = study.origin.called if isinstance(study, Study) else str(source) if places else ""
    return msgspec.structs.replace(_checked(source, _merged(raw, changes)), origin=Origin(called=called, places=places))


def _given(study: StudyLike) -> tuple[object, dict[str, Any], tuple[str, ...]]:
    """What a study is called in errors, its tables, and the folders that they come from."""
    if isinstance(study, Study):
        return f"study {study.name!r}", _without_nothing(tables_of(study)), study.origin.places
    if isinstance(study, Mapping):
        return "study", *_extended(dict(study), Path("."), (), ())
    path = study_path(str(study))
    return path, *_read(path, seen=())


def _checked(path: object, raw: dict[str, Any]) -> Study:
    if "origin" in raw:
        raise InputError(path, "origin: Object contains unknown field `origin`")
    raw = _with_algorithms(raw)
    for key, row in _characteristic_rows(raw):
        _converted(path, row, CharacteristicTable, key)  # before the whole: msgspec does not tell which row of a table is wrong
    parsed = _converted(path, raw, Study)
    for name, row in parsed.vehicle.characteristics.items():
        _check_characteristic(path, f"vehicle.characteristics.{name}", row)
    for name, free in parsed.calibration.items():
        if not (math.isfinite(free.lower) and math.isfinite(free.upper) and free.lower < free.upper):
            raise InputError(path, f"calibration.{name!r}: lower = {free.lower} and upper = {free.upper}", "numbers, lower < upper")
    for name, number in parsed.published.items():
        if number == 0:
            raise InputError(path, f"published.{name} = 0", "a number other than 0")
    _check_finite(path, tables_of(parsed), "")
    return parsed


def _with_algorithms(raw: dict[str, Any]) -> dict[str, Any]:
    """The tables of algorithms, such as [search.nsga2], put where the schema has them."""
    search = raw.get("search")
    if not isinstance(search, dict):
        return raw
    own = {key: value for key, value in search.items() if isinstance(value, dict) and key not in SearchTable.__struct_fields__}
    rest = {key: value for key, value in search.items() if key not in own}
    return {**raw, "search": {**rest, "parameters": {**rest.get("parameters", {}), **own}}} if own else raw


def _converted(source: object, raw: object, table: type[T], prefix: str = "") -> T:
    try:
        return msgspec.convert(raw, table)
    except msgspec.ValidationError as error:
        raise invalid(source, raw, error, prefix) from None


def _characteristic_rows(raw: dict[str, Any]) -> list[tuple[str, object]]:
    vehicle = raw.get("vehicle")
    rows = vehicle.get("characteristics") if isinstance(vehicle, dict) else None
    return [(f"vehicle.characteristics.{name}", row) for name, row in rows.items()] if isinstance(rows, dict) else []


def invalid(source: object, raw: object, error: msgspec.ValidationError, prefix: str = "") -> InputError:
    """Turn msgspec's error on `raw` into one that names the key and its value."""
    problem, _, location = str(error).partition(" - at `$")
    keys = [key for key in location.rstrip("`").replace("[...]", "").split(".") if key]
    value, known = raw, True
    for key in keys:
        known = known and isinstance(value, dict) and key in value
        value = value[key] if known and isinstance(value, dict) else None
    where = ".".join([*([prefix] if prefix else []), *keys])
    if known and where and not isinstance(value, dict):
        return InputError(source, f"{where} = {value!r}", problem)
    return InputError(source, f"{where}: {problem}" if where else problem)


def _read(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Read a TOML file, and the folders that it comes from; what it `extends` comes first, its own keys override table by table."""
    if path in seen:
        raise InputError(path, f"extends = {path.stem!r} leads back to this file", "a study that does not extend this one")
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(path, f"is not TOML: {error}") from None
    except RecursionError:
        raise InputError(path, "is nested too deeply", "a study as in studies/") from None
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text: {error}") from None
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    return _extended(raw, path, seen, () if path.parent == STUDIES else (str(path.resolve().parent),))


def _extended(raw: dict[str, Any], path: Path, seen: tuple[Path, ...], places: tuple[str, ...]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The tables of the study that `raw` extends, overridden by its own, and the folders of both."""
    if "extends" not in raw:
        return raw, places
    base = raw.pop("extends")
    if not isinstance(base, str):
        raise InputError(path, f"extends = {base!r}", "the name or path of a study")
    beside = path.parent / base
    extended, further = _read(beside if is_file(beside) else study_path(base), (*seen, path))
    return _merged(extended, raw), tuple(dict.fromkeys((*places, *further)))


def write_study(path: Path, study: Study, comment: str) -> None:
    """Write a complete study file that begins with a comment.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    tables = {name: value for name, value in _without_nothing(tables_of(study)).items() if value != {}}
    printable = ("".join(character if character.isprintable() else "?" for character in line) for line in comment.splitlines())
    text = "".join(f"# {line}".rstrip() + "\n" for line in printable) + "\n" + tomli_w.dumps(tables)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError("out", f"cannot write {path}: {error.strerror}", "a file in a directory that exists") from None


def check_writable(path: Path, source: str = "out") -> None:
    """Refuse a file that cannot be written before the work whose result it is to take.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    is_new = not path.exists()
    try:
        with path.open("a"):
            pass
        if is_new:
            path.unlink()
    except OSError as error:
        raise InputError(source, f"cannot write {path}: {error.strerror}", "a file in a directory that exists") from None


def _without_nothing(raw: Any) -> Any:
    """TOML has no null: what is not given is left out."""
    return {key: _without_nothing(value) for key, value in raw.items() if value is not None} if isinstance(raw, dict) else raw


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Override `base` by `over`; another `model` or `distribution`, and what may be calibrated, replace the whole table."""
    result = dict(base)
    for key, value in over.items():
        result[key] = _merged(base[key], value) if _refines(key, base.get(key), value) else value
    return result


def _refines(key: str, old: object, new: object) -> bool:
    """Whether a new table changes single keys of the old one."""
    if key in REPLACED or not (isinstance(old, dict) and isinstance(new, dict)):
        return False
    return all(new.get(kind, old.get(kind)) == old.get(kind) for kind in ("model", "distribution"))


def _check_finite(path: object, value: object, key: str) -> None:
    """Refuse nan and infinities wherever they stand."""
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_finite(path, inner, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            _check_finite(path, inner, f"{key}.{i}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(path, f"{key} = {value}", "a finite number")


def _check_characteristic(path: object, key: str, row: CharacteristicTable) -> None:
    values = {"original": row.original, "lower": row.lower, "upper": row.upper}
    for name, value in values.items():
        if not math.isfinite(value):
            raise InputError(path, f"{key}.{name} = {value}", "a finite number")
        if abs(value) > LARGEST:
            raise InputError(path, f"{key}.{name} = {value}", f"a number up to {LARGEST:g}")
    if row.lower >= row.upper:
        raise InputError(path, f"{key}: lower = {row.lower} and upper = {row.upper}", "lower < upper")
    if not row.lower <= row.original <= row.upper:
        raise InputError(path, f"{key}.original = {row.original}", f"a value in [{row.lower}, {row.upper}]")
    if row.original == 0:
        raise InputError(path, f"{key}.original = 0", "a value other than 0: changes are relative to it")
