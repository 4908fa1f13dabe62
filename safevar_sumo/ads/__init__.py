"""Automated driving systems by name."""

from collections.abc import Mapping

from safevar_sumo.ads.aeb import Aeb, AutowareAeb
from safevar_sumo.ads.base import (
    Ads as Ads,
    FullBrake as FullBrake,
    PerVehicleAds as PerVehicleAds,
    ScalarAds as ScalarAds,
)
from safevar_sumo.ads.car_following import Acc, Idm, Krauss
from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.ads.fmu import (
    MAX_INSTANCES as MAX_INSTANCES,
    Fmu as Fmu,
    FmuAds as FmuAds,
)
from safevar_sumo.ads.highway_idm import HighwayIdm
from safevar_sumo.ads.intel_rss import AdRss
from safevar_sumo.ads.published import Apollo, WorldOnRails
from safevar_sumo.ads.reference_drivers import R157, FullBraking, FuzzySafety, Rss

ADS: Mapping[str, type] = {
    "acc": Acc,
    "ad_rss": AdRss,
    "aeb": Aeb,
    "apollo": Apollo,
    "autoware_aeb": AutowareAeb,
    "competent_driver": CompetentDriver,
    "full_braking": FullBraking,
    "fuzzy_safety": FuzzySafety,
    "highway_idm": HighwayIdm,
    "idm": Idm,
    "krauss": Krauss,
    "r157": R157,
    "rss": Rss,
    "world_on_rails": WorldOnRails,
}
