"""Euro NCAP's crash avoidance protocol as data: matrices, colours, and the computation of points."""

from safevar_sumo.protocol.cells import (
    EURO_NCAP_2026,
    NOT_RED,
    PROTOCOLS,
    Cell,
    CellMatrix,
    CellScenario,
    Layer,
    Protocol,
    cells_of_part,
    protocol_of,
)
from safevar_sumo.protocol.points import COLOURS, RED, REQUIRED_CELLS, UNCHECKED_CELLS, Points, RequiredCells, points_of

__all__ = [
    "COLOURS",
    "EURO_NCAP_2026",
    "NOT_RED",
    "PROTOCOLS",
    "RED",
    "REQUIRED_CELLS",
    "UNCHECKED_CELLS",
    "Cell",
    "CellMatrix",
    "CellScenario",
    "Layer",
    "Points",
    "Protocol",
    "RequiredCells",
    "cells_of_part",
    "points_of",
    "protocol_of",
]
