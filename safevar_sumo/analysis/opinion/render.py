"""The second vehicle model's opinions, as text on the terminal."""

from __future__ import annotations

from rich.console import Console

from safevar_sumo.analysis.opinion.result import Opinions, OpinionVerdict
from safevar_sumo.analysis.words import join_phrases, list_of_changes, number_of
from safevar_sumo.terminal import print_text, printable_text
from safevar_sumo.vehicles import CharacteristicSet

MODEL_IN_WORDS = "Driven again with CommonRoad's multi-body vehicle, Pacejka's tyres and anti-lock brakes"
STYLES = {OpinionVerdict.CONFIRMED: "green", OpinionVerdict.CONTRADICTED: "red"}
"""Styles of verdicts on the terminal; others are yellow."""


def print_opinions(console: Console, result: Opinions) -> None:
    """Print how many causes are confirmed, then every cause with the reason."""
    characteristics = CharacteristicSet.of(result.study.vehicle.characteristics)
    print_text(console, result.study.title)
    print_text(console, f"Unsafe: {result.unsafe.description}. {MODEL_IN_WORDS}: {opinion_in_words(result)}")
    print_text(console, f"The original vehicle with our model: {result.original_here}; with the second: {result.original_there}.")
    for handle in result.without_cause:
        print_text(console, f"note: {handle} is not unsafe: it has no cause")
    for opinion in result.opinions:
        handle, style = f"{opinion.solution}: " if opinion.solution else "", STYLES.get(opinion.opinion, "yellow")
        line = printable_text(handle).append(str(opinion.opinion), style)
        changes = list_of_changes(characteristics, opinion.changes)
        console.print(line.append(printable_text(f": {changes}")), soft_wrap=True, highlight=False)
        print_text(console, f"  with our model {opinion.here}; {opinion.because}")


def opinion_in_words(result: Opinions) -> str:
    """A phrase with the number of causes for each verdict; those outside come first, as nothing is said of them."""
    if not result.opinions:
        return "there is no cause to judge."
    counts = [f"{result.count(verdict)} {verdict}" for verdict in OpinionVerdict if result.count(verdict)]
    if outside := result.count(OpinionVerdict.OUTSIDE):
        counts = [f"{outside} outside (no answer)", *counts[:-1]]
    return f"of {number_of(len(result.opinions), 'minimal cause')} {join_phrases(counts)}."
