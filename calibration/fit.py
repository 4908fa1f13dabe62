"""Fits parameters of studies to published rows by CMA-ES (Hansen 2016), and logs every trial.

    python calibration/fit.py calibration/sun_rain.toml FOLDER --log trials.csv --trials 10000
    --seed 1

FOLDER holds the published files that the plan names. Each call adds its trials to the log; of all
trials in the log it prints the best values, their agreement with the rows used and with those held
back, and the tables [spread] and [model_error] of the studies. With `--trials 0` it only prints.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.questions.model_spread import (
    BAND_SHARE,
    band_of,
    error_distance,
    evaluate_sets,
    value_of,
    with_values,
)
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.reference.agreement import (
    defined_pairs,
    measure_agreement,
    rank_correlation,
)
from safevar_sumo.reference.rows import ReferenceData, read_reference
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

NEAR, FAR = 0.02, 0.3
"""Initial standard deviation of a search from the studies' values, and from a random place, in
widths of the bounds.
"""
SIGNIFICANT_DIGITS = 6
"""Significant digits of the values that are tried, as in a study file."""
WORST_LOSS, WORST_DEVIATION = 1e5, 10.0
"""Loss of a study that cannot be simulated; largest deviation of a metric of the original vehicle,
in tolerances.
"""
ROWS_PER_COEFFICIENT = 10
"""Minimum number of rows for each coefficient of a regression."""
MAX_SETS = 20
"""Maximum number of parameter sets in a table [spread], including the best set."""
ERROR_DECIMALS = 3
"""Decimals of a model error [m]."""


class Parameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A free parameter: its `key` in a study file, its bounds, and the `studies` that it belongs to
    (default: all).

    With `log`, the search measures distances of values as ratios.
    """

    key: str
    lower: float
    upper: float
    unit: str
    meaning: str
    log: bool = False
    studies: list[str] = []


class Target(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a study is fitted to: published `files`, and the weights of `loss_of_original` and
    `loss_of_file`.
    """

    files: list[str]
    weights: dict[str, float]
    original: float
    rank: float
    collisions: float
    effects: float = 0.0


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fit of several studies, by name or path.

    One of every `hold_out` rows of a file is reported and not fitted. `tolerance` is the share of a
    published value of the original vehicle within which a deviation costs nothing. Trials whose
    loss exceeds the lowest by at most the share `alike` fit equally well. `population` is the
    number of trials in a generation.
    """

    studies: dict[str, Target]
    parameters: list[Parameter]
    population: int
    hold_out: int
    tolerance: float
    alike: float = 0.05


class Fit(NamedTuple):
    """Studies by name, with their published rows by file."""

    plan: Plan
    studies: dict[str, Study]
    rows: dict[str, dict[str, ReferenceData]]

    def studies_at(self, values: Sequence[float]) -> dict[str, Study]:
        """The studies with these values of the parameters."""
        pairs = list(zip(self.plan.parameters, values, strict=True))
        return {
            name: with_values(
                study,
                {
                    p.key: value
                    for p, value in pairs
                    if not p.studies or name in p.studies
                },
            )
            for name, study in self.studies.items()
        }

    def own_values(self) -> list[float]:
        """The values in the study files."""
        first = next(iter(self.studies))
        return [
            value_of(self.studies[p.studies[0] if p.studies else first], p.key)
            for p in self.plan.parameters
        ]

    def loss(self, values: Sequence[float]) -> float:
        """The mean loss of the studies with these values on the rows used."""
        return float(
            np.mean(
                [
                    self._loss_of_study(name, study)
                    for name, study in self.studies_at(values).items()
                ]
            )
        )

    def _loss_of_study(self, name: str, study: Study) -> float:
        target, hold_out = self.plan.studies[name], self.plan.hold_out
        files = [
            data.take(~held_back(data, hold_out)) for data in self.rows[name].values()
        ]
        original, *evaluated = simulate(study, files)
        if not all(evaluations.valid.all() for evaluations in (original, *evaluated)):
            return WORST_LOSS
        losses = [
            loss_of_file(*pair, study, target)
            for pair in zip(files, evaluated, strict=True)
        ]
        return loss_of_original(original, study, target, self.plan.tolerance) + float(
            np.mean(losses)
        )


def simulate(study: Study, files: Sequence[ReferenceData]) -> list[Evaluations]:
    """Evaluations of the original vehicle and of the rows of each file; equal settings are
    simulated once.
    """
    blocks = [
        CharacteristicSet.of(study).original[np.newaxis],
        *(data.settings for data in files),
    ]
    settings, places = np.unique(np.concatenate(blocks), axis=0, return_inverse=True)
    evaluations = drive_and_score(assemble(study), settings)
    ends = np.cumsum([len(block) for block in blocks])[:-1]
    return [evaluations.take(rows) for rows in np.split(places.ravel(), ends)]


def loss_of_original(
    original: Evaluations, study: Study, target: Target, tolerance: float
) -> float:
    """The mean over metrics, weighted, of twice the deviation beyond the tolerance, in tolerances
    (Vapnik 1995).
    """
    names = list(study.published)
    deviations = (
        np.array(
            [original.metrics[name][0] / study.published[name] - 1 for name in names]
        )
        / tolerance
    )
    deviations = np.nan_to_num(
        np.clip(deviations, -WORST_DEVIATION, WORST_DEVIATION), nan=WORST_DEVIATION
    )
    weights = np.array([target.weights.get(name, 0.0) for name in names])
    return target.original * float(
        np.mean(weights * 2 * np.maximum(np.abs(deviations) - 1, 0.0))
    )


def loss_of_file(
    data: ReferenceData, here: Evaluations, study: Study, target: Target
) -> float:
    """The sum of rank correlations' distance from 1 and of mean errors, by metric, of differences
    between the characteristics' linear effects, and of the share of rows that collide on one side
    only, all weighted.

    The unit of errors is the study's repeatability or, if unknown, the standard deviation of the
    published values.
    """
    loss = target.collisions * float(np.mean(data.collided != here.collided))
    for name, weight in target.weights.items():
        there, values = defined_pairs(data.metrics[name], here.metrics[name])
        if not there.size or np.ptp(there) == 0:
            continue
        unit = study.repeatability.get(name) or float(np.nanstd(data.metrics[name]))
        correlation = rank_correlation(there, values) or 0.0
        loss += weight * (
            target.rank * (1 - correlation)
            + float(np.mean(np.abs(values - there))) / unit
        )
        if name == SAFETY_DEGREE and target.effects:
            effects = [
                linear_effects(study, data.settings, side)
                for side in (here.f_safe, data.metrics[name])
            ]
            loss += (
                target.effects
                * float(np.mean(np.abs(np.nan_to_num(effects[0] - effects[1]))))
                / unit
            )
    return loss


def linear_effects(
    study: Study, settings: FloatArray, values: FloatArray
) -> FloatArray:
    """How much `values` change over the whole domain of each characteristic, by linear regression
    on all characteristics that vary; NaN where undefined.
    """
    domains = CharacteristicSet.of(study)
    defined, effects = np.isfinite(values), np.full(settings.shape[1], np.nan)
    shares = (settings[defined] - domains.original) / (domains.upper - domains.lower)
    varies = (shares != shares[:1]).any(axis=0)
    design = np.column_stack([np.ones(len(shares)), shares[:, varies]])
    if len(shares) >= ROWS_PER_COEFFICIENT * design.shape[1]:
        effects[varies] = np.linalg.pinv(design)[1:] @ values[defined]
    return effects


def held_back(data: ReferenceData, hold_out: int) -> BoolArray:
    """Whether a row is reported and not fitted; shape (rows,)."""
    return np.asarray(np.arange(len(data.settings)) % hold_out == hold_out - 1)


class Cube(NamedTuple):
    """The unit cube of the parameters' bounds, on a logarithmic scale where a parameter asks for
    it.
    """

    lower: FloatArray
    upper: FloatArray
    is_log: BoolArray

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> Cube:
        return cls(
            *(
                np.array([getattr(p, name) for p in parameters])
                for name in ("lower", "upper", "log")
            )
        )

    def scale(self, values: FloatArray) -> FloatArray:
        """Values on the parameters' scales."""
        return np.log(values, out=np.array(values, dtype=float), where=self.is_log)

    def places(self, values: FloatArray) -> FloatArray:
        """Places in the cube, shape (..., parameters), from values."""
        start = self.scale(self.lower)
        return np.clip(
            (self.scale(values) - start) / (self.scale(self.upper) - start), 0, 1
        )

    def values(self, place: FloatArray) -> list[float]:
        """The parameters' values at a place, with `SIGNIFICANT_DIGITS`."""
        start = self.scale(self.lower)
        scaled = start + place * (self.scale(self.upper) - start)
        values = np.clip(
            np.exp(scaled, out=scaled.copy(), where=self.is_log), self.lower, self.upper
        )
        return [float(f"{value:.{SIGNIFICANT_DIGITS}g}") for value in values]


def search(
    fit: Fit, log: Path, trials: int, seed: int, jobs: int, *, from_scratch: bool
) -> None:
    """Add at most `trials` trials of one CMA-ES to the log, in whole generations.

    It begins at the studies' values, which are the first trial; from scratch at a random place.
    """
    import cma

    cube, keys = (
        Cube.of(fit.plan.parameters),
        [parameter.key for parameter in fit.plan.parameters],
    )
    own = fit.own_values()
    start = (
        np.random.default_rng(seed).random(len(keys))
        if from_scratch
        else cube.places(np.array(own))
    )
    options = {
        "seed": seed,
        "bounds": [0, 1],
        "popsize": fit.plan.population,
        "verbose": -9,
    }
    strategy = cma.CMAEvolutionStrategy(start, FAR if from_scratch else NEAR, options)
    is_new = not log.exists()
    with (
        log.open("a", newline="", encoding="utf-8") as file,
        ProcessPoolExecutor(jobs) as pool,
    ):
        writer, lowest = csv.writer(file, lineterminator="\n"), np.inf
        writer.writerows([["loss", *keys]] if is_new else [])
        writer.writerows([] if from_scratch else [[repr(fit.loss(own)), *own]])
        for done in range(fit.plan.population, trials + 1, fit.plan.population):
            places = strategy.ask()
            values = [cube.values(place) for place in places]
            losses = list(pool.map(fit.loss, values))
            strategy.tell(places, losses)
            writer.writerows(
                [repr(loss), *row] for loss, row in zip(losses, values, strict=True)
            )
            file.flush()
            lowest = min(lowest, *losses)
            print(f"{done} of {trials} trials, lowest loss {lowest:.4f}", flush=True)


def distant_rows(places: FloatArray) -> list[int]:
    """The first and up to `MAX_SETS` - 1 other rows that lie as far apart as possible, by
    farthest-point sampling.
    """
    indices, distances = [0], np.linalg.norm(places - places[0], axis=1)
    while len(indices) < min(MAX_SETS, len(places)) and distances.max() > 0:
        indices.append(int(np.argmax(distances)))
        distances = np.minimum(
            distances, np.linalg.norm(places - places[indices[-1]], axis=1)
        )
    return indices


def model_error(study: Study, files: Sequence[ReferenceData]) -> float:
    """The margin on each side with which the band of [spread] holds the share `BAND_SHARE` of new
    rows of each file, in m per domain width of distance from the original: split conformal
    prediction (Lei et al. 2018), file by file.
    """
    study, margins = msgspec.structs.replace(study, model_error={}), [0.0]
    for data in files:
        published = data.metrics[SAFETY_DEGREE]
        lower, upper = band_of(study, evaluate_sets(study, data.settings))
        beyond = np.maximum(np.maximum(lower - published, published - upper), 0.0)
        share = min(1.0, BAND_SHARE * (1 + 1 / len(published)))  # + 1 for the new row
        margins.append(
            float(
                np.quantile(
                    beyond / error_distance(study, data.settings),
                    share,
                    method="inverted_cdf",
                )
            )
        )
    return max(margins)


def print_result(fit: Fit, log: Path) -> None:
    """Print the best values in the log, their agreement, and the studies' tables [spread] and
    [model_error].
    """
    parameters, hold_out = fit.plan.parameters, fit.plan.hold_out
    trials = np.loadtxt(log, delimiter=",", skiprows=1, ndmin=2)
    trials = trials[np.argsort(trials[:, 0], kind="stable")]
    lowest = trials[0, 0]
    alike = trials[trials[:, 0] <= lowest * (1 + fit.plan.alike), 1:]
    sets = alike[distant_rows(Cube.of(parameters).places(alike))]
    print(
        f"\n# loss {lowest:.4f}, lowest of {len(trials)} trials; {len(alike)} fit equally well"
    )
    for name, study in fit.studies_at(alike[0].tolist()).items():
        files = fit.rows[name]
        own = [
            k
            for k, parameter in enumerate(parameters)
            if not parameter.studies or name in parameter.studies
        ]
        with_sets = msgspec.structs.replace(
            study, spread={parameters[k].key: sets[:, k].tolist() for k in own}
        )
        print(f"\n# {name}")
        _, *evaluated = simulate(with_sets, list(files.values()))
        for (file, data), here in zip(files.items(), evaluated, strict=True):
            for part, rows in (
                ("used", ~held_back(data, hold_out)),
                ("held back", held_back(data, hold_out)),
            ):
                table = measure_agreement(data.take(rows), here.take(rows)).set_index(
                    "metric"
                )
                agreement = table.loc[SAFETY_DEGREE].drop("unit")
                print(
                    f"# {file}, {part}: "
                    + ", ".join(
                        f"{key} {value:.3f}" for key, value in agreement.items()
                    )
                )
        error = model_error(
            with_sets,
            [data.take(~held_back(data, hold_out)) for data in files.values()],
        )
        print(
            f"[model_error]\n{SAFETY_DEGREE} = {round(error, ERROR_DECIMALS)}\n[spread]"
        )
        for key, values in with_sets.spread.items():
            print(f'"{key}" = {values}')


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plan", type=Path, help="free parameters, studies and weights")
    parser.add_argument("folder", type=Path, help="folder of the published files")
    parser.add_argument(
        "--log",
        type=Path,
        required=True,
        metavar="FILE.csv",
        help="loss and values of every trial",
    )
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1, help="seed of the search")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count(), help="worker processes"
    )
    parser.add_argument(
        "--from-scratch", action="store_true", help="begin at a random place"
    )
    given = parser.parse_args(arguments)
    plan = msgspec.toml.decode(given.plan.read_bytes(), type=Plan)
    studies = {name: read_study(name) for name in plan.studies}
    rows = {
        name: {
            file: read_reference(
                given.folder / file, CharacteristicSet.of(studies[name])
            )
            for file in target.files
        }
        for name, target in plan.studies.items()
    }
    fit = Fit(plan, studies, rows)
    if given.trials:
        search(
            fit,
            given.log,
            given.trials,
            given.seed,
            given.jobs,
            from_scratch=given.from_scratch,
        )
    print_result(fit, given.log)


if __name__ == "__main__":
    main()
