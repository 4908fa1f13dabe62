"""The sentences of the answer of `simulate`."""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, note

ORIGINAL = answer("The original vehicle {original}.")
CHANGED = answer("The changed vehicle {changed}. The original vehicle {original}.")
ORIGINAL_IN_TEST = answer("In the test case {test}, the original vehicle {original}.")
CHANGED_IN_TEST = answer(
    "In the test case {test}, the changed vehicle {changed}. The original vehicle {original} in"
    " the same test case."
)
ORIGINAL_IN_WORST = answer(
    "The original vehicle {original} in the worst of {number} test cases ({test})."
)
CHANGED_IN_WORST = answer(
    "The changed vehicle {changed} in the worst of {number} test cases ({test}). The original"
    " vehicle {original} in the same test case."
)
STOPPING_DISTANCE = answer(
    "The changed vehicle needs {factor:.2f} times the stopping distance of the original vehicle."
)
LESS_SAFE = answer("The changed vehicle is less safe than the original vehicle.")
SAFER = answer("The changed vehicle is safer than the original vehicle.")
EQUALLY_SAFE = answer("Both vehicles are equally safe.")
DIFFERENCE = answer(
    "The mean safety degree of the changed vehicle minus that of the original vehicle is"
    " {difference:+.2f} m (95 %: {low:+.2f} to {high:+.2f} m)."
)
NO_DIFFERENCE = answer("The repeated runs do not show which vehicle is safer.")
UNDECIDED = answer(
    "This simulation cannot tell which vehicle is safer, because a safety degree is undefined."
)
LEFT_OUT = condition(
    "A search would leave this encounter out: the original vehicle keeps less than the required"
    " {demand:.2f} m in this encounter."
)
CHANGES = note("Changed: {changes}.")
ENCOUNTER = condition("The encounter has {values}.")
LATER = condition("The encounter begins {phase:g} steps of the driving system later.")
IGNORED = (
    "The largest change (f_diff) and the number of changes (f_num_diff) count {small} as unchanged,"
    " because a search ignores such small changes. All other numbers are those of the vehicle as"
    " stated."
)
