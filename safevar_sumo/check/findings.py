"""Findings of `check`: what is wrong in user code, where, and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import nullcontext
from typing import NamedTuple

from safevar_sumo.plugins import Lookup
from safevar_sumo.study import Study, user_code
from safevar_sumo.sumo.traci_controller import substitute_traci

METRIC, ALGORITHM, SIMULATOR = "metric", "algorithm", "simulator"
"""Kinds of user code that get advice of their own. All other classes share theirs."""
KIND_OF_KEY = {
    "metrics.also": METRIC,
    "search.objectives": METRIC,
    "search.algorithms": ALGORITHM,
}
CHECKS: Mapping[str, Mapping[str, str]] = {
    "contract": {
        "": (
            "return what the base class documents, leave arguments as they are, and guard divisions"
            " and roots where the domain ends"
        ),
        METRIC: (
            "return one number for each run or setting, state what a metric reads in its needs, and"
            " guard divisions and roots where the domain ends"
        ),
        ALGORITHM: (
            "yield filtered settings within the domains, and return evaluations that were received"
        ),
        SIMULATOR: (
            "return what `simulate` documents: in each sample the quantities of one moment, in SI"
            " units, and an end of the run that fits the samples"
        ),
    },
    "repetition": {
        "": "draw nothing at random, read no clock, and keep nothing in a class or a module",
        ALGORITHM: (
            "draw random numbers from `rng` alone, read no clock, and keep nothing in a class or a"
            " module"
        ),
        SIMULATOR: (
            "give each random part a generator of its own with a fixed seed, read no clock, and"
            " keep nothing of a run for the next run"
        ),
    },
    "order": {
        "": (
            "compute element i of a result from element i of the arguments alone, whatever its"
            " place"
        ),
        SIMULATOR: (
            "keep nothing of a run for the next run in a class, a module or an engine"
        ),
    },
    "alone": {
        "": (
            "compute element i of a result from element i of the arguments alone: no mean, sum or"
            " maximum over the vehicles; keep what a vehicle remembers in its memory or its own"
            " instance, not in a class or a module"
        ),
        METRIC: (
            "compute number i of a metric from run i alone: no mean, sum or maximum over the runs"
        ),
        SIMULATOR: (
            "keep nothing of a run for the next run in a class, a module or an engine"
        ),
    },
    "reaction": {
        "": (
            "command enough throttle while nobody is in sight, where `gap` is infinite; check that"
            " the code reads the quantity that it should react to, with the right sign and unit"
        ),
    },
    "meeting": {
        "": (
            "choose values of the scenario's parameters at which the vehicle meets the others"
            " before they have left, and check the signs of places and speeds: the others come into"
            " its way"
        ),
    },
    "undefined": {
        "": (
            "let runs have what the metric reads, its `needs`, or return a number where the metric"
            " is defined; else leave out its name"
        ),
        SIMULATOR: (
            "return what the metric needs, such as `gap` and `obstacle_speed`, or the metric itself"
            " without a trace; else leave out its name"
        ),
    },
    "constant": {
        "": (
            "compute the metric from the runs or settings that it gets, or leave out its name"
        ),
    },
    "unread": {
        "": (
            "read each value of the setting by its name, spelled as in `UNITS`, or leave out the"
            " characteristic"
        ),
    },
    "standing": {
        "": (
            "find out with `simulate` why a changed vehicle never moves: read each value of the"
            " setting in its unit, compare numbers by `<` instead of `==`, and start with any of"
            " them"
        ),
    },
    "modified": {
        "": "change a copy, such as `setting = dict(setting)`, and not the setting itself",
    },
    "shift": {
        "": "read speed, gap and position at the same moment of each step, and then append them",
    },
    "step": {
        "": (
            "multiply each change of the state by the time step [s], the argument `step` of"
            " `prepare`"
        ),
    },
    "duplicates": {
        "": (
            "keep the evaluations that were received, yield other settings, and return each"
            " solution once"
        ),
    },
    "original": {
        "": (
            "find out with `simulate` why the original vehicle fails, and check signs and units;"
            " changes of a vehicle that is unsafe as it is explain nothing"
        ),
    },
}
"""The checks by name, each with advice after a failure, by the kind of user code. Failures of the
first four checks also prevent a study from starting.
"""


class Code(NamedTuple):
    """User code of a study: its key and its name, such as `ads.model` and `my_ads:Careful`."""

    key: str
    name: str


class Finding(NamedTuple):
    """A failed check.

    Attributes
    ----------
    check
        The name of the check.
    finding
        The wrong result.
    where
        The file and line of the user code; "" in a finding of a trial, which does not know the
        place.
    input
        The vehicle with the wrong result, in words.
    expected
        The right result.
    advice
        What to do; "" in a finding of a trial.
    """

    check: str
    finding: str
    where: str
    input: str
    expected: str
    advice: str = ""

    def __str__(self) -> str:
        """The finding with its input and place on one line."""
        line = f"{self.check}: {self.finding}"
        if self.input:
            line += f", with {self.input}"
        if self.where not in self.finding:
            line += f" ({self.where})"
        return line

    def in_code(self, study: Study, code: Iterable[Code]) -> Finding:
        """The finding with its place and its advice, if it is in one of these pieces of user
        code.
        """
        places = []
        advices = []
        by_kind = CHECKS[self.check]
        for piece in code:
            places.append(definition(study, piece))
            advices.append(by_kind.get(kind_of(study, piece.key), by_kind[""]))
        # Code of several kinds gets all advice, each only once.
        advice = "; ".join(dict.fromkeys(advices)) or by_kind[""]
        where = self.where or " or ".join(dict.fromkeys(places)) or study.source
        return self._replace(where=where, advice=advice)


Findings = Iterator[Finding]
"""Findings that are computed one by one, when the caller asks for the next finding."""


def kind_of(study: Study, key: str) -> str:
    """The kind of the user code under a key of a study, one of those with advice of their own; ""
    for others.
    """
    # A study of a simulator names no vehicle model: the simulator moves the vehicle.
    if key == "scenario.model" and not study.vehicle.model:
        return SIMULATOR
    return KIND_OF_KEY.get(key, "")


def definition(study: Study, code: Code) -> str:
    """The file and line at which user code is defined. Without a known line: its key and name."""
    if ":" not in code.name:
        return f"{code.key} = {code.name!r}"
    with substitute_traci() if study.ads.kind == "traci" else nullcontext():
        found = Lookup.of(study).find({}, code.name, code.key).code
    # A name with a colon always is a name of user code.
    assert found is not None
    return found.definition() or found.name


def pieces_of_code(study: Study) -> list[Code]:
    """The user code of a study."""
    return [Code(key, name) for key, name in user_code(study)]


def own_measures(study: Study) -> dict[str, Code]:
    """The user's measures that a study names, by the name of their column."""
    lookup = Lookup.of(study)
    measures = {}
    for code in pieces_of_code(study):
        if KIND_OF_KEY.get(code.key) == METRIC:
            measures[lookup.find({}, code.name, code.key).target.name] = code
    return measures
