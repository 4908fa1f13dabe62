"""The verdict: what makes the original vehicle's driving system unsafe, in a few sentences."""

from __future__ import annotations

from typing import Any

import numpy as np

from safevar_sumo.analysis.case import collided
from safevar_sumo.answers import joined
from safevar_sumo.report.findings import Found, least_cause
from safevar_sumo.report.material import Material
from safevar_sumo.results import CHOICES, Handle, chosen_handle, unsafe_rows
from safevar_sumo.showing.comparison import changes_in_words

ASKED = {"fewest": "With the fewest changes", "smallest": "With the smallest changes", "most_severe": "Most severe"}


def verdict(material: Material, explained: Found | None) -> dict[str, Any]:
    """What happened to the original vehicle, and the changes that make it unsafe, the smallest first."""
    case = material.case
    degree = case.original["safety_degree"]
    unsafe = case.solutions[unsafe_rows(case.solutions, degree)]
    hits = bool(collided(case.solutions).any())
    told: dict[str, Any] = {"unsafe": len(unsafe), "solutions": len(case.solutions), "rule": _rule(hits, degree), "findings": [],
                            "original": _original(material), "hits": hits}
    if unsafe.empty and case.solutions.empty:
        told["headline"] = "No solution was found: nothing to tell a failure from."
        return told
    choices = list(CHOICES) if len(unsafe) else ["most_severe"]
    for choice in sorted(choices, key=list(ASKED).index):
        handle = chosen_handle(case.solutions, degree, choice, material.place)
        told["findings"].append(_finding(material, ASKED[choice], handle))
    told["headline"] = _headline(told, explained, material)
    return told


def _rule(hits: bool, degree: float) -> str:
    if hits:
        return "a collision"
    return f"a safety degree below {degree / 2:.2f} m, half of the original's (nothing collides)"


def _original(material: Material) -> str:
    if material.system is None:
        return f"The original vehicle's safety degree is {material.case.original['safety_degree']:.2f} m."
    return f"The original vehicle {material.compared(material.case.characteristics.original).verdict(0)}."


def _headline(told: dict[str, Any], explained: Found | None, material: Material) -> str:
    what = "collide" if told["hits"] else "unsafe"
    if not told["unsafe"]:
        return f"Nothing unsafe was found among {told['solutions']} solutions; the nearest miss is told below."
    if material.original_fails:
        return "No change is needed: the original vehicle itself collides."
    least = least_cause(explained, material) if explained else None
    changes = told["findings"][0]["changes"] if least is None else _changes(material, material.setting_with(least["boundary"]))
    if len(changes) == 1:
        return f"One change is enough to make it {what}: {changes[0]}."
    return f"The fewest changes found that make it {what}: {joined(changes)}."


def _finding(material: Material, title: str, handle: Handle) -> dict[str, Any]:
    setting = material.setting_of(handle)
    changes = _changes(material, setting)
    share = float(material.case.characteristics.largest_change(setting[np.newaxis])[0])
    return {"title": title, "handle": str(handle), "anchor": material.anchor("replay", handle), "changes": changes,
            "end": _end(material, handle, setting), "where": material.where(setting),
            "size": f"{len(changes)} of {len(setting)} characteristics changed, by {share:.0%} at the most"}


def _end(material: Material, handle: Handle, setting: np.ndarray) -> str:
    if material.system is None:
        return f"safety degree {material.solutions[str(handle)]['f_safe']:.2f}"
    comparison = material.compared(setting)
    return comparison.verdict(comparison.rows[-1])


def _changes(material: Material, setting: np.ndarray) -> list[str]:
    return changes_in_words(material.case.characteristics, setting)

