"""Euro NCAP's crash avoidance protocol as data: matrices, colours, and the computation of points."""

from safevar_sumo.protocol.cells import COLOURS, EURO_NCAP_2026, Cell, CellMatrix, Protocol, cells_of_part, protocol_of

__all__ = ["COLOURS", "EURO_NCAP_2026", "Cell", "CellMatrix", "Protocol", "cells_of_part", "protocol_of"]
