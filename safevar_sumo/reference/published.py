"""How well the shipped studies agree with published data: totals that travel with the package, no row of the data.

`validate STUDY FILE.csv --totals safevar_sumo/reference/published.toml` writes an entry; a page that is mailed quotes it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from safevar_sumo.errors import InputError
from safevar_sumo.reference.agreement import Agreement
from safevar_sumo.results import fixed, write_whole
from safevar_sumo.study import Study, load_study, refuse_other_than_file, study_names

TOTALS = Path(__file__).with_name("published.toml")
WHAT = "How well studies agree with published data: totals, no row of it. Each entry by `validate STUDY FILE --totals THIS_FILE`."
COMPARED = ("scenario", "vehicle", "ads", "weather", "metrics", "step_length", "matrix")
"""Keys of a study that a simulated setting's metrics depend on."""


@dataclass(frozen=True, kw_only=True)
class Totals:
    """Agreement of one study with one file of published data.

    Attributes
    ----------
    rows
        How many settings were compared.
    spearman
        Rank correlation by metric, for those that are defined.
    mean_absolute_error
        By metric, in its unit.
    reference, here, both
        How many of the settings collide in the published data, in this simulation, and in both.
    """

    study: str
    file: str
    rows: int
    spearman: Mapping[str, float]
    mean_absolute_error: Mapping[str, float]
    reference: int
    here: int
    both: int

    @property
    def recall(self) -> float | None:
        """Share of the published collisions that collide here; None if there are none."""
        return self.both / self.reference if self.reference else None

    @property
    def precision(self) -> float | None:
        """Share of the collisions here that are published ones; None if there are none."""
        return self.both / self.here if self.here else None


def quoted(study: Study) -> list[Totals]:
    """What is known of a study's agreement with published data: the entries of shipped studies that simulate the same."""
    names = {name for name in _read(TOTALS) if name in study_names() and _simulates(load_study(name)) == _simulates(study)}
    return [_totals(name, file, entry) for name, files in _read(TOTALS).items() if name in names for file, entry in files.items()]


def keep_totals(path: Path, study: Study, file: str, found: Agreement) -> None:
    """Write, or replace, the entry of one study and one file.

    Raises
    ------
    InputError
        If the file holds something else or cannot be written.
    """
    kept = _read(path) if path.exists() else {}
    entry = {"rows": found.rows, "spearman": _rounded(found.spearman), "mean_absolute_error": _rounded(found.mean_absolute_error),
             "collisions": found.collisions}
    kept = {**kept, study.name: {**kept.get(study.name, {}), file: entry}}
    write_whole(path, f"# {WHAT}\n\n{tomli_w.dumps(kept)}")


def _rounded(values: Mapping[str, float | None]) -> dict[str, float]:
    """To four decimals: more than anybody reads."""
    return {name: round(value, 4) for name, value in values.items() if value is not None}


def _read(path: Path) -> dict[str, dict[str, Any]]:
    refuse_other_than_file(path)
    try:
        kept: dict[str, dict[str, Any]] = tomllib.loads(path.read_text(encoding="utf-8"))
        for name, files in kept.items():
            for file, entry in files.items():
                _totals(name, file, entry)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise InputError(path, "holds no totals", "a new file, or one that `validate --totals` has written") from None
    return kept


def _totals(study: str, file: str, entry: Mapping[str, Any]) -> Totals:
    return Totals(study=study, file=file, rows=entry["rows"], spearman=entry["spearman"], mean_absolute_error=entry["mean_absolute_error"],
                  **{name: entry["collisions"][name] for name in ("reference", "here", "both")})


def _simulates(study: Study) -> dict[str, Any]:
    everything = fixed(study)
    return {name: everything.get(name) for name in COMPARED}
