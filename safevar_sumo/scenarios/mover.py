"""Who moves the vehicles of a scenario, as values on which other code branches. Code asks for
the class of a scenario only to tell bodies on tracks from a world of SUMO.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

Part = Literal[
    "a driving system",
    "a picture",
    "a trace",
    "SUMO",
    "recorded scenes",
    "roads",
    "sumo-gui",
    "weather",
]
"""What a mover may lack, as refusals name it."""


class Mover(NamedTuple):
    """Who moves the vehicles of a scenario.

    Attributes
    ----------
    kind
        What a scenario of it is, in words. All tests of a matrix have one kind.
    at_once
        How many settings it simulates at once, with their repeats; 0, of SUMO alone, is as many as
        fit into memory. With 1 a simulation takes long: questions say how many they take, and do as
        many as they may.
    is_exact
        Whether it repeats itself to the bit. If not, a study may repeat each setting; without
        repeats, another process tries whether results are the same.
    has_own_step
        Whether it has a time step of its own, which no study states.
    lacks
        What it lacks besides `OF_SUMO`, which only SUMO has; each with the reason, with which it
        is refused.
    """

    kind: str
    at_once: int = 1
    is_exact: bool = True
    has_own_step: bool = False
    lacks: Mapping[Part, str] = {}

    @property
    def takes_long(self) -> bool:
        """Whether simulations take so long that questions count them: those of a mover that
        simulates one setting at once.
        """
        return self.at_once == 1

    def reason_against(self, part: Part) -> str:
        """Why it lacks a part; "" if it has it."""
        return {**OF_SUMO, **self.lacks}.get(part, "") if self.at_once else ""

    def has(self, part: Part) -> bool:
        """Whether it does not lack a part."""
        return not self.reason_against(part)


OF_SUMO: Mapping[Part, str] = {
    "SUMO": "it takes no other engine",
    "recorded scenes": "its own simulator moves the vehicle",
    "roads": "it has no road to export",
    "sumo-gui": "it has no scene for sumo-gui",
}
"""What every mover other than SUMO lacks."""
SUMO = Mover("a scenario of SUMO", at_once=0)
"""SUMO, or a scene that it has played once, or tracks of bodies."""
OWN_SIMULATOR = Mover(
    "a simulator of the user's own",
    is_exact=False,
    has_own_step=True,
    lacks={
        "a driving system": "nothing of its driving system can be changed here",
        "a picture": "a picture needs the position in its trace",
        "a trace": "it states metrics alone",
        "weather": "it moves and drives the vehicle in a weather of its own",
    },
)
"""A class with `simulate`, which drives one vehicle after another; see `Simulator`."""
