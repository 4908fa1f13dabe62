"""NSGA-II on the predictions of models. The models learn from all simulations so far.

The search follows the global search of SAMOTA (Haq, Shin and Briand, "Efficient online testing for
DNN-enabled systems using surrogate-assisted and many-objective optimization", ICSE 2022). It
simulates the settings with the best predictions, and the settings with the most uncertain
predictions. The models here are bagged ridge regressions (Breiman, "Bagging predictors", Machine
Learning 24, 1996). Only metrics are predicted, because measures of change follow from the setting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.search.baselines import Ranges
from safevar_sumo.search.genetic import Nsga2


class Surrogate(Nsga2, frozen=True, kw_only=True):
    """NSGA-II on the predictions of models: SUMO simulates the best and the most uncertain
    vehicles.

    The search begins with one population of vehicles, in which from one to all characteristics are
    changed. In each round, 20 ridge regressions (weight 0.1) learn the metrics, each from a
    bootstrap sample of all simulated vehicles; an undefined metric is learned as that of the
    original vehicle. The prediction for a vehicle is the mean of the regressions, and the
    uncertainty of a prediction is the standard deviation of the predicted safety degrees. NSGA-II,
    with the parameters of `nsga2`, searches the predictions (1,500 vehicles in generations of 100),
    from all non-dominated simulated vehicles and 100 sampled vehicles. If earlier rounds of the
    search simulated N vehicles, a round simulates 10 + N / 10 new vehicles that are non-dominated
    in the predictions. Four fifths of the vehicles of a round have the best crowding distance, one
    fifth has the most uncertain prediction. `surrogate` returns the non-dominated archive of all
    simulations.
    """

    def search(
        self, problem: Problem, rng: np.random.Generator, _: object = None
    ) -> Search:
        draw = Ranges(problem).draw
        predicted = replace(problem, population=100, evaluations=1500)
        archive = yield draw(min(problem.population, problem.evaluations), rng)
        while budget := problem.evaluations - len(archive):
            predict = _learn(archive, problem, int(rng.integers(2**31)))
            best = problem.nondominated(archive).settings
            search = super().search(
                predicted, rng, np.concatenate([best, draw(100, rng)])
            )
            settings = next(search)
            try:
                while True:
                    settings = search.send(predict(settings))
            except StopIteration as stop:
                front = stop.value

            # The best settings come first, then the settings with the most uncertain predictions.
            new = {bytes(setting): row for row, setting in enumerate(front.settings)}
            for setting in archive.settings:
                new.pop(bytes(setting), None)
            rows = list(new.values())
            number = 10 + len(archive) // 10
            promising = number * 4 // 5
            certainty = front.column("certainty")
            rows[promising:] = sorted(rows[promising:], key=lambda row: certainty[row])

            # If the predictions give too few new settings, random settings are added. A search with
            # a smaller budget simulates the same first settings as a search with a larger budget.
            candidates = np.concatenate([front.settings[rows], draw(number, rng)])
            batch = yield candidates[: min(number, budget)]
            archive = Evaluations.concatenate([archive, batch])
        return problem.nondominated(archive)


def _learn(
    archive: Evaluations, problem: Problem, seed: int
) -> Callable[[FloatArray], Evaluations]:
    """Fit models of all metrics. The returned function predicts the evaluations of settings, shape
    (k, n).

    The predictions have a further metric, `certainty`: minus the standard deviation of the
    predicted safety degrees. The models are linear: unlike trees, they can predict settings that
    are less safe than all simulated settings. For an undefined metric, the models learn the
    original vehicle's value.
    """
    # The import of these modules takes a second.
    from sklearn.ensemble import BaggingRegressor
    from sklearn.linear_model import Ridge

    # Each model predicts all metrics, and the first metric twice. With a single column, the
    # predictions would have another shape.
    targets = [
        np.where(np.isnan(values), np.nan_to_num(problem.original.column(name)), values)
        for name, values in archive.metrics.items()
    ]
    columns = np.stack([*targets, targets[0]], axis=1)
    bag = BaggingRegressor(Ridge(0.1), 20, random_state=seed).fit(
        archive.settings, columns
    )

    # The last decimals differ between libraries of linear algebra. Without rounding, a search would
    # take another way on another machine.
    def predict(settings: FloatArray) -> Evaluations:
        """Predict the evaluations of settings: the mean of the models, and their agreement."""
        values = np.array(
            [model.predict(settings).T for model in bag.estimators_]
        ).round(6)
        metrics = dict(zip(archive.metrics, values.mean(axis=0), strict=False))
        metrics["certainty"] = -values.std(axis=0)[0]
        exact = problem.characteristics.change_objectives(settings)
        return replace(
            Evaluations.undefined(settings, "", (), **exact), metrics=metrics
        )

    return predict
