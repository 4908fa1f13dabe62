"""Files of parameter values (class ParameterValueDistribution): which combinations of values a
logical file has.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, product
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.openscenario.document import (
    Element,
    attribute,
    check_unique,
    declared,
    is_number,
    number,
    part,
    root_of,
    unsupported,
    values_of,
    violated,
)
from safevar_sumo.openscenario.expressions import literal
from safevar_sumo.openscenario.guard import guarded
from safevar_sumo.openscenario.reading import beside

FloatArray = Any
"""An array of numbers."""

MOST_STEPS = 100_000
"""Largest number of values of a range."""


class Choice(NamedTuple):
    """Values that parameters take together, one set of them at a time; `ends` are those of a
    range.
    """

    names: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    ends: tuple[float, float] | None = None


class Source(NamedTuple):
    """What a file offers: the concrete file, its parameters with their values, which of them are
    whole numbers, and the choices of a logical one.
    """

    concrete: str
    values: dict[str, str]
    whole_numbers: list[str]
    choices: list[Choice]

    def combinations(self, given: Mapping[str, str]) -> Iterator[dict[str, str]]:
        """All combinations of the choices, without those that the file's constraints exclude."""
        declarations = declared(root_of(self.concrete))
        has_constraints = any(parameter.groups for parameter in declarations)
        for sets in product(*(choice.sets for choice in self.choices)):
            values = dict[str, str]()
            for choice, own in zip(self.choices, sets, strict=True):
                values |= zip(choice.names, own, strict=True)
            if has_constraints and violated(
                declarations, values_of(declarations, {**given, **values}, {})
            ):
                continue
            yield values

    def without(self, names: Mapping[str, object]) -> Source:
        """The file with other choices than those of these parameters, which something else sets."""
        choices = []
        for choice in self.choices:
            kept = [place for place, name in enumerate(choice.names) if name not in names]
            sets = tuple(dict.fromkeys(tuple(own[place] for place in kept) for own in choice.sets))
            if kept:
                choices.append(
                    choice._replace(names=tuple(choice.names[place] for place in kept), sets=sets)
                )
        return self._replace(choices=choices)

    def range_of(self, name: str) -> tuple[float, float] | None:
        """The ends of a parameter's range, None without one."""
        return next((choice.ends for choice in self.choices if choice.names == (name,)), None)


@guarded
def open_file(file: str) -> Source:
    """A concrete or a logical file.

    Raises
    ------
    InputError
        If it is neither, or its values are no deterministic ones.
    """
    root = root_of(file)
    choices = []
    concrete = file
    distribution = root.find("ParameterValueDistribution")
    if distribution is not None:
        if distribution.find("Deterministic") is None:
            raise unsupported(
                "Stochastic distributions are not supported", "Deterministic ones, such as a range"
            )
        choices = [_choice(each) for each in part(distribution, "Deterministic")]
        check_unique(
            [name for choice in choices for name in choice.names], "parameters with values"
        )
        concrete = beside(
            os.path.dirname(file), attribute(part(distribution, "ScenarioFile"), "filepath")
        )
    declarations = declared(root_of(concrete))
    given = {
        name: choice.sets[0][place] for choice in choices for place, name in enumerate(choice.names)
    }
    values_of(declarations, given, {})  # refuses names that the file does not declare
    whole_numbers = [one.name for one in declarations if one.is_whole]
    return Source(concrete, values_of(declarations, {}, {}), whole_numbers, choices)


def _choice(each: Element) -> Choice:
    """A row of class Deterministic."""
    content = part(each, "*")
    match content.tag:
        case "DistributionSet":
            return _with_values(
                Choice((_name(each),), tuple((attribute(one, "value"),) for one in content))
            )
        case "DistributionRange":
            limits = part(content, "Range")
            step = number(content, "stepWidth")
            lower = number(limits, "lowerLimit")
            upper = number(limits, "upperLimit")
            if not (step > 0 and lower <= upper and (upper - lower) / step < MOST_STEPS):
                raise unsupported(
                    f"{_name(each)}: a range from {lower:g} to {upper:g} by {step:g}",
                    f"a step above 0, and at most {MOST_STEPS:,} of them between growing limits",
                )
            count = math.floor((upper - lower) / step + 1e-9) + 1
            values = (round(lower + k * step, 9) for k in range(count))
            return Choice((_name(each),), tuple((repr(value),) for value in values), (lower, upper))
        case "ValueSetDistribution":
            sets = [{_reference(one): attribute(one, "value") for one in own} for own in content]
            names = tuple(sets[0]) if sets else ()
            if any(own.keys() != {*names} for own in sets):
                raise unsupported(
                    "ValueSetDistribution: its sets name different parameters",
                    "the same parameters in each set",
                )
            return _with_values(
                Choice(names, tuple(tuple(own[name] for name in names) for own in sets))
            )
    raise unsupported(
        f"{content.tag} is not supported",
        "DistributionSet, DistributionRange or ValueSetDistribution",
    )


def _name(element: Element) -> str:
    return attribute(element, "parameterName").lstrip("$")


def _reference(element: Element) -> str:
    return attribute(element, "parameterRef").lstrip("$")


def _with_values(choice: Choice) -> Choice:
    if not (choice.names and choice.sets):
        raise unsupported("a distribution without values is not supported", "one value at least")
    return choice


def originals(source: Source) -> dict[str, float]:
    """The numbers among the parameters, by name: what a search begins with."""
    return {name: float(value) for name, value in source.values.items() if is_number(value)}


class Bound(NamedTuple):
    """A linear constraint: the sum of `weights` times values is `at_least` or `at_most` (the
    `kind`) a limit.
    """

    weights: list[float]
    kind: str
    limit: float
    text: str


INSIDE = 1e-6
"""Part of a constraint's range that a search keeps from its limit, which may be excluded itself
[-].
"""
KINDS = {
    "greaterThan": "at_least",
    "greaterOrEqual": "at_least",
    "lessThan": "at_most",
    "lessOrEqual": "at_most",
}
"""Bounds by rules: a search does not tell the two apart."""


def constraints_of(
    file: str, given: Mapping[str, str], names: Sequence[str], low: FloatArray, high: FloatArray
) -> list[Bound]:
    """The constraints of a file on the parameters `names` between `low` and `high`, at `given`
    values of others.

    Raises
    ------
    InputError
        If a constraint is not linear in them.
    """
    declarations = declared(root_of(file))
    bounds = []

    def difference(name: str, text: str, at: FloatArray) -> float:
        own = {key: repr(float(value)) for key, value in zip(names, at, strict=True)}
        values = values_of(declarations, {**given, **own}, {})
        return float(values[name]) - float(literal(text, values))

    middle = (low + high) / 2
    half = (high - low) / 2
    for name, _, _, groups in declarations:
        for rule, text in chain(*groups):
            if rule not in KINDS:
                continue
            # What the constraint leaves in the middle, and how it changes towards each end.
            base = difference(name, text, middle)
            slopes = (
                np.array([difference(name, text, middle + step) - base for step in np.diag(half)])
                / half
            )
            sign = 1 if KINDS[rule] == "at_least" else -1
            reach = np.abs(slopes * half).sum()
            is_given = reach < 1e-12
            least = sign * base - reach
            holds_everywhere = least > 0 or (least == 0 and rule.endswith("Equal"))
            if is_given or holds_everywhere:
                continue
            # A constraint is linear if its slopes also tell what it leaves elsewhere.
            elsewhere = [low, high, middle - half / 3]
            errors = [
                difference(name, text, at) - base - slopes @ (at - middle) for at in elsewhere
            ]
            if np.abs(errors).max() > 1e-6 * reach:
                raise unsupported(
                    f"the constraint of {name} is not linear in {', '.join(names)}",
                    "other parameters to search",
                )
            limit = float(slopes @ middle - base + sign * INSIDE * reach)
            bounds.append(Bound(slopes.tolist(), KINDS[rule], limit, f"{name} {rule} {text}"))
    return bounds
