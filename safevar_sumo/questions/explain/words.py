"""The sentences of `explain`.

The slot `{unsafe}` is a collision, or an unsafe vehicle by another criterion. `{collide}` and
`{causes}` are verbs, in the singular or plural that fits the count of the sentence.
"""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, evidence, note

# The smallest unsafe changes of a study.
AT_ENDS = (
    answer(
        "One change is enough for {unsafe}: {changes}, an end of its domain (its range of values)."
    ),
    answer(
        "{number} changes together are enough for {unsafe}: {changes}, each at an end of its"
        " domain (its range of values)."
    ),
)
"""The sentence about one change, and the sentence about several changes."""
ON_THE_WAY = (
    answer(
        "One change is enough for {unsafe}: {changes}, {share} % of the way from the original"
        " value to an end of its domain (its range of values)."
    ),
    answer(
        "{number} changes together are enough for {unsafe}: {changes}, each {share} % of the way"
        " from its original value to an end of its domain (its range of values)."
    ),
)
"""The sentence about one change, and the sentence about several changes."""
WITH_REPEATS = answer(
    "With {number} the vehicle {fails}: {changes}. All other characteristics are as in the original"
    " vehicle."
)
NOT_CONFIRMED = answer(
    "No cause was confirmed: each vehicle that failed in the search was safe in all its fresh runs."
)
OTHERS = answer("The table lists {causes} with the same number of changes.")
NOTHING_FOUND = answer(
    "The search found no cause of {unsafe} with {changes}, each at an end of its domain (its range"
    " of values)."
)
TOO_FEW = answer(
    "No cause was found, because too few simulations were allowed. Allow more simulations"
    " (--simulations)."
)
UNSAFE_IN_ENCOUNTER = answer(
    "The original vehicle is already unsafe in this encounter, without any change."
)

# The causes of failures in results.
NONE_UNSAFE = answer(
    "No cause was found, because none of the examined vehicles is unsafe."
)
ENDING = evidence("The original vehicle {ending}.")
CHANGES = (
    answer(
        "One change is enough for {unsafe}: {changes}. All other characteristics are as in the"
        " original vehicle."
    ),
    answer(
        "{number} changes together are enough for {unsafe}: {changes}. All other characteristics"
        " are as in the original vehicle."
    ),
)
"""The sentence about one change, and the sentence about several changes."""
ENCOUNTER = answer(
    "The original vehicle is safe in the same encounter, which has {values}."
)
SHARE = evidence(
    "{count} failures whose causes were searched {have} the same cause (the same characteristics,"
    " changed in the same direction)."
)
BEYOND = evidence("{count} vehicles that were tested with {larger} {collide}.")

# The certainty of a cause.
GAP = evidence(
    "The unsafe range has a gap: at {share} % of the way to the ends, the vehicle is safe again."
)
CHECKED_WITH = evidence("The checks of {checks} use these values: {changes}.")
SETS = evidence(
    "The same cause was found in {holds} of {fits} parameter sets of the vehicle model"
    " (alternative calibrations)."
)
ROBUST = evidence(
    "The cause is robust: {share} vehicles with slightly different values are unsafe, too."
)
BORDERLINE = evidence(
    "The cause is borderline: only {share} vehicles with slightly different values are unsafe."
)

# The simulations of a study.
OF_SIZE = evidence("{count} {combinations} {causes}.")
ONLY = evidence("The only simulated combination of {changes} {is_safe}.")
OF_PART = evidence(
    "{count} simulated {combinations} {causes} ({existing:,} such combinations exist)."
)
STEP = note(
    "{changes} enough for {unsafe} if each change goes {shares} % of the way to an end of its"
    " domain."
)
STEP_WITH_REPEATS = note(
    "With {changes}, some of the repeated runs fail at {shares} % of the way to the ends of the"
    " domains."
)
STEP_WITHOUT = note(
    "None of {tried:,} simulated combinations of {changes} {causes} at {shares} % of the way to the"
    " ends of the domains."
)
LARGER_LEFT_OUT = note(
    "Combinations of more changes were not simulated there, because they are too many."
)
CONTAINING = condition(
    "The counts of combinations leave out {combinations} with a smaller cause (fewer unsafe"
    " changes)."
)
CURES = condition(
    "Another change prevents the failure in {count} simulated combinations with a smaller cause."
)
IN_NONE = condition(
    "No cause with {changes}, each at an end of its domain, includes {names}."
)
SCOPE = note(
    "Valid for: the original encounter and the {number} encounters in which the original vehicle"
    " is least safe."
)

# The number of failures, and the drivers who would have avoided them.
NUMBER_OF_SAMPLE = evidence("{count} vehicles that were {sampled} {collide}.")
NUMBER_OF_SOLUTIONS = evidence(
    "{count} different vehicles that the search returned (its solutions) {collide}."
)
COMPETENT_DRIVER = evidence(
    "A competent driver (as in UN R157) in the same vehicle would have avoided {avoided:,} of"
    " {collisions}."
)
FULL_BRAKING = evidence(
    "Full braking at the first possible moment would have avoided {avoided:,} of {collisions}."
)
COMPLETE = condition(
    "For the examined failures, all minimal causes (smallest unsafe sets of changes) with up to"
    " {changes} were found."
)

# The end of a failing run, for a table.
AT_POINT = evidence(
    "In the test case {point}, the original vehicle {original}. The failed vehicle {changed}."
)
