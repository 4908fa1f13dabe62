"""The answer of `permit`, which says up to which speed each car may drive: the verdict, the
numbers, the tables, and the list (CSV) that fleet software reads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
import pandas as pd

from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.questions.answer import Answer, JsonRows
from safevar_sumo.questions.between import remark_on_phases
from safevar_sumo.questions.models import Models
from safevar_sumo.questions.part import UpperEnd, scope_of, study_up_to
from safevar_sumo.questions.permit import words
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import ROUGH, THIS_CAR, YES, Fleet
from safevar_sumo.questions.permit.permits import (
    Permit,
    PermitSearch,
    Repaired,
    WorstEnd,
)
from safevar_sumo.questions.permit.rows import (
    CARS,
    DRIVE,
    LIMITED,
    SETS,
    STOP,
    assumed_cells,
    assumed_sentences,
    failure_columns,
    set_rows,
    verdict_of,
)
from safevar_sumo.questions.sentence import (
    Sentence,
    Sentences,
    Verdict,
    answer,
    condition,
)
from safevar_sumo.questions.tables import NamedColumns, tabulate
from safevar_sumo.questions.words import (
    VALID_FOR,
    join_phrases,
    number_of,
    precise_in_words,
)
from safevar_sumo.results import identity_digest
from safevar_sumo.study import Study, unit_text
from safevar_sumo.sumo.system import assemble

DIGEST = "study_digest"
"""The column of the list with the digest that identifies the study, its models and versions."""
SHOWN_WHOLE = 50
"""Largest number of cars that one screen shows completely, because the list is the answer."""


@dataclass(frozen=True, kw_only=True)
class PermitAnswer:
    """The parts of which the answer about the cars of a list is made. Sequences have an item for
    each car, in the order of the list.

    Attributes
    ----------
    span
        The parameter over which cars are driven, usually the speed, and its range.
    need
        The speed that every car must reach; None without one.
    step
        The step of the grid of speeds.
    fleet
        The cars.
    new_car, permits
        How far the new car and each car are safe.
    repaired
        The best repair of each car; None for a car without one.
    is_quick
        Whether cars were driven only at the grid's speeds, without a search for counterexamples.
    is_rough
        Whether the answer is rough for any reason.
    is_box
        Whether the only "car" stands for all cars within the limits that the user states.
    worst_ends
        The assumed value that lowers the speed of each car most; None if it was not searched.
    """

    study: Study
    span: Span
    need: float | None
    step: float
    models: Models
    search: PermitSearch
    fleet: Fleet
    new_car: Permit
    permits: Sequence[Permit]
    repaired: Sequence[Repaired]
    is_quick: bool
    is_rough: bool
    is_box: bool
    worst_ends: Sequence[WorstEnd | None] | None

    def answer(self) -> Answer:
        """Make the answer: its verdict, numbers, tables and list."""
        span = self.span
        rows = self._rows()
        columns = _in_unit(CARS, span)
        if self._is_test:
            columns["up_to"] = columns["up_to"]._replace(head="passes the test up to")
        cars = pd.DataFrame(rows, columns=list(columns))
        counts = Counter(cars["verdict"])
        ordered = cars.sort_values(
            "up_to", kind="stable", na_position="first", ignore_index=True
        )
        claim = self.study
        if span.ending:
            claim = study_up_to(claim, UpperEnd(span.name, span.high))
        scope = scope_of(claim)
        unsafe = self.models.own.unsafe
        failures = []
        sentences = list(self._sentences(cars, counts))
        if self.need is not None:
            is_slow = ~(cars["up_to"].astype(float) >= self.need)
            too_slow = int(is_slow.sum())
            slow = words.TOO_SLOW(
                count=number_of(too_slow, "car"),
                need=span.text(self.need),
                **self._verbs,
            )
            sentences.append(slow)
            failures += [slow.text] * (too_slow > 0)
            failures += [words.ROUGH_NEED] * self.is_rough
        sentences += [*self._notes(), VALID_FOR(scope=scope), self._safe]
        return Answer(
            question="permit",
            study=self.study,
            verdict=Verdict(sentences),
            tested=Verdict([self._tested()]),
            numbers={
                "unsafe": str(unsafe),
                "margin": unsafe.keep,
                "scope": scope,
                "cars": len(rows),
                "drive": counts[DRIVE],
                "limited": counts[LIMITED],
                "stop": counts[STOP],
                "fits": len(self.models.members),
                "attacked": self.search.attacked,
                "step": self.step,
                "need": self.need,
                "not_driven_above": span.high,
                "rough": self.is_rough,
            },
            tables={
                "cars": tabulate(
                    "The cars, first those that may not drive",
                    columns,
                    ordered,
                    shown_whole=SHOWN_WHOLE,
                ),
                "sets": tabulate(
                    "By parameter set",
                    _in_unit(SETS, span),
                    set_rows(self.fleet.names, self.permits, with_car=self.is_box),
                ),
            },
            folded=("sets",),
            failures=tuple(failures),
            listing=self._listing(cars),
        )

    def _rows(self) -> JsonRows:
        """A row of `CARS` for each car, in the order of the list."""
        vehicle = self.models.own.characteristics.vehicle
        new_car = self.new_car.order
        failures = failure_columns(
            [permit.least.failure for permit in self.permits], with_car=self.is_box
        )
        criterion = self.models.own.unsafe
        of_all = {
            "rough": self.is_rough,
            "parameter_sets": len(self.models.members),
            "margin": criterion.keep,
            "unsafe": str(criterion),
        }
        ends = self.worst_ends or [None] * len(failures)
        cells = assumed_cells(vehicle, self.fleet)
        rows = []
        for name, permit, failure, best, assumed, end in zip(
            self.fleet.names,
            self.permits,
            failures,
            self.repaired,
            cells,
            ends,
            strict=True,
        ):
            verdict = verdict_of(
                permit.safe_value,
                new_car,
                self.span.high,
                self.need,
                is_proven=not self.is_quick,
            )
            event = failure["because"]
            row = {
                "car": name,
                "up_to": permit.safe_value,
                "new_car_up_to": new_car,
                "unit": self.span.unit,
                "verdict": verdict,
                "because": self._reason(permit, event, verdict).text,
                "assumed": assumed,
            }
            if event:
                row["parameter_set"] = permit.least.fit
            if best is not None:
                column, repaired = best
                row["repair_first"] = vehicle.names[column]
                row["up_to_after_repair"] = repaired.safe_value
            if end is not None:
                row["assumed_matters_most"] = end.name
            rows.append(dict.fromkeys(CARS) | failure | row | of_all)
        return rows

    def _reason(self, permit: Permit, event: str, verdict: str) -> Sentence:
        """Why a car may drive no faster, in a sentence for a foreman. `event` describes the
        failure; "" without a failure.
        """
        span = self.span
        slots = {
            "low": span.text(span.low),
            "name": span.title,
            "event": event,
            "new_car": span.range_text(self.new_car.order),
            "need": span.text(self.need or 0.0),
        }
        if permit.safe_value is None:
            failure = permit.least.failure
            if failure is not None and np.isneginf(failure.encounters.low):
                return words.IN_FIXED_TEST(**slots)
            return words.NOT_AT_ALL(**slots)
        slots["reach"] = span.range_text(permit.safe_value)
        template = words.AS_NEW
        if not event:
            template = words.SAFE_TO_TOP
        elif verdict != DRIVE:
            template = words.UNSAFE_BEYOND
        elif self.need is not None and permit.safe_value >= self.need:
            template = words.NEED_REACHED
        return template(**slots)

    def _sentences(self, cars: pd.DataFrame, counts: Mapping[str, int]) -> Sentences:
        """Yield the first sentences: how far cars are safe, why no farther, what is assumed."""
        span = self.span
        is_single = len(cars) == 1
        if is_single:
            yield self._car(cars["car"][0], cars["up_to"][0])
        else:
            yield from self._groups(counts)
        reach = self._reach(self.new_car.order)
        yield words.NEW_CAR(
            reach=reach,
            **self._verbs,
        )
        vehicle = self.models.own.characteristics.vehicle
        if is_single:
            yield answer(cars["because"][0])
        yield from assumed_sentences(self.study, vehicle, self.fleet)
        is_checked = is_single and not pd.isna(cars["up_to"][0])
        if is_checked and self.worst_ends and not self.fleet.measured.all():
            end = self.worst_ends[0]
            if end is None:
                yield words.NO_WORST_END(name=span.title)
            else:
                yield words.WORST_END(
                    end=f"{end.name} {end.text}",
                    value=span.text(max(end.value, span.low)),
                )

    def _car(self, name: str, safe_value: float) -> Sentence:
        """Say how far a single car is safe; NaN means that it is not safe at the least speed."""
        car = name
        if not (self.is_box or name == THIS_CAR):
            car = words.NAMED_CAR.format(name=name)
        if pd.isna(safe_value):
            return words.CAR_STOPS(
                car=car,
                **self._verbs,
            )
        return words.CAR(
            car=car,
            reach=self._reach(safe_value),
            **self._verbs,
        )

    def _groups(self, counts: Mapping[str, int]) -> Sentences:
        """Say how many cars have each verdict; `counts` has their number by verdict."""
        span = self.span
        slots = {
            **self._verbs,
            "top": span.text(span.high),
            "low": span.text(span.low),
            "name": span.title,
        }
        templates = {DRIVE: words.FAST, LIMITED: words.SLOWER, STOP: words.STOPPING}
        if self.need is not None:
            templates[DRIVE] = words.FAST_ENOUGH
            slots["need"] = span.text(self.need)
        cars = number_of(sum(counts.values()), "car")
        for verdict, template in templates.items():
            if counts[verdict]:
                count = f"{counts[verdict]} of {cars}"
                yield template(
                    count=count,
                    **slots,
                )

    def _notes(self) -> Sentences:
        """Yield notes on exact measurements, a rough list, phases, and tests that end early or were
        left out.
        """
        span = self.span
        vehicle = self.models.own.characteristics.vehicle
        # Limits that a user states are no measurements, so no note on their exactness is needed.
        is_measured = np.any(self.fleet.measured, axis=0) & (not self.is_box)
        if names := precise_in_words(compress(vehicle, is_measured)):
            yield words.MEASURED(names=names)
        if self.fleet.is_rough:
            yield words.ROUGH_LIST
        yield condition(remark_on_phases(self.models.own.in_phases))
        top = span.text(span.high)
        if span.ending:
            yield words.ENDING(
                top=top,
                tests=join_phrases(span.ending),
            )
        if span.tests_above:
            yield words.LEFT_OUT(
                top=top,
                tests=join_phrases(span.tests_above),
            )

    @property
    def _verbs(self) -> dict[str, str]:
        """The verbs of sentences about safe and unsafe cars: pass a test, or drive."""
        return words.PASSING if self._is_test else words.DRIVING

    def _reach(self, value: float) -> str:
        """The range in which cars are safe, in words that follow the verb."""
        return self.span.range_text(value, with_low=not self._is_test)

    @property
    def _is_test(self) -> bool:
        """Whether the study is a test of a regulation: a car passes by the regulation's rules, but
        need not be safe otherwise.
        """
        allows_impacts = any(test.allowed_impact_speed for test in self.study.tests)
        return allows_impacts or bool(self.study.unsafe.source)

    @property
    def _safe(self) -> Sentence:
        """Say what "safe" means, for the study's own parameter set and for the other sets."""
        unsafe = self.models.own.unsafe
        sets = len(self.models.members)
        template = words.SAFE_WITHOUT_CONTACT
        if unsafe.keep:
            template = words.SAFE_WITH_CLEARANCE[sets > 1]
        elif unsafe.below:
            template = words.SAFE_WITH_DISTANCE
        elif unsafe.below is None and not unsafe.is_collision:
            template = words.SAFE_BY_CRITERION
        return template(
            unsafe=unsafe.description,
            keep=unsafe.keep,
            below=unsafe.below,
            sets=number_of(sets, "parameter set"),
            others=number_of(sets - 1, "other parameter set"),
        )

    def _tested(self) -> Sentence:
        """Say at which speeds cars were driven, and how many simulations searched for failures."""
        values = self.search.values
        driven = f"from {values[0]:g} to {self.span.text(values[-1])}"
        if len(values) == len(self.search.listed):
            listed = join_phrases(f"{value:g}" for value in values)
            driven = f"({listed}{unit_text(self.span.unit)})"
        template = words.TESTED_QUICK if self.is_quick else words.TESTED
        return template(
            number=len(values), values=driven, attacked=self.search.attacked
        )

    def _listing(self, cars: pd.DataFrame) -> pd.DataFrame:
        """The list for fleet software: the user's columns, then the columns of the answer. The cars
        keep the user's order.
        """
        manifest = manifest_now(self.study, assemble(self.study))
        table = self.fleet.table.reset_index(drop=True)
        if self.is_box:
            # With limits, the columns of values are not measured: only the name remains.
            table = table[table.columns[:1]]
        listing = pd.concat([table, cars.drop(columns="car")], axis=1)
        listing[ROUGH] = YES if self.is_rough else "no"
        listing[DIGEST] = identity_digest(manifest)[:12]
        return listing


def _in_unit(columns: NamedColumns, span: Span) -> NamedColumns:
    """The same columns; columns of speeds have the unit of the parameter."""
    named = dict(columns)
    for name in {"up_to", "new_car_up_to", "up_to_after_repair"} & named.keys():
        named[name] = named[name]._replace(unit=span.unit)
    return named
