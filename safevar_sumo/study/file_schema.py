"""The JSON schema of study files, for editors. `python -m safevar_sumo.study.file_schema` renews
the shipped file.
"""

from __future__ import annotations

import json

import msgspec

from safevar_sumo.shipped import STUDY_SCHEMA
from safevar_sumo.study.schema import Study

EXTENDS = {
    "type": "string",
    "description": "The study that this file extends, by its name or the path of its file.",
}
FROM_FILE = {
    "file": {
        "type": "string",
        "description": "A file of OpenSCENARIO, in place of model and parameters.",
    },
    "ego": {"type": "string", "description": "The vehicle under test in the file, by default Ego."},
    "values": {"type": "object", "description": "Values of the file's parameters."},
}


def schema_text() -> str:
    """The content of the shipped file: the records' schema, in which a file that extends a study
    may leave out any key; the tables of algorithms and of a repair's parameters have names of their
    own.
    """
    schema = msgspec.json.schema(Study)
    tables = schema["$defs"]
    for table in tables.values():
        table.pop("required", None)
    del tables["Origin"], tables["Study"]["properties"]["origin"]
    tables["Study"]["properties"]["extends"] = EXTENDS
    tables["SearchTable"]["additionalProperties"] = {"type": "object"}
    rows = tables["VehicleTable"]["properties"]["characteristics"]
    rows["additionalProperties"] = {"anyOf": [rows["additionalProperties"], {"const": False}]}
    tables["RepairTable"]["additionalProperties"] = {"$ref": "#/$defs/FreeParameter"}
    tables["ScenarioTable"]["properties"] |= FROM_FILE
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    STUDY_SCHEMA.write_text(schema_text(), encoding="utf-8")
