"""What `explain` can say.

`{unsafe}` is a collision, or an unsafe vehicle by another criterion; `{collide}` and `{causes}` are
verbs for as many as the sentence counts.
"""

from __future__ import annotations

from safevar_sumo.questions.sentence import Sentence

# Of a study: the smallest changes.
AT_ENDS = (
    Sentence(
        "answer",
        "One change is enough for {unsafe}: {changes}, an end of its domain (its range of values).",
    ),
    Sentence(
        "answer",
        "{number} changes together are enough for {unsafe}: {changes}, each at an end of its domain"
        " (its range of values).",
    ),
)
"""Of one change, and of several."""
ON_THE_WAY = (
    Sentence(
        "answer",
        "One change is enough for {unsafe}: {changes}, {share} % of the way from the original value"
        " to an end of its domain (its range of values).",
    ),
    Sentence(
        "answer",
        "{number} changes together are enough for {unsafe}: {changes}, each {share} % of the way"
        " from its original value to an end of its domain (its range of values).",
    ),
)
"""Of one change, and of several."""
OTHERS = Sentence("answer", "The table lists {causes} with the same number of changes.")
NOTHING_FOUND = Sentence(
    "answer",
    "The search found no cause of {unsafe} with {up_to}, each at an end of its domain (its range of"
    " values).",
)
TOO_FEW = Sentence(
    "answer",
    "No cause was found, because too few simulations were allowed. Allow more simulations"
    " (--simulations).",
)
UNSAFE_IN_ENCOUNTER = Sentence(
    "answer",
    "The original vehicle is already unsafe in this encounter, without any change.",
)

# Of results: what is enough for their failures.
ALREADY_UNSAFE = Sentence(
    "answer",
    "The original vehicle is already unsafe: it {breach}. A failure needs no change of the"
    " vehicle.",
)
NONE_UNSAFE = Sentence(
    "answer",
    "No cause was found, because none of the examined vehicles is unsafe.",
)
ENDING = Sentence("evidence", "The original vehicle {ending}.")
CHANGES = (
    Sentence(
        "answer",
        "One change is enough for {unsafe}: {changes}. All other characteristics are as in the"
        " original vehicle.",
    ),
    Sentence(
        "answer",
        "{number} changes together are enough for {unsafe}: {changes}. All other characteristics"
        " are as in the original vehicle.",
    ),
)
"""Of one change, and of several."""
ENCOUNTER = Sentence(
    "answer",
    "The original vehicle is safe in the same encounter, which has {values}.",
)
SHARE = Sentence(
    "evidence",
    "{count} failures whose causes were searched {have} the same cause (the same characteristics,"
    " changed in the same direction).",
)
BEYOND = Sentence(
    "evidence", "{count} vehicles that were tested with {larger} {collide}."
)

# How sure a cause is.
GAP = Sentence(
    "evidence",
    "The unsafe range has a gap: at {share} % of the way to the ends, the vehicle is safe again.",
)
CHECKED_WITH = Sentence(
    "evidence",
    "The program checked this cause with similar vehicles and other parameter sets, from these"
    " values on: {changes}.",
)
RUNS = Sentence("evidence", "The vehicle is unsafe in {share} % of its repeated runs.")
SETS = Sentence(
    "evidence",
    "The same cause was found in {holds} of {fits} parameter sets of the vehicle model (alternative"
    " calibrations).",
)
ROBUST = Sentence(
    "evidence",
    "The cause is robust: {share} vehicles with slightly different values are unsafe, too.",
)
BORDERLINE = Sentence(
    "evidence",
    "The cause is borderline: only {share} vehicles with slightly different values are unsafe.",
)

# What was simulated of a study.
OF_SIZE = Sentence("evidence", "{count} {combinations} {causes}.")
OF_PART = Sentence(
    "evidence",
    "{count} simulated {combinations} {causes} ({existing:,} such combinations exist).",
)
STEP = Sentence(
    "note",
    "{changes} enough for {unsafe} if each change goes {shares} % of the way to an end of its"
    " domain.",
)
STEP_WITHOUT = Sentence(
    "note",
    "None of {tried:,} simulated combinations ({up_to}) {causes} if each change goes {shares} % of"
    " the way to an end of its domain.",
)
CONTAINING = Sentence(
    "condition",
    "The counts of combinations leave out {combinations} with a smaller cause (fewer changes that"
    " are enough).",
)
CURES = Sentence(
    "condition",
    "Another change prevents the failure in {count} simulated combinations with a smaller cause.",
)
IN_NONE = Sentence("condition", "No cause with {up_to} includes {names}.")
SCOPE = Sentence(
    "note",
    "Valid for: the original encounter and the {number} encounters in which the original vehicle is"
    " least safe.",
)

# How many vehicles fail, and who would have avoided it.
NUMBER_OF_SAMPLE = Sentence(
    "evidence", "{count} vehicles that were {sampled} {collide}."
)
NUMBER_OF_SOLUTIONS = Sentence(
    "evidence",
    "{count} different vehicles that the search returned (its solutions) {collide}.",
)
COMPETENT_DRIVER = Sentence(
    "evidence",
    "A competent driver (as in UN R157) in the same vehicle would have avoided {avoided:,} of"
    " {collisions}.",
)
FULL_BRAKING = Sentence(
    "evidence",
    "Full braking at the first possible moment would have avoided {avoided:,} of {collisions}.",
)
COMPLETE = Sentence(
    "condition",
    "For the examined failures, all minimal causes (smallest unsafe sets of changes) with up to"
    " {changes} were found.",
)

# In a table: how a failure ends.
AT_POINT = Sentence(
    "evidence",
    "In the test case {point}, the original vehicle {original}. The failed vehicle {changed}.",
)
