"""The sentences of `rules`."""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, evidence

OUTSIDE = answer(
    "{outside:.0f} % of all unsafe vehicles lie outside of {regions} that the table lists."
)
REGION = answer(
    "Vehicles are unsafe more often in this region than in the rest of the domain (all ranges of"
    " values): {region}."
)
DENSITY = answer("{density:.0f} % of the vehicles in this region are unsafe.")
DENSITY_OVER_SETS = answer(
    "{density:.0f} % of the vehicles in this region are unsafe. Over the parameter sets of the"
    " vehicle model, this share ranges from {density_least:.0f} to {density_greatest:.0f} %."
)
COVERAGE = answer("{coverage:.0f} % of all unsafe vehicles lie in this region.")
NO_REGION = answer(
    "No region was found in which vehicles are unsafe more often than in the whole domain (all"
    " ranges of values)."
)
TOO_FEW = answer(
    "No region can be found, because the search has only {unsafe:,} unsafe and {safe:,} safe"
    " vehicles. At least {least} vehicles of both kinds are needed. Ask for more vehicles by"
    " --samples, or by --simulations if you stated it."
)
SHARE = evidence(
    "{count} vehicles that were {sampled} {collide}: {share} % (95 % confidence interval"
    " {interval})."
)
