"""What the vehicles of a study meet: tests, whose axes list values or are ranges of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Final, Literal, Self

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
"""The aggregate of a matrix by which the least safety degree decides."""
TESTS: Final = "tests"
RANGES: Final = "ranges"
"""What the vehicles of a study meet: listed encounters, or any in the ranges of its axes."""
BY_EXCESS = "impact_excess >"
"""The aggregate of a matrix in which impacts may be allowed."""


class ModelTable(Table, frozen=True, kw_only=True):
    """A `model` by its name, or by `package.module:Name`, and its `parameters`.

    An ADS of the `kind` `traci` is a controller written for SUMO's TraCI; an ADS of the kind `fmu`
    is an FMU, named by its path: `inputs` and `outputs` are the FMU's variables by the quantity
    they receive or return. `files` are data files, or folders of them, that a model of your own
    reads, relative to the study's file.
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
"""Distance that the original vehicle must keep in an encounter that is searched, unless the study
says another [m].
"""


class AxisTable(Table, frozen=True, kw_only=True):
    """A parameter of encounters: the values that its test drives, `at`, and the range in which any
    value may occur, from `lower` to `upper`. A list is short for `at`.

    The range is by default that of `at`, or without `at` the widest that the scenario's class
    declares. `original` is where the original vehicle drives in a search, by default the first of
    `at`, else the test's own value. Without `at` a test drives at its own value.
    """

    at: list[Any] = []
    lower: float | None = None
    upper: float | None = None
    original: float | None = None
    unit: str = ""
    meaning: ShortText = ""
    short_name: ShortText = ""

    def __post_init__(self) -> None:
        # An illegal range is refused here, with the path of the axis.
        _ = self.range

    @property
    def range(self) -> Domain | None:
        """The range; None without one, as of texts and seeds."""
        if self.lower is None or self.upper is None or self.original is None:
            return None
        fields = asdict(self)
        del fields["at"]
        return Domain(**fields)


def axis_of(domain: Domain) -> AxisTable:
    """An axis whose range is a domain."""
    return AxisTable(**asdict(domain))


Axes = dict[str, Annotated[list[Any], Meta(min_length=1)] | AxisTable]
"""Axes of encounters by name."""


class ScenarioTable(ModelTable, frozen=True, kw_only=True):
    """The scenario: its `model` and `parameters`; `over` are axes of its encounters, in a matrix of
    each test that does not state them: parameters of the scenario or of the weather.

    In a study with ranges of encounters, the original vehicle drives in the encounter of each
    variant, too. The encounter counts only if the original vehicle keeps at least `margin` [m]
    between bodies: in any other, a failure says nothing about the variant. Without a margin all
    encounters count. A simulator of the user's own that is not deterministic simulates each setting
    `repeats` times: the share of unsafe runs, the worst run, and means of metrics count.
    """

    over: Annotated[Axes, ORDERED] = {}
    margin: Annotated[float, Meta(ge=0, le=100)] | None = ORIGINAL_MARGIN
    repeats: Annotated[int, Meta(ge=1, le=1000)] = 1


class Weather(Table, frozen=True, kw_only=True):
    """Weather as data: its `name`, and its effects on the road and on the sensors.

    `road_friction` and `visibility` are factors relative to the dry, clear case [-]. `water` is its
    depth on the road [mm], whose effect the vehicle `worn` computes: it takes `road_friction` as
    the grip of the same road when dry. `recognition_delay` is the additional time that the sensors
    need to recognise a road user [s], for every ADS; the reaction time of an ADS is one of its
    parameters. `light` is a label.
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
    """Axes as tables."""
    axes = dict(over)
    for name, at in over.items():
        if not isinstance(at, AxisTable):
            axes[name] = AxisTable(at=at)
    return axes


def _ranges_of(axes: Iterable[tuple[str, AxisTable]]) -> dict[str, Domain]:
    """The ranges of axes that have one."""
    return {name: axis.range for name, axis in axes if axis.range is not None}


def _lists_of(axes: dict[str, AxisTable]) -> Axes:
    """The lists of axes that have one."""
    return {name: axis.at for name, axis in axes.items() if axis.at}


def _widest(domains: Sequence[Domain]) -> Domain:
    """The first of several domains, as wide as all of them together."""
    lower = min(domain.lower for domain in domains)
    upper = max(domain.upper for domain in domains)
    return replace(domains[0], lower=lower, upper=upper)


class MatrixTest(Table, frozen=True, kw_only=True):
    """A test of a matrix: its `name`, and a scenario at every combination of the values of the axes
    in `over`, in each of the `weathers`.

    `parameters` are added to those of the study's scenario; a test with a `model` of its own has
    only its own parameters. A weather is a name or a table. An impact is allowed up to a relative
    speed of `allowed_impact_speed` [km/h], by which the metric `impact_excess` counts.
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
        """The axes of `over`."""
        return as_axes(self.over)


class MatrixTable(Table, frozen=True, kw_only=True):
    """The `tests` at whose points every setting is simulated.

    `aggregate` says at which point a setting counts: `worst` at that with the lowest safety degree,
    `drac >` at that with the largest value of this metric, `ttc_min <` with the smallest.
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


class Encounters(Table, frozen=True, kw_only=True):
    """What vehicles meet: a scenario in a weather, or the tests of a matrix; listed encounters, or
    any in the ranges of the axes.

    A setting meets the tests whose ranges and constraints hold its encounter (`Point.meets`), and
    the worst of them decides (`safevar_sumo.sumo.encounters.worst_points`).

    Which encounters count: listed ones always; with ranges a setting counts where the original
    vehicle keeps the `margin` in all tests that it meets. Without a margin (`all_count`) all count:
    in `permit`, and at other phases of listed encounters. Between listed ones an encounter counts
    unless the original is unsafe there (`Model.new_car`).
    """

    scenario: Annotated[ScenarioTable, PART_OF_SYSTEM, OF_SCENARIO]
    encounters: Literal["tests", "ranges"] = TESTS
    weather: Annotated[str | Weather, PART_OF_SYSTEM] = ""
    matrix: Annotated[MatrixTable | None, PART_OF_SYSTEM, OF_SCENARIO] = None
    constraints: list[Constraint] = []

    def check_axes(self, characteristics: Mapping[str, Domain]) -> None:
        """Refuse axes that something else sets, too, and what is about ranges without any."""
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
        """The tests of the matrix; none without one."""
        if self.matrix is None:
            return []
        return self.matrix.tests

    @property
    def axes(self) -> set[str]:
        """The names of the axes that a test has."""
        return {*dict(self._named_axes)}

    @property
    def _named_axes(self) -> list[tuple[str, AxisTable]]:
        """The axes of all tests, with their names."""
        pairs = list[tuple[str, AxisTable]]()
        for test in self._tests_or_none:
            pairs += self.axes_of(test).items()
        return pairs

    @property
    def _tests_or_none(self) -> list[MatrixTest | None]:
        """The tests; None for the encounters of a study without any."""
        return [*self.tests] or [None]

    def axes_of(self, test: MatrixTest | None) -> dict[str, AxisTable]:
        """The axes of a test, its own first; those of all tests, unless it has values of them."""
        shared = as_axes(self.scenario.over)
        if test is None:
            return shared
        if shared and test.weathers:
            for name in free_parameters(Weather):
                shared.pop(name, None)
        axes = test.axes
        return axes | shared | axes

    def lists_of(self, test: MatrixTest | None) -> dict[str, list[Any]]:
        """The axes of a test whose values are driven one after another."""
        ranges = self.ranges_of(test)
        axes = self.axes_of(test).items()
        return {name: axis.at for name, axis in axes if axis.at and name not in ranges}

    def ranges_of(self, test: MatrixTest | None) -> dict[str, Domain]:
        """The axes of a test of which any value may occur."""
        if self.encounters == TESTS:
            return {}
        return _ranges_of(self.axes_of(test).items())

    @property
    def states_ranges(self) -> bool:
        """Whether an axis has a range beside or without listed values."""
        return bool(_ranges_of(self._named_axes))

    @property
    def ranges(self) -> dict[str, Domain]:
        """Of which parameters of its encounter each setting has a value beside the vehicle: the
        axes of all tests whose values may be any, each as wide as in its widest test; those of
        [scenario.over] alone come last.
        """
        domains: dict[str, list[Domain]] = {}
        for test in self.tests:
            for name in self.ranges_of(test):
                if name in test.over:
                    domains[name] = []
        for alternatives in map(self.ranges_of, self._tests_or_none):
            for name, domain in alternatives.items():
                domains.setdefault(name, []).append(domain)
        return dict(zip(domains, map(_widest, domains.values()), strict=True))

    def points_of(self, test: MatrixTest) -> list[MatrixTest]:
        """A test at each of its points alone: at each combination of its listed values, in each of
        its weathers.
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
        """The study with other axes of each test, and of all; lists alone are written as such."""

        def changed(over: Axes) -> Axes:
            axes: Axes = {}
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
        """The study without the ranges of axes that list values; itself if any value may occur."""
        if self.encounters == RANGES:
            return self
        return self.mapped(_lists_of)

    @property
    def all_count(self) -> Self:
        """The study whose encounters all count, whatever the original vehicle does in them."""
        return replace(self, scenario=replace(self.scenario, margin=None))

    def with_tests(self, tests: Sequence[MatrixTest]) -> Self:
        """The study in these tests alone, with the constraints that concern them."""
        assert self.matrix is not None
        names = {test.name for test in tests}
        constraints = []
        for constraint in self.constraints:
            common = [name for name in constraint.tests if name in names]
            if common or not constraint.tests:
                constraints.append(replace(constraint, tests=common))
        matrix = replace(self.matrix, tests=[*tests])
        return replace(self, matrix=matrix, constraints=constraints)
