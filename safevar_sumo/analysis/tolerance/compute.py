"""How far may each characteristic go, alone, in pairs, and all together?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.analysis.criterion import Unsafe, usual_in
from safevar_sumo.analysis.evaluator import Bench, Progress, open_bench, silent
from safevar_sumo.analysis.tolerance.one_at_a_time import OneAtATimeScan, scan
from safevar_sumo.analysis.tolerance.pairs import Pair, planes
from safevar_sumo.analysis.tolerance.safe_box import SafeBox, no_box, safe_box
from safevar_sumo.errors import unknown
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.workers.evaluation import Pool


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far characteristics may go; `pairs` is None if nobody asked for them."""

    study: Study
    unsafe: Unsafe
    original: Evaluations
    alone: list[OneAtATimeScan]
    pairs: list[Pair] | None
    joint: SafeBox

    @property
    def verdict(self) -> str:
        """What is unsafe by itself, in one sentence."""
        single = [one.characteristic.name for one in self.alone if one.unsafe]
        double = [" with ".join(member.name for member in pair.characteristics) for pair in self.pairs or [] if pair.nearest is not None]
        if self.unsafe.of(self.original)[0]:
            return "The original vehicle itself is unsafe."
        if single:
            return f"Unsafe alone: {', '.join(single)}."
        if self.pairs is None:
            return "No single characteristic makes it unsafe."
        if double:
            return f"No single characteristic makes it unsafe, but {len(double)} of {len(self.pairs)} pairs: {', '.join(double)}."
        return "No single characteristic and no pair makes it unsafe."

    def frame(self) -> pd.DataFrame:
        """One row for each characteristic alone.

        Columns: `characteristic`, `unit`, `original`, `lower` and `upper` of the domain, `safe_from`, `safe_to` [unit],
        `margin_from`, `margin_to`, the safety degrees there [m], and `unsafe` and `not_simulated`, lists of intervals.
        """
        return pd.DataFrame([{
            "characteristic": one.characteristic.name, "unit": one.characteristic.unit, "original": one.characteristic.original,
            "lower": one.characteristic.lower, "upper": one.characteristic.upper,
            **dict(zip(("safe_from", "safe_to"), one.safe or (None, None), strict=True)),
            **dict(zip(("margin_from", "margin_to"), one.margins, strict=True)), "unsafe": one.unsafe,
            "not_simulated": one.not_simulated} for one in self.alone])

    def record(self) -> dict[str, Any]:
        """As `tolerance --json` prints it."""
        return {"study": self.study.name, "unsafe": str(self.unsafe), "alone": [one.record() for one in self.alone],
                "pairs": [pair.record() for pair in self.pairs or []], "joint": self.joint.record()}

    def __repr__(self) -> str:
        return f"<Tolerance of {self.study.name}, unsafe {self.unsafe}: {self.verdict}>"


def find_tolerances(study: Study, *, unsafe: str | None = None, characteristics: Sequence[str] | None = None, pairs: bool = False,
              pool: Pool | None = None, jobs: int | None = None, progress: Progress = silent) -> Tolerance:
    """Find how far the characteristics of a study may go. Nothing is filtered: this is about the vehicle, not about a search.

    Parameters
    ----------
    unsafe
        `collision` or `below=X`; by default a collision if one of many settings all over the domain is one, else half of
        the original's safety degree.
    characteristics
        Which ones vary, by default all: alone, in pairs, and together in the joint box; the others are the original's.
    pairs
        Whether pairs are looked at too.
    pool, jobs
        Where to simulate: a pool, or that many worker processes (by default one for each core).
    progress
        Is told what is done.

    Raises
    ------
    InputError
        If `unsafe` or a name cannot be used, or the study cannot be assembled.
    """
    means, columns = Unsafe.given(unsafe), _columns(study, characteristics)
    with open_bench(study, pool, jobs, progress) as bench:
        original = bench.original()
        means = means or usual_in(bench, original)
        alone = scan(bench, columns, means)
        both = planes(bench, columns, means) if pairs else None
        is_safe = not means.of(original)[0]
        box = safe_box(bench, columns, means, _known(bench, alone, both or [])) if is_safe else no_box(bench, columns)
    return Tolerance(study=study, unsafe=means, original=original, alone=alone, pairs=both, joint=box)


def _columns(study: Study, characteristics: Sequence[str] | None) -> list[int]:
    names = list(study.vehicle.characteristics)
    for name in characteristics or ():
        if name not in names:
            raise unknown("characteristics", f"there is no characteristic {name!r}", name, names)
    return [column for column, name in enumerate(names) if characteristics is None or name in characteristics]


def _known(bench: Bench, alone: Sequence[OneAtATimeScan], pairs: Sequence[Pair]) -> FloatArray:
    """The unsafe settings that are known, shape (K, n)."""
    names, original = bench.characteristics.names, bench.characteristics.original
    known = [{one.characteristic.name: value} for one in alone for interval in one.unsafe for value in interval]
    known += [dict(zip((member.name for member in pair.characteristics), pair.nearest, strict=True)) for pair in pairs if pair.nearest]
    settings = np.tile(original, (len(known), 1))
    for row, values in enumerate(known):
        for name, value in values.items():
            settings[row, names.index(name)] = value
    return settings
