"""Findings in words, the same on the terminal, in JSON and in reports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from shlex import quote

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.explain.braking_comparison import REMAINDER, BrakingComparison, Course
from safevar_sumo.analysis.rules.compute import Rule
from safevar_sumo.records import Outcome
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

WORTH_A_WORD = 0.005
"""A part of a distance that rounds to less than a centimetre is left out of a sentence [m]."""
ENDS = {
    Outcome.STOPPED: "stops", Outcome.PASSED: "passes", Outcome.TIMEOUT: "is still under way at the end",
    Outcome.NEVER_MOVED: "never moves", Outcome.SIMULATOR_ERROR: "could not be simulated",
    Outcome.INVALID_TEST: "leaves the tolerance of the test's speed"}
PARTS = {
    "place": ("it begins to brake nearer", "it begins to brake farther away"), "speed": ("it is faster", "it is slower"),
    "delay": ("its brake pedal follows later", "its brake pedal follows sooner"),
    "slowing": ("it slows less while the pedal moves", "it slows more while the pedal moves"),
    "deceleration": ("it brakes more weakly", "it brakes harder")}
"""What costs distance, and what gains some."""


def change(member: Characteristic, value: float) -> str:
    """One change, such as `mass 2404 -> 2600 kg (+8.2 %)`."""
    share = (value - member.original) / abs(member.original)
    return f"{member.name} {member.original:g} -> {member.text(value)}{member.suffix} ({share:+.1%})"


def changes(characteristics: CharacteristicSet, values: Mapping[str, float]) -> str:
    """All changes of some values, in the study's order."""
    told = [change(member, values[member.name]) for member in characteristics
            if values.get(member.name, member.original) != member.original]
    return ", ".join(told) or "no change at all"


def direction(member: Characteristic, value: float) -> str:
    """Which way a characteristic is changed, such as `mass up`."""
    return f"{member.name} {'up' if value > member.original else 'down'}"


def command(study: str, values: Mapping[str, float], point: str = "") -> str:
    """The command that simulates these changes of a study, at one point of its matrix if one is named."""
    return " ".join([ask("simulate", study, point), *(f"--set {quote(f'{name}={value!r}')}" for name, value in values.items())])


def ask(question: str, place: str, point: str = "") -> str:
    """The command that asks a question about results or a study, at one point of its matrix if one is named."""
    return " ".join(["python -m safevar_sumo", question, quote(place), *(["--point", quote(point)] if point else [])])


def joined(parts: Iterable[str]) -> str:
    """Parts of a sentence as one speaks them."""
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def how(course: Course) -> str:
    """How a drive ended."""
    if course.outcome == Outcome.COLLISION:
        return f"hits at {course.collision_speed:.2f} m/s"
    end = ENDS.get(Outcome(course.outcome), course.outcome)
    return end if course.safety_degree != course.safety_degree else f"{end}, safety degree {course.safety_degree:.2f} m"


def sentence(told: BrakingComparison) -> str:
    """Why the changed vehicle is less safe than the original, in one sentence or two."""
    at = f"At {told.place}: the" if told.place else "The"
    ends = f"{at} original {how(told.original)}; this one {how(told.changed)}."
    one, other = told.original.braking, told.changed.braking
    if one is None and other is None:
        return f"{ends} Neither of them brakes."
    if not told.parts:
        return f"{ends} {'The original' if one is None else 'It'} does not slow down by its brake."
    unbraked = "" if other is not None else ", without any effect of its brake"
    costs, gains = ("", "gained ") if told.lost >= 0 else ("lost ", "")
    pieces = [f"{abs(told.parts[name]):.2f} m {costs if told.parts[name] > 0 else gains}because {PARTS[name][told.parts[name] < 0]}"
              f"{_numbers(told, name)}"
              for name in sorted(PARTS, key=lambda name: -told.parts[name]) if abs(told.parts[name]) >= WORTH_A_WORD]
    if abs(told.parts["remainder"]) > REMAINDER:
        pieces.append(f"{told.parts['remainder']:+.2f} m that this does not explain")
    if not pieces:
        return f"{ends} They brake alike."
    return f"{ends} Of the {abs(told.lost):.2f} m {'lost' if told.lost >= 0 else 'gained'}{unbraked}: {joined(pieces)}."


def _numbers(told: BrakingComparison, part: str) -> str:
    """What a part was, and what it is with the original."""
    one, other = told.original.braking, told.changed.braking
    if one is None or other is None:
        return ""
    pairs = {"place": (other.gap, one.gap, "m before"), "speed": (other.speed, one.speed, "m/s at the command"),
             "delay": (other.delay, one.delay, "s after the command"), "slowing": (told.slowing[1], told.slowing[0], "m saved"),
             "deceleration": (other.deceleration, one.deceleration, "m/s^2")}
    there, here, name = pairs[part]
    decimals = next((digits for digits in range(2, 9) if f"{there:.{digits}f}" != f"{here:.{digits}f}"), 2)
    return f" ({there:.{decimals}f} instead of {here:.{decimals}f} {name})"


def number_of(count: int, what: str) -> str:
    """`1 change`, `2 changes`."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def rule_in_words(rule: Rule, characteristics: CharacteristicSet, unsafe: Unsafe) -> str:
    """A rule with what it is worth: `tireFric below 1.35 and gearSwitchTime above 0.55 s: collides in 92% (..), covers 61% (..)`."""
    told = [_condition(member, *rule.limits[member.name]) for member in characteristics if member.name in rule.limits]
    what = "collides" if unsafe.below is None else f"SD is below {unsafe.below:g}"
    shares = [f"{word} {share:.0%} ({interval[0]:.0%} to {interval[1]:.0%})" if share is not None and interval is not None else f"{word} -"
              for word, share, interval in ((f"{what} in", rule.density, rule.density_interval),
                                            ("covers", rule.coverage, rule.coverage_interval))]
    return f"{joined(told) if told else 'everywhere'}: {', '.join(shares)}"


def _condition(member: Characteristic, low: float | None, high: float | None) -> str:
    if low is not None and high is not None:
        return f"{member.name} from {low:g} to {high:g}{member.suffix}"
    return f"{member.name} {f'below {high:g}' if low is None else f'above {low:g}'}{member.suffix}"
