"""The originals of the shipped studies and small searches of them, computed in this process; run as a program, renews golden.json."""

from __future__ import annotations

import json
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec

from safevar_sumo.results import RESULTS, load
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.identity import identity_of
from tests.in_process import searched

STUDIES = ("sun", "rain", "lgsvl", "native", "smoke")
FILE = Path(__file__).with_name("golden.json")


def small(name: str) -> Study:
    """A shipped study with a search of a second."""
    study = load_study(name)
    search = msgspec.structs.replace(study.search, algorithms=["nsga2", "rs", "safe_fuzzer"], population=10, evaluations=40, runs=1)
    return msgspec.structs.replace(study, search=search)


def computed(name: str) -> dict[str, Any]:
    """The original vehicle's evaluation, and a digest of the solutions of every algorithm."""
    study = small(name)
    with tempfile.TemporaryDirectory() as folder:
        found = load(searched(study, Path(folder)))
    digests = {algorithm: sha256(rows.to_csv(index=False, lineterminator="\n").encode()).hexdigest()
               for algorithm, rows in found.solutions.groupby("algorithm")}
    return {"original": found.manifest["original"], "solutions": digests}


def platform_here() -> dict[str, str]:
    """The platform as manifests tell it."""
    study = small("native")
    told: dict[str, str] = identity_of(study, assemble(study))["platform"]
    return told


if __name__ == "__main__":
    stored, studies = json.loads(FILE.read_text(encoding="utf-8")), {name: computed(name) for name in STUDIES}
    if studies != stored["studies"] and stored["results"] == RESULTS:
        raise SystemExit(f"results have changed: raise RESULTS in safevar_sumo/results/manifest.py above {RESULTS} first")
    golden = {"platform": platform_here(), "results": RESULTS, "studies": studies}
    FILE.write_text(json.dumps(golden, indent=2) + "\n", encoding="utf-8", newline="\n")
