"""What `compare` can say of two versions, `{a}` and `{b}`."""

from __future__ import annotations

from safevar_sumo.questions.sentence import Sentence

# The decision.
LACKING = Sentence(
    "answer",
    "DECIDE: {b} and {a} were not simulated in the same encounters.",
)
LESS_SAFE = Sentence("answer", "DO NOT RELEASE: {b} is less safe than {a}.")
LESS_SAFE_BUT_SMOOTHER = Sentence(
    "answer",
    "DO NOT RELEASE: {b} is less safe than {a}, although it brakes less often without need.",
)
MIXED = Sentence(
    "answer",
    "DECIDE: {b} is better than {a} in some things and worse in others.",
)
LESS_SMOOTH = Sentence(
    "answer",
    "DECIDE: {b} is as safe as {a}, but brakes more often without need.",
)
BRAKING_UNKNOWN = Sentence(
    "answer",
    "DECIDE: {b} is {safe} {a}, but needless braking was not measured.",
)
BETTER = Sentence(
    "answer",
    "RELEASE: {b} is better than {a}, and worse in nothing that was measured.",
)
ALIKE = Sentence(
    "answer",
    "RELEASE: {b} does not differ from {a} in anything that was measured.",
)

# What decides it.
LACKS = Sentence("answer", "Version {version} lacks {parts}, which {other} has.")
NEW_COLLISION = Sentence(
    "answer",
    "The original vehicle of {b} collides at {speed:.2f} m/s{place}. The original vehicle of {a}"
    " does not collide in the same test case.",
)
NEW_COLLISIONS = Sentence(
    "answer",
    "The original vehicle of {b} collides at {speed:.2f} m/s{place}. The original vehicle of {a}"
    " does not collide in the same test case. {number} test cases end in a collision with {b} and"
    " not with {a}, and the stated collision is the fastest.",
)
ORIGINAL_UNSAFE = Sentence(
    "answer",
    "Even the original vehicle is unsafe in {b}, although it is safe in {a}.",
)
ORIGINAL_SAFE = Sentence(
    "answer",
    "The original vehicle is safe in {b}, although it is unsafe in {a}.",
)
SAFE_NOW = Sentence(
    "answer", "{count} changed vehicles that are unsafe in {a} {are} safe in {b}."
)
UNSAFE_NOW = Sentence(
    "answer", "{count} changed vehicles that are safe in {a} {are} unsafe in {b}."
)
DEGREE = Sentence(
    "answer",
    "The safety degree of the changed vehicles is significantly {higher} in {b} than in {a}.",
)
LIMITS = Sentence(
    "answer", "The limits of single characteristics are {wider} in {b} ({names})."
)
NEEDLESS_BRAKING = Sentence(
    "answer",
    "Version {b} brakes needlessly in {after} of {scenes} benign scenes (nobody needs to brake in"
    " them), and version {a} in {before}.",
)

# What was compared.
WITHIN = Sentence("note", "Only vehicles with {limits} were compared.")
ORIGINALS_DIFFER = Sentence(
    "condition",
    "The original vehicles of {a} and {b} differ ({values}). Therefore the same changes of each"
    " original vehicle are compared.",
)

# How it was tested.
NO_TEST = Sentence(
    "note", "No statistical test is possible, because there is no pair of results."
)
TEST = Sentence(
    "note",
    "A signed-rank test compares the mean safety degree in both versions over {number} pairs"
    " ({pairs}): p = {p:.2g}. A value of {a} is larger than one of {b} with a probability of"
    " {a12:.2f} (effect size A12).",
)
