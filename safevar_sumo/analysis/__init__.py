"""What results mean: research questions, statistics, tables, pictures, reference data; without SUMO."""

from safevar_sumo.analysis.agreement import Agreement, agreement, plot_agreement
from safevar_sumo.analysis.brief import brief
from safevar_sumo.analysis.figures import FIGURES, draw_all
from safevar_sumo.analysis.imported import evaluations_of, original_metrics
from safevar_sumo.analysis.questions import QUESTIONS, Answer, answer
from safevar_sumo.analysis.reference import ReferenceData, package_filter, read_reference
from safevar_sumo.analysis.setting import Setting, Unanswerable, load_settings, setting_of

__all__ = ["FIGURES", "QUESTIONS", "Agreement", "Answer", "ReferenceData", "Setting", "Unanswerable", "agreement", "answer", "brief",
           "draw_all", "evaluations_of", "load_settings", "original_metrics", "package_filter", "plot_agreement", "read_reference",
           "setting_of"]
