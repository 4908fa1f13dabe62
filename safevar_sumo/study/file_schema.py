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


def file_schema() -> Parameters:
    """The JSON schema of a study's file; one that extends a study may leave out any key of a table that it refines."""
    tables: Parameters = copy.deepcopy(json_schema(Study)["$defs"])
    del tables["Origin"], tables["Study"]["properties"]["origin"]
    tables = _for_editors(tables)
    study = tables.pop("Study")
    requirements = _requirements(study, tables)  # of a file that extends no study
    # A file states these as a whole: elements of lists, and tables that no study refines.
    whole_parts = [
        part for name, part in study["properties"].items() if name in WHOLE_TABLES or part.get("type") == "array"
    ]
    whole_tables = {"MatrixTest", *re.findall(r'"#/\$defs/(\w+)"', json.dumps(whole_parts))}
    for name, table in tables.items():
        _describe_keys(table, tables)
        if name not in whole_tables:
            table.pop("required", None)
    # A file has the parameters of an algorithm in a table such as [search.nsga2], those of an ADS under [repair].
    tables["SearchTable"]["additionalProperties"] = {"type": "object", "description": "The algorithm's parameters."}
    tables["RepairTable"]["additionalProperties"] = {"$ref": "#/$defs/FreeParameter"}
    del study["required"]
    _describe_keys(study, tables)
    study["properties"] = {"extends": EXTENDS, **study["properties"]}
    return {"$schema": DRAFT, **study, "if": {"required": ["extends"]}, "else": requirements, "$defs": tables}


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
    """The required keys of a table, of the tables that must stand in it, and of its rows."""
    if "$ref" in schema:
        schema = tables[schema["$ref"].rpartition("/")[2]]
    required_keys = schema.get("required", [])
    requirements: Parameters = {"required": list(required_keys)} if required_keys else {}
    inner_tables = {name: _requirements(schema["properties"][name], tables) for name in required_keys}
    if any(inner_tables.values()):
        requirements["properties"] = {name: inner for name, inner in inner_tables.items() if inner}
    rows = schema.get("additionalProperties")
    if isinstance(rows, dict) and (row_requirements := _requirements(rows, tables)):
        requirements["additionalProperties"] = row_requirements
    return requirements


def _describe_keys(table: Parameters, tables: Parameters) -> None:
    """Describe each key: by the docstring of its own table; else by the sentences of the record's docstring that name
    it; else by what its type says; else by the record's first sentence.
    """
    text = " ".join(table["description"].split())
    sentences = re.split(r"(?<=[.;])\s+", text)
    for name, key in table["properties"].items():
        of_table = tables.get(key.get("$ref", "").rpartition("/")[2], {}).get("description")
        of_record = " ".join(sentence.rstrip(";") for sentence in sentences if f"`{name}`" in sentence)
        key["description"] = " ".join((of_table or of_record or key.get("description") or sentences[0]).split())
        if "$ref" in key:  # in draft 7 nothing counts beside a reference
            table["properties"][name] = {"allOf": [{"$ref": key.pop("$ref")}], **key}
    table["description"] = text


def schema_text() -> str:
    """The content of the shipped file."""
    return json.dumps(file_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    STUDY_SCHEMA.write_text(schema_text(), encoding="utf-8")
