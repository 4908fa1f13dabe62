"""The question `risk`: how likely is an unsafe vehicle if vehicles vary as a study states, and
which characteristics have the largest influence?

The probability is estimated by plain Monte Carlo, with the exact interval of Clopper and Pearson.
The influence of a characteristic is its Sobol index, first order and total (Saltelli's design).
This design does not exist for constrained characteristics, and may take too many simulations. Then
the first-order index is computed from the sampled vehicles themselves (Plischke, Borgonovo, Smith
2013, European Journal of Operational Research 226, 536-550).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import HIGH, LOW, Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.budget import LEAST_SETTINGS
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.indices import (
    LEAST_VEHICLES,
    MIN_OUTCOMES,
    OUTPUTS,
    SENSITIVITY,
    design_of,
    given_data_indices,
    size_of_design,
    sobol_indices,
)
from safevar_sumo.questions.options import Count, Fraction
from safevar_sumo.questions.over_sets import (
    BY_SET,
    INTERVALS,
    SharesOverSets,
    moving_in_words,
    planned_over_sets,
    simulate_sample,
)
from safevar_sumo.questions.risk import words
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.sentence import Sentence, Sentences, Verdict
from safevar_sumo.questions.variation import VariationModel, sampled_in_words
from safevar_sumo.questions.words import (
    constraints_in_words,
    count_in_words,
    counted_in_words,
    interval_in_words,
    notes_on,
    number_of,
    percentage,
)
from safevar_sumo.records import JsonObject
from safevar_sumo.study import Study

SAMPLING = "sampling vehicles"
"""The phase of progress in which the sampled vehicles are simulated."""
RARE = 1e-4
"""If no vehicle is unsafe, the verdict says how many safe vehicles would show that the probability
is at most this small [-].
"""
MAX_RIVALS = 3
"""Largest number of characteristics that the verdict names beside the characteristic with the
largest share of the variance.
"""
COLUMNS = [
    "characteristic",
    *map("".join, product(OUTPUTS, ("_first", "_total"), ("", LOW, HIGH))),
]


@question
@contents(
    "unsafe",
    "samples",
    "failures",
    "probability",
    "interval",
    "confidence",
    BY_SET,
    INTERVALS,
    lead="sensitivity",
    next="explain",
    sensitivity=COLUMNS,
)
def risk(
    subject: Subject,
    evaluator: Evaluator,
    *,
    samples: Count = 10_000,
    confidence: Fraction = 0.95,
    unsafe: Criterion = None,
) -> Answer:
    """Estimate how likely an unsafe vehicle is, if vehicles vary as the study states under
    [variation]. You also get the characteristics with the largest influence on the safety
    degree. For a study without [variation] the answer is the share of unsafe vehicles in the
    domain (ranges of values), which is no probability in traffic.

    Example: python -m safevar_sumo risk rain

    Parameters
    ----------
    samples
        Number of sampled vehicles (drawn at random and simulated).
    confidence
        Confidence level of the intervals.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: the criterion of the study, else a collision (if nothing collides: half of the
        original vehicle's safety degree).
    """
    study = evaluator.study
    model = VariationModel(study)
    has_design = not (model.region or study.ranges)
    of_design = has_design * size_of_design(evaluator)
    phases = planned_over_sets(study, SAMPLING, samples) | {SENSITIVITY: of_design}
    evaluator.begin(phases, minimum=LEAST_SETTINGS)
    criterion = evaluator.choose_criterion(unsafe, subject)
    samples = evaluator.of_stage(samples)
    if evaluator.settings_left is not None:
        # With few simulations, the design is used only if it takes at most half of them.
        has_design = has_design and 2 * of_design <= evaluator.settings_left
        samples = min(samples, evaluator.settings_left - has_design * of_design)
    evaluations = simulate_sample(evaluator, model, samples, SAMPLING)

    simulated = evaluations.take(evaluations.valid)
    failures = criterion.number(simulated)
    total = len(simulated)

    low, high = clopper_pearson(failures, total, confidence)
    over_sets = SharesOverSets.of(evaluator, criterion, evaluations.settings)
    if has_design:
        design = design_of(evaluator, model)
        table, measure = sobol_indices(evaluator, design, criterion, confidence)
    else:
        table, measure = given_data_indices(evaluator, simulated, criterion, confidence)
    indices = table.frame
    numbers = {
        "unsafe": str(criterion),
        "samples": total,
        "failures": failures,
        "probability": failures / total,
        "interval": [low, high],
        "confidence": confidence,
        **over_sets.numbers(failures / total),
    }

    omissions = evaluations.infeasible.sum()
    failed = samples - total - omissions - evaluations.standing.sum()
    sentences = _share_in_words(study, criterion, numbers, failed)
    sentences += moving_in_words(evaluations)
    if not has_design and total < LEAST_VEHICLES:
        sentences.append(words.UNKNOWN_INFLUENCE(least=LEAST_VEHICLES))
    else:
        names = {item.name: item.short_name for item in evaluator.characteristics}
        sentences += influence_in_words(indices, measure, failures, confidence, names)
    sentences += over_sets.sentences()
    counted = counted_in_words(study, omissions)
    sentences += notes_on(criterion, *counted, *constraints_in_words(study))
    has_shares = indices.drop(columns="characteristic").notna().any(axis=None)
    return Answer(
        question="risk",
        study=study,
        verdict=Verdict(sentences),
        numbers=numbers,
        tables={"sensitivity": table},
        folded=() if has_shares else ("sensitivity",),
    )


def _share_in_words(
    study: Study, unsafe: Unsafe, numbers: JsonObject, failed: int
) -> list[Sentence]:
    """Sentences on the share of unsafe vehicles. If no vehicle is unsafe, they say how many
    vehicles would show a small probability (`RARE`). `failed` is the number of failed simulations.

    Clopper and Pearson's upper end for 0 of n vehicles is 1 - ((1 - confidence) / 2)^(1 / n).
    """
    templates = [words.SHARE, words.SAMPLED, words.NO_PROBABILITY]
    if study.variation:
        templates = [words.PROBABILITY, words.SAMPLED]
    confidence = numbers["confidence"]
    needed_samples = math.ceil(math.log((1 - confidence) / 2) / math.log1p(-RARE))
    if not numbers["failures"]:
        templates.append(words.BOUND)
        templates += [words.NEEDED] * (numbers["samples"] < needed_samples)
    templates += [words.NOT_SIMULATED] * bool(failed)

    slots = {
        "count": count_in_words(numbers["failures"], numbers["samples"]),
        "sampled": sampled_in_words(study),
        "unsafe": unsafe,
        "do": unsafe.verbs[numbers["failures"] > 1],
        "share": percentage(numbers["probability"]),
        "interval": interval_in_words(*numbers["interval"]),
        "high": percentage(numbers["interval"][1]),
        "confidence": 100 * confidence,
        "rare": percentage(RARE),
        "needed": needed_samples,
        "failed": number_of(failed, "vehicle"),
    }
    return [template(**slots) for template in templates]


def influence_in_words(
    indices: pd.DataFrame,
    measure: str,
    failures: float,
    confidence: float,
    names: Mapping[str, str],
) -> Sentences:
    """Say which characteristic has the largest influence on the measure. If the interval of its
    share of the variance overlaps intervals of other characteristics, these are named, too.

    Parameters
    ----------
    indices
        The table of indices, the characteristic with the largest share first.
    measure
        The name of the measure in sentences.
    failures
        The number of unsafe vehicles.
    names
        Names of characteristics in sentences, by their names in the table.
    """
    if indices.empty:
        return
    index = "total" if indices["degree_total"].notna().any() else "first"

    share, low, high = (
        100 * indices[f"degree_{index}{end}"] for end in ("", LOW, HIGH)
    )
    name, *rivals = indices["characteristic"].map(names)[~(high < low[0])]
    template = words.UNCERTAIN_INFLUENCE if rivals else words.LARGEST_INFLUENCE
    if np.isnan(share[0]):
        template = words.NO_INFLUENCE
    yield template(
        name=name,
        measure=measure,
        share=share[0],
        low=low[0],
        high=high[0],
        confidence=100 * confidence,
        rivals=", ".join(rivals[:MAX_RIVALS]),
    )

    # If too few vehicles are unsafe or safe, the outcome "unsafe" has no indices of its own.
    if failures and indices[f"unsafe_{index}"].isna().all():
        yield words.FEW_OUTCOMES(least=MIN_OUTCOMES)
