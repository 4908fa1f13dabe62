"""Reading study files strictly, with the studies that they extend, and writing them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomli_w

from safevar_sumo.errors import InputError, refuse_other_than_file
from safevar_sumo.shipped import STUDIES
from safevar_sumo.study.schema import NAME, Origin, SearchTable, Study, StudyLike, is_file, study_path, tables_of
from safevar_sumo.study.validation import converted, implausible, refuse, unusable

REPLACED = ("calibration", "published", "repeatability", "spread", "model_error")
"""Tables that a study inherits as a whole or not at all."""
OF_ONE_SYSTEM = ("title", "published", "repeatability")
"""Keys that hold for one vehicle, ADS, scenario, network, weather and matrix; a study with another one does not inherit them."""


class _Raw(NamedTuple):
    """Unchecked tables of a study, and their origin."""

    source: object
    tables: dict[str, Any]
    origin: Origin = Origin()


def load_study(study: StudyLike, **changes: Any) -> Study:
    """Read a study strictly.

    Parameters
    ----------
    study
        The study's name, the path of its file, its tables as in a file, or a study to change.
    changes
        Keys that override the study's, table by table as in a file that extends it:
        `weather="fog"`, `search={"runs": 2}`.

    Raises
    ------
    InputError
        Naming file, key, value and what is expected.
    """
    raw = _raw(study)
    return _checked(_overridden(raw, changes, raw.source) if changes else raw)


def _raw(study: StudyLike) -> _Raw:
    if isinstance(study, Study):
        return _Raw(study.source, without_nulls(tables_of(study)), study.origin)
    if isinstance(study, Mapping):
        return _extended(_Raw("study", dict(study)), Path("."), ())
    return _read(study_path(str(study)), seen=())


def _checked(raw: _Raw) -> Study:
    refuse(unusable(raw.source, raw.tables))
    tables = _with_fmu(raw, of_today(raw.tables))
    remarks = raw.origin.remarks
    if tables.get("ads") != raw.tables.get("ads"):
        remarks = (*remarks, f"{raw.source}: weather.hesitation is read as ads.parameters.hesitation")
    study = converted(raw.source, _with_algorithms(tables), Study)
    refuse(implausible(raw.source, study))
    return msgspec.structs.replace(study, origin=msgspec.structs.replace(raw.origin, remarks=remarks))


def of_today(tables: dict[str, Any]) -> dict[str, Any]:
    """Tables of any earlier version in the present form: `hesitation`, once the weather's, is a parameter of the driving system."""
    weather, ads = tables.get("weather"), tables.get("ads")
    if not (isinstance(weather, dict) and "hesitation" in weather and isinstance(ads, dict)):
        return tables
    tables = {**tables, "weather": {key: value for key, value in weather.items() if key != "hesitation"}}
    parameters = ads.get("parameters", {})
    if weather["hesitation"] and isinstance(parameters, dict):
        tables["ads"] = {**ads, "parameters": {**parameters, "hesitation": weather["hesitation"]}}
    return tables


def _with_fmu(raw: _Raw, tables: dict[str, Any]) -> dict[str, Any]:
    """A study's tables, with rows of characteristics completed from the parameters that the vehicle's FMU declares."""
    vehicle = tables.get("vehicle")
    if not isinstance(vehicle, dict) or vehicle.get("kind") != "fmu" or not isinstance(model := vehicle.get("model"), str):
        return tables
    stated, fixed = vehicle.get("characteristics", {}), vehicle.get("parameters", {})
    if not isinstance(stated, dict) or not isinstance(fixed, dict) or not all(isinstance(row, dict) for row in stated.values()):
        return tables
    from safevar_sumo.fmu.description import description_of, file_of  # only a study with an FMU needs FMPy

    complete = stated and all({"unit", "original", "lower", "upper"} <= row.keys() for row in stated.values())
    if complete and not file_of(model, raw.origin.places):
        return tables  # results without their FMU can be read
    declared = description_of(model, raw.origin.places, str(raw.source), "vehicle.model")
    rows = {**declared.rows(fixed), **{name: {**declared.row(name, str(row.get("unit", ""))), **row} for name, row in stated.items()}}
    return {**tables, "vehicle": {**vehicle, "characteristics": rows}}


def _with_algorithms(raw: dict[str, Any]) -> dict[str, Any]:
    """Move the tables of algorithms, such as [search.nsga2], to `search.parameters`."""
    search = raw.get("search")
    if not isinstance(search, dict) or not isinstance(search.get("parameters", {}), dict):
        return raw
    of_algorithms = {key: value for key, value in search.items() if isinstance(value, dict) and key not in SearchTable.__struct_fields__}
    others = {key: value for key, value in search.items() if key not in of_algorithms}
    return {**raw, "search": {**others, "parameters": {**others.get("parameters", {}), **of_algorithms}}} if of_algorithms else raw


def _read(path: Path, seen: tuple[Path, ...]) -> _Raw:
    """Read a TOML file and the study that it `extends`; its own keys override table by table."""
    if path in seen:
        raise InputError(path, f"extends = {path.stem!r} leads back to this file", "a study that does not extend this one")
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(path, f"is not TOML: {error}") from None
    except (RecursionError, OverflowError):
        raise InputError(path, "is nested too deeply", "a study as in studies/") from None
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text: {error}") from None
    except ValueError as error:  # an integer of too many digits
        raise InputError(path, f"cannot be read: {error}") from None
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    places = () if path.parent == STUDIES else (str(path.resolve().parent),)
    return _extended(_Raw(path, tables, Origin(called=str(path) if places else "", places=places)), path, seen)


def _extended(raw: _Raw, path: Path, seen: tuple[Path, ...]) -> _Raw:
    """The tables of the study that `raw` extends, overridden by those of `raw`, with the folders of both."""
    refuse(unusable(raw.source, raw.tables))
    tables = dict(raw.tables)
    base = tables.pop("extends", None)
    if base is None:
        return raw
    if not isinstance(base, str):
        raise InputError(raw.source, f"extends = {base!r}", "the name or path of a study")
    if "name" not in tables and re.fullmatch(NAME, path.stem):
        tables["name"] = path.stem
    beside = path.parent / base
    try:
        base_path = beside if is_file(beside) else study_path(base)
    except InputError as error:
        raise InputError(raw.source, f"extends = {base!r}: {error.problem}", error.legal) from None
    extended = _read(base_path, (*seen, path))
    merged = _overridden(extended, tables, raw.source)
    places = tuple(dict.fromkeys((*raw.origin.places, *extended.origin.places)))
    remarks = () if path.parent == STUDIES else merged.origin.remarks  # shipped studies leave keys out on purpose
    return merged._replace(origin=msgspec.structs.replace(merged.origin, called=raw.origin.called, places=places, remarks=remarks))


def _overridden(base: _Raw, overrides: Mapping[str, Any], source: object) -> _Raw:
    """Override a study's tables; another system does not inherit the keys `OF_ONE_SYSTEM`."""
    tables = _merged(base.tables, overrides)
    other = [key for key in ("weather", "vehicle", "ads", "scenario", "matrix") if _kind(tables.get(key)) != _kind(base.tables.get(key))]
    remarks = base.origin.remarks
    if other:
        dropped = [key for key in OF_ONE_SYSTEM[:2] if key in base.tables and key not in overrides]
        tables = {**{key: value for key, value in tables.items() if key not in OF_ONE_SYSTEM}, "title": tables.get("name", ""),
                  **{key: overrides[key] for key in OF_ONE_SYSTEM if key in overrides}}
        if "vehicle" in other or "ads" in other:  # both are about their parameters
            tables = {key: value for key, value in tables.items() if key in overrides or key not in ("spread", "model_error")}
        if dropped:
            remarks = (*remarks, f"{source}: has another {' and another '.join(other)} than study {base.tables.get('name')!r}, so it does "
                                 f"not inherit that study's {' and '.join(f'[{key}]' for key in dropped)}")
    return _Raw(source, tables, msgspec.structs.replace(base.origin, remarks=remarks))


def _kind(table: object) -> object:
    """The model and network of a table, or the weather or matrix itself."""
    if not isinstance(table, dict):
        return table
    parameters = table.get("parameters")
    return table.get("model", table), parameters.get("network") if isinstance(parameters, dict) else None


def _merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Override `base` by `overrides`; another `model` or `distribution`, and the tables `REPLACED`, replace a whole table."""
    result = dict(base)
    for key, value in overrides.items():
        result[key] = _merged(base[key], value) if _refines(key, base.get(key), value) else value
    return result


def _refines(key: str, old: object, new: object) -> bool:
    """Whether a new table changes single keys of the old one."""
    if key in REPLACED or not (isinstance(old, dict) and isinstance(new, dict)):
        return False
    return all(new.get(kind, old.get(kind)) == old.get(kind) for kind in ("model", "distribution"))


def without_nulls(raw: Any) -> Any:
    """Tables without null values, which TOML does not have."""
    return {key: without_nulls(value) for key, value in raw.items() if value is not None} if isinstance(raw, dict) else raw


def write_study(path: Path, study: Study, comment: str) -> None:
    """Write a complete study file that begins with a comment; the study takes the file's name if that is a legal one.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    if re.fullmatch(NAME, path.stem):
        study = msgspec.structs.replace(study, name=path.stem)
    tables = {name: value for name, value in without_nulls(tables_of(study)).items() if value != {}}
    printable = ("".join(character if character.isprintable() else "?" for character in line) for line in comment.splitlines())
    text = "".join(f"# {line}".rstrip() + "\n" for line in printable) + "\n" + tomli_w.dumps(tables)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError("out", f"cannot write {path}: {error.strerror}", "a file in a directory that exists") from None


def check_writable(path: Path, source: str = "out") -> None:
    """Refuse an output file that cannot be written, before the work begins.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    try:
        refuse_other_than_file(path, source, streams=True)
        is_new = not path.exists()
        with path.open("a"):
            pass
        if is_new:
            path.unlink()
    except OSError as error:
        raise InputError(source, f"cannot write {path}: {error.strerror}", "a file in a directory that exists") from None
