"""The answer of a repair: its records as JSON, table and sentences."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import tomli_w

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.repair.attack import Proof
from safevar_sumo.analysis.repair.price import Price
from safevar_sumo.analysis.repair.problem import Parameter, Promise
from safevar_sumo.analysis.words import join_phrases
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import whole_file
from safevar_sumo.records import JsonObject
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import SCHEMA_LINE, Study, study_names, unit_text, write_study
from safevar_sumo.sumo.empty_road import summary_entry
from safevar_sumo.terminal import answer_as_html


class Repair(NamedTuple):
    """A change of parameters that survives the promise.

    `parameters` that change have new values in their units, by name; the `largest_change` is a share of its range.
    `price` and `proof` are its price on a new vehicle and its proof on fresh wear.
    """

    parameters: dict[str, float]
    largest_change: float
    price: Price
    proof: Proof

    def to_dict(self) -> JsonObject:
        """A record of the JSON."""
        return {
            "parameters": self.parameters,
            "changed": len(self.parameters),
            "largest_change": self.largest_change,
            **self.price._asdict(),
            **self.proof._asdict(),
        }


@dataclass(frozen=True, kw_only=True)
class Repairs:
    """The smallest changes of one and of two parameters that survive the promised wear.

    Attributes
    ----------
    worst_today
        Safety degree of today's driving system with the worst vehicle of the promise that was tried and that a driving
        system can keep safe [m]; below 0, minus the speed of the impact [m/s].
    proof_of_today
        If today's system keeps the promise already: its proof on fresh wear.
    not_repairable
        Parts of the promise that no driving system survives: for each characteristic of a minimal cause, the value from
        which on even full braking at once fails.
    """

    study: Study
    promise: Promise
    unsafe: Unsafe
    parameters: tuple[Parameter, ...]
    repairs: tuple[Repair, ...]
    worst_today: float
    proof_of_today: Proof | None
    not_repairable: tuple[dict[str, float], ...]
    simulations: int
    no_verdict: str = ""

    def to_dict(self) -> list[JsonObject]:
        """The JSON of `repair`."""
        summary: JsonObject = {
            "record": "summary",
            "promise": self.promise.to_dict(),
            "margin": self.unsafe.keep,
            "worst_today": self.worst_today,
            "kept_today": self.proof_of_today is not None,
            "repairs": len(self.repairs),
            "not_repairable": list(self.not_repairable),
            "simulations": self.simulations,
        }
        repairs = [{"record": "repair", **repair.to_dict()} for repair in self.repairs]
        return [*repairs, summary, *summary_entry(self.no_verdict)]

    def to_frame(self) -> pd.DataFrame:
        """One row for each repair, with the columns of its record in the JSON."""
        return pd.DataFrame([repair.to_dict() for repair in self.repairs])

    def repaired_study(self) -> Study:
        """The study with the first repair."""
        return with_parameters(self.study, self.repairs[0].parameters)

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        return f"<Repairs of {self.study.name}: {self.verdict}>"

    @property
    def verdict(self) -> str:
        """One sentence on the promise: kept already, survived by a change, or by none."""
        if self.no_verdict:
            return self.no_verdict
        promise = self.promise.in_words
        if self.proof_of_today is not None:
            where = " wherever any driving system can" if self.not_repairable else ""
            return (
                f"The driving system of today keeps this promise ({promise}){where}: the worst vehicle tried has a "
                f"safety degree of {self._worst_in_words}, and {_proof_in_words(self.proof_of_today)}."
            )
        if self.repairs:
            number = "One change survives" if len(self.repairs[0].parameters) == 1 else "Two changes survive"
            return f"{number} this wear ({promise}): {self.changes_in_words(self.repairs[0])}."
        names = join_phrases(parameter.name for parameter in self.parameters)
        return f"No change of one or two of {names} was found that survives this promise ({promise})."

    @property
    def _worst_in_words(self) -> str:
        return distance_in_words(self.worst_today, self.unsafe.contact)

    def sentences(self) -> Iterator[str]:
        """The verdict; the price, the other repair and the proof; what cannot be repaired."""
        yield f"Unsafe: {self.unsafe.description}."
        if not self.no_verdict:
            yield self.verdict
        degree = self.worst_today
        for number, repair in enumerate(self.repairs):
            if number:
                yield f"  or                 {self.changes_in_words(repair)}"
            else:
                worst = f"safety degree {self._worst_in_words}" if degree >= 0 else f"a collision at {-degree:.2f} m/s"
                yield f"  today              the worst vehicle of the promise: {worst}"
            yield f"  price on a new car {_price_in_words(repair.price)}"
            yield f"  checked            {_proof_in_words(repair.proof)}"
        members = {member.name: member for member in self.promise.region.characteristics}
        for part in self.not_repairable:
            limits = [
                f"{name} {'below' if value < members[name].original else 'above'} "
                f"{members[name].text(value)}{members[name].suffix}"
                for name, value in part.items()
            ]
            wear = " with ".join(limits) or "even the original"
            yield f"  not repairable     {wear}: needs another part, not a parameter"

    def changes_in_words(self, repair: Repair) -> str:
        """The parameters that change, such as `margin 0.5 -> 2.9 m (gap that it plans to keep at the stop)`."""
        return ", ".join(
            f"{name} {today:.6g} -> {repair.parameters[name]:.10g}{unit_text(row.unit)} ({row.meaning})"
            for name, row, today in self.parameters
            if name in repair.parameters
        )


def write_repair(path: Path, result: Repairs) -> None:
    """Write a study file with the first repair. It extends the study's file; without a file, it is the whole repaired
    study.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    study, values = result.study, result.repairs[0].parameters
    comment = result.verdict + (f" Only {study.origin.point} was simulated." if study.origin.point else "")
    if not study.origin.called and study.name not in study_names():
        write_study(path, result.repaired_study(), comment)
        return
    base = os.path.abspath(study.origin.called) if study.origin.called else study.name
    tables = {"extends": base, "name": f"{study.name}-repaired", "ads": {"parameters": values}}
    text = f"{SCHEMA_LINE}# {comment}\n\n{tomli_w.dumps(tables)}"
    with whole_file(path, "out") as file:
        file.write_text(text, encoding="utf-8")


def _price_in_words(price: Price) -> str:
    if price.metres_earlier is None:
        metres = "brakes nowhere on a new car"
    else:
        place = f" at {price.most_at}" if price.most_at else ""
        metres = (
            f"brakes up to {price.metres_earlier:.2f} m ({price.seconds_earlier:.2f} s) earlier{place}, "
            f"{price.metres_earlier_mean:.2f} m on average"
        )
    needless = "needless braking is unknown: the study has no benign scenes"
    if price.benign_scenes:
        scenes = f"{price.benign_scenes} benign scenes ({price.needless_braking_today} before)"
        needless = f"brakes needlessly in {price.needless_braking} of {scenes}"
    return f"{metres}; up to {price.largest_deceleration:.1f} m/s^2; {needless}"


def _proof_in_words(proof: Proof) -> str:
    return (
        f"{proof.proof_samples:,} fresh worn cars, {proof.proof_failures} unsafe (at most {100 * proof.at_most:.2g} %, "
        f"{100 * CONFIDENCE:.0f} %)"
    )
