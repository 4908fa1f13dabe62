"""Files of OpenSCENARIO XML: a concrete one becomes a tree in which every value is a literal."""

from __future__ import annotations

import os
import tomllib
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import ParseError, parse

from safevar_sumo.errors import InputError, one_of, unknown_name
from safevar_sumo.openscenario.expressions import Values, compare, literal

Element: TypeAlias = "ElementTree.Element[str]"

FILE_KEY = ""
"""Who reads a file names it, and the study."""
LEGAL = tomllib.loads(Path(__file__).with_name("legal.toml").read_text(encoding="utf-8"))
"""The words of an enumeration, or `SIZE`, by attribute."""
CHILDREN: dict[str, list[str]] = LEGAL.pop("children")
"""What an element may have in it, by its tag: with `*` more than once."""
CHOICES: list[str] = LEGAL.pop("choices")["names"]
"""Elements that have exactly one in them."""
NEEDED = {"ConditionGroup": "Condition", "Event": "Action"}
"""What an element must have in it, by its tag."""
SIZE = "at least 0"


MOST = 1e9
"""Largest size of a number: beyond it sums lose their places."""
MOST_DEPTH = 100
"""Elements within each other at most; the schemas need fewer than 30."""


IS_READ = "isRead"
"""Attribute of an action that sets what a condition compares."""


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


def check_element(element: Element) -> None:
    """Refuse a word that an enumeration does not have, a negative size (a rate has no sign), and
    elements in it that the schema does not have there.
    """
    _check_children(element)
    for name, value in element.attrib.items():
        legal = LEGAL.get(f"{element.tag}.{name}", LEGAL.get(name))
        is_transition = name == "value" and element.get("dynamicsDimension", "rate") != "rate"
        if legal == SIZE or is_transition:
            if number(element, name) < 0:
                raise unsupported(f"{element.tag}: {name} = {value!r}", f"a number of {SIZE}")
        elif legal and value not in legal:
            raise unsupported(f"{element.tag}: {name} = {value!r}", one_of(legal))


def _check_children(element: Element) -> None:
    tags = Counter(child.tag for child in element)
    legal = CHILDREN.get(element.tag)
    if element.tag in CHOICES and len(element) != 1:
        raise unsupported(f"{element.tag} has {len(element)} elements in it", "one")
    if element.tag in NEEDED:
        part(element, NEEDED[element.tag])
    for tag, count in tags.items():
        if legal is None or f"{tag}*" in legal:
            continue
        if tag not in legal:
            problem = f"{element.tag} has a {tag} in it"
            raise unsupported(problem, one_of(name.rstrip("*") for name in legal))
        if count > 1:
            raise unsupported(f"{element.tag} has {count} of {tag}", "one")


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
        check_element(rule)
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
