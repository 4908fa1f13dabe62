"""The figure of a changed vehicle beside the original."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.analysis.figures import save
from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.replay.comparison import Comparison, compare_setting
from safevar_sumo.replay.figure import draw_comparison
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate, study_at
from safevar_sumo.sumo.system import assemble


@pytest.fixture(scope="module")
def comparison(slippery: Path) -> Comparison:
    (case,) = load_cases([slippery])
    return compare_setting(case.study, assemble(case.study), case.solutions[list(case.characteristics.names)].to_numpy()[0])


def test_it_draws_both_drives_as_far_as_they_go(comparison: Comparison) -> None:
    figure = draw_comparison(comparison)
    trace = comparison.film.drives.trace
    for axis, values in zip(figure.axes, (trace.speed, trace.gap, trace.throttle - trace.brake), strict=False):
        for row, line in zip(comparison.rows, axis.lines[:1] + [one for one in axis.lines[1:] if len(one.get_xdata()) > 9], strict=False):
            end = comparison.film.last[row] + 1
            assert list(line.get_xdata()) == list(trace.time[:end])
            assert list(line.get_ydata()) == list(values[:end, row])
    assert [axis.get_ylabel() for axis in figure.axes] == [
        "speed [m/s]", "gap to the obstacle [m]", "brake     |     throttle", "time to collision [s]"]
    words = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert comparison.verdict(0) in words
    assert comparison.verdict(1) in words
    heading = figure.get_suptitle()
    for change in comparison.changes:
        assert change in heading


def test_its_words_stand_within_their_axes_and_on_nothing_else(comparison: Comparison) -> None:
    figure = draw_comparison(comparison)
    figure.canvas.draw()
    for axis in figure.axes[:2]:
        words = [text.get_window_extent() for text in axis.texts if text.get_text()]
        assert words
        assert not any(one.overlaps(other) for one, other in combinations(words, 2))
        for box in words:
            assert axis.bbox.x0 < box.x0 < box.x1 < axis.bbox.x1
            assert axis.bbox.y0 < box.y0 < box.y1 < axis.bbox.y1
    impact = next(text for text in figure.axes[1].texts if text.get_text() == "impact").get_window_extent()
    assert impact.y1 < figure.axes[1].transData.transform((0, 0))[1], "below the ground, where no line is"


def test_time_ends_where_all_has_come_to_rest(comparison: Comparison) -> None:
    """The original waits for the end of the simulation: as here, after its last metre."""
    drives, short = comparison.film.drives, draw_comparison(comparison).axes[3].get_xlim()[1]
    trace = drives.trace
    more = {one.name: np.concatenate([values, np.repeat(values[-1:], 400, axis=0)]) for one in fields(trace)
            if np.ndim(values := getattr(trace, one.name)) == 2}
    more["active"][:, 1] &= np.arange(len(more["active"])) < len(trace.time)
    more["active"][:, 0], more["speed"][len(trace.time):] = True, 0.0
    longer = replace(trace, time=np.arange(len(more["active"])) * trace.step, **more)
    encounter = drives.encounter._make(np.concatenate([values, np.repeat(values[-1:], 400, axis=0)]) for values in drives.encounter)
    waits = replace(comparison, film=replace(comparison.film, drives=replace(drives, trace=longer, encounter=encounter)))
    assert waits.film.drives.trace.time[waits.film.last[0]] > 2 * short
    assert draw_comparison(waits).axes[3].get_xlim()[1] == pytest.approx(short, abs=0.2)


def test_at_an_impact_the_pedals_are_those_that_were_in_force() -> None:
    """AEB lets go of the brake once the gap is gone, which is after the collision."""
    study = study_at(load_study("euro_ncap_pedestrian"), "CPLA, speed 60, clear", "point")
    system = assemble(study)
    setting = system.characteristics.original.copy()
    for name, value in (("tireFric", 1.0), ("mass", 2600.0)):
        setting[system.characteristics.names.index(name)] = value
    shown, drives = compare_setting(study, system, setting), simulate(system, setting[np.newaxis])
    trace, end = shown.film.drives.trace, shown.film.last[-1]
    assert shown.verdict(1).startswith("hits")
    assert drives.trace.brake[end, 0] == 0
    assert trace.brake[end, 1] == trace.brake[end - 1, 1] == drives.trace.brake[end - 1, 0] == 1
    assert shown.evaluations.metrics["safety_degree"][1] == -drives.collision_speed[0]


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_same_bytes_twice(kind: str, comparison: Comparison, tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(draw_comparison(comparison), tmp_path / f"{name}.{kind}")
    assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
