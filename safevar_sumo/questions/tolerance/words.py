"""The sentences of `tolerance`.

The slots `{names}` and `{limits}` use the short names of characteristics. `{event}` is how a
vehicle fails, and `{unsafe}` is what counts as unsafe.
"""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, evidence, note

# The original vehicle, and the specified limits.
BROKEN = "the specified limit of {name} does not hold"
ROUGH = "a rough answer confirms no limit; ask again without --quick, or for more simulations"
"""The reason for which a gate (a command that must succeed) fails on a rough answer."""
NO_LIMIT = answer("Therefore no limit can be given.")
DO_NOT_RELEASE = answer("DO NOT RELEASE: the specified limits do not hold.")
OUTSIDE = answer(
    "With {name} at {value}, {event}. The specified limit is {outside} beyond the last safe value."
)
TOGETHER = answer("With all specified limits ({limits}), {event}.")
SOME_UNSAFE = "the vehicle is unsafe"
SPECIFIED_SETS = evidence(
    "The specified limits hold in {holding} of {fits} parameter sets of the vehicle model"
    " (alternative calibrations), and fail in {broken}."
)
NEAREST = evidence(
    "One such limit would hold instead, if all other specified limits stay: {limits}."
)
NONE_NEAREST = evidence(
    "Changing only one specified limit is not enough: no value was found with which all specified"
    " limits hold."
)

# The joint limits.
LIMITS = {
    (False, False): "",
    (True, False): "{name} at {low} or more",
    (False, True): "{name} at {high} or less",
    (True, True): "{name} between {low} and {high}",
}
"""Phrases of a joint limit. The key says whether its lower end, and whether its upper end, is
within the domain.
"""
KEEP = answer("Keep {limits}.")
JOINT = answer("The {number} joint limits in the table hold at the same time.")
ANY_VALUE = (
    answer("{names} may have any value of its domain (its range of values)."),
    answer("{names} may have any value of their domains (their ranges of values)."),
)
"""The sentence about one characteristic, and the sentence about several."""
UNLIMITED = answer(
    "No joint limit is needed: each characteristic may have every value of its domain (its range"
    " of values), all at the same time."
)
SPECIFIED = answer(
    "All specified limits hold, together with the joint limits in the table."
)
NOT_SPECIFIED = answer(
    "The joint limits in the table hold, but not all specified limits do."
)
SETS = evidence(
    "These limits hold in {holding} of {fits} parameter sets of the vehicle model (alternative"
    " calibrations)."
)
SAFE = evidence("No vehicle that was tested within these limits is unsafe ({unsafe}).")
CLEARANCE = (
    evidence(
        "Every vehicle that was tested within these limits keeps at least {keep:g} m of"
        " clearance."
    ),
    evidence(
        "With parameter set 0 (that of the study), every vehicle that was tested within these"
        " limits keeps at least {keep:g} m of clearance. With {others}, no tested vehicle"
        " collides."
    ),
)
"""The sentence for one parameter set, and the sentence for several."""
LEFT_OUT = condition(
    "The limits do not cover parameter set {fit} of the vehicle model, because even the original"
    " vehicle fails with this set: {event}."
)
WITHOUT_ROOM = answer(
    "Keep the original value of {names}, because no safe change was found beside the other joint"
    " limits."
)

# No joint limits.
SPECIFIED_ALONE = answer(
    "The specified limits hold if all other characteristics are as in the original vehicle."
)
NO_ROOM = answer(
    "The simulations found no joint limits of use, because no safe change of {names} was found"
    " beside the other limits."
)
NO_BOX = answer(
    "No joint limits were found ({unsafe}). The search tested {boxes} and found an unsafe vehicle"
    " within each. Other joint limits may exist, because the search cannot try all."
)
TOO_FEW = answer(
    "No joint limits can be given, because too few simulations were allowed to test any. Allow"
    " more simulations (--simulations)."
)

UNTESTED_REASON = (
    "hardly any simulated vehicle satisfies the constraints in an encounter that counts"
)
UNTESTED = answer(f"No joint limits can be given, because {UNTESTED_REASON}.")

# The wider ranges of a study.
RANGES_HOLD = evidence(
    "In the wider ranges of encounters that the study states, {number:,} simulations found no"
    " failure of these limits. The worst vehicle of this search {keeps}."
)
RANGES_FAIL = evidence(
    "These limits fail in the wider ranges of encounters that the study states: {event}."
)
RANGES_UNKNOWN = evidence(
    "No verdict for the wider ranges of encounters that the study states: none of {number:,}"
    " simulations met an encounter that counts (in which the original vehicle is safe)."
)

# Each characteristic alone.
NONE_ALONE = condition(
    "No single characteristic was found that makes the vehicle unsafe when it changes alone."
)
NO_SINGLE_CHANGE = condition(
    "No characteristic has a limit alone, because no simulated change of a single characteristic"
    " satisfies the constraints."
)
ALONE = condition(
    "A change of {names} alone can make the vehicle unsafe, with all other characteristics as in"
    " the original vehicle."
)

# Tests that were left out, and the tests of the limits.
TESTS_LEFT_OUT = note(
    "Some tests were left out, because all their values are above {end}: {tests}."
)
AT_TESTS = note(
    "Only the listed values of the tests were simulated, and no values between those (--at-tests)."
)
SEARCH = evidence(
    "{number:,} simulations searched for a counterexample (an unsafe vehicle within the limits)"
    " and found none: the worst vehicle {keeps}."
)
FRESH_RUNS = note(
    "None of {number:,} fresh runs of the worst vehicles within the limits is unsafe."
)
EMPTY_SEARCH = evidence(
    "{number:,} simulations searched for a counterexample (an unsafe vehicle within the limits),"
    " but none met an encounter that counts (in which the original vehicle is safe)."
)
SOME_CORNERS = evidence(
    "{number:,} random corner cases were simulated (vehicles with every characteristic at an end of"
    " its allowed range)."
)
CORNERS = evidence(
    "All corner cases were simulated (vehicles with every characteristic at an end of its allowed"
    " range)."
)
PROOF = evidence(
    "None of {samples:,} vehicles that were sampled within the limits is unsafe ({bound} of such"
    " vehicles are unsafe)."
)
NOT_SIMULATED = evidence(
    "{not_simulated:,} of these sampled vehicles could not be simulated."
)
NOT_COUNTED = condition(
    "{share} % of the encounters do not count, because the original vehicle keeps less than"
    " {margin:g} m of clearance in them."
)

# Sentences for a manual, one for each characteristic. All of them hold at the same time.
MANUAL_NONE = "{name}: no joint limits were found."
MANUAL_ORIGINAL = (
    "{name}: keep the original value, {original}. No safe change of this value was found beside the"
    " other joint limits. Valid for: {scope}."
)
MANUAL_ANY = (
    "{name}: every tested value is safe, from {lower} to {upper}. Valid for: {scope}."
)
MANUAL = "{name}: keep {limit}. Valid for: {scope}."
MANUAL_FAILURE = (
    "{name}: keep {limit}. With {values} and all others at their limits, {event}. Valid for:"
    " {scope}."
)
