"""A network looked at as a whole before anything is simulated on it."""

from __future__ import annotations

from functools import lru_cache

from safevar_sumo.errors import InputError
from safevar_sumo.simulation.copies import check_roads, parsed
from safevar_sumo.simulation.demand import check_demand
from safevar_sumo.simulation.network import ROADS, built_network, network_fingerprint
from safevar_sumo.simulation.options import TRAFFIC, check_options, options_of
from safevar_sumo.simulation.sources import OPTIONS, Sources, sources_of


def check_network(network: str) -> None:
    """Refuse a network that cannot be simulated as it is meant.

    Raises
    ------
    InputError
        Naming the file, what it says, and what it may say.
    EnvironmentFault
        If the network cannot be built for reasons beside it.
    """
    _check(network, network_fingerprint(network))


@lru_cache(maxsize=1000)
def _check(network: str, fingerprint: str) -> None:
    sources = sources_of(network)
    check_options(sources.place / OPTIONS)
    for name in (*sources.roads, TRAFFIC):
        if b"<include" in (sources.place / name).read_bytes():
            raise InputError(sources.place / name, "includes another file", "one file, that holds everything")
    built = built_network(network)
    roads = parsed(built)
    named = built if sources.built else sources.place
    check_roads(roads, named)
    _check_edited(sources, built.read_text(encoding="utf-8"))
    check_demand(parsed(sources.place / TRAFFIC), sources.place / TRAFFIC, roads, options_of(sources.place / OPTIONS))


def _check_edited(sources: Sources, built: str) -> None:
    """Refuse a network that was drawn on in netedit after its sources, which do not say so."""
    file = sources.place / (sources.builds or ROADS)
    if sources.built or not file.is_file() or any((sources.place / name).stat().st_mtime >= file.stat().st_mtime for name in sources.roads):
        return
    head, _, net = file.read_text(encoding="utf-8", errors="replace").partition("<net ")
    if "netedit" in head and f"<net {net}".strip() != built.strip():
        raise InputError(file, f"was saved by netedit after {', '.join(sources.roads)}, which build another network",
                         "save plain XML there too; or move those files away, to have the network as it is")
