"""The answer about a sweep: a row for each of many settings."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.api.evaluation import evaluate_with_workers
from safevar_sumo.questions.answer import Answer, Column, tabulate
from safevar_sumo.questions.words import ending_in_words, number_of
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.replay.safer import rises_again
from safevar_sumo.replay.setting import NOT_SAFE, remark_table, remarks_of
from safevar_sumo.scenarios import FROM_CENTRES
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.system import System


def answer_of_sweep(study: Study, system: System, settings: FloatArray, names: list[str]) -> Answer:
    """A row for each setting of a sweep."""
    # All settings, and the original vehicle first.
    characteristics = system.characteristics
    evaluations = evaluate_with_workers(
        study, np.concatenate([characteristics.original_settings, settings])
    )
    contact = system.contact
    no_verdict = why_no_verdict(system)

    # A column for each characteristic that varies, and for each metric.
    frame = pd.DataFrame(settings, columns=list(characteristics.names))[names]
    columns = {
        item.name: Column(item.unit, "value", "g") for item in characteristics if item.name in names
    }
    columns["outcome"] = Column("", "how the simulation ends")
    metrics = {metric.name: metric for metric in system.measuring.scoring.metrics}
    for name in evaluations.metrics:
        columns[name] = (
            Column(metrics[name].unit, metrics[name].title, ".3f")
            if name in metrics
            else Column("", name)
        )
    columns["gap"] = Column("m", "least distance between bodies", ".3f", is_shown=bool(contact))
    values = {
        "outcome": evaluations.outcome,
        **evaluations.metrics,
        "gap": evaluations.gaps(contact),
    }
    frame = frame.assign(**{name: column[1:] for name, column in values.items()})

    # What a reader should know of the settings.
    collisions = int(evaluations.collided[1:].sum())
    centres = f" ({FROM_CENTRES.strip()}: bodies touch at {contact:.2f} m)" if contact else ""
    note = f"Safety degree: least distance in m{centres}, or minus the collision speed in m/s."
    remarks = [*remarks_of(system), note]
    read_first = list[str]()
    if unsafe_originals := np.count_nonzero(system.measuring.scoring.violation(evaluations)[1:]):
        read_first.append(f"Remark: In {unsafe_originals} of {len(frame)} settings {NOT_SAFE}.")
    if len(names) == 1 and rises_again(frame, names[0], characteristics):
        read_first.append(
            "Remark: The safety degree does not fall steadily along this sweep: it rises again"
            " further from the original value, so do not extrapolate from two values."
        )
        remarks.append(
            "The driving system decides only once per frame, so a weaker vehicle may get a harder"
            " or an earlier brake command."
        )
    verb = "collide" if collisions > 1 else "collides"
    counts = f"Of {number_of(len(frame), 'setting')}, {collisions or 'none'} {verb}."
    sentences = [no_verdict, counts, _original_in_words(system, evaluations), *read_first]
    return Answer(
        question="simulate",
        study=study,
        verdict=" ".join(filter(None, sentences)),
        numbers={"driven": not no_verdict, "settings": len(frame), "collisions": collisions},
        tables={"sweep": tabulate(study.title, columns, frame), "remarks": remark_table(remarks)},
    )


def _original_in_words(system: System, evaluations: Evaluations) -> str:
    """How the original vehicle ends, the first of a sweep's evaluations."""
    where = " in the original encounter" if len(system.characteristics.scenario) else ""
    ending = ending_in_words(evaluations.outcome[0], evaluations.f_safe[0], system.contact)
    points = len(system.matrix)
    worst = f", in the worst of {points} test cases" if points > 1 else ""
    return f"The original vehicle{where} {ending}{worst}."
