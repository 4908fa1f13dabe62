"""Do conclusions hold with the other vehicle models that fit the published data about as well (sets of [spread])?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator, Interval
from safevar_sumo.analysis.explain.causes import MinimalCause, find_minimal_causes, necessity_frame
from safevar_sumo.analysis.preventability import Preventability, assess_preventability
from safevar_sumo.analysis.words import number_of, share_in_words
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray, JsonObject

MAX_SHARE_SETS = 8
"""Maximum number of sets with which shares are computed; the first sets lie farthest apart."""
MAX_VEHICLES = 300
"""Maximum number of vehicles, drawn at random, that are simulated with each set; the reference drivers meet their
collisions.
"""
MAX_FAILURES = 20
"""Maximum number of failures, those with the fewest changes, whose minimal causes are found with each set."""
STAGE = "other fitted vehicle models"


class AcrossFits(NamedTuple):
    """Ranges of shares over the parameter sets of a study's table [spread].

    A range is the share with the study's own parameters, plus the least and the greatest difference that another set
    makes on a sample.

    Attributes
    ----------
    sets
        Number of parameter sets with which the shares were computed, the study's own among them.
    unsafe
        Range of the share of settings that are unsafe.
    necessary
        Range of the share of failures that need a characteristic, by its name.
    preventable
        Range of the share of collisions in each category of drivers, and `later`, by name; empty without a collision.
    """

    sets: int
    unsafe: Interval
    necessary: Mapping[str, Interval]
    preventable: Mapping[str, Interval]

    def __str__(self) -> str:
        competent = self.preventable.get("competent_driver")
        avoided = f"; a competent driver avoids {_in_words(competent)} of the collisions" if competent else ""
        return (
            f"With {number_of(self.sets, 'vehicle model')} that fit the published data about as well, "
            f"{_in_words(self.unsafe)} of the vehicles are unsafe{avoided}."
        )

    def to_dict(self) -> JsonObject:
        """The entry `across_fits` of a summary in JSON: the ranges under the names of the shares."""

        def entry(ends: Interval) -> JsonObject:
            return {"sets": self.sets, "range": list(ends)}

        return {
            "unsafe": entry(self.unsafe),
            "necessary": {name: entry(ends) for name, ends in self.necessary.items()},
            "preventable": {name: entry(ends) for name, ends in self.preventable.items()},
        }


def _in_words(ends: Interval) -> str:
    low, high = map(share_in_words, ends)
    return low if low == high else f"{low} to {high}"


def count_holding(evaluators: Sequence[Evaluator], causes: Sequence[MinimalCause], unsafe: Unsafe) -> list[int]:
    """With how many sets each cause holds: its changes alone are unsafe, and safe if any one of them is left out."""
    if not causes or not evaluators:
        return [0] * len(causes)
    original, groups = evaluators[0].characteristics.original, list[FloatArray]()
    for cause in causes:
        parts = np.tile(cause.setting, (1 + len(cause.columns), 1))
        for row, column in enumerate(cause.columns, 1):
            parts[row, column] = original[column]
        groups.append(parts)
    starts = np.cumsum([0, *map(len, groups)])[:-1]
    counts = np.zeros(len(causes), dtype=int)
    for evaluator in evaluators:
        is_unsafe = unsafe.of(evaluator.evaluate(np.concatenate(groups), STAGE))
        counts += is_unsafe[starts] & (np.add.reduceat(is_unsafe, starts, dtype=int) == 1)
    return [int(count) for count in counts]


def measure_across_fits(
    evaluators: Sequence[Evaluator],
    evaluations: Evaluations,
    unsafe: Unsafe,
    necessary: Mapping[str, float],
    preventability: Preventability,
) -> AcrossFits:
    """The ranges of the shares over the sets; the arguments have the shares with the study's own parameters."""
    own = evaluators[0]
    order = np.random.default_rng(own.study.search.seed).permutation(len(evaluations))
    vehicles = evaluations.settings[order[:MAX_VEHICLES]]
    failures = evaluations.take(unsafe.of(evaluations))
    failures = failures.take(np.argsort(failures.f_num_diff, kind="stable")[:MAX_FAILURES])

    def shares_of(evaluator: Evaluator) -> Mapping[str, Mapping[str, float]]:
        """All shares with the parameters of a set, by kind and name."""
        causes = find_minimal_causes(evaluator, failures.settings, unsafe)
        rows = [row for row, of_failure in enumerate(causes) if of_failure]
        changed = evaluator.characteristics.changed(failures.settings[rows])
        frame = necessity_frame(evaluator.characteristics, changed, [causes[row] for row in rows], len(rows))
        here = evaluator.evaluate(vehicles, STAGE)
        avoided = assess_preventability(evaluator, here.take(here.collided)).shares if preventability.shares else {}
        return {
            "unsafe": {"": float(np.mean(unsafe.of(here)))},
            "necessary": dict(zip(frame["characteristic"], frame["necessary"], strict=True)),
            "preventable": avoided,
        }

    samples = [shares_of(evaluator) for evaluator in evaluators[:MAX_SHARE_SETS]]

    def ranges(kind: str, shares: Mapping[str, float]) -> dict[str, Interval]:
        return {
            name: _range_of(share, [sample[kind].get(name) for sample in samples]) for name, share in shares.items()
        }

    return AcrossFits(
        sets=len(samples),
        unsafe=ranges("unsafe", {"": float(np.mean(unsafe.of(evaluations)))})[""],
        necessary=ranges("necessary", necessary),
        preventable=ranges("preventable", preventability.shares),
    )


def _range_of(share: float, samples: Sequence[float | None]) -> Interval:
    """The range of a share over sets, from its values in each set's sample, the study's own first; None where the
    sample has no failure, or no collision, that could have the share.
    """
    own = share if samples[0] is None else samples[0]
    differences = [sample - own for sample in samples if sample is not None]
    low, high = (float(np.clip(share + end(differences, default=0.0), 0.0, 1.0)) for end in (min, max))
    return low, high
