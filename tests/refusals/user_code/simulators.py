"""Simulators of a user that fail, do not end, or return no record of a drive."""

import time

import numpy as np

STOPPED = {
    "time": [0, 0.1, 0.2],
    "speed": [16, 8, 0],
    "separation": np.array([20, 19, 18]),
    "outcome": "stopped",
}


class Replays:
    """A simulator whose result for each vehicle is what its study states."""

    UNITS = {"decel": "m/s^2"}

    def __init__(self, **result):
        self.result = result or STOPPED

    def simulate(self, setting):
        return self.result


class IsNowhere(Replays):
    def simulate(self, setting):
        return {**STOPPED, "separation": STOPPED["separation"] * np.nan}


class IsFarAway(Replays):
    def simulate(self, setting):
        return {**STOPPED, "separation": STOPPED["separation"] + np.inf}


class ReturnsANumber(Replays):
    def simulate(self, setting):
        return 3


class DividesByZero(Replays):
    def simulate(self, setting):
        return 1 / 0


class NeverEnds(Replays):
    def simulate(self, setting):
        time.sleep(9)
