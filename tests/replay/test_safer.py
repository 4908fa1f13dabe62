"""Why a changed vehicle looks safer: from made-up drives whose distances are worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from safevar_sumo.api.simulation import Simulation
from safevar_sumo.replay import safer
from safevar_sumo.study import SAFETY_DEGREE

STEP, ONSET = 0.1, 5
"""Time between two frames [s], and the sample at which both begin to brake."""


def drives(
    monkeypatch: pytest.MonkeyPatch,
    gaps: tuple[float, float],
    *,
    speeds: tuple[float, float] = (10.0, 10.0),
    brakes: tuple[float, float] = (0.5, 0.5),
    degrees: tuple[float, float] = (1.0, 1.4),
) -> Simulation:
    """The original and a changed vehicle: the distance to the obstacle and the speed at the start
    of braking, the hardest pedal, and the safety degrees.
    """
    samples = 10
    trace = SimpleNamespace(
        gap=np.tile(gaps, (samples, 1)),
        speed=np.tile(speeds, (samples, 1)),
        brake=np.tile(brakes, (samples, 1)),
        active=np.ones((samples, 2), dtype=bool),
        step=STEP,
    )
    monkeypatch.setattr(safer, "brake_onset", lambda runs, row: ONSET)
    pair = SimpleNamespace(runs=SimpleNamespace(trace=trace), evaluations=[0, 0])
    original = SimpleNamespace(metrics={SAFETY_DEGREE: degrees[0]})
    simulation = SimpleNamespace(metrics={SAFETY_DEGREE: degrees[1]}, original=original, pair=pair)
    return cast(Simulation, simulation)


def test_a_gain_of_less_than_a_frame_does_not_show_that_the_change_helps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At 10 m/s a frame of 0.1 s is 1 m: braking 0.6 m earlier is chance, 1.4 m is not."""
    (sentence,) = safer.why_safer(drives(monkeypatch, (20.0, 20.6)))
    assert sentence.startswith("It begins to brake 0.60 m earlier, which is less than a frame")
    assert "decides once in 0.1 s, in which the vehicle travels 1.00 m" in sentence
    assert not safer.why_safer(drives(monkeypatch, (20.0, 21.4)))
    assert not safer.why_safer(drives(monkeypatch, (20.0, 19.5)))


def test_pedals_and_speeds_come_before_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    (harder,) = safer.why_safer(drives(monkeypatch, (20.0, 20.6), brakes=(0.5, 0.8)))
    assert "with up to 80 instead of 50 % of the pedal" in harder
    alike = drives(monkeypatch, (20.0, 21.4), brakes=(0.381, 0.384))
    assert not safer.why_safer(alike), "both are 38 %"
    (slower,) = safer.why_safer(drives(monkeypatch, (20.0, 20.6), speeds=(10.0, 9.5)))
    assert "it begins to brake at 9.50 instead of 10.00 m/s" in slower


@pytest.mark.parametrize("degrees", [(1.4, 1.0), (-2.0, 1.0), (1.0, 1.0)])
def test_nothing_is_said_of_a_vehicle_that_is_not_safer(
    monkeypatch: pytest.MonkeyPatch, degrees: tuple[float, float]
) -> None:
    """Nor beside an original that collides."""
    assert not safer.why_safer(drives(monkeypatch, (20.0, 20.6), degrees=degrees))
