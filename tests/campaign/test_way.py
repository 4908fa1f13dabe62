"""The way of a setting from the search to solutions.csv is the one that the manual lists."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import FrameType
from typing import Any

from safevar_sumo.study import load_study
from tests.in_process import searched

ROOT = Path(__file__).parents[2]
PACKAGE = f"{ROOT / 'safevar_sumo'}/"
ENDS = {
    "vehicles/characteristics.py": (
        "CharacteristicSet.filter",
        "CharacteristicSet.largest_change",
        "CharacteristicSet.number_changed",
    ),
    "vehicles/base.py": ("Vehicle.at_start",),
    "vehicles/carla.py": ("Carla.prepare", "Carla.sense", "Carla.advance"),
    "scenarios/published.py": ("PedestrianCrossing.observe", "PedestrianCrossing.encounter"),
    "ads/published.py": ("WorldOnRails.drive",),
    "sumo/perception.py": ("Perception.observe",),
    "sumo/recorded_world.py": ("RecordedWorld.enter", "RecordedWorld.step"),
    "sumo/bodies.py": ("Contacts.count",),
    "sumo/batch.py": ("_Log.write", "_Log.trace", "_Outcomes.judge", "_Outcomes.classify"),
    "metrics/base.py": ("Metric.__call__",),
    "results/journal.py": ("Journal.append", "Journal.finish"),
    "results/store.py": ("evaluations_frame",),
    "results/manifest.py": ("write_whole",),
}
"""Where a setting, or what became of it, leaves the package's way: into a model, a metric, or a file."""
BESIDE = "_verify"
"""Verification takes a way of its own."""


def functions_on_the_stack(frame: FrameType | None) -> list[tuple[str, str]]:
    """The package's functions on the stack, up to the campaign, which a worker may carry out elsewhere."""
    functions = []
    while frame is not None:
        file, name = frame.f_code.co_filename, frame.f_code.co_qualname
        if file.startswith(PACKAGE) and not frame.f_code.co_name.startswith("<"):
            functions.append((file.removeprefix(PACKAGE), name))
        frame = frame.f_back
    return functions


def listed() -> set[tuple[str, str]]:
    """The functions in the table of the manual: a file in the second column, its functions in the third."""
    section = (ROOT / "docs/architecture.md").read_text().partition("## The path of a value")[2].partition("\n## ")[0]
    rows = re.findall(r"^\|.*\| `([\w/]+\.py)` \| (.+) \|$", section, re.MULTILINE)
    return {(file, name) for file, names in rows for name in re.findall(r"`([\w.]+)`", names)}


def test_the_way_of_a_setting_is_the_one_in_the_manual(tmp_path: Path) -> None:
    study = load_study("rain", search={"algorithms": ["nsga2"], "population": 4, "evaluations": 8, "runs": 1})
    way = set[tuple[str, str]]()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            file, name = frame.f_code.co_filename, frame.f_code.co_qualname
            if file.startswith(PACKAGE) and name in ENDS.get(file.removeprefix(PACKAGE), ()):
                functions = functions_on_the_stack(frame)
                names = [name for _, name in functions]
                if BESIDE not in names and ("carry_share" in names or "ResultsDirectory.finish" in names):
                    start = names.index("carry_share" if "carry_share" in names else "ResultsDirectory.finish")
                    way.update(functions[: start + 1])

    sys.setprofile(note)
    try:
        searched(study, tmp_path)
    finally:
        sys.setprofile(None)
    assert way == listed()
    assert len(way) <= 40
