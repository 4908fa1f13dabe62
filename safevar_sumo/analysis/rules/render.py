"""Rules in sentences."""

from __future__ import annotations

from rich.console import Console

from safevar_sumo.analysis.rules.compute import Rules
from safevar_sumo.analysis.words import rule_in_words
from safevar_sumo.terminal import print_meanings
from safevar_sumo.vehicles import CharacteristicSet


def print_rules(console: Console, told: Rules) -> None:
    """Every rule with its density and coverage."""
    members = CharacteristicSet.of(told.study.vehicle.characteristics)
    _say(console, told.study.title)
    _say(console, f"Unsafe: {told.unsafe}; {told.unsafe_share:.2%} of {told.samples} settings all over the domain.")
    if told.remark:
        _say(console, f"No rule: {told.remark}.")
    elif not told.rules:
        _say(console, "Nothing unsafe found.")
    for rule in told.rules:
        _say(console, f"- {rule_in_words(rule, members, told.unsafe)}")
    if told.rules:
        print_meanings(console, [member for member in members if any(member.name in rule.limits for rule in told.rules)])
        _say(console, f"Judged on settings that the rules were not made from; in brackets {told.rules[0].confidence:.0%} intervals.")


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)
