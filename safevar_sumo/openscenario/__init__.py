"""OpenSCENARIO XML 1.0 to 1.3: a file becomes the motion of all its actors, with an Ego that holds
its speed.
"""

from safevar_sumo.openscenario.actors import STEP as STEP
from safevar_sumo.openscenario.document import MOST as MOST
from safevar_sumo.openscenario.expressions import text_of as text_of
from safevar_sumo.openscenario.logical import (
    Source as Source,
    constraints_of as constraints_of,
    open_file as open_file,
    originals as originals,
)
from safevar_sumo.openscenario.reading import read as read
from safevar_sumo.openscenario.scene import (
    EVERY as EVERY,
    Moved as Moved,
    Played as Played,
    play as play,
)
