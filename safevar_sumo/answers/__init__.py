"""What an engineer asks of a finding: which changes did it, how far may each go, how likely is it, in which region."""

from safevar_sumo.answers.braking_comparison import Braking, BrakingComparison, Course
from safevar_sumo.answers.explanation import explain
from safevar_sumo.answers.figures import necessity_figure, pairs_figure, profiles_figure, save, sensitivity_figure
from safevar_sumo.answers.findings import Cause, Explained, Explanation
from safevar_sumo.answers.lead import lead
from safevar_sumo.answers.preventability import Preventability, PreventableBy, preventability, preventable_by
from safevar_sumo.answers.risk import Risk, risk
from safevar_sumo.answers.robustness import Robustness
from safevar_sumo.answers.rules import Rule, Rules, rules
from safevar_sumo.answers.tolerance import Tolerance, tolerance
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.answers.where import points_in_words, points_of
from safevar_sumo.answers.words import ask, changes, command, joined, number_of, rule_in_words, sentence

__all__ = [
    "Braking", "BrakingComparison", "Cause", "Course", "Explained", "Explanation", "Preventability", "PreventableBy", "Risk",
    "Robustness", "Rule", "Rules", "Tolerance", "Unsafe", "ask", "changes", "command", "explain", "joined", "lead", "necessity_figure",
    "number_of", "pairs_figure", "points_in_words", "points_of", "preventability", "preventable_by", "profiles_figure", "risk",
    "rule_in_words", "rules", "save", "sensitivity_figure", "sentence", "tolerance"]
