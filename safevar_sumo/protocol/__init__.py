"""Euro NCAP's crash avoidance protocol as data: matrices, colours, and the computation of points."""

from safevar_sumo.protocol.cells import (
    COLOURS as COLOURS,
    EURO_NCAP_2026 as EURO_NCAP_2026,
    Cell as Cell,
    CellMatrix as CellMatrix,
    Protocol as Protocol,
    cells_of_part as cells_of_part,
    protocol_of as protocol_of,
)
