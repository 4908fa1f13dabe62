"""Search algorithms of a user that fail, do not end, or do not meet their contract."""

import time


class ChangesADomain:
    def search(self, problem, rng):
        problem.characteristics.lower[:] = 0


class AsksForNothing:
    def search(self, problem, rng):
        yield from ()
        return problem.original.take([])


class AsksForNoSettings:
    def search(self, problem, rng):
        yield problem.characteristics.original[None][:0]


class CannotBeAnswered:
    def search(self, problem, rng):
        return iter([])


class ReturnsNothing:
    def search(self, problem, rng):
        return None


class StartsFromAnotherRun:
    best = None

    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(10, rng))
        evaluated = yield settings
        if StartsFromAnotherRun.best is None:
            StartsFromAnotherRun.best = evaluated.settings[0].copy()
        settings[1] = StartsFromAnotherRun.best
        evaluated = yield settings
        return evaluated.take([0])


class IsNeverCreated:
    def __init__(self):
        time.sleep(60)

    def search(self, problem, rng): ...


class Raises:
    def search(self, problem, rng):
        raise ValueError("no search today")
