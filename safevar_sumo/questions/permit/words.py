"""The sentences of `permit`.

The slots `{may}` and `{may_not}` are what safe and unsafe cars do. `{reach}` is how far cars are
safe, `{name}` is the parameter over which cars are driven, from `{low}` to `{top}`, and `{event}`
is how a car fails.
"""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, evidence, note

# The verdicts on cars.
DRIVING = {
    "may": "may drive",
    "may_not": "may not drive",
    "is_safe": "is safe",
    "would_fail": "would be unsafe",
    "safe": "Safe",
}
PASSING = {
    "may": "can pass the test",
    "may_not": "cannot pass the test",
    "is_safe": "passes the test",
    "would_fail": "would fail the test",
    "safe": "Passing",
}
"""Verbs of sentences about cars on roads, and about cars in a test of a regulation. A car that
passes a test need not be safe.
"""
NAMED_CAR = 'The car "{name}"'
CAR = answer("{car} {may} {reach}.")
CAR_STOPS = answer("{car} {may_not}.")
FAST = answer("{count} {may} up to {top}, or as fast as a new car.")
FAST_ENOUGH = answer("{count} {may} up to {need}.")
SLOWER = answer("{count} {may} only up to a lower {name}, which the table states.")
STOPPING = answer("{count} {may_not}, not even at {low}.")
NEW_CAR = answer("A new car {may} {reach}.")
TOO_SLOW = answer("{count} {may_not} at {need}.")
ROUGH_NEED = (
    "a rough answer lets no car drive: ask without --quick, or for more simulations"
)
"""The reason for which a gate (a command that must succeed) fails on a rough answer."""

# The reasons for which a car may drive no faster.
NOT_AT_ALL = answer("Already at {low}, {event}.")
IN_FIXED_TEST = answer("In a test with a {name} of its own, {event}.")
NEVER_MOVES = answer("No {name} can be given, because {event}.")
SAFE_TO_TOP = answer(
    "The car {is_safe} {reach}, the highest {name} that was simulated."
)
UNSAFE_BEYOND = answer("At a higher {name}, {event}.")
NEED_REACHED = answer("The car {is_safe} {reach}, and {need} is needed.")
AS_NEW = answer(
    "The car {may} as fast as a new car, {new_car}. At a higher {name}, {event}."
)
NOT_CONFIRMED = "a vehicle failed in the search, but in none of its fresh runs"
WITH_CHANGES = "with {changes}, {event}"

# Values of a car that are assumed, or measured inexactly.
MEASURED = condition(
    "The answer uses the least safe value within the measuring error of {names}."
)
ASSUMED = evidence(
    "This answer assumes values that were not measured, as the study states under [unmeasured]:"
    " {values}."
)
ASSUMED_NEW = evidence(
    "This answer assumes values that were not measured, as in a new car: {values}."
)
FURTHER_ASSUMED = condition(
    'In {count}, further values are assumed, which the column "assumed" names (--details).'
)
WORST_END = evidence(
    "The assumed {assumption} matters most: with {end} in place of the assumed {assumed}, the car"
    " {would_fail} already at {value}. The ends of all domains were tried, with the parameter set"
    " that limits the car."
)
NO_WORST_END = evidence(
    "No assumed value lowers the {name}, not even at an end of its domain (checked at the tested"
    " values, with the parameter set that limits the car)."
)

# The simulations, and the meaning of "safe".
ROUGH_LIST = note(
    "Remark: the list is a rough answer (rough = yes), whose speeds prove nothing."
)
ENDING = note("Nothing was simulated above {top}, where these tests end: {tests}.")
LEFT_OUT = note("Some tests were not driven, because they begin above {top}: {tests}.")
SAFE_BY_CRITERION = note(
    "{safe} means: the car is not unsafe ({unsafe}) in {sets} of the vehicle model."
)
SAFE_WITHOUT_CONTACT = note(
    "{safe} means: the car touches nobody in {sets} of the vehicle model."
)
SAFE_WITH_DISTANCE = note(
    "{safe} means: the car keeps at least {below:g} m of clearance in {sets} of the vehicle model."
)
SAFE_WITH_CLEARANCE = (
    note("{safe} means: the car keeps at least {keep:g} m of clearance."),
    note(
        "{safe} means: the car keeps at least {keep:g} m of clearance with parameter set 0 of the"
        " vehicle model (that of the study). With the {others}, the car touches nobody."
    ),
)
"""The sentence for one parameter set, and the sentence for several."""
TESTED = evidence(
    "In each test, {number} values {values} were simulated. {attacked:,} simulations searched for"
    " an unsafe encounter."
)
TESTED_QUICK = evidence(
    "In each test, {number} values {values} were simulated. Nothing else was simulated."
)
