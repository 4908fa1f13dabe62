"""Finds repairs by counterexamples: the smallest changes that survive them, attacks, and proof on fresh wear.

The steps of the algorithm: 0. what no driving system survives; 1. counterexamples; 2. the smallest changes that survive
them (`smallest`); 3. attacks on these, whose failures are new counterexamples (`attack`); 4. the end, when attacks find
nothing, or the largest promise that can be kept; 5. proof on fresh wear; 6. what the repair has not seen (`price`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain.causes import cause_key, describe_causes, find_minimal_causes
from safevar_sumo.analysis.repair import RepairOptions
from safevar_sumo.analysis.repair.answer import Exchange, NotRepairable, Repair, Repairs
from safevar_sumo.analysis.repair.attack import Proof, attack, prove
from safevar_sumo.analysis.repair.price import Prices, check_unseen
from safevar_sumo.analysis.repair.problem import Problem, Promise, parameters_of
from safevar_sumo.analysis.repair.smallest import Search
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import FloatArray, JsonObject, differences
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import CharacteristicSet

DEFAULT_MARGIN = 0.3
"""Safety degree to keep of a study that states no error of its model [m]."""
SOBOL_VEHICLES = 256
"""Sobol points of the promise among the first counterexamples."""
MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""
LEFT_OUT = 3
"""Every so many points of a matrix are left out until a repair has survived all attacks at the others."""
HALVINGS = 6
"""Halvings that locate the largest promise that can be kept."""
CAUSES_OF, WORST_AT_POINTS = 4, 16
"""Failures of full braking whose causes are told; the worst vehicles that are driven at each point left out."""
EVERY_READER = 8
"""One in so many counterexamples shows whether a simulation reads a parameter."""
CURVE_PROMISES, CURVE_VEHICLES = 10, 32
"""Promises of a curve; Sobol points of each, besides its corners."""


def find_repairs(source: Study | Case, options: RepairOptions, evaluator: Evaluator) -> Repairs:
    """Find the smallest changes of a driving system that survive the promise.

    Raises
    ------
    InputError
        If the study is rated, the promise or a parameter cannot be used, or no simulation reads the parameters.
    """
    problem = _problem_of(evaluator, options)
    system = assemble(problem.study)
    prices, count = Prices(problem.study, system), len(system.matrix)
    # 1. Counterexamples: corners and Sobol points of the promise, and failures of the results; the worst first.
    vehicles = problem.promise.spread(SOBOL_VEHICLES, problem.study.search.seed)
    if not isinstance(source, Study):
        names = list(evaluator.characteristics.names)
        settings = source.solutions[Unsafe(problem.margin).rows(source.solutions)][names].to_numpy(dtype=float)
        vehicles = np.unique(
            np.concatenate([vehicles, problem.promise.feasible(problem.promise.of_solutions(settings))]), axis=0
        )
    degrees = problem.degrees(problem.today[np.newaxis], vehicles, "the driving system of today")[0][0]
    order = np.argsort(degrees, kind="stable")
    vehicles, degrees = vehicles[order], degrees[order]
    failing = degrees < problem.margin
    # 0. What no driving system survives needs another part, not a parameter; the rest is repaired.
    can = ~failing
    can[failing] = problem.repairable(vehicles[failing])
    lost, vehicles = vehicles[~can], vehicles[can]
    not_repairable = _describe(problem, system, lost, len(lost) / len(can))
    seen = [number for number in range(count) if number % LEFT_OUT != LEFT_OUT - 1]
    finder = _Finder(problem=problem, prices=prices, points=count, search=Search(problem, vehicles, seen))
    repairs, unread, largest, curve = list[Repair](), list[str](), None, list[Exchange]()
    proof_of_today = finder.prove_today() if len(vehicles) and not failing[can].any() else None
    if len(vehicles) and proof_of_today is None:
        finder.problem, unread = _without_unread(problem, finder.search.vehicles)
        finder.search = Search(finder.problem, finder.search.vehicles, seen)
        repairs = finder.find()
        largest = None if repairs else finder.largest_promise()
    if options.curve is not None and len(vehicles):
        curve = finder.exchange_rate(options.curve, repairs)
    return Repairs(
        study=problem.study,
        promise=problem.promise,
        margin=problem.margin,
        parameters=tuple(problem.parameters),
        repairs=tuple(repairs),
        worst_today=float(degrees[0] if proof_of_today is None else degrees[can][0]),
        proof_of_today=proof_of_today,
        not_repairable=tuple(not_repairable),
        largest_promise=largest,
        unread=tuple(unread),
        attacks=finder.attacks,
        simulations=evaluator.simulated,
        counterexamples=len(finder.search.vehicles),
        curve=tuple(curve),
        no_verdict=evaluator.no_verdict,
    )


def _problem_of(evaluator: Evaluator, options: RepairOptions) -> Problem:
    """The problem that options state."""
    study = evaluator.study
    if is_rated(study):
        text = f"{study.name!r} is rated, and its repair would take a whole test matrix for every vehicle and change"
        raise InputError(study.source, text, "the study without the rating, such as wear for euro_ncap_rating")
    promise = Promise.of(study, evaluator.region, options.promise)
    if options.curve is not None and options.curve not in evaluator.characteristics.names:
        evaluator.characteristics.setting({options.curve: 0.0}, "curve")  # raises the error of an unknown name
    margin = study.model_error.get(SAFETY_DEGREE, DEFAULT_MARGIN) if options.margin is None else options.margin
    problem = Problem(
        evaluator=evaluator, promise=promise, parameters=parameters_of(study, options.change), margin=margin
    )
    return replace(problem, arrays=problem.takes_arrays())


def _without_unread(problem: Problem, vehicles: FloatArray) -> tuple[Problem, list[str]]:
    """The problem without the parameters that no simulation reads, and their names; an error if none is left."""
    vehicles, count = vehicles[::EVERY_READER], len(problem.parameters)
    ends = np.repeat([problem.today], 1 + 2 * count, axis=0)
    ends[np.arange(1, 1 + 2 * count), np.repeat(range(count), 2)] = np.tile([0.0, 1.0], count)
    rows = np.repeat(ends, len(vehicles), axis=0), np.tile(vehicles, (len(ends), 1))
    evaluations = problem.evaluate(*rows, "which parameters matter")
    today, *others = np.split(np.arange(len(evaluations)), len(ends))
    results = evaluations.take(today).results
    is_read = [any(differences(results, evaluations.take(other).results)) for other in others]
    read = [one for one, flags in zip(problem.parameters, np.reshape(is_read, (-1, 2)), strict=True) if flags.any()]
    unread = [one.name for one in problem.parameters if one not in read]
    if not read:
        raise InputError(
            "change", f"{', '.join(unread)}: no simulation reads it", "a parameter that changes a simulation"
        )
    return replace(problem, parameters=read), unread


def _describe(problem: Problem, system: System, vehicles: FloatArray, share: float) -> list[NotRepairable]:
    """What no driving system can survive: the minimal causes of failures of full braking, shrunk to the limit."""
    if not len(vehicles):
        return []
    driver, unsafe = problem.best_driver, Unsafe(problem.margin)
    rows = vehicles[np.linspace(0, len(vehicles) - 1, min(len(vehicles), CAUSES_OF)).astype(int)]
    causes = find_minimal_causes(driver, problem.promise.settings(rows), unsafe)
    chosen = list({cause_key(driver.characteristics, cause): cause for group in causes for cause in group}.values())
    described = describe_causes(driver, chosen, unsafe)
    limits = np.array([cause.setting(driver.characteristics) for cause in chosen])
    worst = driver.evaluate(limits, "full braking").worst_points
    names = [""] * len(chosen) if worst is None else [system.points[number].name for number in worst.tolist()]
    return [NotRepairable(cause.boundary, name, share) for cause, name in zip(described, names, strict=True)]


@dataclass(kw_only=True)
class _Finder:
    """The search for repairs, by counterexamples."""

    problem: Problem
    search: Search
    prices: Prices
    points: int
    attacks: int = 0
    at_left_out: JsonObject | None = None

    def prove_today(self) -> Proof | None:
        """The proof that the driving system of today survives attacks and fresh wear; None if it does not: its failures
        join the counterexamples.
        """
        today = self.problem.today
        (found,), proof = self._attack([today], range(self.points)), None
        if not len(found):
            proof, found = prove(self.problem, today, 0)
        self.search.add(found)
        return proof

    def _attack(self, sets: Sequence[FloatArray], points: Sequence[int]) -> list[FloatArray]:
        self.attacks += len(sets)
        return attack(self.problem, sets, self.search.vehicles, points, self.attacks) if sets else []

    def find(self) -> list[Repair]:
        """Search, attack and prove in turns until the repairs kept survive everything."""
        survived, attempt = set[bytes](), 0
        self.search.add(np.concatenate(self._attack([self.problem.today], self.search.seen)))
        for _ in range(MAX_ROUNDS):
            # 2. The smallest changes that survive all counterexamples.
            kept = self.search.pareto_set(lambda one: self.prices.of(self.problem.changed_values(one)).mean or 0.0)
            if not kept:
                return []
            # 3. Attacks on those that have survived none yet; new failures are counterexamples.
            fresh = [one for one in kept if one.tobytes() not in survived]
            failures = self._attack(fresh, self.search.seen)
            survived |= {one.tobytes() for one, failing in zip(fresh, failures, strict=True) if not len(failing)}
            # 4. Attacks find nothing: the points left out count, too, and then fresh wear.
            if not any(map(len, failures)):
                if len(self.search.seen) < self.points:
                    self._look_at_left_out(kept)
                    survived.clear()
                    continue
                # 5. Proof on fresh wear.
                proofs = list[Proof]()
                for one in kept:
                    proof, failing = prove(self.problem, one, attempt)
                    if proof is None:
                        failures, attempt = [failing], attempt + 1
                        break
                    proofs.append(proof)
                else:
                    return [self._repair(one, proof) for one, proof in zip(kept, proofs, strict=True)]
            self.search.add(np.concatenate(failures))
        return []

    def _look_at_left_out(self, sets: Sequence[FloatArray]) -> None:
        """Note at how many of the points left out all repairs are safe, and let the search see all points from now
        on.
        """
        left_out = [number for number in range(self.points) if number not in self.search.seen]
        worst, stage = self.search.vehicles[:WORST_AT_POINTS], "points left out"
        safe = [
            (self.problem.degrees(np.array(sets), worst, stage, [number])[0] >= self.problem.margin).all()
            for number in left_out
        ]
        self.at_left_out = {"all": len(left_out), "safe": int(sum(safe))}
        self.search.seen = list(range(self.points))

    def _repair(self, one: FloatArray, proof: Proof) -> Repair:
        """A repair with its price, and what it has not seen (6)."""
        values, problem = self.problem.changed_values(one), self.problem
        unseen = check_unseen(problem, values, self.search.vehicles)
        lost = self.prices.lost_points(values, problem.margin)
        return Repair(
            values=values,
            largest_change=float(self.search.change(one)),
            price=self.prices.with_needless_braking(values),
            proof=proof,
            held_out={"points": self.at_left_out, **unseen, "lost_on_new_car": lost},
        )

    def largest_promise(self) -> Promise | None:
        """The largest part of the promise, shrunk towards the original, that some change keeps by the counterexamples;
        None if none does.
        """
        original, vehicles, low, high = self.problem.promise.worn.original, self.search.vehicles, 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            search = Search(self.problem, original + middle * (vehicles - original), self.search.seen)
            low, high = (middle, high) if search.pareto_set(lambda one: 0.0) else (low, middle)
        return self.problem.promise.shrunk(low) if low else None

    def exchange_rate(self, name: str, repairs: Sequence[Repair]) -> list[Exchange]:
        """How much earlier the ADS has to brake for promises of a characteristic, from new to the end of its wear.

        The parameters of the first repair change, or each by itself without a repair.
        """
        problem, seed = self.problem, self.problem.study.search.seed
        names = [parameter.name for parameter in problem.parameters]
        changed = tuple(names.index(value) for value in repairs[0].values) if repairs else ()
        subsets = [changed] if changed else [(number,) for number in range(len(names))]
        (one,) = (one for one in problem.promise.region.characteristics if one.name == name)
        falls = one.original - one.lower >= one.upper - one.original
        ends = np.linspace(one.original, one.lower if falls else one.upper, CURVE_PROMISES + 1)[1:].tolist()
        exchanges = []
        for end in ends:
            worn = replace(one, lower=min(end, one.original), upper=max(end, one.original))
            others = {other.name: other for other in problem.promise.worn}
            members = tuple((others | {name: worn}).values())
            part = replace(problem, promise=replace(problem.promise, worn=CharacteristicSet(members)))
            vehicles = part.promise.spread(CURVE_VEHICLES, seed)
            degrees = part.degrees(part.today[np.newaxis], vehicles, "exchange rate")[0][0]
            vehicles = vehicles[np.argsort(degrees, kind="stable")]
            if (degrees >= part.margin).all():
                exchanges.append(Exchange(name, end, 0.0, True))
                continue
            search = Search(part, vehicles, range(self.points))
            if part.repairable(vehicles).all():
                search.search(dict.fromkeys(subsets, 1.0))
            prices = [self.prices.of(part.changed_values(found)).worst for found in search.best.values()]
            metres = min((price for price in prices if price is not None), default=None)
            exchanges.append(Exchange(name, end, metres, bool(search.best)))
        return exchanges
