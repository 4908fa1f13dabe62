"""Parts of a report that take long to compute, kept beside the results that they are about."""

from __future__ import annotations

import json
from collections.abc import Callable
from hashlib import sha256
from importlib.metadata import version
from typing import Any

from safevar_sumo.errors import SafevarError
from safevar_sumo.report.material import Material
from safevar_sumo.results import write_whole
from safevar_sumo.results.manifest import MANIFEST
from safevar_sumo.results.store import SOLUTIONS
from safevar_sumo.study import refuse_other_than_file

FOLDER = "answers"
"""Of a results directory."""


def stored(material: Material, name: str, compute: Callable[[], Any]) -> Any:
    """What `compute` gives as plain values; from the results directory if it was computed from the same results before.

    Where the directory cannot be written, nothing is kept.
    """
    at = f"-{material.anchor(material.point)}" if material.point else ""
    file, identity = material.place / FOLDER / f"{name}{at}.json", _identity(material, name)
    try:
        refuse_other_than_file(file)
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["identity"] == identity:
            return kept["value"]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # never computed, or not by us: it is computed now
    text = json.dumps({"identity": identity, "value": compute()}, indent=1, allow_nan=False) + "\n"
    try:
        file.parent.mkdir(exist_ok=True)
        write_whole(file, text)
    except (OSError, SafevarError):
        pass  # a report from results on a read-only disk is a report all the same
    return json.loads(text)["value"]


def _identity(material: Material, name: str) -> str:
    """Results of other content, other options, or another version of this package give other answers."""
    digest = sha256(version("safevar_sumo").encode())
    for kept in (MANIFEST, SOLUTIONS):
        file = material.place / kept
        content = file.read_bytes() if file.is_file() else b""
        digest.update(len(content).to_bytes(8, "big") + content)
    digest.update(repr(material.case.finished).encode() + material.point.encode() + repr(material.options[name]).encode())
    return digest.hexdigest()
