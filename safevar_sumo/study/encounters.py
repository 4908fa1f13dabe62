"""The encounters of a study: tests, whose axes (parameters of encounters) list values or have
ranges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Final, Literal, NamedTuple, Self

from msgspec import Meta
from msgspec.structs import asdict, replace

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.study.characteristics import (
    Constraint,
    Domain,
    ShortText,
    check_constraints,
    mistake,
)
from safevar_sumo.study.marks import OF_SCENARIO, ORDERED, PART_OF_SYSTEM, Table
from safevar_sumo.study.parameters import free_parameters, searched

Parameters = dict[str, Any]
WORST = "worst"
"""The aggregate of a matrix by which the test case with the least safety degree gives the
result.
"""
TESTS: Final = "tests"
RANGES: Final = "ranges"
"""Values of the key `encounters`: vehicles meet the listed encounters, or any encounter in the
ranges of the axes.
"""
BY_EXCESS = "impact_excess >"
"""The aggregate of a matrix with a test that allows an impact."""


class ModelTable(Table, frozen=True, kw_only=True):
    """The table [ads] names the driving system: its `model` and the model's `parameters`. The model
    is a shipped name, or a class as `package.module:Name`.

    - `kind` is "traci" for a controller that is written for SUMO's TraCI. `kind` is "fmu" for an
      FMU, whose path is the `model`.
    - `inputs` and `outputs` name the variables of an FMU, by the quantity that a variable receives
      or returns.
    - `files` are data files, or folders of data files, that a driving system of your own reads. The
      paths of `files` are relative to the study's file.
    """

    model: str
    parameters: Parameters = {}
    kind: Literal["", "traci", "fmu"] = ""
    inputs: dict[str, str] = {}
    outputs: dict[str, str] = {}
    files: list[str] = []

    def __post_init__(self) -> None:
        if self.kind != "fmu" and (self.inputs or self.outputs):
            raise mistake(
                f"{self.model!r} is no FMU, but has inputs or outputs",
                'kind = "fmu", or no such keys',
            )


ORIGINAL_MARGIN = 0.3
"""Least distance that the original vehicle must keep in an encounter of a range, unless the study
states another distance [m].
"""


class AxisTable(Table, frozen=True, kw_only=True):
    """An axis is a parameter of encounters, such as a speed. A list in place of an axis's table
    gives only `at` (the tested values).

    - `at` lists the values with which a test is driven. Without `at`, a test is driven with the
      value among its `parameters`, or with the default of the scenario's class.
    - `lower` and `upper` are the ends of the range in which any value may occur. By default the
      range extends over the values of `at`, or, without `at`, over the widest range that the
      scenario's class declares.
    - `original` is the value at which the original vehicle drives in a search. By default
      `original` is the first value of `at`. Without `at`, `original` is the value with which the
      test is driven.
    """

    at: list[Any] = []
    lower: float | None = None
    upper: float | None = None
    original: float | None = None
    unit: str = ""
    meaning: ShortText = ""
    short_name: ShortText = ""

    def __post_init__(self) -> None:
        # Building the range checks its ends, so that the error names the path of this axis.
        _ = self.range

    @property
    def range(self) -> Domain | None:
        """The range of the axis; None without a range. The values of an axis may be texts or seeds,
        which have no range.
        """
        if self.lower is None or self.upper is None or self.original is None:
            return None
        fields = asdict(self)
        del fields["at"]
        return Domain(**fields)


def axis_of(domain: Domain) -> AxisTable:
    """An axis that has the range of a domain, and lists no values."""
    return AxisTable(**asdict(domain))


Axes = dict[str, Annotated[list[Any], Meta(min_length=1)] | AxisTable]
"""Axes by their names, as in a study: each axis is a list of values, or a table."""


class ScenarioTable(ModelTable, frozen=True, kw_only=True):
    """The table [scenario] describes the encounter: its `model` (name of the scenario) and the
    scenario's `parameters`.

    - `over` has axes (parameters of the scenario or of the weather). These axes vary in each test
      that does not state them itself.
    - `margin` [m] is for studies with ranges of encounters. The original vehicle drives in the
      encounter of each changed vehicle, too. An encounter counts only if the original vehicle keeps
      at least `margin` between bodies. Where the original vehicle fails, a failure of the changed
      vehicle says nothing about the change.
    - `repeats` is for simulators of your own whose runs differ: each vehicle is simulated this
      number of times. Answers combine the runs of a vehicle: the share of unsafe runs, the worst
      run, and the means of metrics.
    """

    over: Annotated[Axes, ORDERED] = {}
    margin: Annotated[float, Meta(ge=0, le=100)] | None = ORIGINAL_MARGIN
    repeats: Annotated[int, Meta(ge=1, le=1000)] = 1


class Weather(Table, frozen=True, kw_only=True):
    """A weather has a `name`, and effects on the road and on the sensors.

    - `road_friction` and `visibility` [-] are factors relative to dry and clear weather.
    - `water` [mm] is the depth of the water on the road. Only the vehicle `worn` computes the
      effect of water, and takes `road_friction` for the grip of the same road when dry.
    - `recognition_delay` [s] is the additional time that the sensors need to recognise a road user.
      `recognition_delay` is the same for every driving system, but the reaction time is a parameter
      of the driving system.
    - `light` says whether it is day or night. An answer states day or night, but no simulation
      depends on the light.
    """

    name: str
    road_friction: Annotated[
        float,
        Meta(gt=0, le=1.5),
        searched(0.1, 1.2, "-", "road friction, factor on the tyres' friction"),
    ]
    visibility: Annotated[
        float,
        Meta(gt=0, le=1.5),
        searched(0.05, 1.5, "-", "visibility, factor on the range of the sensors"),
    ]
    recognition_delay: Annotated[
        float,
        Meta(ge=0, le=5),
        searched(
            0.0, 2.0, "s", "additional time that the sensors need in this weather"
        ),
    ] = 0.0
    light: Literal["day", "night"] = "day"
    water: Annotated[float, Meta(ge=0, le=20)] = 0.0


def are_numbers(values: Iterable[object]) -> bool:
    """Whether the values of an axis are numbers, none of which is a bool."""
    return all(type(value) in (int, float) for value in values)


def as_axes(over: Parameters) -> dict[str, AxisTable]:
    """Convert axes to tables: an axis that is a list becomes the key `at` of a table."""
    axes = dict(over)
    for name, at in over.items():
        if not isinstance(at, AxisTable):
            axes[name] = AxisTable(at=at)
    return axes


def _ranges_of(axes: Iterable[tuple[str, AxisTable]]) -> Mapping[str, Domain]:
    """The ranges of all axes that have a range."""
    return {name: axis.range for name, axis in axes if axis.range is not None}


def _lists_of(axes: dict[str, AxisTable]) -> Axes:
    """The lists of all axes that list values."""
    return {name: axis.at for name, axis in axes.items() if axis.at}


def _widest(domains: Sequence[Domain]) -> Domain:
    """The first of several domains, with ends that include all of these domains."""
    return replace(
        domains[0],
        lower=min(domain.lower for domain in domains),
        upper=max(domain.upper for domain in domains),
    )


class MatrixTest(Table, frozen=True, kw_only=True):
    """A test of the matrix has a `name`, and one or more test cases. The test has a test case for
    every combination of the values of its axes in `over`, in each of its `weathers`.

    - `model` is the name of another scenario. A test that names a `model` takes no `parameters`
      from the study's scenario.
    - `parameters` are added to those of the study's scenario, if the test has no `model`.
    - `weathers` are names of shipped weathers, or tables with weathers of your own.
    - `allowed_impact_speed` [km/h] is the relative speed up to which an impact is allowed. The
      metric `impact_excess` is the impact speed minus `allowed_impact_speed`.
    """

    name: Annotated[str, Meta(min_length=1)]
    model: str = ""
    parameters: Parameters = {}
    over: Annotated[Axes, ORDERED] = {}
    weathers: list[str | Weather] = []
    allowed_impact_speed: Annotated[float, Meta(ge=0, le=250)] = 0.0

    def __post_init__(self) -> None:
        for name in self.parameters.keys() & self.over.keys():
            if self.axes[name].at:
                raise mistake(f"{name} is in parameters and in over", "one of them")

    @property
    def axes(self) -> dict[str, AxisTable]:
        """The axes that the test states under `over`, as tables."""
        return as_axes(self.over)


class DecidingMetric(NamedTuple):
    """The metric whose worst value decides which test case gives the result of a vehicle.

    The `aggregate` of a matrix states it as text: `drac >` if the largest value of `drac` is the
    worst, and `ttc_min <` if the smallest value of `ttc_min` is.
    """

    name: str
    largest_is_worst: bool

    def __str__(self) -> str:
        return f"{self.name} {'>' if self.largest_is_worst else '<'}"


class MatrixTable(Table, frozen=True, kw_only=True):
    """The table [matrix] has the `tests` in which every vehicle is simulated.

    `aggregate` says which test case gives the result of a vehicle. The value `worst` takes the test
    case with the lowest safety degree, `"drac >"` the one with the largest value of the metric
    `drac`, and `"ttc_min <"` the one with the smallest value of the metric `ttc_min`.
    """

    tests: Annotated[list[MatrixTest], Meta(min_length=1)]
    aggregate: Annotated[
        str, Meta(pattern=r"^(worst|[A-Za-z][A-Za-z0-9_]{0,63} [<>])\Z")
    ] = WORST

    def __post_init__(self) -> None:
        if self.aggregate != BY_EXCESS and any(
            test.allowed_impact_speed for test in self.tests
        ):
            raise mistake(
                f"aggregate = {self.aggregate!r}, and a test allows an impact",
                f"{BY_EXCESS!r}, or no allowed_impact_speed",
            )


class StudyEncounters(Table, frozen=True, kw_only=True):
    """The encounters of a study: a scenario in a weather, or the tests of a matrix. Vehicles meet
    the listed encounters, or any encounter in the ranges of the axes.

    A setting belongs to the tests whose ranges and constraints contain its encounter
    (`Point.meets`). The worst of these tests decides (`safevar_sumo.sumo.encounters.worst_points`).

    Listed encounters always count. With ranges, a setting counts if the original vehicle keeps the
    `margin` in all tests to which the setting belongs. Without a margin (`all_count`) all settings
    count: in `permit`, and at other phases of listed encounters. Between listed encounters, an
    encounter counts unless the original vehicle is unsafe in this encounter (`Model.new_car`).
    """

    scenario: Annotated[ScenarioTable, PART_OF_SYSTEM, OF_SCENARIO]
    encounters: Literal["tests", "ranges"] = TESTS
    weather: Annotated[str | Weather, PART_OF_SYSTEM] = ""
    matrix: Annotated[MatrixTable | None, PART_OF_SYSTEM, OF_SCENARIO] = None
    constraints: list[Constraint] = []

    @property
    def deciding(self) -> DecidingMetric | None:
        """The metric that `aggregate` states; None if the safety degree decides."""
        if self.matrix is None or self.matrix.aggregate == WORST:
            return None
        name, direction = self.matrix.aggregate.split()
        return DecidingMetric(name, direction == ">")

    def check_axes(self, characteristics: Mapping[str, Domain]) -> None:
        """Refuse axes that contradict the rest of the study.

        An axis must not share its name with a characteristic, and must not lack values. Ranges and
        a margin need an axis with a range, and constraints need existing names.
        """
        axes = self._named_axes
        for name, axis in axes:
            if name in characteristics:
                problem = f"over.{name}: a characteristic of the vehicle has this name"
                raise InputError("", problem, "a unique name")
            if not axis.at and axis.range is None:
                problem = f"over.{name}: no original value, as the test states none"
                raise InputError("", problem, "original = a value of its range")
        for name, axis in as_axes(self.scenario.over).items():
            if axis.at and self.matrix is None:
                raise InputError(
                    "",
                    f"scenario.over.{name} lists values, and the study has no tests",
                    "[[matrix.tests]], or a range alone",
                )
        if self.encounters == RANGES and not self.states_ranges:
            raise InputError(
                "",
                f"encounters = {RANGES!r}, and no axis has a range",
                "over = { NAME = { lower = X, upper = Y } }, or 'tests'",
            )
        if self.scenario.margin not in (None, ORIGINAL_MARGIN) and not axes:
            raise InputError(
                "",
                f"scenario.margin = {self.scenario.margin:g}, and no encounter has an axis",
                "an axis with lower and upper, or no margin",
            )
        check_constraints({**characteristics, **_ranges_of(axes)}, self.constraints)
        tests = [test.name for test in self.tests]
        for constraint in self.constraints:
            for name in constraint.tests:
                check_name(
                    "", f"constraints.tests: there is no test {name!r}", name, tests
                )

    @property
    def tests(self) -> list[MatrixTest]:
        """The tests of the matrix; an empty list without a matrix."""
        if self.matrix is None:
            return []
        return self.matrix.tests

    @property
    def axes(self) -> set[str]:
        """The names of all axes of all tests."""
        return {*dict(self._named_axes)}

    @property
    def _named_axes(self) -> list[tuple[str, AxisTable]]:
        """The axes of all tests, with their names; a name occurs once for each test that has the
        axis.
        """
        return [
            named_axis
            for test in self._tests_or_none
            for named_axis in self.axes_of(test).items()
        ]

    @property
    def _tests_or_none(self) -> list[MatrixTest | None]:
        """The tests; [None] for a study without a matrix, whose only encounter is its scenario."""
        return list(self.tests) or [None]

    def axes_of(self, test: MatrixTest | None) -> dict[str, AxisTable]:
        """The axes of a test: first its own axes, then the axes of [scenario.over] that the test
        does not state itself. The weathers of a test replace axes of the weather. For None: the
        axes of [scenario.over].
        """
        shared = as_axes(self.scenario.over)
        if test is None:
            return shared
        if shared and test.weathers:
            for name in free_parameters(Weather):
                shared.pop(name, None)
        axes = test.axes
        return axes | shared | axes

    def lists_of(self, test: MatrixTest | None) -> dict[str, list[Any]]:
        """The lists of values at which a test is driven, for each axis that has no range in use."""
        ranges = self.ranges_of(test)
        axes = self.axes_of(test).items()
        return {name: axis.at for name, axis in axes if axis.at and name not in ranges}

    def ranges_of(self, test: MatrixTest | None) -> Mapping[str, Domain]:
        """The axes of a test on which any value in a range may occur; none if encounters are
        listed.
        """
        if self.encounters == TESTS:
            return {}
        return self.stated_ranges_of(test)

    def stated_ranges_of(self, test: MatrixTest | None) -> Mapping[str, Domain]:
        """The ranges of a test's axes, also if encounters are listed."""
        return _ranges_of(self.axes_of(test).items())

    @property
    def states_ranges(self) -> bool:
        """Whether an axis of any test has a range, with or without listed values."""
        return bool(_ranges_of(self._named_axes))

    @property
    def ranges(self) -> Mapping[str, Domain]:
        """The parameters of the encounter that are part of each setting, after the values of the
        vehicle.

        These parameters are the axes with ranges of all tests. The range of an axis includes its
        ranges in all tests. Axes that only [scenario.over] states come last.
        """
        domains: dict[str, list[Domain]] = {}
        for test in self.tests:
            for name in self.ranges_of(test):
                if name in test.over:
                    domains[name] = []
        for test_or_none in self._tests_or_none:
            for name, domain in self.ranges_of(test_or_none).items():
                domains.setdefault(name, []).append(domain)
        return {name: _widest(ranges) for name, ranges in domains.items()}

    def points_of(self, test: MatrixTest) -> list[MatrixTest]:
        """Split a test into tests of a single test case: one test for each combination of its
        listed values, in each of its weathers.
        """
        lists = self.lists_of(test)
        points = []
        for values in product(*lists.values()):
            over = dict(test.over)
            for name, value in zip(lists, values, strict=True):
                over[name] = [value]
            point = replace(test, over=over)
            for weather in test.weathers:
                points.append(replace(point, weathers=[weather]))
            if not test.weathers:
                points.append(point)
        return points

    def mapped(self, change: Callable[[dict[str, AxisTable]], Axes]) -> Self:
        """The study with changed axes. `change` maps the axes of each test, and the axes of
        [scenario.over]. An axis that has nothing but a list becomes a list again.
        """

        def changed(over: Axes) -> Axes:
            axes = {}
            for name, axis in as_axes(change(as_axes(over))).items():
                is_list = axis == AxisTable(at=axis.at)
                axes[name] = axis.at if is_list else axis
            return axes

        matrix = self.matrix
        if matrix is not None:
            tests = [replace(test, over=changed(test.over)) for test in matrix.tests]
            matrix = replace(matrix, tests=tests)
        scenario = replace(self.scenario, over=changed(self.scenario.over))
        return replace(self, matrix=matrix, scenario=scenario)

    def listed(self) -> Self:
        """The study without the ranges of axes that list values. The same study if any value in a
        range may occur.
        """
        if self.encounters == RANGES:
            return self
        return self.mapped(_lists_of)

    @property
    def all_count(self) -> Self:
        """The study without a margin: every encounter counts, whatever the original vehicle does in
        it.
        """
        return replace(self, scenario=replace(self.scenario, margin=None))

    def with_tests(self, tests: list[MatrixTest]) -> Self:
        """The study with these tests alone, and with the constraints that apply in any of them."""
        assert self.matrix is not None
        names = {test.name for test in tests}
        constraints = []
        for constraint in self.constraints:
            common = [name for name in constraint.tests if name in names]
            if common or not constraint.tests:
                constraints.append(replace(constraint, tests=common))
        matrix = replace(self.matrix, tests=tests)
        return replace(self, matrix=matrix, constraints=constraints)
