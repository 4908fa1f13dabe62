"""A SUMO that stays open: the actors of one batch are taken off the road, and those of the next put onto it.

Loading a network takes as long as a batch drives on it. Whoever comes onto an empty road drives as after loading, to
the last bit; `traffic.py` knows which traffic can be put back like that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safevar_sumo.sumo.copies import copied_id
from safevar_sumo.sumo.traffic import Car, Traffic, Walker

BATCHES_PER_LOADING = 200
"""So often a network is driven on before it is loaded anew: whatever might creep cannot creep far."""
PARKING = 1
"""Flag of a stop beside the lane (TraCI, "set stop")."""


class ReusableSumo:
    """An open SUMO whose network nobody is on; `enter` puts the actors onto its first copies.

    Parameters
    ----------
    loaded
        The network's fingerprint and further options that SUMO was started with.
    copies
        How many copies of the network.
    """

    def __init__(self, api: Any, loaded: tuple[str, ...], copies: int) -> None:
        self._api, self._loaded, self._copies = api, loaded, copies
        self._traffic: Sequence[Traffic] = ()
        self._ways: set[str] = set()
        self._batches = 0

    @property
    def network(self) -> str:
        """The network's fingerprint."""
        return self._loaded[0]

    def serves(self, wanted: tuple[str, ...], n: int) -> bool:
        """Whether the next batch, of `n` settings, may be driven here."""
        return self._batches < BATCHES_PER_LOADING and n <= self._copies and wanted == self._loaded

    def expect(self, traffic: Sequence[Traffic]) -> None:
        """Take note of the actors of the next batch, in each of its copies."""
        self._traffic = traffic

    def enter(self) -> None:
        """Clear the road, and let everybody who is expected set off with the next step."""
        if self._batches:
            self._clear()
        self._batches += 1
        for copy, traffic in enumerate(self._traffic):
            for actor in traffic:
                self._add_car(copy, actor) if isinstance(actor, Car) else self._add_walker(copy, actor)

    def shift(self) -> None:
        """Put those who have departed beside the middle of their lane where they belong there."""
        for copy, traffic in enumerate(self._traffic):
            for actor in traffic:
                if isinstance(actor, Car) and actor.left:
                    self._api.vehicle.setLateralLanePosition(copied_id(copy, actor.name), actor.left)

    def _clear(self) -> None:
        for vehicle in self._api.vehicle.getLoadedIDList():
            self._api.vehicle.remove(vehicle)
        for person in self._api.person.getIDList():
            self._api.person.removeStages(person)
        self._api.simulationStep()

    def _add_car(self, copy: int, car: Car) -> None:
        name, way = copied_id(copy, car.name), _way(copy, car)
        if way not in self._ways:
            self._api.route.add(way, _copied(copy, car.edges))
            self._ways.add(way)
        self._api.vehicle.add(name, way, copied_id(copy, car.type), **car.places)
        for stop in car.stops:
            edge, flags = copied_id(copy, stop.edge), PARKING * stop.parking
            self._api.vehicle.setStop(name, edge, stop.end, stop.lane, stop.duration, flags, stop.start)

    def _add_walker(self, copy: int, walker: Walker) -> None:
        name = copied_id(copy, walker.name)
        self._api.person.add(name, copied_id(copy, walker.walks[0].edges[0]), walker.place, typeID=copied_id(copy, walker.type))
        for walk in walker.walks:
            self._api.person.appendWalkingStage(name, _copied(copy, walk.edges), walk.end, speed=walk.speed)


def _way(copy: int, car: Car) -> str:
    """Id of a route of ours; one that came with a vehicle in the traffic file has none, and would go with it."""
    return copied_id(copy, f"way over {'-'.join(car.edges)}")


def _copied(copy: int, edges: tuple[str, ...]) -> list[str]:
    return [copied_id(copy, edge) for edge in edges]
