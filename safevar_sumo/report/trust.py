"""What was not tested, how far to trust it, and how every number is made again."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from safevar_sumo.analysis.explain.necessity import BORDERLINE, is_borderline
from safevar_sumo.analysis.options import RUN
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Outcome
from safevar_sumo.report.findings import Found
from safevar_sumo.report.input import ReportInput
from safevar_sumo.report.verdict import agreement
from safevar_sumo.study import Study, load_study, study_names

NOT_MODELLED = (
    "A search finds failures; that it finds none proves nothing about what it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no single wheels and axles, no suspension, no wind, no sensor "
    "noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: the tables below show how far they agree with published data, where there is any.",
)


def trust(material: ReportInput, explained: Found | None) -> dict[str, Any]:
    """What a reader should hold against the findings of one study."""
    case = material.case
    rows = [{"name": name, "published": case.study.published[name], "here": case.original[name]}
            for name in METRICS if name in case.study.published and not math.isnan(case.original[name])]
    told = []
    failed = int((case.evaluations["outcome"] == str(Outcome.SIMULATOR_ERROR)).sum())
    if failed:
        told.append(f"{failed} of {len(case.evaluations)} settings could not be simulated; they are in no result.")
    invalid = int((case.evaluations["outcome"] == str(Outcome.INVALID_TEST)).sum())
    if invalid:
        told.append(f"{invalid} of {len(case.evaluations)} settings left the tolerance of a test's speed before the driving system acted: "
                    "they are neither failures nor successes.")
    if explained:
        shares = [failure["robustness"] for failure in explained if failure.get("robustness") is not None]
        if shares:
            fragile = sum(map(is_borderline, shares))
            told.append(f"{fragile} of {len(shares)} failures analysed are borderline: "
                        f"fewer than {BORDERLINE:.0%} of their neighbours are unsafe too.")
    if not rows:
        told.append("No published values of the original vehicle are known to hold the study against.")
    return {"published": rows, "told": told, "general": NOT_MODELLED, "agreement": agreement(material)["rows"]}


def reproduce(materials: Sequence[ReportInput], parts: Sequence[str]) -> list[dict[str, str]]:
    """Commands that make the numbers of this page again."""
    places = " ".join(shlex.quote(str(material.place)) for material in materials)
    commands = []
    for material in materials:
        place, study = shlex.quote(str(material.place)), material.case.study
        now = " --as-it-is-now" if material.changed else ""
        if material.case.has_runs:
            commands.append({"what": f"The study {study.name}, as its manifest.json records it whole, into another directory",
                             "command": _again(study, f"{material.place}-again", material.place)})
        commands += [{"what": f"The part {part}", "command": material.options[part].command_line(str(material.place), material.point) + now}
                     for part in parts]
        if material.point:
            continue
        commands.append({"what": "A replay, with figure and animation",
                         "command": f"{RUN} simulate {place} --most-severe --plot it.png --animate it.html{now}"})
    if any(material.point for material in materials):
        return commands
    commands.append({"what": "The tables of RQ1 to RQ3", "command": f"{RUN} tables {places}"})
    commands.append({"what": "The figures", "command": f"{RUN} figures {places} --out figures"})
    return commands


def _again(study: Study, out: str, place: Path) -> str:
    """What carries a study out: the command where it is a shipped one with other options, else what the results record of it."""
    search = study.search
    if study.name in study_names():
        options = {name: getattr(search, name) for name in ("seed", "runs", "evaluations", "algorithms")}
        shipped = load_study(study.name)
        if msgspec.structs.replace(shipped, search=msgspec.structs.replace(shipped.search, **options), origin=study.origin) == study:
            told = {**options, "algorithms": shlex.quote(",".join(search.algorithms)), "out": shlex.quote(out)}
            return " ".join([f"{RUN} study {study.name}", *(f"--{name} {value}" for name, value in told.items())])
    script = f"import safevar_sumo as sv; sv.run(sv.load({json.dumps(str(place))}).study, out={json.dumps(out)}, progress=True)"
    return f"python -c {shlex.quote(script)}"
