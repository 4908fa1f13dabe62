"""The sentences of `compare` about two versions, `{a}` and `{b}`."""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, note

# The decision.
LACKING = answer("DECIDE: {b} and {a} were not tested in the same way.")
LESS_SAFE = answer("DO NOT RELEASE: {b} is less safe than {a}.")
LESS_SAFE_BUT_SMOOTHER = answer(
    "DO NOT RELEASE: {b} is less safe than {a}, although it brakes less often without need."
)
MIXED = answer("DECIDE: {b} is better than {a} in some things and worse in others.")
LESS_SMOOTH = answer(
    "DECIDE: {b} is as safe as {a}, but brakes more often without need."
)
BRAKING_UNKNOWN = answer(
    "DECIDE: {b} is {safe} {a}, but needless braking was not measured."
)
BETTER = answer(
    "RELEASE: {b} is better than {a}, and worse in nothing that was measured."
)
ALIKE = answer("RELEASE: {b} does not differ from {a} in anything that was measured.")

# The differences that decide.
LACKS = answer("Version {version} lacks {parts}, which {other} has.")
LEAVES_OUT = answer(
    "Version {version} leaves out values in the ranges of {other}: {values}."
)
ALLOWS = answer(
    "The tests of {version} allow an impact of {speed}, those of {other} {least} ({tests})."
)
CRITERIA = answer(
    "The study {b} calls a vehicle unsafe by the criterion `{in_b}`, and {a} by `{in_a}`."
)
NEW_COLLISION = answer(
    "The original vehicle of {b} collides at {speed:.2f} m/s{place}. The original vehicle of {a}"
    " does not collide in the same test case."
)
NEW_COLLISIONS = answer(
    "The original vehicle of {b} collides in {number} test cases in which the original vehicle of"
    " {a} does not collide. The fastest of these collisions has {speed:.2f} m/s{place}."
)
ORIGINAL_UNSAFE = answer(
    "Even the original vehicle is unsafe in {b}, although it is safe in {a}."
)
ORIGINAL_SAFE = answer(
    "The original vehicle is safe in {b}, although it is unsafe in {a}."
)
SAFE_NOW = answer("{count} changed vehicles that are unsafe in {a} {are} safe in {b}.")
UNSAFE_NOW = answer(
    "{count} changed vehicles that are safe in {a} {are} unsafe in {b}."
)
DEGREE = answer(
    "The safety degree of the changed vehicles is significantly {higher} in {b} than in {a}."
)
LIMITS = answer("The limits of single characteristics are {wider} in {b} ({names}).")
NEEDLESS_BRAKING = answer(
    "Version {b} brakes needlessly in {after} of {scenes} benign scenes (nobody needs to brake in"
    " them), and version {a} in {before}."
)

# The basis of the comparison.
WITHIN = note("Only vehicles with {limits} were compared.")
ORIGINALS_DIFFER = condition(
    "The original vehicles of {a} and {b} differ ({values}). Therefore the same changes of each"
    " original vehicle are compared."
)

EQUAL_RESULTS = note(
    "The code of {a} and {b} differs in {files}, but every simulated vehicle has equal results in"
    " both. Check whether {b} uses the changed code."
)

# The statistical test.
NO_TEST = note("No statistical test is possible, because there is no pair of results.")
TEST = note(
    "A signed-rank test compares the mean safety degree of the same vehicles in both versions,"
    " over {number} groups of vehicles ({groups}): p = {p:.2g}. The mean safety degree of a"
    " group is larger in {a} than in {b} with a probability of {a12:.2f} (effect size A12)."
)
