"""Files of OpenSCENARIO XML: a concrete one becomes a tree in which every value is a literal."""

from __future__ import annotations

import copy
import os
import tomllib
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import ParseError, parse

from safevar_sumo.errors import InputError, one_of, unknown_name
from safevar_sumo.openscenario.expressions import Values, compare, literal
from safevar_sumo.openscenario.guard import guarded

Element: TypeAlias = "ElementTree.Element[str]"

FILE_KEY = ""
"""Who reads a file names it, and the study."""
LEGAL = tomllib.loads(Path(__file__).with_name("legal.toml").read_text(encoding="utf-8"))
"""The words of an enumeration, or `SIZE`, by attribute."""
SIZE = "at least 0"


MOST = 1e9
"""Largest size of a number: beyond it sums lose their places."""
MOST_DEPTH = 100
"""Elements within each other at most; the schemas need fewer than 30."""


def unsupported(problem: str, legal: str) -> InputError:
    """The refusal of a file, in a sentence that names the element."""
    return InputError(FILE_KEY, problem, legal)


def root_of(file: str) -> Element:
    """The root of an XML file, without entities; the caller does not change it."""
    try:
        stamp = os.stat(file)
    except OSError as error:
        raise unsupported(
            f"{file!r} cannot be read: {error.strerror}", "the path of a file"
        ) from None
    return _parsed(file, stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=64)
def _parsed(file: str, modified: int, size: int) -> Element:
    try:
        root: Element = parse(file, forbid_dtd=True).getroot()
        for element in root.iter():
            element.tag = element.tag.rpartition("}")[2]  # without a namespace
        level = [root]
        for _ in range(MOST_DEPTH):
            level = [child for element in level for child in element]
        if level:
            problem = f"{file!r} has elements within each other, {MOST_DEPTH} and more"
            raise unsupported(problem, f"up to {MOST_DEPTH}")
        return root
    except DefusedXmlException as error:
        problem = f"{file!r} has a document type or entities ({type(error).__name__})"
        raise unsupported(problem, "XML without them") from None
    except (ParseError, ValueError, LookupError, OSError) as error:
        raise unsupported(
            f"{file!r} is no XML: {error}", "a file of OpenSCENARIO or OpenDRIVE"
        ) from None


def attribute(element: Element, name: str) -> str:
    """An attribute that an element must have."""
    value = element.get(name)
    if value is None:
        raise unsupported(f"{element.tag} has no {name}", f"{name} = ..., as the schema says")
    return value


def number(element: Element, name: str, default: float | None = None) -> float:
    """A number of an element, or the default if the element does not have it."""
    if default is not None and name not in element.attrib:
        return default
    text = literal(attribute(element, name), {})
    if not is_number(text):
        raise unsupported(
            f"{element.tag}: {name} = {text[:80]!r}", f"a finite number, at most {MOST:g}"
        )
    return float(text)


def is_number(text: str) -> bool:
    """Whether a text is a number that is not too large."""
    try:
        return "_" not in text and abs(float(text)) <= MOST
    except ValueError:
        return False


def whole(element: Element, name: str) -> int:
    """A whole number of an element."""
    value = number(element, name)
    if value != round(value):
        raise unsupported(f"{element.tag}: {name} = {value:g}", "a whole number")
    return round(value)


def _check(element: Element) -> None:
    """Refuse a word that an enumeration does not have, and a negative size (a rate has no sign)."""
    for name, value in element.attrib.items():
        legal = LEGAL.get(f"{element.tag}.{name}", LEGAL.get(name))
        is_transition = name == "value" and element.get("dynamicsDimension", "rate") != "rate"
        if legal == SIZE or is_transition:
            if number(element, name) < 0:
                raise unsupported(f"{element.tag}: {name} = {value!r}", f"a number of {SIZE}")
        elif legal and value not in legal:
            raise unsupported(f"{element.tag}: {name} = {value!r}", one_of(legal))


def truth(element: Element, name: str) -> bool:
    """A truth value of an element; it is false if the element does not have it."""
    return element.get(name) in ("true", "1")


def part(element: Element, path: str) -> Element:
    """The element at a path that must be there; with `/*` at its end the first one below."""
    found = element.find(path)
    if found is None:
        raise unsupported(
            f"{element.tag} has no {path}", f"the element {path} in it, as the schema says"
        )
    return found


class Parameter(NamedTuple):
    """A declared parameter, its value as written, whether it is a whole number, and its
    constraints: groups of a rule and a limit each.
    """

    name: str
    text: str
    is_whole: bool
    groups: tuple[tuple[tuple[str, str], ...], ...]


WHOLE = ("integer", "int", "unsignedInt", "unsignedShort")
"""Types of whole numbers."""
GROUPS_OF_CONSTRAINTS = ("ConstraintGroup", "ValueConstraintGroup")
"""Elements of a parameter's constraints: by the schema, and by its class."""


def declared(element: Element) -> list[Parameter]:
    """The parameters that an element declares."""
    found = [
        Parameter(
            attribute(each, "name").lstrip("$"),
            attribute(each, "value"),
            each.get("parameterType") in WHOLE,
            tuple(
                tuple((attribute(rule, "rule"), attribute(rule, "value")) for rule in group)
                for group in each
                if group.tag in GROUPS_OF_CONSTRAINTS
            ),
        )
        for each in element.findall("ParameterDeclarations/ParameterDeclaration")
    ]
    check_unique([parameter.name for parameter in found], "parameters")
    for rule in element.iterfind("ParameterDeclarations/*/*/*"):
        _check(rule)
    return found


def check_unique(names: Sequence[str], kind: str) -> None:
    """Refuse a name that several of a kind have."""
    for name, count in Counter(names).items():
        if count > 1:
            raise unsupported(f"{count} {kind} are named {name!r}", "a name of its own for each")


def values_of(parameters: Sequence[Parameter], given: Values, outer: Values) -> dict[str, str]:
    """Values by name: those given, otherwise those declared, which may use names that were declared
    before.
    """
    names = [parameter.name for parameter in parameters]
    for name in given:
        if name not in names:
            raise unknown_name(FILE_KEY, f"the file declares no parameter {name}", name, names)
    values = dict(outer)
    for parameter in parameters:
        values[parameter.name] = literal(given.get(parameter.name, parameter.text), values)
    return values


def refuse_violated(parameters: Sequence[Parameter], values: Values) -> None:
    """Refuse values that violate a constraint."""
    if problems := violated(parameters, values):
        raise unsupported(
            f"the file's constraints exclude {', '.join(problems)}", "values that they allow"
        )


def violated(parameters: Sequence[Parameter], values: Values) -> list[str]:
    """The values that violate a constraint, as `name = value`.

    By the standard (class ParameterDeclaration) one group must hold whole; the files of UN R157
    write limits that must all hold as groups of their own. So several groups are joined by "or" if
    they are all `equalTo`, else by "and".
    """
    problems = []
    for name, _, _, groups in parameters:
        results = [
            all(compare(rule, values[name], literal(limit, values)) for rule, limit in group)
            for group in groups
        ]
        has_choices = all(rule == "equalTo" for group in groups for rule, _ in group)
        if results and not (any(results) if has_choices else all(results)):
            problems.append(f"{name} = {values[name]}")
    return problems


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
    logic = root.find("RoadNetwork/LogicFile")
    name = "" if logic is None else logic.get("filepath", "")
    road = name and beside(folder, name)
    if road and not os.path.isfile(road):
        raise unsupported(
            f"the road {road!r} is not there",
            "the path of an OpenDRIVE file, from the file that names it",
        )
    return Document(root, parameters, values, list(dict.fromkeys(catalogs)), road)


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
    _check(element)
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
        raise unsupported(f"the entry {name} of the catalog {catalog} refers to itself", "another")
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
