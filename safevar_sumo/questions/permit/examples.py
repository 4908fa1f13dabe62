"""Simulates the failures that the answer of `permit` shows, as they are printed. After this nothing
is simulated.
"""

from __future__ import annotations

from collections.abc import Sequence

from safevar_sumo.questions.bench import Bench
from safevar_sumo.questions.counterexamples import (
    OF_ENCOUNTER,
    Failure,
    failures_at,
    texts_of,
)
from safevar_sumo.questions.drives import Drives
from safevar_sumo.questions.permit import words
from safevar_sumo.questions.permit.encounters import SpeedWorld
from safevar_sumo.questions.permit.found import Example, Permit
from safevar_sumo.questions.permit.speed_search import LimitingFailure
from safevar_sumo.questions.words import change_texts, join_phrases
from safevar_sumo.study import PHASE


def with_examples(
    bench: Bench[SpeedWorld], permits: Sequence[Permit], *, with_car: bool
) -> list[Permit]:
    """The permits, whose failures are told."""
    failures = []
    for permit in permits:
        failures += permit.failures
    examples = iter(examples_of(bench, failures, with_car=with_car))
    told = []
    for permit in permits:
        reached = [
            of_set
            if of_set.failure is None
            else of_set._replace(example=next(examples))
            for of_set in permit.reached
        ]
        told.append(Permit(reached))
    return told


def examples_of(
    bench: Bench[SpeedWorld],
    failures: Sequence[LimitingFailure],
    *,
    with_car: bool = False,
) -> list[Example]:
    """How cars fail, in the order of their failures.

    The printed settings are simulated once more. If runs differ, these are fresh runs, and the
    example says if none of them fails. With `with_car` the words name the car's changed values,
    too.
    """
    drives = Drives.concatenate(
        [bench.nothing, *(failure.drive for failure in failures)]
    )
    examples = [Example(words.NOT_CONFIRMED)] * len(failures)
    for world, rows in bench.in_worlds(drives):
        told = failures_at(world.model, world.settings(drives[rows]))
        for place, failure in told.items():
            examples[rows[place]] = _example_of(world, failure, with_car=with_car)
    return examples


def _example_of(world: SpeedWorld, failure: Failure, *, with_car: bool) -> Example:
    """How a car fails in a world."""
    model = world.model
    members = model.characteristics
    event = failure.words.partition(" (parameter set")[0]
    if with_car:
        values = failure.failing_values
        changes = change_texts(members.vehicle, values, are_printed=True)
        phrases = join_phrases(changes or ["no change"])
        event = words.WITH_CHANGES.format(changes=phrases, event=event)
    named = {*OF_ENCOUNTER, *members.names}
    encounter = {
        name: value for name, value in failure.point.items() if name not in named
    }
    encounter |= {name: failure.failing_values[name] for name in members.scenario.names}
    phase = encounter.pop(PHASE, None)
    texts = texts_of(model.evaluator.system.points[0], encounter)
    where = ", ".join(f"{name} {text}" for name, text in texts.items())
    return Example(
        because=event,
        test=world.name or None,
        encounter=where or None,
        phase=phase,
        outcome=failure.breach,
        simulate=failure.command,
    )
