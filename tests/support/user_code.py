"""Classes of a user, written into a folder."""

from __future__ import annotations

from collections.abc import Callable

from safevar_sumo.sumo.system import System

Mine = Callable[..., System]
SCALAR = "from safevar_sumo.ads import ScalarAds\n\n\nclass Mine(ScalarAds):\n"
ADS = '[ads]\nmodel = "mine:Mine"\n'
"""Modules and tables that tests write beside a study file."""
