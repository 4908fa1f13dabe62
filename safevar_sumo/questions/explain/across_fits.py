"""Do conclusions hold with the other vehicle models that fit the published data about as well?

These are the parameter sets of a study's table [spread].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator, Interval
from safevar_sumo.questions.explain.causes import Cause, find_minimal_causes, necessity_frame
from safevar_sumo.questions.preventability import Preventability, assess_preventability
from safevar_sumo.questions.words import number_of, share_in_words
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, JsonObject

MAX_SHARE_SETS = 8
"""Maximum number of sets with which shares are computed; the first sets lie farthest apart."""
MAX_VEHICLES = 300
"""Maximum number of vehicles, drawn at random, that are simulated with each set; those that collide show which
collisions the reference drivers avoid.
"""
MAX_FAILURES = 20
"""Maximum number of failures, those with the fewest changes, whose minimal causes are found with each set."""
STAGE = "other fitted vehicle models"


class AcrossFits(NamedTuple):
    """Ranges of shares over the parameter sets of a study's table [spread].

    The ends of a range are the share with the study's own parameters plus the least, and plus the greatest difference
    that another set makes on a sample.

    Attributes
    ----------
    sets
        Number of parameter sets with which the shares were computed, the study's own among them.
    ranges
        The ends of each range by kind and name of the share: (`unsafe`, ""), the settings that are unsafe;
        (`necessary`, a characteristic), the failures that need it; (`preventable`, a driver),
        the collisions that he avoids of those with a verdict, if there is one.
    """

    sets: int
    ranges: Mapping[tuple[str, str], Interval]

    def __str__(self) -> str:
        sentence = (
            f"With {number_of(self.sets, 'vehicle model')} that fit the published data about as well, "
            f"{self._words('unsafe', '')} of them are unsafe"
        )
        if ("preventable", "competent_driver") not in self.ranges:
            return f"{sentence}."
        avoided = self._words("preventable", "competent_driver")
        return f"{sentence}; a competent driver avoids {avoided} of the collisions."

    def _words(self, kind: str, name: str) -> str:
        return " to ".join(dict.fromkeys(map(share_in_words, self.ranges[kind, name])))

    def to_dict(self) -> JsonObject:
        """The entry `across_fits` of a summary in JSON: the ranges under the names of the shares."""
        kinds: dict[str, JsonObject] = {"unsafe": {}, "necessary": {}, "preventable": {}}
        for (kind, name), ends in self.ranges.items():
            kinds[kind][name] = {"sets": self.sets, "range": list(ends)}
        return {**kinds, "unsafe": kinds["unsafe"][""]}


def count_holding(evaluators: Sequence[Evaluator], causes: Sequence[Cause], unsafe: Unsafe) -> list[int]:
    """Number of sets with which each cause holds: its changes alone are unsafe, and safe if any one of them is left
    out.
    """
    counts = np.zeros(len(causes), dtype=int)
    if not causes or not evaluators:
        return counts.tolist()
    characteristics, groups = evaluators[0].characteristics, list[FloatArray]()
    for cause in causes:
        setting = cause.setting(characteristics)
        is_changed = setting != characteristics.original
        is_left_out = np.diag(is_changed)[is_changed]
        groups.append(np.vstack([setting, np.where(is_left_out, characteristics.original, setting)]))
    starts = np.cumsum([0, *map(len, groups[:-1])])
    for evaluator in evaluators:
        is_unsafe = unsafe.of(evaluator.evaluate(np.concatenate(groups), STAGE))
        # A cause holds if its first setting, with all changes, is the only unsafe one of its group.
        counts += is_unsafe[starts] & (np.add.reduceat(is_unsafe, starts, dtype=int) == 1)
    return counts.tolist()


def measure_across_fits(
    evaluators: Sequence[Evaluator],
    evaluations: Evaluations,
    unsafe: Unsafe,
    necessity: pd.DataFrame,
    preventability: Preventability,
) -> AcrossFits:
    """The ranges of the shares over the sets of `evaluators`.

    `evaluations`, `necessity` and `preventability` give the shares with the study's own parameters.
    """
    order = np.random.default_rng(evaluators[0].study.search.seed).permutation(len(evaluations))
    vehicles = evaluations.settings[order[:MAX_VEHICLES]]
    failures = evaluations.take(unsafe.of(evaluations))
    failures = failures.take(np.argsort(failures.f_num_diff, kind="stable")[:MAX_FAILURES])

    def sample_shares(evaluator: Evaluator) -> pd.Series[float]:
        """All shares of the sample with the parameters of a set."""
        causes = find_minimal_causes(evaluator, failures.settings, unsafe)
        rows = [row for row, of_failure in enumerate(causes) if of_failure]
        changed = evaluator.characteristics.changed(failures.settings[rows])
        frame = necessity_frame(evaluator.characteristics, changed, [causes[row] for row in rows], len(rows))
        runs = evaluator.evaluate(vehicles, STAGE)
        avoided = assess_preventability(evaluator, runs.take(runs.collided)).shares if preventability.shares else {}
        return _shares_by_kind(unsafe.of(runs), frame, avoided)

    shares = _shares_by_kind(unsafe.of(evaluations), necessity, preventability.shares)
    samples = pd.concat(list(map(sample_shares, evaluators[:MAX_SHARE_SETS])), axis=1).reindex(shares.index)
    # Column 0 has the study's own parameters. There is no share where a sample has no failure, or no collision.
    differences = samples.sub(samples[0].fillna(shares), axis=0)
    lows, highs = (
        (shares + extremes.fillna(0.0)).clip(0.0, 1.0).tolist()
        for extremes in (differences.min(axis=1), differences.max(axis=1))
    )
    return AcrossFits(samples.shape[1], dict(zip(shares.index, zip(lows, highs, strict=True), strict=True)))


def _shares_by_kind(
    is_unsafe: BoolArray, necessity: pd.DataFrame, preventable: Mapping[str, float]
) -> pd.Series[float]:
    necessary = necessity.set_index("characteristic")["necessary"]
    kinds = {"unsafe": {"": is_unsafe.mean()}, "necessary": necessary, "preventable": preventable}
    shares: pd.Series[float] = pd.concat({kind: pd.Series(values, dtype=float) for kind, values in kinds.items()})
    return shares
