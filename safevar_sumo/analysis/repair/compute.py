"""Finds repairs by counterexamples: the smallest changes that survive them, attacks, and proof on fresh wear.

The steps of the algorithm: 1. counterexamples, without those that no driving system survives; 2. the smallest changes
that survive them (`smallest`); 3. attacks on these, whose failures are new counterexamples (`attack`); 4. when attacks
find nothing, the points left out at first; 5. proof on fresh wear; 6. what the repair has not seen (`price`). Without a
change that survives: the largest promise that can be kept.
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
from safevar_sumo.analysis.repair.problem import Promise, RepairProblem, parameters_of
from safevar_sumo.analysis.repair.smallest import Search
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe, margin_of
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import BoolArray, FloatArray, JsonObject, differences
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import CharacteristicSet

SOBOL_VEHICLES = 256
"""Sobol points of the promise among the first counterexamples."""
MAX_ROUNDS = 30
"""Largest number of rounds of attacks."""
LEFT_OUT = 3
"""Every so many points of a matrix are left out until a repair has survived all attacks at the others."""
HALVINGS = 6
"""Halvings that locate the largest promise that can be kept."""
CAUSES_OF, WORST_AT_POINTS = 4, 16
"""Number of failures of full braking whose causes are told; of the worst vehicles, which are driven at each point that
was left out.
"""
EVERY_READER = 8
"""Every so many counterexamples, one is simulated to find whether simulations read a parameter."""
CURVE_PROMISES, CURVE_VEHICLES = 10, 32
"""Number of promises of a curve; of Sobol points of each, besides its corners."""


def find_repairs(source: Study | Case, options: RepairOptions, evaluator: Evaluator) -> Repairs:
    """Find the smallest changes of a driving system that survive the promise.

    Raises
    ------
    InputError
        If the study is rated, the promise or a parameter cannot be used, or no simulation reads the parameters.
    """
    problem = _problem_of(evaluator, options)
    system = assemble(problem.study)
    # 1. Counterexamples: corners and Sobol points of the promise, and failures of the results; the worst first.
    vehicles = problem.promise.corners_and_sobol_points(SOBOL_VEHICLES, problem.study.search.seed)
    if not isinstance(source, Study):
        names = list(evaluator.characteristics.names)
        settings = source.solutions[Unsafe(problem.margin).rows(source.solutions)][names].to_numpy(dtype=float)
        failures = problem.promise.feasible(problem.promise.vehicles_among(settings))
        vehicles = np.unique(np.concatenate([vehicles, failures]), axis=0)
    degrees = problem.degrees_today(vehicles, "the driving system of today")
    order = np.argsort(degrees, kind="stable")
    vehicles, degrees = vehicles[order], degrees[order]
    is_unsafe = degrees < problem.margin
    # What no driving system survives needs another part, not a parameter; the rest is repaired.
    is_repairable = ~is_unsafe
    is_repairable[is_unsafe] = problem.repairable(vehicles[is_unsafe])
    not_repairable = _describe_not_repairable(problem, system, vehicles, is_repairable)
    vehicles = vehicles[is_repairable]
    points = range(len(system.matrix))
    seen = [number for number in points if number % LEFT_OUT != LEFT_OUT - 1]
    prices, search = Prices(problem.study, system), Search(problem, vehicles, seen)
    finder = _Finder(problem=problem, prices=prices, points=points, search=search)
    repairs, unread, largest, curve = list[Repair](), list[str](), None, list[Exchange]()
    proof_of_today = finder.prove_today() if len(vehicles) and not is_unsafe[is_repairable].any() else None
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
        unsafe=problem.unsafe,
        parameters=tuple(problem.parameters),
        repairs=tuple(repairs),
        worst_today=float(degrees[0] if proof_of_today is None else degrees[is_repairable][0]),
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


def _problem_of(evaluator: Evaluator, options: RepairOptions) -> RepairProblem:
    """The problem that options state."""
    study = evaluator.study
    if is_rated(study):
        text = f"{study.name!r} is rated, and its repair would take a whole test matrix for every vehicle and change"
        raise InputError(study.source, text, "the study without the rating, such as wear for euro_ncap_rating")
    promise = Promise.of(study, evaluator.region, options.promise)
    if options.curve is not None and options.curve not in evaluator.characteristics.names:
        evaluator.characteristics.setting({options.curve: 0.0}, "curve")  # raises the error of an unknown name
    unsafe = Unsafe(keep=margin_of(study, options.margin), contact=contact_degree(assemble(study)))
    problem = RepairProblem(
        evaluator=evaluator, promise=promise, parameters=parameters_of(study, options.change), unsafe=unsafe
    )
    return replace(problem, arrays=problem.takes_arrays())


def _without_unread(problem: RepairProblem, vehicles: FloatArray) -> tuple[RepairProblem, list[str]]:
    """The problem without the parameters that no simulation reads, and their names; an error if none is left."""
    vehicles, count = vehicles[::EVERY_READER], len(problem.parameters)
    # The set of today, then two sets for each parameter, with the parameter at its lower and at its upper bound.
    sets = np.repeat([problem.today], 1 + 2 * count, axis=0)
    sets[np.arange(1, 1 + 2 * count), np.repeat(range(count), 2)] = np.tile([0.0, 1.0], count)
    rows = np.repeat(sets, len(vehicles), axis=0), np.tile(vehicles, (len(sets), 1))
    evaluations = problem.evaluate(*rows, "which parameters matter")
    today, *others = np.split(np.arange(len(evaluations)), len(sets))
    results = evaluations.take(today).results
    differs = [any(differences(results, evaluations.take(other).results)) for other in others]
    read = [
        parameter
        for parameter, at_bounds in zip(problem.parameters, np.reshape(differs, (count, 2)), strict=True)
        if at_bounds.any()
    ]
    unread = [parameter.name for parameter in problem.parameters if parameter not in read]
    if not read:
        raise InputError(
            "change", f"{', '.join(unread)}: no simulation reads it", "a parameter that changes a simulation"
        )
    return replace(problem, parameters=read), unread


def _describe_not_repairable(
    problem: RepairProblem, system: System, vehicles: FloatArray, is_repairable: BoolArray
) -> list[NotRepairable]:
    """What no driving system can survive: the minimal causes of failures of full braking, shrunk to the limit."""
    failures = vehicles[~is_repairable]
    if not len(failures):
        return []
    driver, unsafe = problem.best_driver, Unsafe(problem.margin)
    chosen = failures[np.linspace(0, len(failures) - 1, min(len(failures), CAUSES_OF)).astype(int)]
    groups = find_minimal_causes(driver, problem.promise.settings(chosen), unsafe)
    causes = list({cause_key(driver.characteristics, cause): cause for group in groups for cause in group}.values())
    settings = np.array([cause.setting(driver.characteristics) for cause in causes])
    worst = driver.evaluate(settings, "full braking").worst_points
    names = [""] * len(causes) if worst is None else [system.points[number].name for number in worst.tolist()]
    return [
        NotRepairable(cause.boundary, name, len(failures) / len(vehicles))
        for cause, name in zip(describe_causes(driver, causes, unsafe), names, strict=True)
    ]


@dataclass(kw_only=True)
class _Finder:
    """The search for repairs by counterexamples, at the numbers `points` of a matrix.

    `at_left_out` counts the points that were left out at first, and those of them where all repairs were safe at once.
    """

    problem: RepairProblem
    search: Search
    prices: Prices
    points: range
    attacks: int = 0
    at_left_out: JsonObject | None = None

    def prove_today(self) -> Proof | None:
        """The proof that the driving system of today survives attacks and fresh wear.

        None if it does not; its failures join the counterexamples.
        """
        today, proof = self.problem.today, None
        (failures,) = self._attack([today], self.points)
        if not len(failures):
            proof, failures = prove(self.problem, today, 0)
        self.search.add(failures)
        return proof

    def _attack(self, changes: Sequence[FloatArray], points: Sequence[int]) -> list[FloatArray]:
        self.attacks += len(changes)
        return attack(self.problem, changes, self.search.vehicles, points, self.attacks) if changes else []

    def find(self) -> list[Repair]:
        """Search, attack and prove in turns until the smallest changes survive everything."""
        unbroken, attempt = set[bytes](), 0
        self.search.add(np.concatenate(self._attack([self.problem.today], self.search.seen)))
        for _ in range(MAX_ROUNDS):
            # 2. The smallest changes that survive all counterexamples.
            changes = self.search.pareto_set(
                lambda change: self.prices.of(self.problem.changed_values(change)).mean or 0.0
            )
            if not changes:
                return []
            # 3. Attacks on changes that have survived none yet; new failures are counterexamples.
            attacked = [change for change in changes if change.tobytes() not in unbroken]
            failures = self._attack(attacked, self.search.seen)
            unbroken |= {change.tobytes() for change, found in zip(attacked, failures, strict=True) if not len(found)}
            if not any(map(len, failures)):
                # 4. Attacks find nothing: the points left out count, too.
                if len(self.search.seen) < len(self.points):
                    self._look_at_left_out(changes)
                    unbroken.clear()
                    continue
                # 5. Proof on fresh wear.
                repairs = []
                for change in changes:
                    proof, found = prove(self.problem, change, attempt)
                    if proof is None:
                        failures, attempt = [found], attempt + 1
                        break
                    repairs.append((change, proof))
                else:
                    return [self._repair(*repair) for repair in repairs]
            self.search.add(np.concatenate(failures))
        return []

    def _look_at_left_out(self, changes: Sequence[FloatArray]) -> None:
        """Note at how many of the points left out all changes are safe, and let the search see all points from now
        on.
        """
        left_out = [number for number in self.points if number not in self.search.seen]
        worst, stage = self.search.vehicles[:WORST_AT_POINTS], "points left out"
        are_safe = [
            (self.problem.degrees(np.array(changes), worst, stage, [number])[0] >= self.problem.margin).all()
            for number in left_out
        ]
        self.at_left_out = {"all": len(left_out), "safe": int(sum(are_safe))}
        self.search.seen = list(self.points)

    def _repair(self, change: FloatArray, proof: Proof) -> Repair:
        """A repair with its price, and (6.) what it has not seen."""
        values, problem = self.problem.changed_values(change), self.problem
        unseen = check_unseen(problem, values, self.search.vehicles)
        lost = self.prices.lost_points(values, problem.margin)
        return Repair(
            values=values,
            largest_change=float(self.search.largest_change(change)),
            price=self.prices.with_needless_braking(values),
            proof=proof,
            held_out={"points": self.at_left_out, **unseen, "lost_on_new_car": lost},
        )

    def largest_promise(self) -> Promise | None:
        """The promise shrunk towards the original as little as some change needs to survive the counterexamples, which
        shrink with it; None if no change does.
        """
        original, vehicles, low, high = self.problem.promise.worn.original, self.search.vehicles, 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            search = Search(self.problem, original + middle * (vehicles - original), self.search.seen)
            if search.pareto_set(lambda _: 0.0):
                low = middle
            else:
                high = middle
        return self.problem.promise.shrunk(low) if low else None

    def exchange_rate(self, name: str, repairs: Sequence[Repair]) -> list[Exchange]:
        """How much earlier the ADS has to brake for promises of a characteristic, from new to the end of its wear.

        The parameters of the first repair change; without a repair, each parameter alone.
        """
        problem, seed = self.problem, self.problem.study.search.seed
        names = [parameter.name for parameter in problem.parameters]
        changed = tuple(names.index(parameter) for parameter in repairs[0].values) if repairs else ()
        subsets = [changed] if changed else [(number,) for number in range(len(names))]
        (whole,) = (member for member in problem.promise.region.characteristics if member.name == name)
        new, wears_down = whole.original, whole.original - whole.lower >= whole.upper - whole.original
        ends = np.linspace(new, whole.lower if wears_down else whole.upper, CURVE_PROMISES + 1)[1:].tolist()
        exchanges = []
        for end in ends:
            worn = {member.name: member for member in problem.promise.worn}
            worn[name] = replace(whole, lower=min(end, new), upper=max(end, new))
            promise = replace(problem.promise, worn=CharacteristicSet(tuple(worn.values())))
            narrowed = replace(problem, promise=promise)
            vehicles = promise.corners_and_sobol_points(CURVE_VEHICLES, seed)
            degrees = narrowed.degrees_today(vehicles, "exchange rate")
            vehicles = vehicles[np.argsort(degrees, kind="stable")]
            if (degrees >= narrowed.margin).all():
                exchanges.append(Exchange(name, end, 0.0, True))
                continue
            search = Search(narrowed, vehicles, self.points)
            if narrowed.repairable(vehicles).all():
                search.search(dict.fromkeys(subsets, 1.0))
            prices = [self.prices.of(narrowed.changed_values(change)).worst for change in search.best.values()]
            metres = min((price for price in prices if price is not None), default=None)
            exchanges.append(Exchange(name, end, metres, bool(search.best)))
        return exchanges
