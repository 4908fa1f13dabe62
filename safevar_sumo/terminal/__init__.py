"""What a person sees on the terminal."""

from safevar_sumo.terminal.campaign import print_forecast, print_summary
from safevar_sumo.terminal.progress import CampaignProgress, counted, trials
from safevar_sumo.terminal.reference import print_agreement, print_calibration
from safevar_sumo.terminal.simulation import print_evaluation, print_names

__all__ = [
    "CampaignProgress", "counted", "print_agreement", "print_calibration", "print_evaluation", "print_forecast", "print_names",
    "print_summary", "trials",
]
