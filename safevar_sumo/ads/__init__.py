"""Automated driving systems by name."""

from collections.abc import Mapping
from typing import Any

from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.ads.apollo import Apollo
from safevar_sumo.ads.base import Ads, ScalarAds
from safevar_sumo.ads.guarded import ADS_CONTRACT, SCALAR_ADS_CONTRACT, GuardedAds, PerVehicle
from safevar_sumo.ads.krauss import Krauss
from safevar_sumo.ads.world_on_rails import WorldOnRails

ADS: Mapping[str, type[Any]] = {
    "aeb": Aeb,
    "apollo": Apollo,
    "krauss": Krauss,
    "world_on_rails": WorldOnRails,
}

__all__ = ["ADS", "ADS_CONTRACT", "SCALAR_ADS_CONTRACT", "Ads", "GuardedAds", "PerVehicle", "ScalarAds"]
