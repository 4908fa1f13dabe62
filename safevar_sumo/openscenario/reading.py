"""A concrete file becomes a tree in which every value is a literal, without catalogs."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.openscenario.document import (
    IS_READ,
    Element,
    Parameter,
    attribute,
    check_element,
    check_unique,
    declared,
    refuse_violated,
    root_of,
    unsupported,
    values_of,
    whole,
)
from safevar_sumo.openscenario.expressions import Values, literal
from safevar_sumo.openscenario.guard import guarded

MINORS = (0, 1, 2, 3)
"""Versions 1.0 to 1.3."""


class Document(NamedTuple):
    """A concrete file with every value a literal: its root, its parameters and their values, and
    the paths of the catalogs and the road that it names, "" without one.
    """

    root: Element
    parameters: list[Parameter]
    values: dict[str, str]
    catalogs: list[str]
    road: str


@guarded
def read(file: str, given: Mapping[str, str]) -> Document:
    """Read a concrete file with some of its parameters set.

    Raises
    ------
    InputError
        If the file is no concrete one, or something that it names is not there.
    """
    root = copy.deepcopy(root_of(file))
    header = root.find("FileHeader")
    if root.tag != "OpenSCENARIO" or header is None or header.get("revMajor") != "1":
        raise unsupported(
            f"{file!r} is no OpenSCENARIO XML 1.x", "a file with FileHeader revMajor = 1"
        )
    if whole(header, "revMinor") not in MINORS:
        problem = f"FileHeader: revMinor = {header.get('revMinor')!r}"
        raise unsupported(problem, f"one of {', '.join(map(str, MINORS))}")
    if root.find("Storyboard") is None:
        raise unsupported(
            f"{file!r} has no Storyboard", "a scenario, or a file of parameter values"
        )
    parameters = declared(root)
    values = values_of(parameters, given, {})
    folder = os.path.dirname(file)
    folders = []
    for each in root.findall("CatalogLocations/*/Directory"):
        folders.append(beside(folder, literal(attribute(each, "path"), values)))
    catalogs: list[str] = []
    _resolve(root, values, Library(tuple(folders), catalogs))
    # An orientation without a type is absolute up to version 1.2, and relative from 1.3 on.
    for orientation in root.iter("Orientation"):
        orientation.attrib.setdefault(
            "type", "relative" if whole(header, "revMinor") >= 3 else "absolute"
        )
    check_unique([attribute(one, "name") for one in root.findall("Entities/*")], "entities")
    _name_members(root)
    _mark_values(root)
    logic = root.find("RoadNetwork/LogicFile")
    name = "" if logic is None else logic.get("filepath", "")
    road = name and beside(folder, name)
    if road and not os.path.isfile(road):
        raise unsupported(
            f"the road {road!r} is not there",
            "the path of an OpenDRIVE file, from the file that names it",
        )
    return Document(root, parameters, values, list(dict.fromkeys(catalogs)), road)


def _mark_values(root: Element) -> None:
    """Mark actions that set a parameter or a variable which a condition compares."""
    for kind in ("parameter", "variable"):
        reference = f"{kind}Ref"
        conditions = root.iter(f"{kind.capitalize()}Condition")
        names = {one.get(reference, "").lstrip("$") for one in conditions}
        for action in root.iter(f"{kind.capitalize()}Action"):
            if action.get(reference, "").lstrip("$") in names:
                action.set(IS_READ, "true")


def _name_members(root: Element) -> None:
    """Replace selections of entities (class EntitySelection) by their members, where they act or
    are watched.
    """
    members = {
        attribute(one, "name"): one.findall("Members/EntityRef")
        for one in root.findall("Entities/EntitySelection")
    }
    if root.find("Entities/EntitySelection/Members/ByType") is not None:
        raise unsupported(
            "EntitySelection with ByType is not supported", "EntityRef for each member"
        )
    for parent in root.iter() if members else ():
        if parent.tag in ("Actors", "TriggeringEntities"):
            parent[:] = [
                one for each in parent for one in members.get(each.get("entityRef", ""), [each])
            ]


def beside(folder: str, path: str) -> str:
    """A path that counts from a folder; paths of Windows have slashes, too."""
    return os.path.normpath(os.path.join(folder, path.replace("\\", "/")))


class Library(NamedTuple):
    """Where catalogs are: folders, the files that are read, and the entries that are being read."""

    folders: tuple[str, ...]
    files: list[str]
    entered: tuple[tuple[str, str], ...] = ()


REFERENCES = ("parameterRef", "parameterName", "variableRef")
"""Attributes that name a parameter or a variable, also as `$name`."""
NAMES = ("name", "storyboardElementRef")
"""Attributes that name an element."""
WITHOUT_EFFECT = ("ObjectController", "AssignControllerAction", "EnvironmentAction")
"""Elements that move nobody, whose catalogs may be missing."""


def _resolve(element: Element, values: Values, library: Library) -> None:
    """Replace values and references to catalogs below an element."""
    for key, text in element.attrib.items():
        if "$" in text and key not in REFERENCES:
            try:
                element.set(key, literal(text, values))
            except InputError:
                # The name of what is no entity is a text, whatever it holds, and so is a property.
                is_text = key in NAMES and element.tag != "ScenarioObject"
                if not is_text and element.tag != "Property":
                    raise
    check_element(element)
    for place, child in enumerate(list(element)):
        if child.tag == "ParameterDeclarations":
            continue
        if child.tag == "CatalogReference":
            try:
                element[place] = _referenced(child, values, library)
            except InputError:
                # A vehicle that the file describes itself needs no catalog.
                if element.tag not in WITHOUT_EFFECT and element.find("*/BoundingBox") is None:
                    raise
        else:
            own = declared(child)
            inner = values_of(own, {}, values) if own else values
            refuse_violated(own, inner)
            _resolve(child, inner, library)


def _referenced(child: Element, values: Values, library: Library) -> Element:
    """The entry of a catalog that a reference names, with the values that it assigns."""
    catalog, name = (literal(attribute(child, key), values) for key in ("catalogName", "entryName"))
    if (catalog, name) in library.entered:
        raise unsupported(
            f"the entry {name} of the catalog {catalog} refers to itself", "an entry that does not"
        )
    file, found = _entry(catalog, name, library.folders)
    # Another value of a parameter may choose any of them.
    is_chosen = "$" in attribute(child, "catalogName")
    library.files.extend(_files(library.folders) if is_chosen else [file])
    given = {
        attribute(each, "parameterRef").lstrip("$"): literal(attribute(each, "value"), values)
        for each in child.iter("ParameterAssignment")
    }
    entry = copy.deepcopy(found)
    own = declared(found)
    inner = values_of(own, given, values)
    refuse_violated(own, inner)
    _resolve(entry, inner, library._replace(entered=(*library.entered, (catalog, name))))
    return entry


def _files(folders: Sequence[str]) -> list[str]:
    """The files of catalogs in folders; a folder may be a file itself."""
    paths = [
        path
        for folder in folders
        for path in (
            [os.path.join(folder, name) for name in sorted(os.listdir(folder))]
            if os.path.isdir(folder)
            else [folder]
        )
    ]
    return [path for path in paths if path.endswith(".xosc") and os.path.isfile(path)]


def _entry(catalog: str, entry: str, folders: tuple[str, ...]) -> tuple[str, Element]:
    """The file of a catalog, and its entry of that name; without a catalog of that name a file may
    have it.
    """
    catalogs = {file: root_of(file).find("Catalog") for file in _files(folders)}
    named = [(file, one) for file, one in catalogs.items() if one is not None]
    for names in ([one.get("name") for _, one in named], [Path(file).stem for file, _ in named]):
        if catalog in names:
            file, found = named[names.index(catalog)]
            entries = {each.get("name", ""): each for each in found}
            if entry not in entries:
                raise unsupported(f"the catalog {catalog} has no {entry}", one_of(entries))
            return file, entries[entry]
    raise unsupported(
        f"there is no catalog {catalog} in {', '.join(folders) or 'CatalogLocations'}",
        "a file with it",
    )
