"""Rules in sentences."""

from __future__ import annotations

from rich.console import Console

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.rules.compute import Rule, Rules
from safevar_sumo.analysis.words import joined
from safevar_sumo.terminal import print_meanings, print_text
from safevar_sumo.vehicles import Characteristic, CharacteristicSet


def print_rules(console: Console, result: Rules) -> None:
    """Every rule with its density and coverage."""
    members = CharacteristicSet.of(result.study.vehicle.characteristics)
    print_text(console, result.study.title)
    print_text(console, f"Unsafe: {result.unsafe}; {result.unsafe_share:.2%} of {result.samples} settings all over the domain.")
    if result.remark:
        print_text(console, f"No rule: {result.remark}.")
    elif not result.rules:
        print_text(console, "Nothing unsafe found.")
    for rule in result.rules:
        print_text(console, f"- {rule_in_words(rule, members, result.unsafe)}")
    if result.rules:
        print_meanings(console, [member for member in members if any(member.name in rule.limits for rule in result.rules)])
        print_text(console, f"Judged on settings that did not make the rules; in brackets {result.rules[0].confidence:.0%} intervals.")


def rule_in_words(rule: Rule, characteristics: CharacteristicSet, unsafe: Unsafe) -> str:
    """A rule with what it is worth: `tireFric below 1.35 and gearSwitchTime above 0.55 s: collides in 92% (..), covers 61% (..)`."""
    conditions = [_condition(member, *rule.limits[member.name]) for member in characteristics if member.name in rule.limits]
    what = "collides" if unsafe.below is None else f"SD is below {unsafe.below:g}"
    shares = [f"{word} {share:.0%} ({interval[0]:.0%} to {interval[1]:.0%})" if share is not None and interval is not None else f"{word} -"
              for word, share, interval in ((f"{what} in", rule.density, rule.density_interval),
                                            ("covers", rule.coverage, rule.coverage_interval))]
    return f"{joined(conditions) if conditions else 'everywhere'}: {', '.join(shares)}"


def _condition(member: Characteristic, low: float | None, high: float | None) -> str:
    if low is not None and high is not None:
        return f"{member.name} from {low:g} to {high:g}{member.suffix}"
    return f"{member.name} {f'below {high:g}' if low is None else f'above {low:g}'}{member.suffix}"
