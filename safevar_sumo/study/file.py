"""Strict reading of study files and of the studies that they extend, and writing of study files."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
from msgspec.structs import replace

from safevar_sumo.errors import InputError, about, did_you_mean, one_of, printable
from safevar_sumo.output import read_file, whole_file
from safevar_sumo.shipped import STUDIES, STUDY_SCHEMA
from safevar_sumo.study.encounters import Parameters
from safevar_sumo.study.extending import StudyTables, table_in, with_overrides
from safevar_sumo.study.schema import (
    NAME_PATTERN,
    OBJECTIVES,
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
"""The first line of a written study file. Editors find the schema on this machine by this line."""


RECORDED = 'scenario.model = "recorded_tracks", with a table of tracks (docs/recorded_tracks.md)'
"""What replaces a scenario that an earlier release read from a file."""
ENDED_KEYS = {
    "scenario.search": (
        '[scenario.over] in its place; and encounters = "ranges", or --ranges, to search it'
    ),
    "wider": "no such key: limits are tried in the ranges of their own study",
    "matrix.point": "--point",
    **dict.fromkeys(("scenario.file", "scenario.values", "scenario.ego"), RECORDED),
    "matrix.protocol": "[[matrix.tests]], as in euro_ncap_pedestrian and euro_ncap_car_to_car",
    "rating": "no such table: Euro NCAP's own calculator computes points",
    "correlations": "no such key: [[constraints]] leave out vehicles that do not occur",
}
"""Keys of earlier releases, with the text that says what replaces each key."""
_IN_RANGES = 'with --ranges or encounters = "ranges"'
ENDED_STUDIES = {
    "wear_joint": f"wear, {_IN_RANGES}",
    "sun_joint": f"sun, {_IN_RANGES}",
    "alks_joint": f"alks at --point cut_in, {_IN_RANGES}",
    "alks_joint_cut_out": f"alks at --point cut_out, {_IN_RANGES}",
    "alks_joint_following": f"alks at --point following, {_IN_RANGES}",
    "comfort": "sun, with a metric of your own (docs/tutorials/own_metric.md)",
    "euro_ncap_rating": "euro_ncap_pedestrian or euro_ncap_car_to_car, Euro NCAP's tests",
}
"""Shipped studies of earlier releases, with the text that says what replaces each study."""


LIKE_A_STUDY = (
    "the name of a study, the path of its file, its tables, or a Study (sv.load_study)"
)
"""What `load_study` reads, for errors."""


def study_names() -> list[str]:
    """Names of the shipped studies."""
    return sorted(path.stem for path in STUDIES.glob("*.toml"))


def study_path(study: str) -> Path:
    """The path of a study's file. `study` is the name of a shipped study, or a path.

    Raises
    ------
    InputError
        If no such study and no such file exists.
    """
    if study in study_names():
        return STUDIES / f"{study}.toml"
    if os.path.isdir(study):
        raise InputError(
            "study",
            f"{study!r} is a directory",
            "the name of a study, or the path of its file (TOML)",
        )
    if study.endswith(".xosc"):
        raise InputError(
            "study", f"{study!r}: such files are not read any more", RECORDED
        )
    if os.path.exists(study):
        return Path(study)
    if study in ENDED_STUDIES:
        raise InputError(
            "study",
            f"{study!r} is a study of releases before 0.5",
            ENDED_STUDIES[study],
        )
    problem = f"there is no study or file {study!r}"
    names = study_names()
    raise InputError(
        "study",
        f"{problem}{did_you_mean(study, names)}",
        f"the path of a study file (TOML), or {one_of(names)}",
    )


def read_tables(study: StudyLike, **changes: Any) -> StudyTables:
    """Read the tables of a study and of the studies that it extends, in the shape of the records.
    `safevar_sumo.scenarios.declared.read_study` then completes and checks the tables.
    """
    raw = _raw_study(study)
    # A study with other encounters is the same study. An override would drop keys that no other
    # study inherits, such as [unmeasured].
    if "encounters" in changes:
        raw = raw._replace(
            tables={**raw.tables, "encounters": changes.pop("encounters")}
        )
    if changes:
        arguments = ", ".join(f"{name}=..." for name in changes)
        raw = with_overrides(
            raw, plain_values(changes), f"{raw.source} with {arguments}"
        )
    with about(raw.source):
        if "origin" in raw.tables:
            raise InputError("", "origin: there is no such key")
        _refuse_ended(raw.tables)
        tables = _with_parameters(raw.tables, "search", SearchTable)
        return raw._replace(tables=_with_parameters(tables, "repair", RepairTable))


def _refuse_ended(tables: Tables) -> None:
    """Refuse keys of earlier releases. The error says what replaces the key."""
    for key, legal in ENDED_KEYS.items():
        # A key without a dot is a key of the study itself, which is the table "" here.
        table, _, name = key.rpartition(".")
        if name in table_in({"": tables, **tables}, table):
            raise InputError("", f"{key} is a key of releases before 0.5", legal)


def plain_values(value: Any) -> Any:
    """Convert values of numpy and pandas into Python's own values, at any depth of tables and
    lists.

    A scalar or an array without dimension becomes a number, a Series with names as index a table,
    and any other Series or array a list.
    """
    if isinstance(value, Mapping):
        return {key: plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    if hasattr(value, "to_dict") and all(isinstance(name, str) for name in value.index):
        return plain_values(value.to_dict())
    if hasattr(value, "tolist"):
        return plain_values(value.tolist())
    return value


def _raw_study(study: StudyLike) -> StudyTables:
    """The tables of a study, from a `Study`, from tables or from a file."""
    if isinstance(study, Study):
        return StudyTables(study.source, tables_of(study), study.origin)
    if isinstance(study, Mapping):
        for key in study:
            if not isinstance(key, str):
                raise InputError("study", f"the key {key!r}", "keys that are texts")
        return _with_base(StudyTables("study", plain_values(study)), Path("."), ())
    if not isinstance(study, str | os.PathLike):
        raise InputError("study", repr(study), LIKE_A_STUDY)
    return _read_file(study_path(str(study)), visited_paths=())


def checked_study(raw: StudyTables) -> Study:
    """Make a study of complete tables. Errors do not name the source: the caller adds it."""
    # An empty list of tests removes the matrix that the study inherits.
    tables = dict(raw.tables)
    vehicle = table_in(tables, "vehicle")
    if table_in(tables, "matrix").get("tests") == []:
        del tables["matrix"]
    if "model" in vehicle and "characteristics" not in vehicle:
        raise _without_characteristics(vehicle["model"])

    # With repeats, the search maximises the share of unsafe runs by default.
    search = table_in(tables, "search")
    if search and table_in(tables, "scenario").get("repeats", 1) != 1:
        tables["search"] = {"objectives": ["unsafe_share", *OBJECTIVES[1:]], **search}
    study = convert_table(tables, Study)
    study.check_axes(study.vehicle.characteristics)
    for name in study.spread:
        locate_parameter(msgspec.to_builtins(study), name)
    return replace(study, origin=raw.origin)


def _without_characteristics(model: object) -> InputError:
    """The error for a vehicle model without characteristics. A study with another model than its
    base does not inherit the base's characteristics.
    """
    models = set()
    for name in study_names():
        tables = tomllib.loads(study_path(name).read_text(encoding="utf-8"))
        models.add(tables.get("vehicle", {}).get("model"))
    models.discard(None)
    problem = (
        f"vehicle.model = {model!r} has no characteristics:"
        " vehicle.characteristics is missing"
    )
    return InputError(
        "",
        f"{problem}{did_you_mean(model, models)}",
        "[vehicle.characteristics] of that model; of a shipped study that is extended, those of"
        f" {one_of(models)}",
    )


def _with_parameters(
    tables: Parameters, name: str, record: type[SearchTable | RepairTable]
) -> Parameters:
    """Move nested tables, such as [search.nsga2] or the tables of [repair], into `parameters` of
    their table. Tables that `record` has as fields stay.
    """
    table = tables.get(name)
    if not isinstance(table, dict) or not isinstance(table.get("parameters", {}), dict):
        return tables

    nested_table = {**table, "parameters": dict(table.get("parameters", {}))}
    for key, value in table.items():
        if isinstance(value, dict) and key not in record.__struct_fields__:
            nested_table["parameters"][key] = nested_table.pop(key)
    return {**tables, name: nested_table}


def _read_file(path: Path, visited_paths: tuple[Path, ...]) -> StudyTables:
    """Read a TOML file and the study that it `extends`. Keys of the file override keys of that
    study, table by table.
    """
    try:
        tables = tomllib.loads(read_file(path).decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        legal = "the path of a study file"
        if isinstance(error, tomllib.TOMLDecodeError):
            legal = "TOML, in which each key stands once"
        raise InputError(path, f"cannot be read as TOML: {reason}", legal) from None

    origin = Origin()
    if path.parent != STUDIES:
        origin = Origin(
            called=str(path),
            places=(str(path.resolve().parent),),
            files=(os.path.abspath(path),),
        )
    return _with_base(StudyTables(path, tables, origin), path, visited_paths)


def _with_base(
    raw: StudyTables, path: Path, visited_paths: tuple[Path, ...]
) -> StudyTables:
    """Put the tables of `raw` over the tables of the study that `raw` extends. The result has the
    folders and files of both studies. Without `extends`, return `raw`.
    """
    tables = dict(raw.tables)
    base = tables.pop("extends", None)
    if base is None:
        return raw
    if not isinstance(base, str):
        raise InputError(
            raw.source, f"extends = {base!r}", "the name or path of a study"
        )

    # A study without a name has the name of its file. A base with a relative path is searched
    # beside this file first.
    if "name" not in tables and re.fullmatch(NAME_PATTERN, path.stem):
        tables["name"] = path.stem
    name_or_path = base
    if os.path.isfile(path.parent / base):
        name_or_path = str(path.parent / base)
    try:
        base_path = study_path(name_or_path)
    except InputError as error:
        raise InputError(
            raw.source, f"extends = {base!r}: {error.problem}", error.legal
        ) from None
    if base_path in (*visited_paths, path):
        raise InputError(
            raw.source, f"extends = {base!r} leads back to {base_path}", "another study"
        )

    base_study = _read_file(base_path, (*visited_paths, path))
    origin = replace(
        raw.origin,
        places=tuple(dict.fromkeys((*raw.origin.places, *base_study.origin.places))),
        files=(*raw.origin.files, *base_study.origin.files),
    )
    merged_study = with_overrides(base_study, tables, raw.source)
    merged_study = merged_study._replace(origin=origin)
    # Shipped studies omit keys on purpose: remarks on them would only confuse the user.
    if path.parent == STUDIES:
        return merged_study._replace(remarks=())
    return merged_study


def write_study(path: Path, study: Study, comment: str) -> None:
    """Write a complete study file as `write_tables` does. The study gets the file's name, if this
    name is a legal name of a study.
    """
    if re.fullmatch(NAME_PATTERN, path.stem):
        study = replace(study, name=path.stem)
    write_tables(path, tables_of(study), comment)


def write_tables(path: Path, tables: Parameters, comment: str) -> None:
    """Write the tables of a study to a file, which begins with `SCHEMA_LINE` and a comment.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    # TOML refuses control characters in comments.
    text = SCHEMA_LINE
    for line in comment.splitlines():
        text += f"# {printable(line)}".rstrip() + "\n"
    text += "\n" + tomli_w.dumps(tables)
    with whole_file(path, "out") as file:
        file.write_text(text, encoding="utf-8")
