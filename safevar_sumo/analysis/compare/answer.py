"""The answer on two systems: what is unsafe in one of them only, as JSON, table, sentences and a figure."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.table import Table

from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, GREY, SKY_BLUE, VERMILION, escape_dollars, new_figure
from safevar_sumo.analysis.research_questions.answer import WEATHER, TableAnswer
from safevar_sumo.analysis.research_questions.formats import as_json
from safevar_sumo.analysis.research_questions.statistics import ALPHA, magnitude_of
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan
from safevar_sumo.analysis.words import number_of, two_decimals
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, JsonObject, finite_or_none
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.terminal import WholeTable, answer_as_html, meanings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VERDICTS = {"only_a_unsafe": "only A unsafe", "only_b_unsafe": "only B unsafe", "both": "both unsafe", "": "both safe"}
"""Verdicts on a setting, by the key under which the JSON counts them; settings that are safe in both have no key there.
"""
COLOURS = {"": GREY, "both": SKY_BLUE, "only_a_unsafe": BLUE, "only_b_unsafe": VERMILION}
"""Colours by verdict, in the order in which the points are drawn."""
SOURCES = {"a": "solutions of A", "b": "solutions of B", "sample": "common sample"}


@dataclass(frozen=True, kw_only=True)
class Side:
    """One of the two systems.

    Attributes
    ----------
    original
        The evaluation of the original vehicle.
    limits
        Scans of each characteristic alone, in the study's order.
    points
        The original's points in the rating; None unless both systems are rated.
    no_verdict
        Why simulations tell nothing about the driving system; "" if they do.
    """

    study: Study
    original: Evaluations
    limits: list[OneAtATimeScan]
    points: float | None
    no_verdict: str

    @property
    def original_facts(self) -> JsonObject:
        return {
            "outcome": str(self.original.outcome[0]),
            SAFETY_DEGREE: finite_or_none(self.original.f_safe[0]),
            "values": {scan.characteristic.name: scan.characteristic.original for scan in self.limits},
        }


@dataclass(frozen=True, kw_only=True)
class SystemComparison:
    """The same settings in two systems, A and B.

    Attributes
    ----------
    frame
        One row for each setting that both systems could simulate: see `to_frame`.
    p
        p-value of the signed-rank test of the safety degree (if both systems are rated, of the points); None without
        pairs.
    a12
        Probability that this quantity is greater in A than in B (Vargha and Delaney); None without pairs.
    needless_braking
        Number of benign scenes of A in which the original vehicle of A brakes, of those in which B's does, and of all.
    test_unit, test_size
        What the pairs of the test are, "run" or "setting", and their number.
    weather
        The table `weather` of the research questions, if the systems differ in the weather alone.
    """

    a: Side
    b: Side
    unsafe: Unsafe
    frame: pd.DataFrame
    p: float | None
    a12: float | None
    test_unit: str
    test_size: int
    weather: pd.DataFrame | None
    needless_braking: tuple[int, int, int]
    remarks: tuple[str, ...] = ()

    @property
    def study(self) -> Study:
        return self.a.study

    @property
    def no_verdict(self) -> str:
        """Why simulations tell nothing about a driving system; empty if they do."""
        return " ".join(dict.fromkeys(filter(None, (self.a.no_verdict, self.b.no_verdict))))

    @property
    def _scans(self) -> list[tuple[OneAtATimeScan, OneAtATimeScan]]:
        """The scans of each characteristic in A and in B, in A's order."""
        scans_of_b = {scan.characteristic.name: scan for scan in self.b.limits}
        return [(scan, scans_of_b[scan.characteristic.name]) for scan in self.a.limits]

    def to_frame(self) -> pd.DataFrame:
        """One row for each setting that both systems could simulate.

        Columns: its values, its `source` (a key of `SOURCES`), of solutions `algorithm`, `run` and `solution`, and for
        each system, with the suffix `_a` or `_b`, `outcome`, `safety_degree` [m, or -m/s] and `unsafe`.
        """
        return self.frame.copy()

    def _verdicts(self, frame: pd.DataFrame) -> dict[str, pd.Series[bool]]:
        """Which rows have each verdict, in the order of `VERDICTS`."""
        in_a, in_b = frame["unsafe_a"], frame["unsafe_b"]
        return dict(zip(VERDICTS, (in_a & ~in_b, in_b & ~in_a, in_a & in_b, ~in_a & ~in_b), strict=True))

    def counts(self, source: str = "") -> dict[str, int]:
        """Number of different settings by verdict, in the order of `VERDICTS`; of one source, or of all."""
        frame = self.frame[self.frame["source"] == source] if source else self.frame
        frame = frame.drop_duplicates(list(self.study.vehicle.characteristics))
        return {name: int(rows.sum()) for name, rows in self._verdicts(frame).items()}

    def to_dict(self) -> JsonObject:
        """The JSON of `compare`."""
        counts = self.counts()
        answer: JsonObject = {
            **driven_entry(self.no_verdict),
            "a": self.a.study.name,
            "b": self.b.study.name,
            "criterion": str(self.unsafe),
            "settings": sum(counts.values()),
            **{name: count for name, count in counts.items() if name},
            "p": self.p,
            "a12": self.a12,
            "limits": [
                {"characteristic": a.characteristic.name, "unit": a.characteristic.unit, "a": a.safe, "b": b.safe}
                for a, b in self._scans
            ],
        }
        answer["needless_braking"] = dict(zip(("a", "b", "benign_scenes"), self.needless_braking, strict=True))
        if self.original_differences:
            answer["originals"] = {"a": self.a.original_facts, "b": self.b.original_facts}
        if self.a.points is not None:
            answer["rating"] = {"a": self.a.points, "b": self.b.points}
        if self.weather is not None:
            answer[WEATHER] = json.loads(as_json([TableAnswer(WEATHER, self.weather, ())]))
        return answer

    @property
    def original_differences(self) -> list[str]:
        """How the original vehicles differ: in their values, and in what they do; empty if they do not."""
        pairs = [(scan_a.characteristic, scan_b.characteristic) for scan_a, scan_b in self._scans]
        texts = [
            f"{a.name} {a.text(a.original)} in A, {b.text(b.original)}{b.suffix} in B"
            for a, b in pairs
            if a.original != b.original
        ]
        ends = [(facts["outcome"], facts[SAFETY_DEGREE]) for facts in (self.a.original_facts, self.b.original_facts)]
        if ends[0] != ends[1]:
            in_a, in_b = (f"{outcome}, SD {two_decimals(degree)}" for outcome, degree in ends)
            texts.append(f"{in_a} in A, {in_b} in B")
        return texts

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        counts = self.counts()
        return (
            f"<Comparison of {self.a.study.name} with {self.b.study.name}, unsafe {self.unsafe}: only in A "
            f"{counts['only_a_unsafe']}, only in B {counts['only_b_unsafe']} of {sum(counts.values())} settings>"
        )

    def sentences(self) -> Iterator[str | Table]:
        """What is unsafe in which system, the test, the limits side by side, and the rating."""
        counts = self.counts()
        yield f"A: {self.a.study.name}. B: {self.b.study.name}: {self.b.study.title}."
        yield f"Unsafe: {self.unsafe.description}."
        if self.original_differences:
            yield f"The original vehicles differ: {'; '.join(self.original_differences)}."
        yield (
            f"Of {sum(counts.values())} settings, {counts['only_a_unsafe']} are unsafe in A only, "
            f"{counts['only_b_unsafe']} in B only and {counts['both']} in both."
        )
        table = WholeTable("settings", right=("number", *VERDICTS.values()), title="The same settings in both systems")
        for source, words in SOURCES.items():
            numbers = self.counts(source).values()
            if any(numbers):
                table.add_row(words, str(sum(numbers)), *map(str, numbers))
        yield table
        yield self._test_in_words()
        yield _as_table(self.limits_frame(), "Limits of each alone, all others as in the original")
        in_a, in_b, scenes = self.needless_braking
        if scenes:
            yield f"Needless braking of the original vehicles in {scenes} benign scenes: {in_a} in A, {in_b} in B."
        if self.a.points is not None and self.b.points is not None:
            yield f"Rating of the original vehicles: {self.a.points:.2f} points in A, {self.b.points:.2f} in B."
        if self.weather is not None:
            names = self.weather[["setting", "other"]].iloc[0].to_list()
            heads = [f"{quantity} {name}" for quantity in ("%", "rank", "+", "-") for name in names]
            frame = self.weather.drop(columns=["setting", "other", "difference"])
            frame.columns = ["characteristic", *heads]
            yield _as_table(frame, "What critical solutions change (rank), and mean increase (+) and decrease (-)")
        yield meanings(scan.characteristic for scan in self.a.limits)
        yield from (f"note: {remark}." for remark in self.remarks)

    def limits_frame(self) -> pd.DataFrame:
        """The limits side by side, as texts."""
        rows = [
            (
                f"{pair[0].characteristic.name} [{pair[0].characteristic.unit}]",
                *(f"{scan.characteristic.original:g}" for scan in pair),
                *("nowhere" if scan.safe is None else "{:.5g} to {:.5g}".format(*scan.safe) for scan in pair),
            )
            for pair in self._scans
        ]
        return pd.DataFrame(rows, columns=["characteristic", "original A", "original B", "safe in A", "safe in B"])

    def _test_in_words(self) -> str:
        if self.p is None or self.a12 is None:
            return "There is no pair of results to test."
        quantity = "Safety degree" if self.a.points is None else "Rating points"
        of_what = ", each with the mean of its solutions" if self.test_unit == "run" else " of the sample"
        return (
            f"{quantity}, paired over {number_of(self.test_size, self.test_unit)}{of_what}: p = {self.p:.2g} (signed "
            f"ranks; {'' if self.p < ALPHA else 'not '}significant at {ALPHA:g}), A12 = {self.a12:.2f} "
            f"({magnitude_of(self.a12)}; above 0.5: greater in A)."
        )

    def figure(self) -> Figure:
        """The safety degree of every setting in B over that in A, and each characteristic's limits side by side."""
        title, number = f"A: {self.a.study.name}; B: {self.b.study.name} (unsafe: {self.unsafe})", len(self.a.limits)
        figure, ((points, bars),) = new_figure(title, rows=1, columns=2, size=(7.2, 2.4 + 0.28 * number))
        verdicts = self._verdicts(self.frame)
        for key, colour in COLOURS.items():
            x, y = (self.frame[f"{SAFETY_DEGREE}_{side}"][verdicts[key]] for side in "ab")
            points.scatter(x, y, s=4, color=colour, label=VERDICTS[key], linewidths=0, rasterized=True)
        points.axline((0, 0), slope=1, color="black", linewidth=0.6)
        points.set(xlabel="safety degree in A [m, below 0: -m/s]", ylabel="safety degree in B [m, below 0: -m/s]")
        points.legend(fontsize=FONT_SIZE - 1, markerscale=2)
        pairs, places = self._scans[::-1], np.arange(number)  # bars are drawn from the bottom up
        domains = [scan.characteristic for scan, _ in pairs]
        lower, upper = np.array([(domain.lower, domain.upper) for domain in domains]).T
        for k, colour, shift in ((0, BLUE, 0.2), (1, VERMILION, -0.2)):
            ends = [pair[k].safe or (domain.lower, domain.lower) for pair, domain in zip(pairs, domains, strict=True)]
            low, high = (np.array(ends).T - lower) / (upper - lower)
            bars.barh(places + shift, high - low, left=low, height=0.36, color=colour, label=f"safe in {'AB'[k]}")
        bars.set_yticks(places, [escape_dollars(domain.name) for domain in domains])
        bars.set(xlabel="share of A's domain [-]")
        bars.grid(visible=False, axis="y")
        figure.legend(
            *bars.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=FONT_SIZE
        )
        return figure


def _as_table(frame: pd.DataFrame, title: str) -> WholeTable:
    """A frame as a table for the terminal; a number has four digits, and "-" stands for none."""
    table = WholeTable(frame.columns[0], right=frame.columns[1:], title=title)
    for cells in frame.astype(object).where(frame.notna(), "-").itertuples(index=False):
        table.add_row(*(cell if isinstance(cell, str) else f"{cell:.4g}" for cell in cells))
    return table
