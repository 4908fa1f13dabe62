"""What results mean: research questions, statistics, tables and pictures; without SUMO."""

from safevar_sumo.analysis.brief import brief
from safevar_sumo.analysis.figures import FIGURES, draw_all
from safevar_sumo.analysis.questions import QUESTIONS, Answer, answer
from safevar_sumo.analysis.setting import Setting, Unanswerable, load_settings, setting_of

__all__ = ["FIGURES", "QUESTIONS", "Answer", "Setting", "Unanswerable", "answer", "brief",
           "draw_all", "load_settings", "setting_of"]
