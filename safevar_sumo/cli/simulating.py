"""What commands that simulate many settings of a study have in common: their options, and what they are asked about."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from safevar_sumo.results.imported import UNKNOWN
from safevar_sumo.study import Study

if TYPE_CHECKING:
    from safevar_sumo.analysis import Case

unsafe_option = click.option(
    "--unsafe", metavar="collision|below=X",
    help="What is unsafe: a collision, or a safety degree below X.  [default: a collision if anything that is looked at collides, else "
         "half of the original's safety degree]")
jobs_option = click.option("--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]")
point_option = click.option("--point", metavar="NAME", help="Of a study with a matrix: ask about this point of it alone.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def results_or_study(place: str, point: str | None = None) -> Study | Case:
    """The case in a results directory, or a study by name or path; at one point of its matrix if one is named.

    Raises
    ------
    InputError
        If it is neither, or has no such point.
    """
    from safevar_sumo.api.results import study_or_case

    found = study_or_case(place)
    if point is None:
        return found
    if isinstance(found, Study):
        return _at(found, point)
    return replace(found, study=_at(found.study, point), solutions=found.solutions.assign(outcome=UNKNOWN))


def _at(study: Study, point: str) -> Study:
    from safevar_sumo.simulation import study_at

    return study_at(study, point, "--point")


def study_of(place: str, point: str | None = None) -> Study:
    """The study that is named, or the one that a results directory records; raises as `results_or_study`."""
    source = results_or_study(place, point)
    return source if isinstance(source, Study) else source.study
