"""The verdict on limits in words: the decision, how sure it is, in how many parameter sets, and in
which scope.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import MET_BY_CORNERS
from safevar_sumo.questions.counterexamples import describe
from safevar_sumo.questions.models import Model, Models, fit_names
from safevar_sumo.questions.phases import remark_on_phases
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Rows
from safevar_sumo.questions.tolerance.alone import AloneLimit
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.questions.words import (
    bound_in_words,
    join_phrases,
    number_of,
    share_in_words,
    undecidable_in_words,
)
from safevar_sumo.study import unit_text


def verdict_sentences(
    models: Models,
    alone: Sequence[AloneLimit],
    together: LimitsTogether | None,
    asked: Asked,
    broken: Sequence[str],
    nearest: Rows,
    in_ranges: Rows,
    refusal: str,
) -> Iterator[str]:
    """The sentences of the verdict: the decision, what decides it, what would do instead, and the
    scope. A `refusal` says why no limit can be kept.
    """
    unsafe = models.own.unsafe
    study = models.own.evaluator.study
    if refusal:
        yield f"{refusal[:1].upper()}{refusal[1:]}"
        return

    # The decision, and how sure it is.
    if broken:
        yield f"Do not release: {'; '.join(broken)}."
    if together is not None:
        yield from _fits_in_words(models, together)
        yield from _nearest_in_words(nearest)
        yield from _box_in_words(models, together, asked)
        box = together.box
        vague = [
            item
            for column, item in enumerate(models.own.evaluator.characteristics.vehicle)
            if box and not item.is_decidable(float(box.lower[column]), float(box.upper[column]))
        ]
        if vague:
            yield undecidable_in_words(vague)

    # What is unsafe elsewhere.
    for _, _, verdict, *_ in in_ranges:
        yield f"In the ranges of the study {verdict}"
    names = [each.characteristic.name for each in alone if each.scan.of_state("unsafe")]
    if len(names) > 1:
        yield f"{join_phrases(names)} can each make the vehicle unsafe on their own."
    elif names:
        yield f"{names[0]} can make the vehicle unsafe on its own."
    else:
        yield "No single characteristic makes the vehicle unsafe on its own."
    if unsafe.remark:
        yield unsafe.remark
    if asked.left_out:
        tests = join_phrases(asked.left_out)
        yield f"Left out, as all their values are above {asked.up_to}: {tests}."
    if asked.at_tests:
        yield "Nothing was simulated between the values of the tests (--at-tests)."
    yield f"Scope: {scope_of(study, between=not asked.at_tests)}."


def tested_sentences(models: Models, together: LimitsTogether | None) -> Iterator[str]:
    """How joint limits were tested; nothing without such limits."""
    study = models.own.evaluator.study
    if together is not None and study.ranges:
        share = share_in_words(models.own.evaluator.share_left_out)
        yield (
            f"Of the encounters over the domain {share} do not count, because the original vehicle"
            f" itself keeps less than {study.scenario.margin or 0:g} m in them."
        )
    if together is not None and together.box is not None:
        yield validation_in_words(together)
        if together.proof is not None:
            bound = bound_in_words(together.proof.at_most).capitalize()
            yield f"{bound} of uniformly sampled vehicles within the limits are unsafe."
        if remark := remark_on_phases(models.own.in_phases):
            yield remark


def _fits_in_words(models: Models, together: LimitsTogether) -> Iterator[str]:
    """In which parameter sets the specified limits do not hold."""
    if together.broken and len(models.members) > 1:
        kept = f"{len(together.members)} of {len(models.members)}"
        fits = fit_names(sorted(together.broken))
        yield f"The specified limits hold in {kept} parameter sets of the vehicle, not in {fits}."


def _nearest_in_words(nearest: Rows) -> Iterator[str]:
    """Which values would hold in place of the specified limits."""
    would_do = [(name, unit, value) for name, unit, _, value in nearest if value is not None]
    if would_do:
        values = " or ".join(
            f"{name} {value:.10g}{unit_text(unit)}" for name, unit, value in would_do
        )
        others = ", if the other specified limits stay" if len(nearest) > 1 else ""
        yield f"A limit that would hold instead: {values}{others}."
    elif nearest:
        yield "No other value of a single specified limit would hold."


def _box_in_words(models: Models, together: LimitsTogether, asked: Asked) -> Iterator[str]:
    """The joint limits, and what was found within them."""
    unsafe = models.own.unsafe
    count = len(together.members)
    if together.box is None:
        if together.boxes:
            kept = (
                "The specified limits hold with all other characteristics as in the original. "
                if asked.limits
                else ""
            )
            tested = number_of(together.boxes, "operating range")
            yield (
                f"{kept}No joint limits were found ({unsafe.description}): the search tested"
                f" {tested}, and found an unsafe vehicle in each. That is no proof that there are"
                " none."
            )
        return
    where = ""
    if len(models.members) > 1:
        where = f" in {count} of {len(models.members)} parameter sets of the vehicle model"
    decision = "All joint limits hold at the same time"
    if asked.limits:
        decision = "The joint limits below hold" if together.broken else "All limits hold"
    yield f"{decision}{where}: {tested_in_words(unsafe, count)}."
    for model in models.left_out:
        # Its words name the test and the parameter set.
        described = describe(model, {"": model.characteristics.original})
        words = described[""].words if described else f"parameter set {model.fit} is unsafe"
        yield f"With the original vehicle itself {words}: there no limit is claimed."
    if not asked.is_quick:
        yield from one_set_in_words(models.members, models.left_out)
    if names := _without_room(models, together):
        yield f"No room was found for {join_phrases(names)}: they stay as in the original."


def one_set_in_words(members: Sequence[Model], left_out: Sequence[Model]) -> Iterator[str]:
    """That limits hold in one parameter set alone though the study has others, in a sentence."""
    if len(members) == 1 and not left_out and members[0].evaluator.study.spread:
        yield (
            "The limits were computed with one parameter set of the vehicle model; the study's"
            " other sets were not tried."
        )


def tested_in_words(unsafe: Unsafe, fits: int) -> str:
    """What every vehicle within limits did that hold in some parameter sets: with others than the
    study's own, no distance is demanded.
    """
    every = "every vehicle that was tested within them"
    if not unsafe.keep:
        sets = f" in any of {fits} parameter sets" if fits > 1 else ""
        return f"no vehicle that was tested within them is unsafe ({unsafe.description}){sets}"
    others = ""
    if fits > 1:
        others = (
            " with the study's own parameter set, and none collides with"
            f" {number_of(fits - 1, 'other')}"
        )
    return f"{every} keeps at least {unsafe.keep:.3g} m of clearance{others}"


def validation_in_words(together: LimitsTogether) -> str:
    """What joint limits were tested with: corner cases, simulations that search for a
    counterexample, and random vehicles.
    """
    evaluator = together.members[0].evaluator
    searched = len(evaluator.characteristics.scenario) > 0
    met = f" in {MET_BY_CORNERS:,} encounters" if searched else ""
    falsification = _falsification_in_words(together)
    number = "All" if evaluator.account.effort >= 1 else "Some"
    return f"{number} corner cases{met}; {falsification}; {_sampled_in_words(together)}."


def _falsification_in_words(together: LimitsTogether) -> str:
    """The falsification: `20,000 simulations that search for a counterexample (smallest clearance
    0.36 m)`.
    """
    passed = [*together.validations.values()]
    number = sum(each.attacked for each in passed)
    at_all_points = sum(each.at_all_points for each in passed)
    simulated = f"{number:,} simulations that search for a counterexample"
    if at_all_points < number:
        simulated += (
            f", {at_all_points:,} of them at all points and the others at those that were the worst"
            " for some vehicle"
        )
    between = sum(each.between for each in passed)
    if between:
        simulated += f", and {between:,} between the points of the tests"
    least, own = together.least
    unsafe = together.members[0].unsafe
    if not abs(least) < float("inf"):
        return f"{simulated}, of which none met an encounter that counts"

    # The worst of them, over all parameter sets and with the study's own.
    worst = unsafe.value_in_words(least)
    of_own = ""
    if own == own and unsafe.value_in_words(own) != worst:
        of_own = (
            f", {unsafe.value_in_words(own).partition(' ')[2]} with the study's own parameter set"
        )
    return f"{simulated} (the worst {worst}{of_own})"


def _sampled_in_words(together: LimitsTogether) -> str:
    proof = together.proof
    if proof is None:
        return "no random vehicles"
    failed = f", {proof.not_simulated} could not be simulated" if proof.not_simulated else ""
    unsafe = "none" if not proof.failures else f"{proof.failures}"
    return f"{proof.samples:,} random vehicles, {unsafe} unsafe{failed}"


def _without_room(models: Models, together: LimitsTogether) -> list[str]:
    """The characteristics that stay as in the original, beside limits that leave others room."""
    box = together.box
    assert box is not None
    return [
        item.name
        for item, low, high, last in zip(
            models.own.characteristics, box.lower, box.upper, together.room, strict=True
        )
        if low == high and last and not item.is_scenario
    ]
