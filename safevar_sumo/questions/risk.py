"""How likely is an unsafe vehicle when vehicles vary as a study specifies, and which characteristic
decides?

Plain Monte Carlo with the exact interval of Clopper and Pearson. What decides: Sobol indices, first
order and total (Saltelli's design); where this design does not exist, as for constrained
characteristics, or takes too many simulations, the first-order index from the drawn vehicles
themselves (Plischke, Borgonovo, Smith 2013, European Journal of Operational Research 226, 536-550).
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pandas as pd
from numpy.random import default_rng

from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import HIGH, LOW, Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.indices import (
    LEAST_VEHICLES,
    MIN_OUTCOMES,
    OF_WHAT,
    OUTPUTS,
    SENSITIVITY,
    design_of,
    given_data_indices,
    size_of_design,
    sobol_indices,
)
from safevar_sumo.questions.options import Count, Fraction
from safevar_sumo.questions.over_sets import (
    INTERVALS,
    SharesOverSets,
    planned_over_sets,
)
from safevar_sumo.questions.price import LEAST_SETTINGS
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.questions.words import join_phrases, number_of, percentage, with_scope
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import Uniform

SAMPLING = "sampling vehicles"
"""Phase of progress."""
RARE = 1e-4
"""If no vehicle is unsafe, the verdict says how many would show a probability this small [-]."""
MAX_DECIDING = 5
"""Number of characteristics that one screen names."""
MAX_RIVALS = 3
"""Largest number of characteristics that the verdict names beside the one with the largest share.
"""
NO_PROBABILITY = (
    " This share is no probability in traffic, because the study does not state how vehicles vary"
    " ([variation])."
)
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
    "by_set",
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
    degree. Without [variation] the answer is the share of unsafe vehicles in the domain (ranges
    of values), and no probability in traffic.

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
    # Vehicles as the study says that they vary.
    study = evaluator.study
    model = VariationModel(study)
    has_design = not (model.region or study.ranges)
    of_design = has_design * size_of_design(evaluator)
    phases = planned_over_sets(study, SAMPLING, samples) | {SENSITIVITY: of_design}
    evaluator.begin(phases, least=LEAST_SETTINGS)
    criterion = evaluator.choose_criterion(unsafe, subject)
    samples = evaluator.at_most(samples)
    if evaluator.left is not None:
        # Few simulations are for the design only where it takes at most half of them.
        has_design = has_design and 2 * of_design <= evaluator.left
        samples = min(samples, evaluator.left - has_design * of_design)
    vehicles = model.draw(samples, default_rng(study.search.seed))
    evaluations = evaluator.evaluate(vehicles, SAMPLING)

    # How many are unsafe.
    simulated = evaluations.take(evaluations.valid)
    failures = criterion.number(simulated)
    total = len(simulated)
    if not total:
        raise SimulationError(
            f"study {study.name!r}: none of {samples} vehicles could be simulated"
        )

    # With which probability, also in other parameter sets, and which characteristics decide.
    low, high = clopper_pearson(failures, total, confidence)
    over_sets = SharesOverSets.of(evaluator, criterion, evaluations.settings)
    if has_design:
        design = design_of(evaluator, model)
        table = sobol_indices(evaluator, design, criterion, confidence)
    else:
        table = given_data_indices(evaluator, simulated, criterion, confidence)
    numbers = {"unsafe": str(criterion), "samples": total, "failures": failures}
    numbers |= {
        "probability": failures / total,
        "interval": [low, high],
        "confidence": confidence,
    }
    numbers |= {"by_set": over_sets.of_all(failures / total), **over_sets.numbers}

    # In words.
    verdict = (
        f"{_probability_in_words(study, criterion, failures, total)} ({100 * confidence:g} %"
        f" confidence interval {percentage(low)} to {percentage(high)} %)."
        f"{over_sets.in_words()}"
        f"{NO_PROBABILITY if not study.variation else ''}"
    )
    infeasible = int(evaluations.infeasible.sum())
    if failed := samples - total - infeasible:
        verdict += f" {failed:,} vehicles could not be simulated and are left out."
    if not has_design and total < LEAST_VEHICLES:
        verdict += f" What decides is unknown: that needs {LEAST_VEHICLES} vehicles."
    else:
        verdict += deciding_in_words(table, failures)
    verdict += "" if failures else _bound_in_words(high, total, confidence)
    table.attrs["lead_rows"] = range(min(MAX_DECIDING, len(table)))
    has_shares = table.drop(columns="characteristic").notna().any(axis=None)
    return Answer(
        question="risk",
        study=study,
        verdict=with_scope(study, infeasible, verdict, criterion.remark),
        numbers=numbers,
        tables={"sensitivity": table},
        folded=() if has_shares else ("sensitivity",),
    )


def _bound_in_words(high: float, total: int, confidence: float) -> str:
    """What a sample without an unsafe vehicle says, and how many vehicles would say more. Clopper
    and Pearson's upper end of 0 of n is 1 - ((1 - confidence) / 2)^(1 / n).
    """
    words = f" No vehicle is unsafe, so the share is at most {percentage(high)} %."
    number = math.ceil(math.log((1 - confidence) / 2) / math.log1p(-RARE))
    further = (
        f" To show at most {percentage(RARE)} %, {number:,} vehicles are needed of which none is"
        " unsafe (--samples)."
    )
    return f"{words}{further if total < number else ''}"


def deciding_in_words(table: pd.DataFrame, failures: float) -> str:
    """Which characteristic decides the table's measure, as the interval of its share of the
    variance is above those of all others, or which may.
    """
    if table.empty:
        return ""
    index = "total" if table["degree_total"].notna().any() else "first"

    # The largest share, of all orders if it is known.
    name = f"degree_{index}"
    largest = table.iloc[0]
    share, low, high = largest[[name, f"{name}{LOW}", f"{name}{HIGH}"]]
    in_words = table.attrs[OF_WHAT]
    words = f" No vehicle was found that changes {in_words['degree']}, so nothing decides it."
    if np.isfinite(share):
        characteristic = largest["characteristic"]
        causes = (
            f"causes {100 * share:.0f} % of the variance of {in_words['degree']}"
            f" ({100 * low:.0f} to {100 * high:.0f} %)"
        )
        _, *rivals = table[table[f"{name}{HIGH}"] >= low]["characteristic"]
        words = f" {characteristic} decides most: it {causes}."
        if rivals:
            words = (
                f" What decides most is uncertain: {characteristic} {causes}, and the interval of"
                f" {join_phrases(rivals[:MAX_RIVALS])} overlaps with that."
            )

    # Without the outcome's own shares, what decides it is unknown.
    if failures and table[f"unsafe_{index}"].isna().all():
        words += (
            " What decides whether a vehicle is unsafe is unknown: that needs"
            f" {MIN_OUTCOMES} unsafe and as many safe vehicles."
        )
    return words


def _probability_in_words(
    study: Study, criterion: Unsafe, failures: float, total: int
) -> str:
    """The share of unsafe vehicles, and how vehicles vary."""
    share = f"{percentage(failures / total)} %"
    if not study.variation:
        vehicles = (
            f"{number_of(total, 'vehicle')} that were sampled uniformly over the"
            " whole domain"
        )
        return f"Of {vehicles}, {criterion.number_in_words(failures)}: {share}"

    # Distributions other than the uniform one.
    variation = [
        f"{name} {distribution.__struct_config__.tag}"
        for name, distribution in study.variation.items()
        if distribution != Uniform()
    ]
    if len(variation) < len(study.domains):
        variation.append("the others uniform")
    manner = join_phrases(variation)
    vehicles = (
        f"Of {number_of(total, 'vehicle')} that vary as the study says ({manner})"
    )
    return f"{vehicles}, {criterion.number_in_words(failures)}. So the probability is about {share}"
