"""Euro NCAP's crash avoidance protocol as data: matrices, colours, and the computation of
points.
"""

from safevar_sumo.protocol.cells import (
    COLOURS as COLOURS,
    EURO_NCAP_2026 as EURO_NCAP_2026,
    CellMatrix as CellMatrix,
    Protocol as Protocol,
    protocol_of as protocol_of,
)
