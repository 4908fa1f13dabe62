"""Finds what the study of one version asks less of than that of the other version: test cases,
weathers, ranges and parameter sets that it lacks, vehicles and encounters that its constraints or
margin exclude, impacts that its tests allow, and another criterion.

A version whose failing tests were deleted would look safer, although nothing shows that it is
safer. All parts of a study count, whether this command uses them or not: `--ranges` uses the ranges
of a study whose tests are listed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import permutations, product
from typing import Any, NamedTuple

from safevar_sumo.questions.compare.words import (
    ALLOWS,
    CRITERIA,
    LACKS,
    LEAVES_OUT,
)
from safevar_sumo.questions.counterexamples import OF_ENCOUNTER
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.pairs import Titles
from safevar_sumo.questions.part import points_of_tests
from safevar_sumo.questions.sentence import Sentences
from safevar_sumo.questions.words import join_few, number_of
from safevar_sumo.records import KMH_PER_MS
from safevar_sumo.scenarios import Point
from safevar_sumo.study import MatrixTest, Study, Weather, unit_text
from safevar_sumo.study.characteristics import Domain, Interval

MAX_PARTS_NAMED = 4
"""Maximum number of missing parts that a sentence names."""
CHANGE_DECIMALS = 9
"""Decimals of changes that count. Differences of rounded values have errors beyond them."""
OF_VEHICLE = "vehicle."
"""Prefix of the parameters of a parameter set that belong to the vehicle. Versions of a driving
system have these parameters in common.
"""


class TestCase(NamedTuple):
    """The encounter at a point of a matrix. It lacks the name of the test, which versions may
    change.
    """

    model: str
    parameters: dict[str, Any]
    weather: Weather


def cases_of(side: Evaluator) -> Iterator[tuple[MatrixTest | None, Point, TestCase]]:
    """Yield the test cases of a version, each with its test (None without tests) and its point."""
    scenario = side.study.scenario
    for test, points_of_test in points_of_tests(side.study, side.system.points):
        model = (test and test.model) or scenario.model
        stated = {**scenario.parameters, **(test.parameters if test else {})}
        for point in points_of_test:
            driven = {
                key: value
                for key, value in point.parameters.items()
                if key not in OF_ENCOUNTER
            }
            yield test, point, TestCase(model, stated | driven, point.weather)


class Coverage(NamedTuple):
    """What a version is tested with: its study, and its listed test cases, each with the name of
    its test (without tests: of its scenario) and its point.
    """

    study: Study
    cases: list[tuple[str, Point, TestCase]]

    @classmethod
    def of(cls, side: Evaluator) -> Coverage:
        """The coverage of a version. Values that an axis lists count even if its range is used."""
        study = side.study
        cases = []
        for test, point, case in cases_of(side):
            axes = study.axes_of(test)
            lists = {
                axis: axes[axis].at for axis in study.ranges_of(test) if axes[axis].at
            }
            for values in product(*lists.values()):
                listed = dict(zip(lists, values, strict=True))
                words = [point.name, *(f"{axis} {listed[axis]}" for axis in listed)]
                parameters = {**case.parameters, **listed}
                cases.append(
                    (
                        test.name if test else case.model,
                        point._replace(name=", ".join(words)),
                        case._replace(parameters=parameters),
                    )
                )
        return cls(study, cases)

    def counterpart(self, name: str, case: TestCase) -> str | None:
        """The name of the test that has this name or else this test case; None if there is none."""
        if any(test == name for test, _, _ in self.cases):
            return name
        return next((test for test, _, own in self.cases if own == case), None)

    def ranges_of(self, name: str) -> Mapping[str, Domain]:
        """The ranges that the study states for a test (without tests: for its scenario)."""
        tests = {test.name: test for test in self.study.tests}
        return self.study.stated_ranges_of(tests.get(name))


def missing_parts(side: Coverage, reference: Coverage) -> list[str]:
    """The parts of the version `reference` that the version `side` lacks, as phrases."""
    parts = [
        *_missing_cases(side, reference),
        *_excluded(side.study, reference.study),
        *_missing_sets(side.study, reference.study),
    ]
    return list(dict.fromkeys(parts))


def missing_in_words(a: Evaluator, b: Evaluator, titles: Titles) -> Sentences:
    """Yield sentences on what the study of one version asks less of than the other, such as
    `Version b lacks the test CCRs, which a has.` `titles` are the names of the versions.
    """
    sides = (Coverage.of(a), titles["a"]), (Coverage.of(b), titles["b"])
    for (side, own), (reference, other) in permutations(sides):
        if parts := missing_parts(side, reference):
            parts_named = join_few(parts, MAX_PARTS_NAMED)
            yield LACKS(version=own, other=other, parts=parts_named)
        if values := left_out(side, reference):
            values_named = join_few(values, MAX_PARTS_NAMED)
            yield LEAVES_OUT(version=own, other=other, values=values_named)
        for (speed, least), tests in allowances(side, reference).items():
            yield ALLOWS(
                version=own,
                other=other,
                tests=join_few(tests, MAX_PARTS_NAMED),
                speed=f"{speed:g} km/h",
                least=f"{least:g} km/h" if least else "none",
            )
    in_a = _criterion(a.study)
    in_b = _criterion(b.study)
    if in_a != in_b:
        yield CRITERIA(in_a=in_a, in_b=in_b, **titles)


def _criterion(study: Study) -> str:
    """The criterion by which a study calls a vehicle unsafe."""
    return study.unsafe.criterion or "collision"


def _missing_cases(side: Coverage, reference: Coverage) -> Iterator[str]:
    """Yield the weathers, test cases and tests of `reference` that `side` lacks, as phrases."""
    tests, _, cases = zip(*side.cases, strict=True)
    weathers = {case.weather for case in cases}
    for test, point, case in reference.cases:
        if case in cases:
            continue
        variants = [case._replace(weather=weather) for weather in weathers]
        is_driven = any(variant in cases for variant in variants)
        if case.weather not in weathers and is_driven:
            yield f"the weather {case.weather.name}"
        elif test in tests and point.name:
            yield f"the test case ({point.name})"
        else:
            yield f"the test {test}"


def left_out(side: Coverage, reference: Coverage) -> list[str]:
    """The values in ranges of `reference` that are in no range of `side`, as phrases: of
    characteristics and of encounters.
    """
    own_domains = side.study.vehicle.characteristics
    domains = {
        name: domain
        for name, domain in reference.study.vehicle.characteristics.items()
        if not _has_changes_of(own_domains[name], domain)
    }
    phrases = list(_outside_of(domains, own_domains))
    for test, _, case in reference.cases:
        # A test that `side` lacks altogether is named elsewhere.
        counterpart = side.counterpart(test, case)
        if counterpart is not None:
            where = f" in the test {test}" if reference.study.tests else ""
            own_ranges = side.ranges_of(counterpart)
            ranges = reference.ranges_of(test)
            phrases += [f"{part}{where}" for part in _outside_of(ranges, own_ranges)]
    return list(dict.fromkeys(phrases))


def _outside_of(
    ranges: Mapping[str, Domain], own_ranges: Mapping[str, Domain]
) -> Iterator[str]:
    """Yield the parts of ranges that are outside of other ranges of the same names, as phrases."""
    for name, domain in ranges.items():
        for part in _outside(domain, own_ranges.get(name)):
            yield _values_in_words(name, part, domain.unit)


def _has_changes_of(own: Domain, domain: Domain) -> bool:
    """Whether a domain has all changes of another domain, each from its own original value."""
    shift = domain.original - own.original
    begins = round(own.lower + shift - domain.lower, CHANGE_DECIMALS) <= 0
    ends = round(own.upper + shift - domain.upper, CHANGE_DECIMALS) >= 0
    return begins and ends


def _values_in_words(name: str, part: Interval, unit: str) -> str:
    """A part of a range as a phrase, such as `speed from 40 to 60 km/h`."""
    low, high = part
    return f"{name} from {low:g} to {high:g}{unit_text(unit)}"


def _outside(domain: Domain, own: Domain | None) -> Iterator[Interval]:
    """Yield the parts of a range that are outside of another range."""
    if own is None:
        yield domain.lower, domain.upper
        return
    if own.lower > domain.lower:
        yield domain.lower, min(own.lower, domain.upper)
    if own.upper < domain.upper:
        yield max(own.upper, domain.lower), domain.upper


def allowances(
    side: Coverage, reference: Coverage
) -> dict[tuple[float, float], list[str]]:
    """The names of the tests of `side` that allow a faster impact than `reference` allows in the
    same test case, by both allowed speeds [km/h].
    """
    tests: dict[tuple[float, float], list[str]] = {}
    for test, point, case in side.cases:
        for _, other_point, other_case in reference.cases:
            allowed = point.allowed_impact_speed * KMH_PER_MS
            least = other_point.allowed_impact_speed * KMH_PER_MS
            if other_case == case and allowed > least:
                names = tests.setdefault((allowed, least), [])
                if test not in names:
                    names.append(test)
    return tests


def _excluded(study: Study, reference: Study) -> Iterator[str]:
    """Yield the vehicles and encounters that a constraint or margin of `study` excludes, but no
    constraint or margin of `reference`, as phrases.
    """
    for constraint in study.constraints:
        low, high = constraint.ends
        if not any(
            (counterpart.sum, counterpart.tests) == (constraint.sum, constraint.tests)
            and low <= counterpart.ends[0]
            and counterpart.ends[1] <= high
            for counterpart in reference.constraints
        ):
            yield f"the vehicles that its constraint on {constraint.quantity} excludes"
    margin = study.scenario.margin
    reference_margin = reference.scenario.margin
    if (
        study.axes
        and margin is not None
        and (reference_margin is None or margin > reference_margin)
    ):
        yield f"the encounters in which its original vehicle keeps less than {margin:g} m"


def _missing_sets(study: Study, reference: Study) -> Iterator[str]:
    """Yield the number of parameter sets of `reference` that `study` lacks, as a phrase."""
    sets = _sets_of_vehicle(reference) - _sets_of_vehicle(study)
    if sets:
        yield number_of(len(sets), "parameter set")


def _sets_of_vehicle(study: Study) -> set[tuple[tuple[str, float], ...]]:
    """The study's parameter sets, as far as they concern the vehicle: names with values."""
    of_vehicle = {
        name: values
        for name, values in study.spread.items()
        if name.startswith(OF_VEHICLE)
    }
    return {
        tuple(zip(of_vehicle, values, strict=True))
        for values in zip(*of_vehicle.values(), strict=True)
    }
