import numpy as np

from safevar_sumo.records import Evaluations


class Halving:
    """Random settings, closer and closer to the original one."""

    title = "halving search"

    def __init__(self, factor=0.5):
        self.factor = factor

    def search(self, problem, rng):
        known, original, reach = [], problem.characteristics.original, 1.0
        for start in range(0, problem.evaluations, 10):
            number = min(10, problem.evaluations - start)
            settings = original + reach * (problem.uniform(number, rng) - original)
            known.append((yield problem.characteristics.filter(settings)))
            reach *= self.factor
        everything = Evaluations.concatenate(known)
        degrees = problem.scoring.values(everything)[:, 0]
        return everything.take(np.argsort(degrees, kind="stable")[:5])
