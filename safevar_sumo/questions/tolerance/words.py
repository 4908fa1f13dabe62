"""The verdict on limits in words: the decision, how sure it is, in how many fits, and in which
scope.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import MET_BY_CORNERS
from safevar_sumo.questions.counterexamples import limit_text
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Models, fit_names
from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance.alone import AloneLimit
from safevar_sumo.questions.tolerance.left_out import Contacts
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.questions.words import join_phrases, number_of, share_in_words
from safevar_sumo.study import Limit, unit_text

USUAL_BUDGET = 5000
"""Number of simulations that search for a counterexample unless an option says otherwise."""
NOT_FALSIFIED = "with --attack 0, no simulation searched for a counterexample"


def rough_in_words(budget: int) -> str:
    """The beginning of a verdict for which fewer simulations than usual searched for a
    counterexample.
    """
    if budget >= USUAL_BUDGET:
        return ""
    return (
        f"Rough answer, with {budget:,} instead of {USUAL_BUDGET:,} simulations that search for a"
        " counterexample. "
    )


def contacts_in_words(evaluator: Evaluator, contacts: Contacts) -> Iterator[str]:
    """What vehicles within the limits do in encounters that do not count; nothing where they touch
    nobody.
    """
    if contacts.number:
        members = evaluator.characteristics
        item = members.members[members.names.index(contacts.name)]
        margin = evaluator.study.scenario.margin
        yield (
            f"Where the original touches nobody but keeps less than {margin:g} m, which does not"
            " count, vehicles within these limits touch somebody:"
            f" {number_of(contacts.number, 'such contact')} found, the lowest at"
            f" {item.name.replace('_', ' ')}"
            f" {limit_text(item, round(contacts.lowest, item.digits + 1))}."
        )


def verdict_sentences(
    models: Models,
    alone: Sequence[AloneLimit],
    together: LimitsTogether | None,
    limits: Mapping[str, Limit],
    broken: Sequence[str],
    budget: int,
    nearest: Sequence[tuple[Any, ...]],
    wider: Sequence[tuple[Any, ...]],
    refusal: str,
    contacts: Contacts | None,
) -> Iterator[str]:
    """The sentences of the verdict, the decision first; a `refusal` says why no limit can be
    kept.
    """
    unsafe = models.own.unsafe
    study = models.own.evaluator.study
    if refusal:
        yield f"{refusal[:1].upper()}{refusal[1:]}. {unsafe.smaller_demand}".strip()
        return
    decision = f"Do not release: {'; '.join(broken)}." if broken else ""
    if rough := f"{rough_in_words(budget)}{decision}".strip():
        yield rough
    if contacts is not None:
        share = share_in_words(models.own.evaluator.share_left_out)
        margin = f"in which the original keeps less than {study.scenario.margin:g} m"
        yield f"Of the encounters over the domain {share} are left out, {margin}."
        yield from contacts_in_words(models.own.evaluator, contacts)
    if together is not None:
        yield from _fits_in_words(models, together)
        yield from _nearest_in_words(nearest)
        yield from _box_in_words(models, together, bool(limits), budget)
    yield f"Scope: {scope_of(study, between=budget > 0)}."
    for name, scope, _, verdict, _ in wider:
        yield f"In the wider scope of {name} ({scope}) {verdict}"
    if names := [each.characteristic.name for each in alone if each.scan.of_state("unsafe")]:
        yield f"Unsafe alone, beyond the limits: {join_phrases(names)}."
    else:
        yield "No single characteristic makes it unsafe."


def _fits_in_words(models: Models, together: LimitsTogether) -> Iterator[str]:
    """In which fits the specified limits do not hold, and which fits do not count."""
    if together.broken and len(models.members) > 1:
        kept = f"{len(together.members)} of {len(models.members)}"
        fits = fit_names(sorted(together.broken))
        yield f"The specified limits hold in {kept} fits of the vehicle, not in {fits}."
    if models.left_out:
        yield (
            f"Left out: {fit_names(models.left_out)}, in which the original itself is unsafe or"
            " keeps too little."
        )


def _nearest_in_words(nearest: Sequence[tuple[Any, ...]]) -> Iterator[str]:
    """What would do in place of the specified limits."""
    would_do = [(name, unit, value) for name, unit, _, value in nearest if value is not None]
    if would_do:
        values = " or ".join(
            f"{name} {value:.10g}{unit_text(unit)}" for name, unit, value in would_do
        )
        others = ", the other specified limits as they are" if len(nearest) > 1 else ""
        yield f"What would do: {values}{others}."
    elif nearest:
        yield "No value of any one of the specified limits would do."


def _box_in_words(
    models: Models, together: LimitsTogether, has_limits: bool, budget: int
) -> Iterator[str]:
    """The limits together, and what they were tested with."""
    unsafe = models.own.unsafe
    count = len(together.members)
    where = (
        "in one model" if len(models.members) == 1 else f"in {count} of {len(models.members)} fits"
    )
    if together.box is None:
        if together.boxes:
            kept = (
                "The specified limits are kept with all others as in the original. "
                if has_limits
                else ""
            )
            boxes = "1 box was" if together.boxes == 1 else f"{together.boxes} boxes were"
            yield (
                f"{kept}No limits together were found ({unsafe.description}): {boxes} "
                "tried, and each held an unsafe vehicle. That is no proof that there are none."
            )
        return
    decision = "All may go to their limits together"
    if has_limits:
        decision = "The limits together below hold" if together.broken else "Keeps all limits"
    if not budget:
        decision = (
            "No search for counterexamples tested the limits together below: they hold at their"
            " corners"
        )
    yield (
        f"{decision} {where}: within them no vehicle that was tried"
        f" {failure_in_words(unsafe, count)}."
    )
    yield f"Tried: {validation_in_words(together, budget)}."
    if names := _without_room(models, together):
        yield f"No room was found for {join_phrases(names)}: they stay as in the original."


def validation_in_words(together: LimitsTogether, budget: int) -> str:
    """What limits together were tested with: corners, an attack, vehicles drawn at random."""
    searched = len(together.members[0].evaluator.characteristics.scenario) > 0
    met = f" in {MET_BY_CORNERS:,} encounters" if searched else ""
    falsification = _falsification_in_words(together, budget)
    return f"all corners{met}; {falsification}; {_proof_in_words(together)}"


def failure_in_words(unsafe: Unsafe, fits: int) -> str:
    """What no vehicle does within limits that hold in some fits: other fits than the study's own
    keep no distance.
    """
    if not unsafe.keep:
        return f"is unsafe ({unsafe.description}){f' in any of {fits} fits' if fits > 1 else ''}"
    between = " between bumpers" if unsafe.contact else ""
    others = (
        f" with the study's own fit, and none collides with {number_of(fits - 1, 'other')}"
        if fits > 1
        else ""
    )
    return f"keeps less than {unsafe.keep:.3g} m{between}{others}"


def _falsification_in_words(together: LimitsTogether, budget: int) -> str:
    """The attack: `the worst of 5,000 aimed at them keeps 0.31 m (with the study's own fit 0.67
    m)`.
    """
    if together.falsification is None or not budget:
        return "not attacked"
    least, own = together.least
    unsafe = together.members[0].unsafe
    if not abs(least) < float("inf"):
        return f"{together.falsification.simulated:,} aimed at them meet nobody"
    words = unsafe.value_in_words(least)
    of_own = ""
    if own == own and unsafe.value_in_words(own) != words:
        of_own = f" (with the study's own fit {unsafe.value_in_words(own).partition(' ')[2]})"
    between = ""
    if together.between:
        between = f", at {number_of(together.between, 'point')} between those of the study, too"
        if together.between_left_out:
            between += (
                f" ({together.between_left_out} left out, where the new car keeps too little)"
            )
    return (
        f"the worst of {together.falsification.simulated:,} aimed at them {words}{of_own}{between}"
    )


def _proof_in_words(together: LimitsTogether) -> str:
    proof = together.proof
    assert proof is not None
    failed = f", {proof.not_simulated} could not be simulated" if proof.not_simulated else ""
    bound = (
        f"at most {100 * proof.at_most:.2f} % of evenly drawn cars are, with {100 * CONFIDENCE:.0f}"
        " % confidence"
    )
    return f"{proof.failures} of {proof.samples:,} drawn at random are unsafe{failed}: {bound}"


def _without_room(models: Models, together: LimitsTogether) -> list[str]:
    """The characteristics that stay as in the original, beside limits that leave others room."""
    box = together.box
    assert box is not None
    return [
        item.name
        for item, low, high, last in zip(
            models.own.evaluator.characteristics, box.lower, box.upper, together.room, strict=True
        )
        if low == high and last and not item.is_scenario
    ]
