"""The JSON schema of study files, for editors. `python -m tools.study_schema` writes the
shipped file again.
"""

from __future__ import annotations

import json

import msgspec

from safevar_sumo.shipped import STUDY_SCHEMA
from safevar_sumo.study import Study

EXTENDS = {
    "type": "string",
    "description": "The study that this file extends, by its name or the path of its file.",
}


def schema_text() -> str:
    """The content of the shipped schema: the schema of the records with some changes. No key is
    required, because a file may extend a study. Tables of algorithms, and tables of a repair's
    parameters, may have any name.
    """
    schema = msgspec.json.schema(Study)
    tables = schema["$defs"]
    for table in tables.values():
        table.pop("required", None)
    del tables["Origin"], tables["Study"]["properties"]["origin"]
    tables["Study"]["properties"]["extends"] = EXTENDS
    tables["SearchTable"]["additionalProperties"] = {"type": "object"}
    rows = tables["VehicleTable"]["properties"]["characteristics"]
    rows["additionalProperties"] = {
        "anyOf": [rows["additionalProperties"], {"const": False}]
    }
    tables["RepairTable"]["additionalProperties"] = {"$ref": "#/$defs/FreeParameter"}
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    STUDY_SCHEMA.write_text(schema_text(), encoding="utf-8")
