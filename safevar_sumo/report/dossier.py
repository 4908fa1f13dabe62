"""The dossier of a pack: eight sections of statements, each with its level of evidence and the command that makes its
numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from safevar_sumo.records import JsonObject
from safevar_sumo.replay.animation import template_environment
from safevar_sumo.report.sections import GENERAL_LIMITS
from safevar_sumo.study import Study, unit_text, user_code_names

FIRST = "Nothing here was compared with a real car."
PURPOSE = (
    "Candidate evidence for a safety case: neither this page nor the program that made it says that a vehicle complies "
    "with anything. No regulation that was read defines a metric or a threshold for simulations."
)
SIMULATED = "compared with published simulator data"
OF_MODEL = "by a model that was compared with published simulator data; this number was not"
EXACT = "compared with a closed form or a second implementation"
ASSUMED = "assumed: no data for this combination of vehicle, driving system and scenario"
"""Levels of evidence of a statement."""
STRONGEST = 3
"""Number of characteristics that the section on sensitivity names."""
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


SHARE_KEYS = {"low": "range.0", "high": "range.1", "sets": "sets"}
TEMPLATE_FOLDER = Path(__file__).parent / "web"


class Statement(NamedTuple):
    """One statement: its text, level of evidence, and the command whose JSON has the `numbers` at their paths."""

    text: str
    level: str = ""
    command: str = ""
    numbers: Mapping[str, Any] = {}

    @classmethod
    def of(cls, text: str, level: str, command: str, answer: Any, paths: Mapping[str, str]) -> Statement:
        """A statement whose text has a field for each name of `paths`, with the number at its path of the answer."""
        values = {name: value_at(answer, path) for name, path in paths.items()}
        shown = {name: float("nan") if value is None else value for name, value in values.items()}
        return cls(
            text.format(**shown) if paths else text,
            level,
            command,
            {path: values[name] for name, path in paths.items()},
        )


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
    made = _Dossier(manifest, study, counts, answers, checks, validations)
    sections = {
        "Intended use and scope": made.scope(),
        "Toolchain": made.toolchain(),
        "Verification": made.verification(),
        "Validation": made.validation(),
        "Uncertainty": made.uncertainty(),
        "Sensitivity": made.sensitivity(),
        "Answers": made.results(),
        "Open points": made.open_points(),
    }
    return {
        "title": f"Candidate evidence: {study.title}",
        "first": FIRST,
        "purpose": PURPOSE,
        "sections": [
            {"title": f"{number}. {title}", "statements": [statement._asdict() for statement in statements]}
            for number, (title, statements) in enumerate(sections.items(), 1)
        ],
    }


def dossier_page(dossier: JsonObject) -> str:
    """The dossier as a page that needs no network."""
    css = (TEMPLATE_FOLDER / "report.css").read_text(encoding="utf-8")
    return template_environment(TEMPLATE_FOLDER).get_template("dossier.html.j2").render(**dossier, css=css)


class _Dossier:
    """The statements of each section; see `make_dossier` for the parameters."""

    def __init__(
        self,
        manifest: JsonObject,
        study: Study,
        counts: Mapping[str, int],
        answers: Mapping[str, tuple[str, Any]],
        checks: JsonObject,
        validations: Sequence[JsonObject],
    ) -> None:
        self._manifest, self._study, self._counts = manifest, study, counts
        self._answers, self._checks, self._validations = answers, checks, validations
        self._directory = f"results/{study.name}"
        self._level = OF_MODEL if study.calibration or study.spread else ASSUMED

    def _from_manifest(self, text: str, **paths: str) -> Statement:
        command = f"python -m json.tool {self._directory}/manifest.json"
        return Statement.of(text, "", command, self._manifest, paths)

    def _from_checks(self, text: str, level: str, **paths: str) -> Statement:
        return Statement.of(text, level, self._python(), self._checks, paths)

    def _from_answer(self, question: str, text: str, level: str = "", **paths: str) -> Statement:
        command, answer = self._answers[question]
        return Statement.of(text, level or self._level, command, answer, paths)

    def _python(self, *further: str) -> str:
        arguments = ", ".join(repr(text) for text in (self._directory, *further))
        return f'python -c "from safevar_sumo.report.measurements import print_checks; print_checks({arguments})"'

    def _causes(self) -> Iterator[tuple[str, JsonObject]]:
        """Every minimal cause of the explained failures, and its path in the answer."""
        _, answer = self._answers.get("explain", ("", [None]))
        for index, failure in enumerate(answer[:-1]):
            for number, cause in enumerate(failure["minimal_causes"]):
                yield f"{index}.minimal_causes.{number}", cause

    def scope(self) -> Iterator[Statement]:
        yield self._from_manifest(
            "Vehicle {vehicle}, driving system {ads}, scenario {scenario}.",
            vehicle="study.vehicle.model",
            ads="study.ads.model",
            scenario="study.scenario.model",
        )
        yield Statement(
            "Vehicle and driving system were fitted to published simulations of another simulator; section 4 has how "
            "far they agree, where reference data is given, and the manual's page on trust."
            if self._level == OF_MODEL
            else "No data was fitted, and none was compared: parameters are from their sources or assumed."
        )
        for line in GENERAL_LIMITS:
            yield Statement(f"Limit: {line}")
        for question in self._answers:
            yield Statement(f"Answer of `{question}`: section 7.", self._level)

    def toolchain(self) -> Iterator[Statement]:
        for name in self._manifest["versions"]:
            yield self._from_manifest(f"{name} {{version}}", version=f"versions.{name}")
        for layer in ("network", "sources"):
            for name, digest in self._manifest[layer].items():
                yield self._from_manifest(f"{layer}: {name}, sha256 {digest}...")
        yield self._from_checks(
            "Numbers that go in: {published} published, {fitted} fitted, {assumed} neither, so counted as assumed.",
            "",
            **{name: f"constants.{name}" for name in ("published", "fitted", "assumed")},
        )

    def verification(self) -> Iterator[Statement]:
        if "settings" in self._checks:
            recorded = (
                "compared with the recorded scene" if self._checks["recorded"] else "which moves the actors itself"
            )
            text = f"{{same}} of {{settings}} settings have the same results in SUMO to the bit, {recorded}."
            yield self._from_checks(text, EXACT, same="same_in_sumo", settings="settings")
        for name in ("half_step", "double_step") if "settings" in self._checks else ():
            if "reason" in self._checks[name]:
                yield self._from_checks(
                    f"{name.replace('_', ' the time ').capitalize()}: {{reason}}", "", reason=f"{name}.reason"
                )
                continue
            yield self._from_checks(
                f"With {name.replace('_', ' the time ')} {{same}} of {{settings}} settings end alike; the safety "
                "degree changes by at most {change:.2f} m.",
                "",
                same=f"{name}.same_outcome",
                settings="settings",
                change=f"{name}.largest_change",
            )
        yield Statement(
            "Closed forms and second implementations (metrics, search algorithms, vehicle dynamics) are among the "
            "program's tests: `make test-all` in its sources.",
            EXACT,
        )
        code = user_code_names(self._study)
        yield Statement(
            f"User code ({', '.join(code)}) was tried before the first batch, as `check` does: repeated, in another "
            "order, in smaller batches, alone. A finding ends the study; there was none."
            if code
            else "No user code, so nothing for `check`."
        )

    def validation(self) -> Iterator[Statement]:
        if not self._validations:
            yield Statement("No reference data was given: nothing is validated here.")
        for answer in self._validations:
            command = self._python(answer["file"])
            for part, rows in (("used", "that a fit uses"), ("held_back", "held back from a fit")):
                paths = {"file": "file", "rows": f"{part}.rows"}
                yield Statement.of(f"{{file}}: {{rows}} rows {rows}.", "", command, answer, paths)
                for name, words in MEASURES.items() if answer[part]["rows"] else ():
                    if name == "coverage" and (part == "used" or answer["coverage"] is None):
                        continue
                    path = "coverage.held_back" if name == "coverage" else f"{part}.{name}"
                    value, (definition, side) = value_at(answer, path), words.rsplit(", ", 1)
                    text = f"Rows {rows}: {definition}: {{value:.4g}}{self._beside_threshold(name, value, side)}"
                    yield Statement.of(text, SIMULATED, command, answer, {"value": path})

    def _beside_threshold(self, name: str, value: float | None, side: str) -> str:
        """The user's threshold of a measure, in words; a full stop without one."""
        thresholds = [threshold for key, threshold in self._study.evidence.threshold.items() if key == name]
        if not thresholds:
            return "."
        kept = value is not None and (value <= thresholds[0] if side == "at most" else value >= thresholds[0])
        return f"; declared by the user: {side} {thresholds[0]:g}, which it {'keeps' if kept else 'does not keep'}."

    def uncertainty(self) -> Iterator[Statement]:
        if original := self._checks.get("original"):
            paths, aleatory, epistemic = {"value": "original.safety_degree"}, "unknown", list[str]()
            if original["repeats"] is not None:
                paths["repeats"], aleatory = "original.repeats", "+-{repeats:.3g} m (90 % of repeats)"
            for name in ("half_step", "double_step"):
                if self._checks[name].get("original") is not None:
                    paths[name] = f"{name}.original"
                    epistemic.append(f"{{{name}:.4g}} m with {name.replace('_', ' the time ')}")
            if original.get("lower") is not None:
                paths |= {name: f"original.{name}" for name in ("lower", "upper", "sets", "collisions")}
                epistemic.append("{lower:.4g} to {upper:.4g} m over {sets} fitted sets, {collisions} of which collide")
            text = "The original's safety degree is {value:.4g} m. Aleatory: " + aleatory
            yield self._from_checks(f"{text}. Epistemic: {'; '.join(epistemic) or 'unknown'}.", self._level, **paths)
        for path, cause in self._causes():
            if cause.get("across_fits"):
                text = (
                    f"Epistemic: {', '.join(cause['changes'])}: a cause in {{holds}} of {{sets}} fitted vehicle models."
                )
                paths = {name: f"{path}.across_fits.{name}" for name in ("holds", "sets")}
                yield self._from_answer("explain", text, **paths)
        yield from self._shares()
        if "risk" in self._answers:
            text = "Sampling: the share of unsafe vehicles is {low:.3g} to {high:.3g} ({confidence:.0%} interval)."
            yield self._from_answer("risk", text, low="interval.0", high="interval.1", confidence="confidence")

    def _shares(self) -> Iterator[Statement]:
        """Ranges of the shares of `explain` over the fitted vehicle models."""
        _, answer = self._answers.get("explain", ("", [{}]))
        summary = answer[-1].get("summary", {})
        ranges, prefix = summary.get("across_fits") or {}, "-1.summary"
        shares = {"of the different solutions are unsafe": "unsafe"}
        shares |= {f"of the failures need {name}": f"necessary.{name}" for name in ranges.get("necessary", {})}
        shares |= {
            f"of the collisions: {name.replace('_', ' ')} avoids them": f"preventable.{name}"
            for name in ranges.get("preventable", {})
            if name in summary["preventable"] and name not in ("nobody", "later")
        }
        for words, path in shares.items() if ranges else ():
            paths = {name: f"{prefix}.across_fits.{path}.{key}" for name, key in SHARE_KEYS.items()}
            if value_at(answer, paths["low"]) < value_at(answer, paths["high"]):
                text = f"Epistemic: {{low:.1%}} to {{high:.1%}} {words}, over {{sets}} fitted vehicle models."
                yield self._from_answer("explain", text, **paths)

    def sensitivity(self) -> Iterator[Statement]:
        _, answer = self._answers.get("risk", ("", {}))
        totals = {index: row["total"] for index, row in enumerate(answer.get("sensitivity", ()))}
        indices = sorted((index for index in totals if totals[index] is not None), key=lambda index: -totals[index])
        if not indices:
            yield Statement("Not computed: `evidence --risk` adds it, unless characteristics are correlated.")
        for index in indices[:STRONGEST]:
            keys = {
                "name": "characteristic",
                "alone": "first_order",
                "total": "total",
                "low": "total_interval.0",
                "high": "total_interval.1",
            }
            text = "{name}: {alone:.2f} of the variance alone, {total:.2f} in all ({low:.2f} to {high:.2f})."
            yield self._from_answer("risk", text, **{name: f"sensitivity.{index}.{key}" for name, key in keys.items()})

    def results(self) -> Iterator[Statement]:
        searched = {"simulated": self._counts["evaluations"]}
        text = "The search simulated {number} settings; it proves nothing about those that it did not try."
        command = f"python -m safevar_sumo status {self._directory} --json"
        yield Statement.of(text, "", command, searched, {"number": "simulated"})
        for path, cause in self._causes():
            paths = {f"value_{number}": f"{path}.changes.{name}" for number, name in enumerate(cause["changes"])}
            words = ", ".join(f"{name} {{value_{number}:.4g}}" for number, name in enumerate(cause["changes"]))
            text = f"Enough by themselves: {words} ({{outcome}})."
            yield self._from_answer("explain", text, outcome=f"{path}.outcome", **paths)
        _, tolerance = self._answers.get("tolerance", ("", {"alone": []}))
        for index, row in enumerate(tolerance["alone"]):
            if row["safe"]:
                paths = {
                    "name": f"alone.{index}.characteristic",
                    "low": f"alone.{index}.safe.0",
                    "high": f"alone.{index}.safe.1",
                }
                unit = unit_text(row["unit"])
                text = f"Alone: no unsafe value of {{name}} found from {{low:.4g}} to {{high:.4g}}{unit}."
                yield self._from_answer("tolerance", text, **paths)
        if tolerance.get("joint"):
            text = (
                "All together: {factor:.1%} of the domain, at most {bound:.2%} unsafe with {confidence:.0%} confidence."
            )
            paths = {"factor": "joint.factor", "bound": "joint.unsafe_at_most", "confidence": "joint.confidence"}
            yield self._from_answer("tolerance", text, **paths)
        if "risk" in self._answers:
            yield self._from_answer("risk", "The share of unsafe vehicles is {share:.3g}.", share="probability")
        for question, (command, _) in self._answers.items():
            yield Statement(f"`{question}`: {STATE_WITH[question]}", self._level, command)

    def open_points(self) -> Iterator[Statement]:
        yield Statement("No vehicle was driven: every statement is about models.")
        if not self._validations:
            yield Statement("Reference data is missing: `evidence --reference FILE.csv` adds section 4.")
        if not self._study.evidence.threshold:
            yield Statement("No threshold was declared: [evidence] threshold in the study.")
        for question in STATE_WITH:
            if question not in self._answers and question not in ("rating", "repair"):
                yield Statement(f"`{question}` was not asked.")
        _, explained = self._answers.get("explain", ("", [{}]))
        for index, failure in enumerate(explained[:-1]):
            if (failure["robustness"] or 0.0) < ROBUST:
                changed = ", ".join(failure["changed"])
                text = f"Borderline: {{share:.0%}} of the neighbours of the failure with {changed} are unsafe."
                yield self._from_answer("explain", text, share=f"{index}.robustness")
        if "explain" in self._answers:
            yield Statement("The second vehicle model was not asked about the causes: `opinion`.")
        if not self._study.variation:
            yield Statement("No [variation]: shares are of the domain, not of vehicles in the field.")
        if any(record.get("driven") is False for record in self._last_records()):
            yield Statement(
                "No verdict: the original vehicle never reaches the encounter, or brakes with nobody in sight."
            )
        yield Statement(
            "EU 2022/1426, UN R157 and WP.29/2022/57 are cited as their readers quote them: they were not read in the "
            "original."
        )

    def _last_records(self) -> Iterator[JsonObject]:
        for _, answer in self._answers.values():
            yield answer[-1].get("summary", {}) if isinstance(answer, list) else answer
