"""The JSON schema of study files, for editors: made from the records that read them, with what the docstrings say of
each key. `python -m safevar_sumo.study.file_schema` renews the shipped file.
"""

from __future__ import annotations

import copy
import json
import re
from typing import Any

from safevar_sumo.shipped import STUDY_SCHEMA
from safevar_sumo.study.file import WHOLE_TABLES
from safevar_sumo.study.schema import Parameters, Study
from safevar_sumo.study.validation import json_schema

DRAFT = "http://json-schema.org/draft-07/schema#"
"""The latest draft that editors for TOML support."""
EXTENDS = {
    "type": "string",
    "description": "The study that this file extends, by its name or the path of its file; keys of this file "
    "override its keys, table by table.",
}
FMU = {"properties": {"kind": {"const": "fmu"}}, "required": ["kind"]}
"""A vehicle whose rows of characteristics state only what its FMU does not declare."""


def file_schema() -> Parameters:
    """The JSON schema of a study's file; one that extends a study may leave out any key of a table that it refines."""
    tables: Parameters = copy.deepcopy(json_schema(Study)["$defs"])
    del tables["Origin"], tables["Study"]["properties"]["origin"]
    tables = _for_editors(tables)
    study = tables.pop("Study")
    complete = _requirements(study, tables)
    vehicle = complete["properties"]["vehicle"]
    rows = vehicle.pop("properties")
    complete["properties"]["vehicle"] = {**vehicle, "if": FMU, "else": {"properties": rows}}
    complete["properties"]["vehicle"]["required"].remove("characteristics")
    complete["properties"]["vehicle"]["else"]["required"] = ["characteristics"]
    # What a file states as a whole: elements of lists, and tables that no study refines.
    wholes = [part for name, part in study["properties"].items() if name in WHOLE_TABLES or part.get("type") == "array"]
    lasting = {"MatrixTest", *re.findall(r'"#/\$defs/(\w+)"', json.dumps(wholes))}
    for name, table in tables.items():
        _describe_keys(table, tables)
        if name not in lasting:
            table.pop("required", None)
    # A file has the parameters of an algorithm in a table such as [search.nsga2].
    tables["SearchTable"]["additionalProperties"] = {"type": "object", "description": "The algorithm's parameters."}
    tables["RepairTable"]["additionalProperties"] = {
        "$ref": "#/$defs/FreeParameter"
    }  # and those of an ADS under [repair]
    del study["required"]
    _describe_keys(study, tables)
    study["properties"] = {"extends": EXTENDS, **study["properties"]}
    return {"$schema": DRAFT, **study, "if": {"required": ["extends"]}, "else": complete, "$defs": tables}


def _for_editors(schema: Any) -> Any:
    """A schema in words of draft 7, without null, which TOML does not have."""
    if isinstance(schema, list):
        return [_for_editors(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    result = {key: _for_editors(part) for key, part in schema.items() if key != "discriminator"}
    if "prefixItems" in result:
        result["items"] = result.pop("prefixItems")  # as many as `minItems` and `maxItems` say
    if "anyOf" in result:
        result["anyOf"] = [part for part in result["anyOf"] if part != {"type": "null"}]
        if len(result["anyOf"]) == 1:
            result |= result.pop("anyOf")[0]
    if result.get("default", "") is None:
        del result["default"]
    if isinstance(pattern := result.get("pattern"), str):
        result["pattern"] = pattern.replace(r"\Z", "$")
    return result


def _requirements(schema: Parameters, tables: Parameters) -> Parameters:
    """The required keys of a table, and of the tables that must stand in it."""
    if "$ref" in schema:
        schema = tables[schema["$ref"].rpartition("/")[2]]
    required = schema.get("required", [])
    inner = {
        name: _requirements(part, tables) for name, part in schema.get("properties", {}).items() if name in required
    }
    found: Parameters = {"required": list(required)} if required else {}
    if inner := {name: part for name, part in inner.items() if part}:
        found["properties"] = inner
    rows = schema.get("additionalProperties")
    if isinstance(rows, dict) and (of_rows := _requirements(rows, tables)):
        found["additionalProperties"] = of_rows
    return found


def _describe_keys(table: Parameters, tables: Parameters) -> None:
    """Describe each key by the parts of the record's docstring that name it, else by the docstring of its own table or
    the record's first sentence.
    """
    text = " ".join(table["description"].split())
    parts = re.split(r"(?<=[.;])\s+", text)
    for name, part in table["properties"].items():
        about = [sentence.rstrip(";") for sentence in parts if f"`{name}`" in sentence]
        inner = tables.get(part.get("$ref", "").rpartition("/")[2], {}).get("description")
        part["description"] = " ".join((inner or " ".join(about) or part.get("description") or parts[0]).split())
        if "$ref" in part:  # in draft 7 nothing counts beside a reference
            table["properties"][name] = {"allOf": [{"$ref": part.pop("$ref")}], **part}
    table["description"] = text


def schema_text() -> str:
    """The content of the shipped file."""
    return json.dumps(file_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    STUDY_SCHEMA.write_text(schema_text(), encoding="utf-8")
