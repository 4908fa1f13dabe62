"""Answers to the research questions from results: statistics, tables and figures, without SUMO."""
