"""What results mean: research questions, statistics, tables and pictures; without SUMO."""
