"""The sentences of an answer about repairs: templates are chosen, and filled with what was
found.
"""

from __future__ import annotations

from collections.abc import Iterator

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.models import fit_names
from safevar_sumo.questions.repair import words
from safevar_sumo.questions.repair.found import Found, Repair
from safevar_sumo.questions.sentence import Sentence, condition
from safevar_sumo.questions.words import (
    UNSAFE_MEANS,
    bound_in_words,
    encounter_in_words,
    join_phrases,
    number_of,
    single_set_in_words,
)
from safevar_sumo.records import NamedValues
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import unit_text

SHOWN_LIMITS = 3
"""Number of limits of full braking that the verdict names."""


def verdict_sentences(found: Found) -> Iterator[Sentence]:
    """The sentences of the verdict: the repair, its price, the required wear, and the wear that no
    driving system can keep safe.
    """
    if found.proof_today is not None:
        yield from _not_necessary(found)
    elif found.repairs:
        yield from _repair(found)
    else:
        names = join_phrases(parameter.name for parameter in found.parameters)
        yield words.NOTHING_FOUND(names=names)
    yield words.WEAR(wear=found.promise.in_words)
    if not found.unsafe.keep:
        yield UNSAFE_MEANS(description=found.unsafe.description)
    yield from _not_repairable(found)


def _not_necessary(found: Found) -> Iterator[Sentence]:
    """Say that all vehicles are safe today, and how safe the worst vehicle is."""
    unsafe = found.unsafe
    template = words.NOT_NECESSARY
    if found.not_repairable:
        template = words.NOT_NECESSARY_WHERE_REPAIRABLE
    yield template(safe=_safe_in_words(unsafe))
    distance = distance_in_words(found.worst_today, unsafe.contact)
    ending = f"has a safety degree of {distance}"
    if unsafe.bound:
        ending = unsafe.value_in_words(found.worst_today)
    yield words.WORST(ending=ending)


def _repair(found: Found) -> Iterator[Sentence]:
    """State the first repair, which is the cheapest one, and its price for a new vehicle."""
    repair = found.repairs[0]
    smallest = min(other.size for other in found.repairs)
    yield words.REPAIR(
        kind="smallest" if repair.size == smallest else "cheapest",
        number=number_of(len(repair.values), "parameter"),
        change=change_in_words(found, repair),
    )
    yield words.REPAIRED(safe=_safe_in_words(found.unsafe))
    price = repair.price
    if price.metres_earlier is None:
        yield words.NO_BRAKING
    else:
        yield words.EARLIER(metres_earlier=price.metres_earlier)
    if not price.benign_scenes:
        yield words.NO_SCENES
    else:
        yield words.NEEDLESS_BRAKING(
            needless_braking=price.needless_braking,
            needless_braking_today=price.needless_braking_today,
            benign_scenes=price.benign_scenes,
        )


def change_in_words(found: Found, repair: Repair) -> str:
    """The change of a repair: the meaning of each parameter, its old value and its new value."""
    texts = []
    for parameter in found.parameters:
        value = repair.values.get(parameter.name)
        if value is not None:
            row = parameter.range
            text = words.CHANGE.format(
                meaning=row.meaning,
                name=parameter.name,
                old=f"{parameter.today:.6g}",
                new=f"{value:.10g}{unit_text(row.unit)}",
            )
            texts.append(text)
    return join_phrases(texts)


def _safe_in_words(unsafe: Unsafe) -> str:
    """What all vehicles do with a repair, such as `stay safe`."""
    return f"keep {unsafe.keep:g} m of clearance" if unsafe.keep else "stay safe"


def _not_repairable(found: Found) -> Iterator[Sentence]:
    """Name wear that no driving system can keep safe, that with the fewest values first."""
    fewest = sorted(found.not_repairable, key=len)
    if fewest:
        parts = [_limits_in_words(found, part) for part in fewest[:SHOWN_LIMITS]]
        yield words.NOT_REPAIRABLE(parts=join_phrases(parts, "or"))
    if len(fewest) > SHOWN_LIMITS:
        yield words.MORE_NOT_REPAIRABLE(number=len(fewest) - SHOWN_LIMITS)


def _limits_in_words(found: Found, part: NamedValues) -> str:
    """Wear that no driving system can keep safe, in words, such as `sensorRange below 21.4 m`, and
    its encounter.
    """
    characteristics = found.promise.region.characteristics
    limits = []
    for member in characteristics.vehicle:
        if member.name in part:
            value = part[member.name]
            side = "below" if value < member.original else "above"
            limits.append(f"{member.name} {side} {member.text(value)}{member.suffix}")
    text = " with ".join(limits) or "even the original"
    return text + encounter_in_words(characteristics, part)


def tested_sentences(found: Found) -> Iterator[Sentence]:
    """Say how the first repair (or today's driving system) was tested, and in how many parameter
    sets it holds. If neither is safe, there is no sentence.
    """
    proof = found.proof
    if proof is None:
        return
    yield words.PROOF(samples=proof.samples, bound=bound_in_words(proof.at_most))
    if found.sets > 1:
        yield words.SETS(holding=found.sets_holding, sets=found.sets)
    if not found.is_rough:
        yield single_set_in_words(found.study, found.sets)
    if found.broken_sets:
        yield words.BROKEN(sets=fit_names(found.broken_sets))
    yield condition(found.phases)
