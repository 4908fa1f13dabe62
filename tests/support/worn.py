"""Vehicles of the study `wear`."""

from __future__ import annotations

from tests.support.made_up import system_of

WORN = system_of("wear", matrix=None)
