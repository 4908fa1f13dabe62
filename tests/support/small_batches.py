"""The program with batches of at most so many settings: a study takes longer, and can be
interrupted at more places.
"""

from __future__ import annotations

import sys

from safevar_sumo.campaign import campaign
from safevar_sumo.cli.program import run_command_line

if __name__ == "__main__":
    size = int(sys.argv.pop(1))
    campaign.efficient_batch = lambda system: size  # type: ignore[attr-defined]
    run_command_line()
