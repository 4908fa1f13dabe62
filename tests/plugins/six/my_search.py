import numpy as np

from safevar_sumo.records import Evaluations


class Halving:
    """Random settings, ever nearer to the original setting."""

    def __init__(self, factor=0.5):
        self.factor = factor

    def search(self, problem, rng):
        result, original, reach = [], problem.characteristics.original, 1.0
        for start in range(0, problem.evaluations, 10):
            number = min(10, problem.evaluations - start)
            settings = original + reach * (problem.uniform(number, rng) - original)
            result.append((yield problem.characteristics.filter(settings)))
            reach *= self.factor
        everything = Evaluations.concatenate(result)
        return everything.take(np.argsort(problem.scoring.values(everything)[:, 0], kind="stable")[:5])
