"""Parts of a report that take long to compute, kept beside the results that they are about."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from typing import Any

from safevar_sumo.errors import SafevarError
from safevar_sumo.plugins import digest_of
from safevar_sumo.report.material import Material
from safevar_sumo.results import RESULTS, write_whole
from safevar_sumo.results.manifest import MANIFEST
from safevar_sumo.results.store import SOLUTIONS
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import foreign_names, refuse_other_than_file

FOLDER = "answers"
"""Of a results directory."""


def stored(material: Material, name: str, compute: Callable[[], Any]) -> Any:
    """What `compute` gives as plain values; from the results directory if it was computed from the same results before.

    Where the directory cannot be written, or nothing tells which code an answer comes from, nothing is kept.
    """
    if material.changed or ("imported" in material.manifest and foreign_names(material.case.study)):
        return json.loads(json.dumps(compute(), allow_nan=False))
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
    """Results of other content, other options, another package or other files of the study give other answers."""
    digest = sha256(_package().encode())
    for kept in (MANIFEST, SOLUTIONS):
        file = material.place / kept
        content = file.read_bytes() if file.is_file() else b""
        digest.update(len(content).to_bytes(8, "big") + content)
    told = [material.case.finished, material.point, material.options[name]]
    digest.update(repr(told).encode())
    return digest.hexdigest()


@cache
def _package() -> str:
    """Tells versions of this package apart, and states of it between two versions: an answer hangs on more code than results do."""
    files = sorted(PACKAGE.rglob("*.py"))
    return repr([version("safevar_sumo"), RESULTS, [(file.relative_to(PACKAGE).as_posix(), digest_of(file)) for file in files]])
