"""The sentences of `repair`.

The slot `{safe}` says what all vehicles do; `{wear}` is the wear that vehicles may have.
"""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, evidence, note

# The repair, or the reason for none.
NOT_NECESSARY = (
    answer(
        "No repair is necessary. With the present driving system, all tested vehicles within the"
        " required wear {safe}."
    ),
    answer(
        "No repair is necessary. With the present driving system, all tested vehicles within the"
        " required wear that any driving system can keep safe {safe}."
    ),
)
"""The first sentence is for a promise in which full braking keeps all vehicles safe; the second
sentence is for any other promise.
"""
WORST = evidence("The worst vehicle {ending}.")
NOTHING_FOUND = answer(
    "No repair was found among the changes of one or two parameters. The parameters that may"
    " change are {names}."
)
REPAIR = answer(
    "The {kind} repair that was found changes {number} of the driving system: {change}."
)
CHANGE = "{meaning} ({name}) from {old} to {new}"
REPAIRED = answer(
    "With this repair, all tested vehicles that wear no further than promised {safe}."
)

# The price of the repair.
EARLIER = evidence(
    "With the repair, the original vehicle brakes up to {metres_earlier:.2f} m earlier."
)
NO_BRAKING = evidence(
    "The original vehicle brakes in none of the test cases, so its braking cannot come earlier."
)
NEEDLESS_BRAKING = evidence(
    "With the repair, the original vehicle brakes needlessly in {needless_braking} of"
    " {benign_scenes} benign scenes (nobody needs to brake in them), and without the repair in"
    " {needless_braking_today}."
)
NO_SCENES = evidence(
    "Needless braking was not measured, because the study has no benign scenes."
)

# The validity of the repair, and its tests.
WEAR = note("Required wear: {wear}.")
NOT_REPAIRABLE = note(
    "Remark: with {parts}, the vehicle is unsafe even with full braking at the first possible"
    " moment. Such a vehicle needs a repaired part, not another parameter."
)
MORE_NOT_REPAIRABLE = note(
    "The option --json prints {number} more such limits (not_repairable)."
)
PROOF = evidence(
    "None of {samples:,} worn vehicles that were sampled afterwards is unsafe ({bound} of such"
    " vehicles are unsafe)."
)
SETS = evidence(
    "The answer holds in {fits} of {number} parameter sets of the vehicle model (alternative"
    " calibrations), each with a search for a counterexample (an unsafe vehicle within the"
    " required wear)."
)
BROKEN = condition("In {sets}, a vehicle within the required wear collides.")
