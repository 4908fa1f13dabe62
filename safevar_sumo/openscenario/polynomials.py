"""Geometries of OpenDRIVE that are polynomials, `poly3` and `paramPoly3`, as short spirals."""

from __future__ import annotations

import math

import numpy as np

from safevar_sumo.openscenario.document import Element, number, unsupported
from safevar_sumo.openscenario.lines import LEAST_TURN, Piece, Pose

N_PARTS = 2000
"""Parts of a curve whose lengths are added up."""
SPIRAL = 2.0
"""Length of a spiral [m]: its curvature is linear, that of the curve nearly so."""
MOST_SPIRALS = 5000


def pieces_of(start: Pose, length: float, shape: Element) -> list[Piece]:
    """A `poly3`, v(u), or a `paramPoly3`, u(p) and v(p), in the coordinates of a pose.

    A place on it is found by its distance along the curve. Where the stated length differs from
    that of the curve, distances are scaled, so that geometries join.
    """
    if is_poly3 := shape.tag == "poly3":
        weights = 1j * np.array([number(shape, key) for key in "abcd"]) + [0, 1, 0, 0]
    else:
        u, v = ([number(shape, f"{key}{axis}") for key in "abcd"] for axis in "UV")
        weights = np.array(u) + 1j * np.array(v)
    curve = np.polynomial.Polynomial(weights)

    # How long the curve is up to each of many parameters, by Simpson's rule.
    is_long = is_poly3 or shape.get("pRange") == "arcLength"
    p = np.linspace(0.0, length if is_long else 1.0, 2 * N_PARTS + 1)
    rates = curve.deriv()(p)
    sizes = np.abs(rates)
    if not (sizes > 0).all():
        raise unsupported("a polynomial of a road stands still", "u and v that change with p")
    parts = (sizes[:-2:2] + 4 * sizes[1::2] + sizes[2::2]) * (p[1] / 3)
    ways = np.concatenate([[0.0], np.cumsum(parts)])
    if not is_poly3:  # which ends where its length is reached
        ways *= length / ways[-1]

    # From end to end of each spiral the curvature is linear; a line needs one piece.
    is_straight = np.abs(np.angle(rates / rates[0])).max() < LEAST_TURN
    count = 1 if is_straight else min(math.ceil(length / SPIRAL), MOST_SPIRALS)
    at = np.interp(np.linspace(0.0, length, count + 1), ways, p[::2])
    rate = curve.deriv()(at)
    bends = (rate.conjugate() * curve.deriv(2)(at)).imag / np.abs(rate) ** 3 * (not is_straight)
    places = (start.place + start.facing * curve(at)).tolist()
    facings = (start.facing * rate / np.abs(rate)).tolist()
    ends = bends.tolist()
    return [
        Piece(Pose(places[k], facings[k]), length / count, ends[k], ends[k + 1])
        for k in range(count)
    ]
