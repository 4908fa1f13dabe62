"""The dossier of a pack: eight sections of statements, each with its level of evidence and the command that makes its
numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

from safevar_sumo.records import JsonObject
from safevar_sumo.replay.animation import template_environment
from safevar_sumo.report.sections import GENERAL_LIMITS
from safevar_sumo.study import Study, unit_text, user_code_names

FIRST_SENTENCE = "Nothing here was compared with a real car."
PURPOSE = (
    "Candidate evidence for a safety case: neither this page nor the program that made it says that a vehicle complies "
    "with anything. No regulation that was read defines a metric or a threshold for simulations."
)
SIMULATED = "compared with published simulator data"
OF_MODEL = "by a model that was compared with published simulator data; this number was not"
EXACT = "compared with a closed form or a second implementation"
ASSUMED = "assumed: no data for this combination of vehicle, driving system and scenario"
"""Levels of evidence of a statement."""
SENSITIVITIES_SHOWN = 3
"""Number of characteristics that the section on sensitivity names."""
STEPS = {"half_step": "half the time step", "double_step": "double the time step"}
"""The checks with another time step."""
ROBUST = 0.8
"""Share of unsafe neighbours below which a finding is borderline."""
MEASURES = {
    "relative_error": "mean |here - there| over mean |there|, at most",
    "rmse": "root mean square of here - there [m], at most",
    "largest_error": "largest |here - there| [m], at most",
    "sprague_geers": "Sprague and Geers's comprehensive error, at most",
    "pearson": "Pearson's correlation, at least",
    "t_test": "p-value of the paired t-test, at least",
    "anova": "p-value of the one-way analysis of variance, at least",
    "kolmogorov_smirnov": "Kolmogorov and Smirnov's distance of the distributions, at most",
    "spearman": "Spearman's rank correlation, at least",
    "mean_absolute_error": "mean |here - there| [m], at most",
    "coverage": "share of the rows in the band of the fitted models, at least",
}
"""Measures of validation: their definitions, and the side of a threshold on which a value keeps it."""
STATE_WITH = {
    "explain": "State with it: the cause's own robustness, the criterion for unsafe, a second opinion on the cause "
    "(`opinion`); for preventability, which driver model and the share of collisions that it was tested on.",
    "tolerance": "State with it: the grid, the bound on the unsafe share of the box and its confidence; all other "
    "values are as in the original.",
    "risk": "State with it: the distributions of [variation] and their sources; the confidence.",
    "rating": "State with it: the protocol's version, and the cells that are not simulated.",
    "repair": "State with it: the promise and who keeps it, the margin, the certified bound and confidence, the price.",
}
"""What a safety case has to say beside an answer."""
ROUNDINGS = {"ceil": ROUND_CEILING, "floor": ROUND_FLOOR}
TEMPLATE_FOLDER = Path(__file__).parent / "web"


class Statement(NamedTuple):
    """One statement: its text, level of evidence, and the command whose JSON has the `numbers` at their paths."""

    text: str
    level: str = ""
    command: str = ""
    numbers: Mapping[str, Any] = {}


class _Reading(Formatter):
    """Fills the fields of a text, which are paths in an answer's JSON below `at`, and notes the values in `numbers`."""

    def __init__(self, answer: Any, at: str) -> None:
        self.answer, self.at, self.numbers = answer, at, dict[str, Any]()

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        path = f"{self.at}{field_name}"
        self.numbers[path] = value = value_at(self.answer, path)
        return float("nan") if value is None else value, field_name

    def format_field(self, value: Any, format_spec: str) -> Any:
        """A limit of a safe range is rounded into the range, by `ceil` or `floor`, to four digits."""
        if format_spec in ROUNDINGS:
            context = Context(prec=4, rounding=ROUNDINGS[format_spec])
            value, format_spec = float(context.create_decimal(repr(value))), ".6g"
        return super().format_field(value, format_spec)


def value_at(answer: Any, path: str) -> Any:
    """The value at a path of names and indices, joined by dots."""
    for key in path.split("."):
        answer = answer[int(key)] if isinstance(answer, list) else answer[key]
    return answer


def make_dossier(
    manifest: JsonObject,
    study: Study,
    counts: Mapping[str, int],
    answers: Mapping[str, tuple[str, Any]],
    checks: JsonObject,
    validations: Sequence[JsonObject],
) -> JsonObject:
    """The dossier of one study as plain values; `answers` are commands and JSON by question."""
    directory = f"results/{study.name}"
    sources = {
        "manifest": (f"python -m json.tool {directory}/manifest.json", manifest),
        "status": (f"python -m safevar_sumo status {directory} --json", {"simulated": counts["evaluations"]}),
        "checks": (_measure(directory), checks),
        **{validation["file"]: (_measure(directory, validation["file"]), validation) for validation in validations},
        **answers,
    }
    files = [validation["file"] for validation in validations]
    dossier = _Dossier(study, sources, list(answers), files, counts["runs"])
    sections = {
        "Intended use and scope": dossier.scope(),
        "Toolchain": dossier.toolchain(),
        "Verification": dossier.verification(),
        "Validation": dossier.validation(),
        "Uncertainty": dossier.uncertainty(),
        "Sensitivity": dossier.sensitivity(),
        "Answers": dossier.results(),
        "Open points": dossier.open_points(),
    }
    return {
        "title": f"Candidate evidence: {study.title}",
        "first": FIRST_SENTENCE,
        "purpose": PURPOSE,
        "sections": [
            {"title": f"{number}. {title}", "statements": [statement._asdict() for statement in statements]}
            for number, (title, statements) in enumerate(sections.items(), 1)
        ],
    }


def _measure(*arguments: str) -> str:
    """The command that prints the numbers of `report/measurements.py`."""
    texts = ", ".join(map(repr, arguments))
    return f'python -c "from safevar_sumo.report.measurements import print_checks; print_checks({texts})"'


def dossier_page(dossier: JsonObject) -> str:
    """The dossier as a page that needs no network."""
    css = (TEMPLATE_FOLDER / "report.css").read_text(encoding="utf-8")
    return template_environment(TEMPLATE_FOLDER).get_template("dossier.html.j2").render(**dossier, css=css)


@dataclass(frozen=True)
class _Dossier:
    """The statements of each section.

    `sources` are commands and their JSON by question or file of validation, and of "manifest", "status" and "checks".
    """

    study: Study
    sources: Mapping[str, tuple[str, Any]]
    questions: Sequence[str]
    validations: Sequence[str]
    finished_runs: int

    @property
    def level(self) -> str:
        return OF_MODEL if self.study.spread else ASSUMED

    def _say(self, source: str, text: str, level: str = "", at: str = "") -> Statement:
        """A statement whose text has fields, which are paths in a source's JSON below `at`."""
        command, answer = self.sources[source]
        reading = _Reading(answer, at)
        if source in self.questions:
            level = self.level
        return Statement(reading.format(text), level, command, reading.numbers)

    def _answer(self, question: str, default: Any) -> Any:
        return self.sources[question][1] if question in self.sources else default

    @property
    def _failures(self) -> list[JsonObject]:
        """The failures of `explain`, whose last record is the summary."""
        return list(self._answer("explain", [])[:-1])

    def _causes(self) -> Iterator[tuple[str, JsonObject]]:
        """Every minimal cause of the explained failures, after its path in the answer."""
        for index, failure in enumerate(self._failures):
            for number, cause in enumerate(failure["minimal_causes"]):
                yield f"{index}.minimal_causes.{number}", cause

    def scope(self) -> Iterator[Statement]:
        text = "Vehicle {study.vehicle.model}, driving system {study.ads.model}, scenario {study.scenario.model}."
        yield self._say("manifest", text)
        yield Statement(
            "Vehicle and driving system were fitted to published simulations of another simulator; section 4 has how "
            "far they agree, where reference data is given, and the manual's page on trust."
            if self.level == OF_MODEL
            else "No data was fitted, and none was compared: parameters are from their sources or assumed."
        )
        for line in GENERAL_LIMITS:
            yield Statement(f"Limit: {line}")
        for question in self.questions:
            yield Statement(f"Answer of `{question}`: section 7.", self.level)

    def toolchain(self) -> Iterator[Statement]:
        manifest = self._answer("manifest", {})
        for name in manifest["versions"]:
            yield self._say("manifest", f"{name} {{versions.{name}}}")
        for name, digest in manifest["files"].items():
            yield Statement(f"file: {name}, sha256 {digest}...", command=self.sources["manifest"][0])
        yield self._say(
            "checks",
            "Numbers that go in: {constants.published} published, {constants.fitted} fitted, {constants.assumed} "
            "neither, so counted as assumed.",
        )

    def verification(self) -> Iterator[Statement]:
        checks = self._answer("checks", {})
        if "settings" in checks:
            recorded = "compared with the recorded scene" if checks["recorded"] else "which moves the actors itself"
            text = f"{{same_in_sumo}} of {{settings}} settings have the same results in SUMO to the bit, {recorded}."
            yield self._say("checks", text, EXACT)
        for name, words in STEPS.items() if "settings" in checks else ():
            text = (
                f"With {words} {{{name}.same_outcome}} of {{settings}} settings end alike; the safety degree changes "
                f"by at most {{{name}.largest_change:.2f}} m."
            )
            failed = f"{words.capitalize()}: {{{name}.reason}}"
            yield self._say("checks", failed if "reason" in checks[name] else text)
        yield Statement(
            "Closed forms and second implementations (metrics, search algorithms, vehicle dynamics) are among the "
            "program's tests: `make test-all` in its sources.",
            EXACT,
        )
        code = user_code_names(self.study)
        yield Statement(
            f"User code ({', '.join(code)}) was tried before the first batch, as `check` does: repeated, in another "
            "order, in smaller batches, alone. A finding ends the study; there was none."
            if code
            else "No user code, so nothing for `check`."
        )

    def validation(self) -> Iterator[Statement]:
        if not self.validations:
            yield Statement("No reference data was given: nothing is validated here.")
        for file in self.validations:
            answer = self._answer(file, {})
            for part, rows in (("used", "that a fit uses"), ("held_back", "held back from a fit")):
                yield self._say(file, f"{{file}}: {{{part}.rows}} rows {rows}.")
                for name, words in MEASURES.items() if answer[part]["rows"] else ():
                    if name == "coverage" and (part == "used" or answer["coverage"] is None):
                        continue
                    path = "coverage.held_back" if name == "coverage" else f"{part}.{name}"
                    definition, side = words.rsplit(", ", 1)
                    beside = self._beside_threshold(name, value_at(answer, path), side)
                    yield self._say(file, f"Rows {rows}: {definition}: {{{path}:.4g}}{beside}", SIMULATED)

    def _beside_threshold(self, name: str, value: float | None, side: str) -> str:
        """The user's threshold of a measure, in words; a full stop without one."""
        # Not `get`: the keys' type is narrower than that of `name`.
        threshold = next((limit for key, limit in self.study.evidence.threshold.items() if key == name), None)
        if threshold is None:
            return "."
        is_kept = value is not None and (value <= threshold if side == "at most" else value >= threshold)
        return f"; declared by the user: {side} {threshold:g}, which it {'keeps' if is_kept else 'does not keep'}."

    def uncertainty(self) -> Iterator[Statement]:
        checks = self._answer("checks", {})
        if original := checks.get("original"):
            repeats = "unknown" if original["repeats"] is None else "+-{original.repeats:.3g} m (90 % of repeats)"
            epistemic = [
                f"{{{name}.original:.4g}} m with {words}"
                for name, words in STEPS.items()
                if checks[name].get("original") is not None
            ]
            if original.get("lower") is not None:
                epistemic.append(
                    "{original.lower:.4g} to {original.upper:.4g} m over {original.sets} fitted sets, "
                    "{original.collisions} of which collide"
                )
            text = (
                f"The original's safety degree is {{original.safety_degree:.4g}} m. Aleatory: {repeats}. Epistemic: "
                f"{'; '.join(epistemic) or 'unknown'}."
            )
            yield self._say("checks", text, self.level)
        for path, cause in self._causes():
            if cause.get("across_fits"):
                text = (
                    f"Epistemic: {', '.join(cause['changes'])}: a cause in {{holds}} of {{sets}} fitted vehicle models."
                )
                yield self._say("explain", text, at=f"{path}.across_fits.")
        yield from self._shares()
        if "risk" in self.questions:
            interval = "{interval.0:.3g} to {interval.1:.3g} ({confidence:.0%} interval)"
            yield self._say("risk", f"Sampling: the share of unsafe vehicles is {interval}.")

    def _shares(self) -> Iterator[Statement]:
        """Ranges of the shares of `explain` over the fitted vehicle models."""
        summary = self._answer("explain", [{}])[-1].get("summary", {})
        ranges = summary.get("across_fits") or {}
        shares = {"unsafe": "of the different solutions are unsafe"} if ranges else {}
        shares |= {f"necessary.{name}": f"of the failures need {name}" for name in ranges.get("necessary", {})}
        shares |= {
            f"preventable.{name}": f"of the collisions: {name.replace('_', ' ')} avoids them"
            for name in ranges.get("preventable", {})
            if name in summary["preventable"] and name not in ("nobody", "later")
        }
        for name, words in shares.items():
            low, high = value_at(ranges, f"{name}.range")
            if low < high:
                text = f"Epistemic: {{range.0:.1%}} to {{range.1:.1%}} {words}, over {{sets}} fitted vehicle models."
                yield self._say("explain", text, at=f"-1.summary.across_fits.{name}.")

    def sensitivity(self) -> Iterator[Statement]:
        rows = self._answer("risk", {}).get("sensitivity", ())
        totals = {index: row["total"] for index, row in enumerate(rows) if row["total"] is not None}
        if not totals:
            yield Statement("Not computed: `evidence --risk` adds it, unless characteristics are correlated.")
        for index in sorted(totals, key=lambda index: -totals[index])[:SENSITIVITIES_SHOWN]:
            yield self._say(
                "risk",
                "{characteristic}: {first_order:.2f} of the variance alone, {total:.2f} in all "
                "({total_interval.0:.2f} to {total_interval.1:.2f}).",
                at=f"sensitivity.{index}.",
            )

    def results(self) -> Iterator[Statement]:
        text = "The search simulated {simulated} settings; it proves nothing about those that it did not try."
        yield self._say("status", text)
        for path, cause in self._causes():
            words = ", ".join(f"{name} {{changes.{name}:.4g}}" for name in cause["changes"])
            yield self._say("explain", f"Enough by themselves: {words or 'no change'} ({{outcome}}).", at=f"{path}.")
        tolerance = self._answer("tolerance", {"alone": []})
        for index, row in enumerate(tolerance["alone"]):
            if row["safe"]:
                text = "Alone: no unsafe value of {characteristic} found from {safe.0:ceil} to {safe.1:floor}"
                yield self._say("tolerance", f"{text}{unit_text(row['unit'])}.", at=f"alone.{index}.")
        if tolerance.get("samples"):
            text = "All together: {failures} of {samples} settings unsafe, at most {at_most:.2%} of all."
            yield self._say("tolerance", text)
        if "risk" in self.questions:
            yield self._say("risk", "The share of unsafe vehicles is {probability:.3g}.")
        for question in self.questions:
            yield self._say(question, f"`{question}`: {STATE_WITH[question]}")

    def open_points(self) -> Iterator[Statement]:
        yield Statement("No vehicle was driven: every statement is about models.")
        runs = len(self.study.search.algorithms) * self.study.search.runs
        if self.finished_runs < runs:
            yield Statement(f"The search is not finished: {self.finished_runs} of {runs} runs.")
        if not self.validations:
            yield Statement("Reference data is missing: `evidence --reference FILE.csv` adds section 4.")
        if not self.study.evidence.threshold:
            yield Statement("No threshold was declared: [evidence] threshold in the study.")
        for question in STATE_WITH:
            if question not in self.questions and question not in ("rating", "repair"):
                yield Statement(f"`{question}` was not asked.")
        for index, failure in enumerate(self._failures):
            if (failure["robustness"] or 0.0) < ROBUST:
                changed = ", ".join(failure["changed"])
                text = f"Borderline: {{robustness:.0%}} of the neighbours of the failure with {changed} are unsafe."
                yield self._say("explain", text, at=f"{index}.")
        if "explain" in self.questions:
            yield Statement("The second vehicle model was not asked about the causes: `opinion`.")
        if not self.study.variation:
            yield Statement("No [variation]: shares are of the domain, not of vehicles in the field.")
        answers = (self._answer(question, {}) for question in self.questions)
        records = (record for answer in answers for record in (answer if isinstance(answer, list) else [answer]))
        if any({**record, **record.get("summary", {})}.get("driven") is False for record in records):
            yield Statement(
                "No verdict: the original vehicle never reaches the encounter, or brakes with nobody in sight."
            )
        yield Statement(
            "EU 2022/1426, UN R157 and WP.29/2022/57 are cited as their readers quote them: they were not read in the "
            "original."
        )
