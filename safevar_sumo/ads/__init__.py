"""Automated driving systems by name."""

from collections.abc import Mapping
from typing import Any

from safevar_sumo.ads.acc import Acc
from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.ads.apollo import Apollo
from safevar_sumo.ads.base import REACTION_PARAMETERS, Ads, GuardedAds, PerVehicleAds, ScalarAds
from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.ads.fmu import FmuAds
from safevar_sumo.ads.full_braking import FullBraking
from safevar_sumo.ads.fuzzy_safety import FuzzySafety
from safevar_sumo.ads.idm import Idm
from safevar_sumo.ads.krauss import Krauss
from safevar_sumo.ads.r157 import R157
from safevar_sumo.ads.rss import Rss
from safevar_sumo.ads.world_on_rails import WorldOnRails

ADS: Mapping[str, type[Any]] = {
    "acc": Acc,
    "aeb": Aeb,
    "apollo": Apollo,
    "competent_driver": CompetentDriver,
    "full_braking": FullBraking,
    "fuzzy_safety": FuzzySafety,
    "idm": Idm,
    "krauss": Krauss,
    "r157": R157,
    "rss": Rss,
    "world_on_rails": WorldOnRails,
}

__all__ = ["ADS", "REACTION_PARAMETERS", "Ads", "FmuAds", "GuardedAds", "PerVehicleAds", "ScalarAds"]
