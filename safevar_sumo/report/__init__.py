"""One page that tells a study's findings to somebody who was not there."""

from safevar_sumo.report.page import SECTIONS, make_report

__all__ = ["SECTIONS", "make_report"]
