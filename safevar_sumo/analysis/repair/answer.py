"""The answer of a repair: its records as JSON, table and sentences."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd
import tomli_w
from rich.table import Table

from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, VERMILION, as_formula, new_panels
from safevar_sumo.analysis.repair.attack import Proof
from safevar_sumo.analysis.repair.price import Price
from safevar_sumo.analysis.repair.problem import Parameter, Promise
from safevar_sumo.analysis.words import join_phrases, number_of
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import whole_file
from safevar_sumo.records import JsonObject
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import SCHEMA_LINE, Study, study_names, unit_text, write_study
from safevar_sumo.study.schema import NAME_PATTERN
from safevar_sumo.sumo.empty_road import summary_entry
from safevar_sumo.terminal import WholeTable, answer_as_html

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class NotRepairable(NamedTuple):
    """A part of the promise that no driving system survives.

    `limits` are, for each characteristic of a minimal cause, the value from which on even full braking at once fails at
    the test `point`. `share` is that of the vehicles tried at the beginning that no driving system keeps safe.
    """

    limits: dict[str, float]
    point: str
    share: float


class Exchange(NamedTuple):
    """What the promise of a characteristic costs: by how many metres the ADS has to brake earlier at its worst point;
    None if it is not `repairable`.
    """

    characteristic: str
    promise: float
    metres_earlier: float | None
    repairable: bool


@dataclass(frozen=True, kw_only=True)
class Repair:
    """A change of parameters that survives the promise.

    Attributes
    ----------
    values
        The parameters that change, with their new values in their units.
    largest_change
        The largest of the changes, as a share of its range.
    price, proof
        What it costs on a new vehicle, and its proof on fresh wear.
    held_out
        By check the numbers `all` and `safe`, or None if there is nothing to check: `points` of the matrix that the
        search left out at first, `second_vehicle`, `fitted_sets`; `weathers` has these numbers for each weather.
        `lost_on_new_car` counts the points that the new vehicle passed before and fails with the repair.
    """

    values: dict[str, float]
    largest_change: float
    price: Price
    proof: Proof
    held_out: JsonObject

    def to_dict(self) -> JsonObject:
        """A record of the JSON."""
        return {
            "record": "repair",
            "parameters": self.values,
            "changed": len(self.values),
            "largest_change": self.largest_change,
            "price": self.price.to_dict(),
            "certified": self.proof._asdict(),
            "held_out": self.held_out,
        }


@dataclass(frozen=True, kw_only=True)
class Repairs:
    """The smallest changes of a driving system that survive the promised wear, the fewest changes first.

    Attributes
    ----------
    worst_today
        Safety degree of today's driving system with the worst vehicle of the promise that was tried [m]; below 0, minus
        the speed of the impact [m/s].
    proof_of_today
        If today's system keeps the promise already: its proof on fresh wear.
    largest_promise
        If no change survives the promise: the largest part of it that some change keeps; None if there is none.
    curve
        The exchange rate between promised wear and metres that the driving system brakes earlier, if requested.
    unread
        Parameters that no simulation reads, so that they were not searched.
    """

    study: Study
    promise: Promise
    unsafe: Unsafe
    parameters: tuple[Parameter, ...]
    repairs: tuple[Repair, ...]
    worst_today: float
    proof_of_today: Proof | None
    not_repairable: tuple[NotRepairable, ...]
    largest_promise: Promise | None
    unread: tuple[str, ...]
    attacks: int
    simulations: int
    counterexamples: int
    curve: tuple[Exchange, ...] = ()
    no_verdict: str = ""

    def to_dict(self) -> list[JsonObject]:
        """The JSON of `repair`."""
        summary: JsonObject = {
            "record": "summary",
            "promise": self.promise.to_dict(),
            "margin": self.unsafe.keep,
            "repairs": len(self.repairs),
            "not_repairable": [part._asdict() for part in self.not_repairable],
            "attacks": self.attacks,
            "simulations": self.simulations,
            "counterexamples": self.counterexamples,
        }
        if not self.repairs and not self.proof_of_today:
            summary["largest_promise"] = self.largest_promise.to_dict() if self.largest_promise else None
        exchanges = [{"record": "exchange", **exchange._asdict()} for exchange in self.curve]
        return [*(repair.to_dict() for repair in self.repairs), *exchanges, summary, *summary_entry(self.no_verdict)]

    def to_frame(self) -> pd.DataFrame:
        """One row for each repair: `parameters`, `changed`, `largest_change`, and the price [m, s, m/s^2, m/s^3]."""
        rows = [
            (
                self._changes_in_words(repair),
                len(repair.values),
                repair.largest_change,
                repair.price.mean,
                repair.price.worst,
                repair.price.seconds,
                repair.price.deceleration,
                repair.price.jerk,
            )
            for repair in self.repairs
        ]
        columns = ["parameters", "changed", "largest_change", "metres_earlier_mean", "metres_earlier_worst"]
        return pd.DataFrame(rows, columns=[*columns, "seconds_earlier", "largest_deceleration", "largest_jerk"])

    def figure(self) -> Figure:
        """Promised wear against metres that the driving system brakes earlier; what no parameter repairs is shaded.

        Raises
        ------
        InputError
            If no curve was computed.
        """
        if not self.curve:
            raise InputError("plot", "there is no curve", "a characteristic for the curve")
        name = self.curve[0].characteristic
        (unit,) = (member.unit for member in self.promise.region.characteristics if member.name == name)
        figure, (axis,) = new_panels(
            f"{self.study.name}: promised wear and earlier braking", 1, 1, (4.0, 2.6), min_width=4.6, title_height=1.0
        )
        priced = {
            exchange.promise: exchange.metres_earlier for exchange in self.curve if exchange.metres_earlier is not None
        }
        axis.plot(list(priced), list(priced.values()), "o-", color=BLUE)
        lost = [exchange.promise for exchange in self.curve if not exchange.repairable]
        if lost:
            axis.axvspan(min(lost), max(lost), facecolor=VERMILION, alpha=0.35, hatch="////", edgecolor="white")
        axis.set_xlabel(f"promised {name} [{as_formula(unit)}]", fontsize=FONT_SIZE)
        axis.set_ylabel("brakes earlier [m]", fontsize=FONT_SIZE)
        return figure

    def repaired_study(self) -> Study:
        """The study with the first repair."""
        return with_parameters(self.study, self.repairs[0].values)

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        return f"<Repairs of {self.study.name}: {self.verdict}>"

    @property
    def verdict(self) -> str:
        """One sentence on the promise: kept already, survived by a change, or by none."""
        if self.no_verdict:
            return self.no_verdict
        if self.proof_of_today is not None:
            where = " wherever any driving system can" if self.not_repairable else ""
            return (
                f"The driving system of today keeps this promise ({self.promise.in_words}){where}: the worst vehicle "
                f"tried has a safety degree of {self._worst_in_words}, and {_proof_in_words(self.proof_of_today)}."
            )
        if self.repairs:
            first = self.repairs[0]
            number = "One change survives" if len(first.values) == 1 else f"{len(first.values)} changes survive"
            return f"{number} this wear ({self.promise.in_words}): {self._changes_in_words(first)}."
        if self.largest_promise is None:
            return (
                f"No change of {join_phrases(parameter.name for parameter in self.parameters)} survives any part of "
                "this promise."
            )
        return (
            f"No change survives this promise ({self.promise.in_words}). The largest that can be kept: "
            f"{self.largest_promise.in_words}."
        )

    @property
    def _worst_in_words(self) -> str:
        return distance_in_words(self.worst_today, self.unsafe.contact)

    def sentences(self) -> Iterator[str | Table]:
        """The verdict; the price, the other repairs and the checks; what cannot be repaired."""
        yield f"Unsafe: {self.unsafe.description}."
        if not self.no_verdict:
            yield self.verdict
        if self.repairs:
            first = self.repairs[0]
            degree = self.worst_today
            worst = f"safety degree {self._worst_in_words}" if degree >= 0 else f"a collision at {-degree:.2f} m/s"
            yield f"  today              the worst vehicle of the promise: {worst}"
            yield f"  price on a new car {_price_in_words(first.price)}"
            for other in self.repairs[1:]:
                yield f"  or                 {self._changes_in_words(other)}: {_price_in_words(other.price)}"
            yield f"  checked            {_proof_in_words(first.proof)}{_held_out_in_words(first.held_out)}"
        if self.curve:
            yield self._curve_table()
        for name in self.unread:
            yield f"  not searched       no simulation reads {name}"
        for part in self.not_repairable:
            limits = [
                f"{name} {'below' if value < member.original else 'above'} {member.text(value)}{member.suffix}"
                for member in self.promise.region.characteristics
                for name, value in part.limits.items()
                if name == member.name
            ]
            place = f" ({part.point})" if part.point else ""
            wear = " with ".join(limits) or "even the original"
            yield f"  not repairable     {wear}{place}: needs another part, not a parameter"

    def _curve_table(self) -> WholeTable:
        name = self.curve[0].characteristic
        table = WholeTable(f"promise of {name}", right=("brakes earlier [m]",), title="The exchange rate")
        for exchange in self.curve:
            metres = "-" if exchange.metres_earlier is None else f"{exchange.metres_earlier:.2f}"
            table.add_row(f"{exchange.promise:.4g}", metres if exchange.repairable else "no parameter repairs it")
        return table

    def _changes_in_words(self, repair: Repair) -> str:
        return ", ".join(
            f"{name} {today:.6g} -> {repair.values[name]:.10g}{unit_text(unit)} ({meaning})"
            for name, unit, meaning, _, _, _, today in self.parameters
            if name in repair.values
        )


def write_repair(path: Path, result: Repairs) -> None:
    """Write a study file with the first repair. It extends the study's file; without a file, it is the whole repaired
    study.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    study, values = result.study, result.repairs[0].values
    comment = result.verdict + (f" Only {study.origin.point} was simulated." if study.origin.point else "")
    if not study.origin.called and study.name not in study_names():
        write_study(path, result.repaired_study(), comment)
        return
    base = os.path.abspath(study.origin.called) if study.origin.called else study.name
    name = path.stem if re.fullmatch(NAME_PATTERN, path.stem) else f"{study.name}-repaired"
    tables = {"extends": base, "name": name, "ads": {"parameters": values}}
    text = f"{SCHEMA_LINE}# {comment}\n\n{tomli_w.dumps(tables)}"
    with whole_file(path, "out") as file:
        file.write_text(text, encoding="utf-8")


def _price_in_words(price: Price) -> str:
    if price.worst is None:
        metres = "brakes nowhere on a new car"
    else:
        place = f" at {price.worst_point}" if price.worst_point else ""
        metres = (
            f"brakes up to {price.worst:.2f} m ({price.seconds:.2f} s) earlier{place}, {price.mean:.2f} m on average"
        )
    if price.needless is None:
        needless = "needless braking is unknown: the study has no benign scenes"
    else:
        scenes, repaired, original = price.needless
        needless = f"brakes needlessly in {repaired} of {scenes} benign scenes ({original} before)"
    return f"{metres}; up to {price.deceleration:.1f} m/s^2; {needless}"


def _proof_in_words(proof: Proof) -> str:
    return (
        f"{proof.n:,} fresh worn cars, {proof.unsafe} unsafe (at most {100 * proof.at_most:.2g} %, "
        f"{100 * proof.confidence:.0f} %)"
    )


def _held_out_in_words(held_out: JsonObject) -> str:
    texts = []
    if held_out["points"]:
        unseen = number_of(held_out["points"]["all"], "unseen test")
        texts.append(f"{held_out['points']['safe']} of {unseen} safe before the search saw them")
    weathers = [f"{name} {count['safe']} of {count['all']}" for name, count in held_out["weathers"].items()]
    if weathers:
        texts.append(f"worst cars safe in other weathers: {', '.join(weathers)}")
    for key, words in (("second_vehicle", "second vehicle model"), ("fitted_sets", "fitted vehicle models")):
        if held_out[key]:
            texts.append(f"{words} {held_out[key]['safe']} of {held_out[key]['all']}")
    texts.append(
        f"a new car fails at {held_out['lost_on_new_car']} points that it passed"
        if held_out["lost_on_new_car"]
        else "a new car loses nothing"
    )
    return "".join(f"; {text}" for text in texts)
