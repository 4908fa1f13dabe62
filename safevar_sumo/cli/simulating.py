"""What commands that simulate many settings of a study have in common: their options, and what they are asked about."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from safevar_sumo.study import Study, load_study, study_names

if TYPE_CHECKING:
    from safevar_sumo.analysis import Case

unsafe_option = click.option(
    "--unsafe", metavar="collision|below=X",
    help="What is unsafe: a collision, or a safety degree below X.  [default: a collision if anything that is looked at collides, else "
         "half of the original's safety degree]")
jobs_option = click.option("--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def results_or_study(place: str) -> Study | Case:
    """The case in a results directory, or a study by name or path.

    Raises
    ------
    InputError
        If it is neither.
    """
    if place in study_names() or not Path(place).is_dir():
        return load_study(place)
    from safevar_sumo.analysis import load_cases

    return load_cases([place])[0]


def study_of(place: str) -> Study:
    """The study that is named, or the one that a results directory records; raises as `results_or_study`."""
    source = results_or_study(place)
    return source if isinstance(source, Study) else source.study
