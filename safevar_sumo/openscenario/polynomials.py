"""Pieces of OpenDRIVE whose shape is a polynomial: `poly3` and `paramPoly3`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from safevar_sumo.openscenario.document import Element, number, unsupported
from safevar_sumo.openscenario.lines import LEAST_TURN, Number, Piece, Pose

N_PARTS = 1000
"""Parts of a curve whose lengths are integrated one by one."""


@dataclass(frozen=True)
class Curve:
    """A curve `w(p) = u(p) + i v(p)` in the plane, for p from 0 to `last`.

    Its parameter is any; a place on it is found by its distance along the curve. Where the file's
    `length` differs from that of the curve, distances are scaled, so that pieces join.
    """

    start: Pose
    length: float
    weights: tuple[complex, ...]
    last: float
    is_reversed: bool = False

    def _shape(self, p: Number, derivative: int = 0) -> Number:
        return np.polynomial.Polynomial(self.weights).deriv(derivative)(p)

    @cached_property
    def _parameter(self) -> Any:
        """The parameter as a function of the distance: a cubic spline through `N_PARTS` points."""
        from scipy.interpolate import CubicHermiteSpline  # takes longer to load than a simulation

        p = np.linspace(0.0, self.last, 2 * N_PARTS + 1)
        rate = np.abs(self._shape(p, 1))
        # Simpson's rule on each part.
        parts = (rate[:-2:2] + 4 * rate[1::2] + rate[2::2]) * (self.last / N_PARTS / 6)
        ways = np.concatenate([[0.0], np.cumsum(parts)])
        scale = self.length / ways[-1]
        return CubicHermiteSpline(ways * scale, p[::2], 1 / (rate[::2] * scale))

    def pose(self, distance: Number) -> Pose:
        """The pose at a distance from the start."""
        along = self.length - distance if self.is_reversed else distance
        p = self._parameter(along)
        facing = self._shape(p, 1)
        direction = facing / np.abs(facing) * (-1 if self.is_reversed else 1)
        return Pose(
            self.start.place + self.start.facing * self._shape(p), self.start.facing * direction
        )

    def curvature(self, distance: Number) -> Number:
        """The curvature at a distance from the start [1/m]."""
        along = self.length - distance if self.is_reversed else distance
        p = self._parameter(along)
        first = self._shape(p, 1)
        bend = (first.conjugate() * self._shape(p, 2)).imag / np.abs(first) ** 3
        return -bend if self.is_reversed else bend

    @property
    def is_straight(self) -> bool:
        """Curves that are lines are pieces; see `curve_of`."""
        return False

    def reversed(self) -> Curve:
        """The curve from its end to its start."""
        return Curve(self.start, self.length, self.weights, self.last, not self.is_reversed)


def curve_of(start: Pose, length: float, shape: Element) -> Curve | Piece:
    """The geometry of a `poly3`, v(u), or a `paramPoly3`, u(p) and v(p); a line if it is one."""
    if shape.tag == "poly3":
        v = [number(shape, key) for key in "abcd"]
        curve = Curve(start, length, (1j * v[0], 1 + 1j * v[1], 1j * v[2], 1j * v[3]), length)
        # The length is that along the curve, so u ends before it.
        u = np.linspace(0.0, length, N_PARTS + 1)
        rate = np.abs(curve._shape(u, 1))
        ways = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2) * length / N_PARTS])
        curve = Curve(start, length, curve.weights, float(np.interp(length, ways, u)))
    else:
        weights = tuple(
            complex(number(shape, f"{key}U"), number(shape, f"{key}V")) for key in "abcd"
        )
        is_normalised = shape.get("pRange", "normalized") != "arcLength"
        curve = Curve(start, length, weights, 1.0 if is_normalised else length)
    rates = curve._shape(np.linspace(0.0, curve.last, N_PARTS + 1), 1)
    if not (np.abs(rates) > 0).all():
        raise unsupported("a polynomial of a road stands still", "u and v that change with p")
    if np.abs(np.angle(rates[1:] / rates[0])).max() < LEAST_TURN:
        return Piece(curve.pose(0.0), length)
    return curve
