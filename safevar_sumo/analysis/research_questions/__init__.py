"""What results mean: research questions, statistics, tables and pictures; without SUMO."""

from safevar_sumo.analysis.research_questions.answer import QUESTIONS, Answer, answer
from safevar_sumo.analysis.research_questions.case import Case, Unanswerable, case_of, load_cases
from safevar_sumo.analysis.research_questions.figures import draw, draw_all
from safevar_sumo.analysis.research_questions.over_runs import brief

__all__ = ["QUESTIONS", "Answer", "Case", "Unanswerable", "answer", "brief", "case_of", "draw", "draw_all", "load_cases"]
