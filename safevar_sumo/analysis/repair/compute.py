"""Finds repairs by counterexamples: searches the smallest changes, attacks them, and proves the rest on fresh wear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import cause_key, describe_causes, find_minimal_causes
from safevar_sumo.analysis.repair import RepairOptions
from safevar_sumo.analysis.repair.answer import Exchange, NotRepairable, Repair, Repairs
from safevar_sumo.analysis.repair.attack import Proof, attack, prove
from safevar_sumo.analysis.repair.curve import exchange_rate
from safevar_sumo.analysis.repair.held_out import check_unseen
from safevar_sumo.analysis.repair.price import NewCar, Price, benign_scenes, drive_new_car, price_of
from safevar_sumo.analysis.repair.problem import Problem, Promise, default_margin, parameters_of
from safevar_sumo.analysis.repair.smallest import Search, Subset
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import Point
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import System, assemble

SOBOL_VEHICLES = 256
"""Sobol points of the promise among the first counterexamples."""
MOST_CHANGED, MOST_KEPT, MAX_ROUNDS = 3, 4, 30
"""Largest number of parameters changed, of repairs kept, and of rounds of attacks."""
LEFT_OUT = 3
"""Every so many points of a matrix are left out until a repair has survived all attacks at the others."""
HALVINGS = 6
"""Halvings that locate the largest promise that can be kept."""
CAUSES_OF, WORST_AT_POINTS = 4, 16
"""Failures of full braking whose causes are told; the worst vehicles that are driven at each point left out."""
EARLIER_BOX = 0.05
"""A repair that failed is sought again in a box that is larger by this share of the ranges."""


def find_repairs(source: Study | Case, options: RepairOptions, evaluator: Evaluator) -> Repairs:
    """Find the smallest changes of a driving system that survive the promise.

    Raises
    ------
    InputError
        If the study is rated, the promise or a parameter cannot be used, or no simulation reads the parameters.
    """
    study = evaluator.study
    if is_rated(study):
        problem_text = (
            f"{study.name!r} is rated, and its repair would take a whole test matrix for every vehicle and change"
        )
        raise InputError(study.source, problem_text, "the study without the rating, such as wear for euro_ncap_rating")
    promise = Promise.of(study, options.promise)
    if not promise.columns:
        raise InputError("promise", "promises a new vehicle only", "a limit short of the original's value")
    if options.curve is not None and options.curve not in promise.characteristics.names:
        promise.characteristics.setting({options.curve: 0.0}, "curve")  # raises the error of an unknown name
    margin = default_margin(study) if options.margin is None else options.margin
    problem = Problem(
        evaluator=evaluator, promise=promise, parameters=parameters_of(study, options.change), margin=margin
    )
    system = assemble(study)
    finder = _Finder(problem=problem, system=system, benign=benign_scenes(study, system))
    return finder.answer(source, options)


@dataclass(kw_only=True)
class _Finder:
    """The state of the search for repairs: the counterexamples, the smallest change of each subset, what is proved."""

    problem: Problem
    system: System
    unread: list[str] = field(default_factory=list)
    attacks: int = 0
    left_out: int = 0
    at_left_out: int = 0
    benign: list[Point] = field(default_factory=list)
    cars: dict[bytes, NewCar] = field(default_factory=dict)

    def answer(self, source: Study | Case, options: RepairOptions) -> Repairs:
        problem, study = self.problem, self.problem.study
        vehicles = self._first_vehicles(source)
        degrees = problem.degrees(np.tile(problem.today, (len(vehicles), 1)), vehicles, "the driving system of today")
        order = np.argsort(degrees, kind="stable")
        vehicles, degrees = vehicles[order], degrees[order]
        worst = float(degrees[0])
        failing = degrees < problem.margin
        can = np.ones(len(vehicles), dtype=bool)
        can[failing] = problem.repairable(vehicles[failing])
        not_repairable = self._describe(vehicles[~can], float(np.mean(~can)))
        self.search = Search(problem, vehicles[can], self._seen())
        repairs: list[Repair] = []
        proof_of_today = None if failing[can].any() or not can.any() else self._proof_of_today()
        largest = None
        if can.any() and proof_of_today is None:
            self._refuse_unread()
            repairs = self._repairs()
            largest = None if repairs else self._largest_promise(self.search.vehicles)
        curve = list[Exchange]()
        if options.curve is not None and can.any():
            curve = exchange_rate(problem, len(self.system.matrix), self._price, options.curve, repairs)
        return Repairs(
            study=study,
            curve=tuple(curve),
            promise=problem.promise,
            margin=problem.margin,
            parameters=tuple(problem.parameters),
            repairs=tuple(repairs),
            worst_today=worst,
            proof_of_today=proof_of_today,
            not_repairable=tuple(not_repairable),
            largest_promise=largest,
            unread=tuple(self.unread),
            attacks=self.attacks,
            simulations=problem.evaluator.simulated,
            counterexamples=len(self.search.vehicles),
            no_verdict=problem.evaluator.no_verdict,
        )

    def _first_vehicles(self, source: Study | Case) -> FloatArray:
        """The first counterexamples: corners, Sobol points, and the solutions of results that lie in the promise."""
        problem, promise = self.problem, self.problem.promise
        seed = problem.study.search.seed
        drawn = 0

        def draw_next(count: int) -> FloatArray:
            nonlocal drawn
            drawn += count
            return promise.settings(sobol_points(drawn, len(promise.columns), seed)[-count:])

        groups = [promise.corners(seed), problem.feasible(draw_next, SOBOL_VEHICLES)]
        if not isinstance(source, Study):
            unsafe, names = Unsafe(problem.margin), list(promise.characteristics.names)
            solutions = source.solutions[unsafe.rows(source.solutions)][names].to_numpy(dtype=float)
            groups.append(solutions[promise.holds(solutions)])
        vehicles = np.unique(np.concatenate(groups), axis=0)
        return vehicles[problem.evaluator.region.feasible(vehicles)]

    def _seen(self) -> list[int]:
        """The points that the search sees at first; empty for a study without a matrix."""
        count = len(self.system.matrix)
        return [number for number in range(count) if number % LEFT_OUT != LEFT_OUT - 1]

    def _proof_of_today(self) -> Proof | None:
        """The proof that the driving system of today survives attacks and fresh wear; None if it does not: its failures
        join the counterexamples.
        """
        today = self.problem.today
        found = self._attacked([today])[0]
        if not len(found):
            proof, found = prove(self.problem, today, 0)
            if not len(found):
                return proof
        self.search.add(found)
        return None

    def _attacked(self, sets: Sequence[FloatArray]) -> list[FloatArray]:
        self.attacks += len(sets)
        return attack(self.problem, sets, self.attacks)

    def _refuse_unread(self) -> None:
        """Leave out parameters that no simulation reads; an error if none is left."""
        problem = self.problem
        vehicles = self.search.vehicles[: len(self.search.vehicles) : 8]
        rows = np.tile(problem.today, (len(vehicles), 1))
        before = problem.evaluate(rows, vehicles, "which parameters matter")
        read = []
        for column in range(len(problem.parameters)):
            for end in (0.0, 1.0):
                changed = rows.copy()
                changed[:, column] = end
                after = problem.evaluate(changed, vehicles, "which parameters matter")
                if any(
                    (values != after.results[name])[
                        (values == values) | (after.results[name] == after.results[name])
                    ].any()
                    for name, values in before.results.items()
                ):
                    read.append(column)
                    break
        self.unread = [one.name for column, one in enumerate(problem.parameters) if column not in read]
        if not read:
            text = f"{', '.join(self.unread)}: no simulation reads it"
            raise InputError("change", text, "a parameter that changes a simulation")
        problem.parameters = [problem.parameters[column] for column in read]
        problem.__dict__.pop("today", None)

    def _repairs(self) -> list[Repair]:
        """Search, attack and prove in turns until the repairs kept survive everything."""
        found = self._smallest({})
        survived, proofs, _held_out = set[bytes](), dict[bytes, Proof](), dict[bytes, tuple[int, int]]()
        proof_attempt = 0
        for _ in range(MAX_ROUNDS):
            kept = self._kept(found)
            if not kept:
                return []
            fresh = [subset for subset in kept if found[subset].tobytes() not in survived]
            failures = dict[Subset, FloatArray]()
            if fresh:
                for subset, failing in zip(fresh, self._attacked([found[one] for one in fresh]), strict=True):
                    failures[subset] = failing
                    if not len(failing):
                        survived.add(found[subset].tobytes())
            elif len(self.search.seen) < len(self.system.matrix):
                self._look_at_left_out([found[subset] for subset in kept])
                failures = {
                    subset: np.array([one.setting])
                    for subset, one in zip(
                        kept, self.search.survivors(np.array([found[subset] for subset in kept])), strict=True
                    )
                    if one is not None
                }
                survived.clear()
                if not failures:
                    continue
            else:
                for subset in kept:
                    key = found[subset].tobytes()
                    if key not in proofs:
                        proofs[key], failing = prove(self.problem, found[subset], proof_attempt)
                        if len(failing):
                            failures[subset] = failing
                if not failures:
                    return [self._repair(found[subset], proofs[found[subset].tobytes()]) for subset in kept]
                proof_attempt += 1
                proofs.clear()
            lost = [subset for subset, failing in failures.items() if len(failing)]
            if lost:
                self.search.add(np.concatenate([failures[subset] for subset in lost]))
                found = self._smallest(found, kept)
        return []

    def _smallest(
        self, found: dict[Subset, FloatArray], kept: Sequence[Subset] | None = None
    ) -> dict[Subset, FloatArray]:
        """The smallest change of each subset of 1, 2, 3 parameters, up to one more than the first number that works.

        Of the changes that are known, only those that new counterexamples break are sought again, in a larger box; only
        those of the subsets `kept`, unless none of the others survives.
        """
        search, count = self.search, len(self.problem.parameters)
        starts = {subset: float(search.change(one)) + EARLIER_BOX for subset, one in found.items()}
        result, worked = self._surviving(found), 0
        if not result:
            kept = None
        for size in range(1, min(MOST_CHANGED, count) + 1):
            limits = {}
            for subset in combinations(range(count), size):
                inner = [float(search.change(one)) for key, one in result.items() if set(key) < set(subset)]
                if subset not in result and (kept is None or subset in kept):
                    limits[subset] = min([1.0, *(change - 0.005 for change in inner)])
            result |= search.smallest(list(limits), limits, starts)
            worked = worked or (size if any(len(subset) <= size for subset in result) else 0)
            if worked and size > worked:
                break
        return result if len(self._surviving(result)) == len(result) else self._smallest(result, kept)

    def _surviving(self, found: dict[Subset, FloatArray]) -> dict[Subset, FloatArray]:
        """The changes that survive all counterexamples; failures of the others join those that candidates are tried
        with.
        """
        if not found:
            return {}
        firsts = self.search.survivors(np.array(list(found.values())))
        self.search.failures += [one for one in firsts if one is not None]
        return {subset: one for (subset, one), first in zip(found.items(), firsts, strict=True) if first is None}

    def _kept(self, found: dict[Subset, FloatArray]) -> list[Subset]:
        """The Pareto set of number of changes, largest change and price; the smallest `MOST_KEPT` of it."""
        rows = []
        for subset, one in found.items():
            price = self._price(one)
            rows.append(
                (len(subset), float(self.search.change(one)), price.mean if price.mean is not None else 0.0, subset)
            )
        best = [
            row
            for row in rows
            if not any(
                other is not row
                and all(a <= b for a, b in zip(other[:3], row[:3], strict=True))
                and other[:3] != row[:3]
                for other in rows
            )
        ]
        return [row[3] for row in sorted(best)[:MOST_KEPT]]

    def _values(self, one: FloatArray) -> dict[str, float]:
        """The values of the parameters that change."""
        values = self.problem.values(one[np.newaxis])[0].tolist()
        return {
            parameter.name: value
            for parameter, value, share, today in zip(
                self.problem.parameters, values, one, self.problem.today, strict=True
            )
            if share != today
        }

    def _price(self, one: FloatArray) -> Price:
        return price_of(self.system, self._new_car(one), self._new_car(self.problem.today))

    def _new_car(self, one: FloatArray) -> NewCar:
        """How a new vehicle drives with a set of parameters; each is simulated once."""
        if one.tobytes() not in self.cars:
            self.cars[one.tobytes()] = drive_new_car(self.problem.study, self._values(one), self.benign)
        return self.cars[one.tobytes()]

    def _look_at_left_out(self, sets: Sequence[FloatArray]) -> None:
        """Note how many repairs are unsafe at the points left out, and let the search see all points from now on."""
        everything = range(len(self.system.matrix))
        left_out = [number for number in everything if number not in self.search.seen]
        self.search.seen = left_out
        for one, failure in zip(sets, self.search.survivors(np.array(sets)), strict=True):
            unsafe = 0
            if failure is not None:
                worst = self.search.vehicles[:WORST_AT_POINTS]
                unsafe = sum(
                    bool(
                        (
                            self.problem.degrees(np.tile(one, (len(worst), 1)), worst, "points left out", [number])
                            < self.problem.margin
                        ).any()
                    )
                    for number in left_out
                )
            self.at_left_out = max(self.at_left_out, unsafe)
        self.left_out, self.search.seen = len(left_out), list(everything)

    def _repair(self, one: FloatArray, proof: Proof) -> Repair:
        values = self._values(one)
        held_out = check_unseen(self.problem, values, self.search.vehicles)
        points = {"all": self.left_out, "safe": self.left_out - self.at_left_out} if self.left_out else None
        today, car = self._new_car(self.problem.today), self._new_car(one)
        lost = np.count_nonzero((today.degrees >= self.problem.margin) & (car.degrees < self.problem.margin))
        return Repair(
            values=values,
            largest_change=float(self.search.change(one)),
            price=self._price(one),
            proof=proof,
            held_out={"points": points, **held_out, "lost_on_new_car": int(lost)},
        )

    def _describe(self, settings: FloatArray, share: float) -> list[NotRepairable]:
        """What no driving system can survive: the minimal causes of failures of full braking, shrunk to the limit."""
        if not len(settings):
            return []
        problem, driver = self.problem, self.problem.best_driver
        unsafe = Unsafe(problem.margin)
        rows = settings[np.linspace(0, len(settings) - 1, min(len(settings), CAUSES_OF)).astype(int)]
        causes = find_minimal_causes(driver, rows, unsafe)
        distinct = {cause_key(driver.characteristics, cause): cause for group in causes for cause in group}
        chosen = list(distinct.values())
        described = describe_causes(driver, chosen, unsafe)
        worst = driver.evaluate(
            np.array([cause.setting(driver.characteristics) for cause in chosen]), "full braking"
        ).worst_points
        names = [""] * len(chosen) if worst is None else [self.system.points[number].name for number in worst.tolist()]
        return [NotRepairable(cause.boundary, name, share) for cause, name in zip(described, names, strict=True)]

    def _largest_promise(self, vehicles: FloatArray) -> Promise | None:
        """The largest part of the promise, shrunk towards the original, that some change keeps; None if none does."""
        original, low, high = self.problem.promise.characteristics.original, 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            smaller = original + middle * (vehicles - original)
            search = Search(self.problem, smaller, self.search.seen)
            found = search.smallest(*_all_open(len(self.problem.parameters)))
            if found and not all(search.survivors(np.array(list(found.values())))):
                low = middle
            else:
                high = middle
        return self.problem.promise.shrunk(low) if low else None


def _all_open(count: int) -> tuple[list[Subset], dict[Subset, float], dict[Subset, float]]:
    """Each parameter by itself and all together, without limits."""
    subsets = list(dict.fromkeys([*((column,) for column in range(count)), tuple(range(count))]))
    return subsets, dict.fromkeys(subsets, 1.0), {}
