"""Driving systems of a user that fail, do not end, or do not meet their contract."""

import time
from contextlib import suppress
from pathlib import Path

from safevar_sumo.ads import ScalarAds
from safevar_sumo.records import Command


class Brakes(ScalarAds):
    """A correct system: the vehicle always brakes fully."""

    def drive(self, seen):
        return 0.0, 1.0


class HasNoDrive(ScalarAds):
    pass


class DriveTakesAMemoryTooMuch(ScalarAds):
    def drive(self, seen, memory): ...


class WritesWhenCreated:
    """No system is created before its class has all methods."""

    def __init__(self, command):
        Path("called").touch()

    def start(self, n, nominal, step): ...


class DriveTakesNoMemory(WritesWhenCreated):
    def drive(self, seen): ...


class DriveIsANumber(WritesWhenCreated):
    drive = 3


class DividesByZero(ScalarAds):
    def drive(self, seen):
        return 1 / 0


class RaisesTwoLines(ScalarAds):
    def drive(self, seen):
        raise RuntimeError("my\n message")


class RaisesALoneSurrogate(ScalarAds):
    def drive(self, seen):
        raise ValueError("bad \ud800 text")


class RaisesAnInterrupt(ScalarAds):
    def drive(self, seen):
        raise KeyboardInterrupt


class ReturnsNothing(ScalarAds):
    def drive(self, seen):
        pass


class BrakesTooMuch(ScalarAds):
    def drive(self, seen):
        return 0, 2


class OwnNominalRaises(Brakes):
    @property
    def nominal(self):
        raise RuntimeError("no")


class StepCannotBeSet(Brakes):
    @property
    def step(self):
        return 1


class SettingNominalRaises(Brakes):
    def put(self, value):
        raise RuntimeError("no")

    nominal = property(None, put)


class Remembers:
    """A system for many vehicles without its method `drive`."""

    def start(self, n, nominal, step):
        return n


class ChangesWhatIsSeen(Remembers):
    def drive(self, seen, memory):
        seen.speed[:] = 0


class ReturnsNoCommand(Remembers):
    def drive(self, seen, memory):
        return (seen.speed * 0, seen.speed), memory


class BrakesNoVehicle(Remembers):
    def drive(self, seen, memory):
        return Command(seen.speed * 0, seen.speed[:0]), memory


class NeverDrives(ScalarAds):
    def drive(self, seen):
        time.sleep(60)


class NeverDrivesWhateverIsRaised(ScalarAds):
    def drive(self, seen):
        for _ in range(9):
            with suppress(Exception):
                time.sleep(60)


class IsNeverCreated(Brakes):
    def __init__(self):
        time.sleep(60)


class HasParameters(Brakes):
    """A correct system."""

    def __init__(self, threshold=1.0, weights=""): ...
