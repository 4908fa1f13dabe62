"""What a finding looks like: a changed vehicle beside the original, as figure, as animation and in sumo-gui."""

from safevar_sumo.showing.animation import ANIMATIONS, animate, check_animation
from safevar_sumo.showing.comparison import Comparison, compare, differences
from safevar_sumo.showing.figure import draw_comparison, write_figure
from safevar_sumo.showing.gui import show_in_gui
from safevar_sumo.showing.moments import Moments, divergence, moments

__all__ = ["ANIMATIONS", "Comparison", "Moments", "animate", "check_animation", "compare", "differences", "divergence", "draw_comparison",
           "moments", "show_in_gui", "write_figure"]
