"""What results mean: research questions, statistics, tables and pictures; without SUMO."""

from safevar_sumo.analysis.brief import brief
from safevar_sumo.analysis.case import Case, Unanswerable, case_of, load_cases
from safevar_sumo.analysis.figures import draw, draw_all
from safevar_sumo.analysis.questions import QUESTIONS, Answer, answer

__all__ = ["QUESTIONS", "Answer", "Case", "Unanswerable", "answer", "brief", "case_of", "draw", "draw_all", "load_cases"]
