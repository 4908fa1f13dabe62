"""The answer to the question which cars may drive: its verdict, its numbers, its tables, and the
list that fleet software reads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.models import Models
from safevar_sumo.questions.part import study_up_to
from safevar_sumo.questions.permit.assumed import (
    WorstEnd,
    assumed_cells,
    worst_end_in_words,
)
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import ROUGH, YES, Fleet
from safevar_sumo.questions.permit.rows import (
    CARS,
    DRIVE,
    LIMITED,
    SETS,
    STOP,
    because,
    failure_columns,
    set_rows,
    verdict_of,
)
from safevar_sumo.questions.permit.search import Permit, PermitSearch, Repaired
from safevar_sumo.questions.phases import remark_on_phases
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tables import Column, Columns, tabulate
from safevar_sumo.questions.words import join_phrases, number_of, precise_in_words
from safevar_sumo.records import JsonObject
from safevar_sumo.results import identity_digest
from safevar_sumo.study import Study, unit_text
from safevar_sumo.sumo.system import assemble

DIGEST = "study_digest"
"""The column of the list that holds the digest of the study, its models and versions."""
ROUGH_LIST = (
    "Remark: the list is a rough answer (rough = yes), whose speeds prove nothing."
)
"""What to know of a list that `--quick` wrote."""
ROUGH_NEED = (
    "a rough answer lets no car drive: ask without --quick, or for more simulations"
)
"""Why no gate passes on a rough answer."""
SHOWN_WHOLE = 50
"""Number of cars up to which one screen shows all: there the list is the answer."""


@dataclass(frozen=True, kw_only=True)
class PermitAnswer:
    """What an answer is made of, beside its rows.

    Attributes
    ----------
    is_quick, is_rough
        Whether cars drive the grid alone, and whether the answer is rough for any reason.
    assumed
        What was not measured, in a sentence that follows the one about the cars.
    ends
        The worst end of each car; None where none was sought.
    """

    study: Study
    span: Span
    need: float | None
    step: float
    models: Models
    search: PermitSearch
    new_car: Permit
    is_quick: bool
    is_rough: bool
    is_box: bool
    assumed: str
    ends: Sequence[WorstEnd | None] | None

    def of(
        self, fleet: Fleet, permits: Sequence[Permit], repaired: Sequence[Repaired]
    ) -> Answer:
        """The answer about the cars of a list, in its order, each with its best repair."""
        span = self.span
        rows = self._rows(fleet, permits, repaired)
        columns = _in_unit(CARS, span)
        if self._is_test:
            columns["up_to"] = columns["up_to"]._replace(head="passes the test up to")
        cars = tabulate("The cars, first those that may not drive", columns, rows)
        counts = {
            verdict: int((cars["verdict"] == verdict).sum())
            for verdict in NUMBERS.values()
        }
        too_slow = 0
        if self.need is not None:
            too_slow = int((~(cars["up_to"].astype(float) >= self.need)).sum())
        ordered = cars.sort_values(
            "up_to", kind="stable", na_position="first", ignore_index=True
        )
        ordered.attrs = {**cars.attrs, "shown_whole": SHOWN_WHOLE}
        unit = unit_text(span.unit)
        end = f"{span.name}={span.high!r}"
        scope = scope_of(study_up_to(self.study, end) if span.ending else self.study)
        own = self.models.own.unsafe
        cannot = f"{number_of(too_slow, 'car')} {self._no_verb(too_slow)}"
        slower = f"{cannot} at {self.need or 0:g}{unit}"
        failures: tuple[str, ...] = (slower,) if too_slow else ()
        if self.is_rough and self.need is not None:
            failures += (ROUGH_NEED,)
        return Answer(
            question="permit",
            study=self.study,
            verdict=" ".join(self._sentences(fleet, cars, counts, slower, scope)),
            tested=self._tested(),
            numbers={
                "unsafe": str(own),
                "margin": own.keep,
                "scope": scope,
                "cars": len(rows),
                **{name: counts[verdict] for name, verdict in NUMBERS.items()},
                "fits": len(self.models.members),
                "attacked": self.search.attacked,
                "step": self.step,
                "need": self.need,
                "not_driven_above": span.high,
                "rough": self.is_rough,
            },
            tables={
                "cars": ordered,
                "sets": tabulate(
                    "By parameter set",
                    _in_unit(SETS, span),
                    set_rows(fleet.names, permits, with_car=self.is_box),
                ),
            },
            folded=("sets",),
            failures=failures,
            listing=self._listing(cars, fleet),
        )

    def _rows(
        self, fleet: Fleet, permits: Sequence[Permit], repaired: Sequence[Repaired]
    ) -> list[JsonObject]:
        """A row of `CARS` for each car, in the order of the list."""
        vehicle = self.models.own.characteristics.vehicle
        new_car = self.new_car.up_to
        assert new_car is not None
        columns = failure_columns(
            [each.least.failure for each in permits], with_car=self.is_box
        )
        own = self.models.own.unsafe
        of_all = {
            "rough": self.is_rough,
            "parameter_sets": len(self.models.members),
            "margin": own.keep,
            "unsafe": str(own),
        }
        ends = self.ends or [None] * len(permits)
        cells = assumed_cells(vehicle, fleet)
        rows = []
        for name, permit, found, best, assumed, end in zip(
            fleet.names, permits, columns, repaired, cells, ends, strict=True
        ):
            verdict = verdict_of(
                permit.up_to,
                new_car,
                self.span.high,
                self.need,
                is_proven=not self.is_quick,
            )
            words = found["because"]
            row = {
                "car": name,
                "up_to": permit.up_to,
                "new_car_up_to": new_car,
                "unit": self.span.unit,
                "verdict": verdict,
                "because": because(
                    permit, words, verdict, self.span, new_car, self.need
                ),
                "parameter_set": permit.least.fit if words else None,
                "repair_first": None if best is None else vehicle.names[best[0]],
                "up_to_after_repair": None if best is None else best[1].up_to,
                "assumed": assumed,
                "assumed_matters_most": None if end is None else end.name,
            }
            rows.append(found | row | of_all)
        return rows

    def _sentences(
        self,
        fleet: Fleet,
        cars: pd.DataFrame,
        counts: Mapping[str, int],
        slower: str,
        scope: str,
    ) -> list[str]:
        """The verdict: how many cars may drive, what is safe, and what was not driven."""
        span = self.span
        unit = unit_text(span.unit)
        top = f"{span.high:g}{unit}"
        number = len(cars)
        new_car = f"the new car {self._verb()} {self._reach(self.new_car.order)}"
        goal = (
            f"{top} or as fast as the new car"
            if self.need is None
            else f"{self.need:g}{unit}"
        )
        phrases = {
            DRIVE: f"up to {goal}",
            LIMITED: f"up to a lower {span.name.replace('_', ' ')}",
            STOP: f"not even at {span.low:g}{unit}",
        }
        of_all = f" of {number_of(number, 'car')}"
        parts = list[str]()
        for verdict, phrase in phrases.items():
            if count := counts[verdict]:
                verb = (
                    f"{self._no_verb(count)}," if verdict == STOP else self._verb(count)
                )
                parts.append(f"{count}{'' if parts else of_all} {verb} {phrase}")
        told = join_phrases(parts)
        name, up_to = cars.iloc[0][["car", "up_to"]]
        is_safe = not pd.isna(up_to)
        if number == 1:
            may = f"{self._verb()} {self._reach(up_to)}" if is_safe else self._no_verb()
            told = f"{name} {may}"
        sentences = [
            f"{told}{self._measured_in_words(fleet)}; {new_car}.",
            self.assumed,
        ]
        if number == 1:
            if is_safe and self.ends and not fleet.measured.all():
                sentences.append(worst_end_in_words(self.ends[0], span))
            sentences.append(cars["because"][0])
        if self.need is not None:
            sentences.append(f"{slower}.")
        if fleet.is_rough:
            sentences.append(ROUGH_LIST)
        sentences.append(remark_on_phases(self.models.own.in_phases))
        if span.ending:
            tests = join_phrases(span.ending)
            sentences.append(
                f"Above {top} nothing was driven, where the tests {tests} end."
            )
        if span.left_out:
            sentences.append(
                f"Not driven, because they begin above {top}: {join_phrases(span.left_out)}."
            )
        sentences += [f"Scope: {scope}.", f"Safe means: {self._safe_in_words()}."]
        return [*filter(None, sentences)]

    def _verb(self, count: int = 1) -> str:
        """What safe cars do."""
        if not self._is_test:
            return "may drive"
        return "passes the test" if count == 1 else "pass the test"

    def _no_verb(self, count: int = 1) -> str:
        """What unsafe cars do."""
        if not self._is_test:
            return "may not drive"
        return f"{'does' if count == 1 else 'do'} not pass the test"

    def _reach(self, value: float) -> str:
        """Up to which value cars are safe, behind the verb."""
        return self.span.up_to(value, with_low=not self._is_test)

    @property
    def _is_test(self) -> bool:
        """Whether the study is a test of a regulation, which is safe by its rules alone."""
        allows_impacts = any(test.allowed_impact_speed for test in self.study.tests)
        return allows_impacts or bool(self.study.unsafe.source)

    def _measured_in_words(self, fleet: Fleet) -> str:
        """That measured values count as they are least safe, behind how far cars are safe."""
        vehicle = self.models.own.characteristics.vehicle
        # Limits are no measurements.
        is_measured = np.any(fleet.measured, axis=0, keepdims=True)[0] & (
            not self.is_box
        )
        precise = precise_in_words(compress(vehicle, is_measured))
        return f" with the least safe value of {precise}" if precise else ""

    def _safe_in_words(self) -> str:
        """What a safe car does, with the study's own parameter set and with the others."""
        own = self.models.own.unsafe
        others = len(self.models.members) - 1
        if own.below is None and not own.is_collision:
            return f"not {own.description}, in {number_of(others + 1, 'parameter set')}"
        if not own.keep:
            clearance = f" and {own.below:g} m of clearance" if own.below else ""
            return f"no contact{clearance}, in {number_of(others + 1, 'parameter set')}"
        rest = f", and no contact with {number_of(others, 'other')}" if others else ""
        return (
            f"no contact and {own.keep:g} m of clearance with the study's own"
            f" parameter set{rest}"
        )

    def _tested(self) -> str:
        values = self.search.values
        unit = unit_text(self.span.unit)
        driven = f"from {values[0]:g} to {values[-1]:g}{unit}"
        if len(values) == len(self.search.listed):
            driven = f"({join_phrases(f'{value:g}' for value in values)}{unit})"
        grid = f"{len(values)} values {driven} in each test"
        attacked = (
            f"{self.search.attacked:,} simulations that search for an unsafe encounter"
        )
        return f"{grid}; {'no search for an unsafe encounter' if self.is_quick else attacked}."

    def _listing(self, cars: pd.DataFrame, fleet: Fleet) -> pd.DataFrame:
        """The list: the columns of the input, then those of the answer, in the input's order."""
        manifest = manifest_now(self.study, assemble(self.study))
        given = fleet.table.reset_index(drop=True)
        # Limits are no measured values of a car.
        given = given[given.columns[:1]] if self.is_box else given
        listing = pd.concat([given, cars.drop(columns="car")], axis=1)
        listing[ROUGH] = YES if self.is_rough else "no"
        listing[DIGEST] = identity_digest(manifest)[:12]
        return listing


NUMBERS = {"drive": DRIVE, "limited": LIMITED, "stop": STOP}
"""The numbers that count cars, by what they may do."""


def _in_unit(columns: Columns, span: Span) -> dict[str, Any]:
    """Columns with the unit of the parameter."""
    named = dict[str, Any](columns)
    for name in ("up_to", "new_car_up_to", "up_to_after_repair"):
        column = columns.get(name)
        if isinstance(column, Column):
            named[name] = column._replace(unit=span.unit)
    return named
