"""What a finding looks like: a changed vehicle beside the original, as figure, as animation and in sumo-gui."""

from safevar_sumo.replay.animation import ANIMATIONS, animate, check_animation
from safevar_sumo.replay.comparison import Comparison, Moments, compare, compare_setting, differences, divergence, moments
from safevar_sumo.replay.figure import draw_comparison
from safevar_sumo.replay.gui import show_in_gui

__all__ = ["ANIMATIONS", "Comparison", "Moments", "animate", "check_animation", "compare", "compare_setting", "differences", "divergence",
           "draw_comparison",
           "moments", "show_in_gui"]
