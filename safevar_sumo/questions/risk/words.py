"""The sentences of `risk`."""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, evidence

PROBABILITY = answer(
    "The probability that a vehicle {unsafe.verbs[0]} is about {share} % ({confidence:g} %"
    " confidence interval {interval})."
)
SHARE = answer(
    "About {share} % of the vehicles in the whole domain (all ranges of values) {unsafe.verbs[1]}"
    " ({confidence:g} % confidence interval {interval})."
)
BOUND = answer(
    "No sampled vehicle is unsafe, so at most {high} % of the vehicles are unsafe (upper end of"
    " the {confidence:g} % confidence interval)."
)
NEEDED = answer(
    "To show a share of at most {rare} %, {needed:,} sampled vehicles are needed, and all must be"
    " safe (--samples)."
)
NO_PROBABILITY = evidence(
    "This share is no probability in traffic, because the study does not state how vehicles vary"
    " ([variation])."
)
SAMPLED = evidence("{count} vehicles that were {sampled} {do}.")
NOT_SIMULATED = evidence("This share leaves out {failed} that could not be simulated.")
LARGEST_INFLUENCE = evidence(
    "{name} has the largest influence: it causes {share:.0f} % of the variance of {measure}"
    " ({confidence:g} % confidence interval {low:.0f} to {high:.0f} %)."
)
UNCERTAIN_INFLUENCE = evidence(
    "The largest influence is uncertain. {name} causes {share:.0f} % of the variance of {measure}"
    " ({confidence:g} % confidence interval {low:.0f} to {high:.0f} %), but the interval of"
    " {rivals} overlaps with this interval."
)
NO_INFLUENCE = evidence(
    "No characteristic has an influence: {measure} is the same for all sampled vehicles."
)
UNKNOWN_INFLUENCE = evidence(
    "The characteristics with the largest influence are unknown: at least {least} sampled vehicles"
    " are needed (--samples)."
)
FEW_OUTCOMES = evidence(
    "The characteristics that decide between safe and unsafe are unknown: at least {least} unsafe"
    " and {least} safe vehicles are needed."
)
