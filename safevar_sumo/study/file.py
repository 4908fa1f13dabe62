"""Strict reading of study files, with the studies that they extend; writing of study files; and the
names of the user code and FMUs of a study.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomli_w
from msgspec.structs import replace

from safevar_sumo.errors import InputError, about, did_you_mean, one_of
from safevar_sumo.output import whole_file
from safevar_sumo.shipped import STUDIES, STUDY_SCHEMA
from safevar_sumo.study.encounters import Parameters
from safevar_sumo.study.marks import (
    OF_MATRIX,
    OF_SCENARIO,
    OF_STUDY,
    OF_SYSTEM,
    OF_VEHICLE_AND_ADS,
    PART_OF_SYSTEM,
    WHOLE,
    keys_with,
)
from safevar_sumo.study.scenario_file import MODEL, WEATHER, files_of_scenario, with_file
from safevar_sumo.study.schema import (
    NAME_PATTERN,
    OBJECTIVES,
    PYMOO,
    Origin,
    RepairTable,
    SearchTable,
    Study,
    StudyLike,
    Tables,
    locate_parameter,
    tables_of,
)
from safevar_sumo.study.validation import convert_table

SCHEMA_LINE = f"#:schema {STUDY_SCHEMA}\n"
"""First line of a written study file, by which editors find the schema on this machine."""


ENDED_KEYS = {
    "scenario.search": (
        '[scenario.over] in its place; and encounters = "ranges", or --ranges, to search it'
    ),
    "wider": "no such key: limits are tried in the ranges of their own study",
    "matrix.point": "--point",
}
"""Keys that studies had, and what stands in their place."""
ENDED_STUDIES = {
    "wear_joint": "wear",
    "wear_fleet": "wear",
    "sun_joint": "sun",
    "alks_joint": "alks at --point cut_in",
    "alks_joint_cut_out": "alks at --point cut_out",
    "alks_joint_following": "alks at --point following",
}
"""Shipped studies that are a part of another one now."""


class StudyTables(NamedTuple):
    """The tables of a study before they are checked, with its source in errors, its origin, and
    remarks for the user on what they do not inherit.
    """

    source: object
    tables: Parameters
    origin: Origin = Origin()
    remarks: tuple[str, ...] = ()


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
    if os.path.isdir(study):
        legal = "the name of a study, or the path of its file (TOML)"
        raise InputError("study", f"{study!r} is a directory", legal)
    if os.path.exists(study):
        return Path(study)
    if study in ENDED_STUDIES:
        problem = f"{study!r} is the ranges of another study now"
        legal = f'{ENDED_STUDIES[study]}, with --ranges or encounters = "ranges"'
        raise InputError("study", problem, legal)
    problem = f"there is no study or file {study!r}"
    names = study_names()
    legal = f"the path of a study file (TOML), or {one_of(names)}"
    raise InputError("study", f"{problem}{did_you_mean(study, names)}", legal)


def read_tables(study: StudyLike, **changes: Any) -> StudyTables:
    """The tables of a study, with the studies that it extends and the scenario's file, in the shape
    of the records; `safevar_sumo.scenarios.declared.read_study` completes and checks them.
    """
    raw = _raw_study(study)
    if "encounters" in changes:  # is another view of the study, and not another study
        raw = raw._replace(tables={**raw.tables, "encounters": changes.pop("encounters")})
    if changes:
        arguments = ", ".join(f"{name}=..." for name in changes)
        raw = _with_overrides(raw, plain_values(changes), f"{raw.source} with {arguments}")
    with about(raw.source):
        if "origin" in raw.tables:
            raise InputError("", "origin: there is no such key")
        _refuse_ended(raw.tables)
        tables = with_file(raw.tables, raw.origin.places)
        tables = _with_parameters(tables, "search", SearchTable)
        return raw._replace(tables=_with_parameters(tables, "repair", RepairTable))


def _refuse_ended(tables: Tables) -> None:
    """Refuse keys of earlier releases, with what to write instead."""
    for key, legal in ENDED_KEYS.items():
        table, _, name = key.rpartition(".")
        if name in (tables.get(table) or {} if table else tables):
            raise InputError("", f"{key} is a key of releases before 0.5", legal)


def plain_values(value: Any) -> Any:
    """Values of numpy and pandas, at any depth of tables and lists, as Python's own: a scalar or an
    array of no dimension as a number, a Series by names as a table, another Series or array as a
    list.
    """
    if isinstance(value, Mapping):
        return {key: plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    if hasattr(value, "to_dict") and all(isinstance(name, str) for name in value.index):
        return plain_values(value.to_dict())
    return plain_values(value.tolist()) if hasattr(value, "tolist") else value


def _raw_study(study: StudyLike) -> StudyTables:
    if isinstance(study, Study):
        return StudyTables(study.source, tables_of(study), study.origin)
    if isinstance(study, Mapping):
        return _with_base(StudyTables("study", plain_values(study)), Path("."), ())
    return _read_file(study_path(str(study)), visited_paths=())


def checked_study(raw: StudyTables) -> Study:
    """The study of complete tables; the error of a mistake does not name its source."""
    # A table that is empty on purpose drops the one of the base.
    tables = dict(raw.tables)
    matrix = tables.get("matrix")
    vehicle = tables.get("vehicle")
    if isinstance(matrix, dict) and matrix.get("tests") == [] and not matrix.get("protocol"):
        del tables["matrix"]  # of a study that it extends
    if isinstance(vehicle, dict) and "model" in vehicle and "characteristics" not in vehicle:
        raise _without_characteristics(vehicle["model"])

    # With repeats the search maximises the share of unsafe runs.
    scenario, search = tables.get("scenario"), tables.get("search")
    has_repeats = isinstance(scenario, dict) and scenario.get("repeats", 1) != 1
    if has_repeats and isinstance(search, dict):
        tables["search"] = {"objectives": ["unsafe_share", *OBJECTIVES[1:]], **search}

    # Records, and what concerns several of them.
    study = convert_table(tables, Study)
    study.check_axes(study.vehicle.characteristics)
    if study.rating.claims and not study.is_rated:
        raise InputError(
            "", "rating.claims: the study is not rated", "matrix.protocol, or no claims"
        )
    for name in study.spread:
        locate_parameter(msgspec.to_builtins(study), name)
    return replace(study, origin=raw.origin)


def _without_characteristics(model: object) -> InputError:
    """The error for a vehicle without characteristics: another model does not inherit those of the
    study's base.
    """
    texts = (study_path(name).read_text(encoding="utf-8") for name in study_names())

    # The models of shipped studies.
    models = {
        tables["vehicle"]["model"]
        for text in texts
        if "model" in (tables := tomllib.loads(text)).get("vehicle", {})
    }
    problem = (
        f"vehicle.model = {model!r} has no characteristics: vehicle.characteristics is missing"
    )
    legal = (
        "[vehicle.characteristics] of that model; of a shipped study that is extended, those of"
        f" {one_of(models)}"
    )
    return InputError("", f"{problem}{did_you_mean(model, models)}", legal)


def _with_parameters(
    tables: Parameters, name: str, record: type[SearchTable | RepairTable]
) -> Parameters:
    """Move the tables within a table, such as [search.nsga2] and those of [repair], to its
    `parameters`.
    """
    table = tables.get(name)
    if not isinstance(table, dict) or not isinstance(table.get("parameters", {}), dict):
        return tables

    # Tables within the table are parameters.
    inner_tables = {
        key: value
        for key, value in table.items()
        if isinstance(value, dict) and key not in record.__struct_fields__
    }
    other_keys = {key: value for key, value in table.items() if key not in inner_tables}
    parameters = {**other_keys.get("parameters", {}), **inner_tables}
    return {**tables, name: {**other_keys, "parameters": parameters}} if inner_tables else tables


def _read_file(path: Path, visited_paths: tuple[Path, ...]) -> StudyTables:
    """Read a TOML file and the study that it `extends`; keys of the file override that study, table
    by table.
    """
    # The tables of the file.
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        legal = "the path of a study file"
        if isinstance(error, tomllib.TOMLDecodeError):
            legal = "TOML, in which each key stands once"
        raise InputError(path, f"cannot be read as TOML: {reason}", legal) from None

    # Where it comes from.
    folders = () if path.parent == STUDIES else (str(path.resolve().parent),)
    origin = Origin(
        called=str(path) if folders else "",
        places=folders,
        files=(os.path.abspath(path),) if folders else (),
    )
    return _with_base(StudyTables(path, tables, origin), path, visited_paths)


def _with_base(raw: StudyTables, path: Path, visited_paths: tuple[Path, ...]) -> StudyTables:
    """The tables of `raw`, over those of the study that it extends, if any; with the folders of
    both.
    """
    tables = dict(raw.tables)
    base = tables.pop("extends", None)
    if base is None:
        return raw
    if not isinstance(base, str):
        raise InputError(raw.source, f"extends = {base!r}", "the name or path of a study")

    # A study takes its file's name, and its base may stand beside it.
    if "name" not in tables and re.fullmatch(NAME_PATTERN, path.stem):
        tables["name"] = path.stem
    sibling = path.parent / base
    try:
        base_path = study_path(str(sibling) if os.path.isfile(sibling) else base)
    except InputError as error:
        raise InputError(raw.source, f"extends = {base!r}: {error.problem}", error.legal) from None
    if base_path in (*visited_paths, path):
        raise InputError(
            raw.source, f"extends = {base!r} leads back to {base_path}", "another study"
        )

    # This study's tables over those of its base.
    base_study = _read_file(base_path, (*visited_paths, path))
    merged_study = _with_overrides(base_study, tables, raw.source)

    # Where both come from.
    folders = tuple(dict.fromkeys((*raw.origin.places, *base_study.origin.places)))
    remarks = (
        () if path.parent == STUDIES else merged_study.remarks
    )  # shipped studies leave keys out on purpose
    files = (*raw.origin.files, *base_study.origin.files)
    return merged_study._replace(
        origin=Origin(called=raw.origin.called, places=folders, files=files), remarks=remarks
    )


def _with_overrides(base: StudyTables, overrides: Tables, source: object) -> StudyTables:
    """Override a study's tables, but for those that the new study does not inherit: their marks in
    the records say when; of another weather not the axes of its parameters.
    """
    # Keys about this one study, and keys about its scenario, if the overrides name another one.
    left_out = {*keys_with(OF_STUDY, Study)}
    if _names_scenario(overrides.get("scenario"), base.tables.get("scenario")):
        left_out.update(keys_with(OF_SCENARIO, Study))
    inherited = {key: value for key, value in base.tables.items() if key not in left_out}
    scenario = inherited.get("scenario")
    if isinstance(scenario, dict) and "over" in scenario:
        inherited["scenario"] = _with_axes_for(overrides, scenario)
    tables = _merge(inherited, overrides)

    # Keys about the parts of the system that differ now.
    parts = [
        key
        for key in keys_with(PART_OF_SYSTEM, Study)
        if _model_and_network(tables.get(key)) != _model_and_network(inherited.get(key))
    ]
    marks = [OF_SYSTEM] if parts else []
    marks += [OF_VEHICLE_AND_ADS] if {"vehicle", "ads"} & {*parts} else []
    marks += [OF_MATRIX] if "matrix" in parts else []
    for key in {key for mark in marks for key in keys_with(mark, Study)} - overrides.keys():
        tables.pop(key, None)

    # A study without a title of its own is called by its name.
    if parts or base.tables.get("title", "") == base.tables.get("name"):
        tables["title"] = overrides.get("title", tables.get("name", ""))
    remarks = base.remarks
    dropped = [
        f"[{key}]"
        for key, value in base.tables.items()
        if isinstance(value, dict)
        and key not in {*tables, *keys_with(OF_STUDY, Study)}  # which no study inherits
    ]
    lost = _set_in(base.tables.get("scenario")) - _set_in(tables.get("scenario"))
    dropped += [f"{name} of [scenario]" for name in sorted(lost)]
    if parts and dropped:
        differences = " and a different ".join("ADS" if key == "ads" else key for key in parts)
        of_base = f"than {base.tables.get('name')!r}, so not its {', '.join(dropped)}"
        remarks = (*remarks, f"{source}: has a different {differences} {of_base}")
    return StudyTables(source, tables, base.origin, remarks)


def _with_axes_for(overrides: Tables, scenario: Parameters) -> Parameters:
    """A table [scenario] that a study inherits: of another weather without the axes of its
    parameters, and for the cells of a protocol, which are fixed, without any.
    """
    matrix = overrides.get("matrix")
    if isinstance(matrix, dict) and matrix.get("protocol"):
        return {key: value for key, value in scenario.items() if key not in ("over", "margin")}
    names = scenario["over"].keys() - (WEATHER if "weather" in overrides else ())
    return {
        **scenario,
        "over": {name: scenario["over"][name] for name in scenario["over"] if name in names},
    }


def _names_scenario(table: object, base_table: object) -> bool:
    """Whether a table [scenario] names a file or another model than that of its base, whose matrix
    is not about it.
    """
    if not isinstance(table, dict):
        return False
    base_model = base_table.get("model") if isinstance(base_table, dict) else None
    return "file" in table or table.get("model", base_model) != base_model


def _set_in(scenario: object) -> set[str]:
    """The parameters that a table [scenario] sets or searches."""
    inner_tables = scenario.values() if isinstance(scenario, dict) else ()
    return {name for table in inner_tables if isinstance(table, dict) for name in table}


def _model_and_network(table: object) -> object:
    """The model and network that a table names; instead of a model, a weather or matrix itself."""
    if not isinstance(table, dict):
        return table
    parameters = table.get("parameters")
    return table.get("model", table), (
        parameters.get("network") if isinstance(parameters, dict) else None
    )


def _merge(base: Tables, overrides: Tables) -> Parameters:
    """Override `base` by `overrides`; another `model` or `distribution`, and the tables
    that are inherited as a whole, replace a whole table; false in place of a table leaves it out.
    """
    result = dict(base)
    for key, value in overrides.items():
        if value is False and isinstance(result.get(key), dict):
            del result[key]
            continue
        result[key] = _merge(base[key], value) if _refines(key, base.get(key), value) else value
    return result


def _refines(key: str, base_value: object, override: object) -> bool:
    """Whether an override changes single keys of the table that it overrides."""
    if key in keys_with(WHOLE, Study) or not (
        isinstance(base_value, dict) and isinstance(override, dict)
    ):
        return False
    return all(
        override.get(choice, base_value.get(choice)) == base_value.get(choice)
        for choice in ("model", "distribution")
    )


def write_study(path: Path, study: Study, comment: str) -> None:
    """Write a complete study file that begins with `SCHEMA_LINE` and a comment; the study takes the
    file's name if that is a legal name of a study.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    if re.fullmatch(NAME_PATTERN, path.stem):
        study = replace(study, name=path.stem)

    # A comment of printable characters.
    lines = (
        "".join(character if character.isprintable() else "?" for character in line)
        for line in comment.splitlines()
    )
    text = (
        SCHEMA_LINE
        + "".join(f"# {line}".rstrip() + "\n" for line in lines)
        + "\n"
        + tomli_w.dumps(tables_of(study))
    )
    with whole_file(path, "out") as file:
        file.write_text(text, encoding="utf-8")


def user_code_names(study: Study) -> list[str]:
    """The keys of a study that name user code, such as `ads.model = 'my_ads:Careful'`."""
    return [f"{key} = {name!r}" for key, name in (*user_code(study), *fmus_of(study))]


def without_skipping(study: Study) -> Study:
    """A study that stops where its simulator fails."""
    search = msgspec.structs.replace(study.search, failed="stop")
    return msgspec.structs.replace(study, search=search)


def fmus_of(study: Study) -> list[tuple[str, str]]:
    """Key and path of a study's FMU."""
    return [("ads.model", study.ads.model)] if study.ads.kind == "fmu" else []


def user_modules(study: Study) -> list[str]:
    """The modules of a study's user code."""
    return sorted({name.partition(":")[0] for _, name in user_code(study)})


def user_code(study: Study) -> list[tuple[str, str]]:
    """Keys and names of a study's user code."""
    tests = [test.model for test in study.tests]
    names_by_key = {
        "vehicle.model": [study.vehicle.model],
        "ads.model": [study.ads.model],
        "scenario.model": [study.scenario.model, *tests],
        "metrics.also": study.metrics.also,
        "search.objectives": study.search.objectives,
        "search.algorithms": [
            name for name in study.search.algorithms if not name.startswith(PYMOO)
        ],
    }
    fmus = fmus_of(study)
    return [
        (key, name)
        for key, names in names_by_key.items()
        for name in dict.fromkeys(names)
        if ":" in name and (key, name) not in fmus
    ]


def data_files(study: Study) -> dict[str, str]:
    """The paths of the data files and folders that a study names, by their names.

    Raises
    ------
    InputError
        If one of them does not exist.
    """
    places = study.origin.places or (os.getcwd(),)
    paths = {}

    # Each file or folder beside the study.
    for key, table in (
        ("vehicle", study.vehicle),
        ("ads", study.ads),
        ("scenario", study.scenario),
    ):
        for name in table.files:
            found = [
                os.path.abspath(path) for place in places if (path := Path(place, name)).exists()
            ]
            if not found:
                problem = f"{key}.files: there is no file {name!r}"
                raise InputError(
                    study.source, problem, f"the path of a file or folder, relative to {places[0]}"
                )
            paths[name] = found[0]

    # Files of OpenSCENARIO, at every point of the matrix.
    if study.scenario.model == MODEL:
        tests = study.tests
        with about(study.source):
            paths |= files_of_scenario(study.scenario.parameters, tests, study.origin.places)
    return paths
