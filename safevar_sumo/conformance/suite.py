"""The checks of a subject, one after the other."""

from __future__ import annotations

import pickle
import re
import shlex
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from safevar_sumo.ads import ScalarAds
from safevar_sumo.conformance.finding import ADVICE, BLOCKING_CHECKS, Finding, Report
from safevar_sumo.conformance.measures import PROBES
from safevar_sumo.conformance.models import StudyProbe
from safevar_sumo.conformance.probe import Indices, Outputs, Probe, measure_time, target_of
from safevar_sumo.conformance.source import Source
from safevar_sumo.conformance.subject import Subject, contract_violation, find_subject, subjects_of
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins import UserCodeTimeout, guard_process_state, time_limit
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, load_study, study_names

RUN_LIMIT = 6.0
"""Longest time of a run of a probe, without imports [s]; after it the subject counts as hung."""
COST_LIMIT = 1e-3
"""Time per vehicle and step above which a subject counts as slow [s]: 1,000 simulations then take minutes."""
VEHICLES_ALONE = 2
"""Number of vehicles that also run alone."""
CONTRACT_FILES = {"ads": "ads/base.py", "vehicle": "vehicles/base.py", "scenario": "scenarios/base.py", "metric": "metrics/base.py",
         "objective": "vehicles/characteristics.py", "algorithm": "search/base.py", "traci": "sumo/traci_controller.py",
         "constraint": "vehicles/region.py"}
"""File of the contract by kind of subject."""


def check(name: str, study: str | None = None) -> Report:
    """Check a subject, or everything that a study names.

    Parameters
    ----------
    name
        `package.module:Name`, the name of a shipped subject, or the name or path of a study.
    study
        The study to try a subject in.

    Raises
    ------
    InputError
        If the subject or the study cannot be loaded.
    """
    start = time.perf_counter()
    if ":" not in name and (name in study_names() or name.endswith(".toml")):
        if study is not None:
            raise InputError("study", f"{study!r}: {name!r} is a study itself", "a study to try a model, metric or algorithm in")
        report = Report(subject=name, kind="study")
        for single in check_study(load_study(name)):
            report.findings += single.findings
            report.remarks += [f"{single.kind} {single.subject}: {remark}" for remark in (*single.remarks, single.speed) if remark]
    else:
        report = check_subject(find_subject(name, study))
    report.seconds = time.perf_counter() - start
    return report


def check_study(study: Study, *, only_user_code: bool = False) -> Iterator[Report]:
    """Check all subjects that a study names, but simulate the study only once. Raises the errors of `check_subject`."""
    subjects = [subject for subject in subjects_of(study) if subject.is_user_code or not only_user_code]
    order = ("traci", "scenario", "ads", "vehicle")
    models = sorted((subject for subject in subjects if subject.kind in order),
                    key=lambda subject: (not subject.is_user_code, order.index(subject.kind)))
    for subject in subjects:
        yield check_subject(subject, with_study=subject in models[:1])


def refuse_defects(study: Study) -> list[str]:
    """Check the user code that a study names; returns the warnings.

    Raises
    ------
    UserCodeError
        With file, line and advice of the first finding that makes results wrong.
    """
    remarks = []
    for report in check_study(study, only_user_code=True):
        for finding in report.findings:
            location = f"{finding.file}:{finding.line}"
            problem = f"{report.key} {finding.got}{'' if location in finding.got else f' ({location})'}"
            if finding.check in BLOCKING_CHECKS:
                command = f"{PROGRAM_COMMAND} check {shlex.quote(study.origin.called or study.name)}"
                raise UserCodeError(study.source, f"{problem}; to reproduce it: {command}", f"{finding.expected}; {finding.advice}")
            remarks.append(f"{problem}; expected: {finding.expected}")
    return remarks


def check_subject(subject: Subject, *, with_study: bool = True) -> Report:
    """Check one subject; `with_study` also simulates its study.

    Raises
    ------
    InputError
        If the subject does not take its parameters, or its study cannot be assembled.
    """
    report = Report(subject=subject.name, kind=subject.kind, key=subject.key, remarks=list(subject.remarks))
    start, suite = time.perf_counter(), _Suite(subject, with_study)
    with guard_process_state("check", [subject.name]):
        report.findings += suite.findings()
    report.speed, report.seconds = suite.speed, time.perf_counter() - start
    return report


ADVICE_ON_FMUS = {
    "determinism": "let the FMU draw nothing at random and ask no clock", "state": "let its reset bring everything back to its start",
    "batch": "let its instances share nothing", "finite": "limit what the FMU divides by; a max of an input limits infinite gaps",
    "reaction": "look at the table of inputs and outputs, and at units and signs"}
"""Advice on findings in an FMU by check, in place of `ADVICE`."""


class _Suite:
    def __init__(self, subject: Subject, with_study: bool) -> None:
        self._subject, self._source = subject, Source(subject.member)
        self._probes = [probe for probe in PROBES[subject.kind] if with_study or probe is not StudyProbe]
        self.speed, self._run_time = "", 0.0

    def findings(self) -> Iterator[Finding]:
        """The findings on the subject; no probe runs after a probe with findings."""
        violation, expected = contract_violation(self._subject)
        if violation:
            yield self._finding("contract", violation, expected, self._source.location_of_definition(*_method_names(violation)))
            return
        for probe_type in self._probes:
            has_findings = False
            for finding in self._findings_of(probe_type):
                has_findings = True
                yield finding
            if has_findings:
                break
        yield from self._pickling_findings()

    def _findings_of(self, probe_type: type[Probe]) -> Iterator[Finding]:
        try:
            with np.errstate(all="ignore"):
                probe = probe_type(self._subject)
                with self._source.watch_returns(), time_limit(RUN_LIMIT):
                    model = probe.load()
                    outputs = probe.run(model, np.arange(probe.vehicle_count))
                findings = list(self._compare_runs(probe, model, outputs))
                if not findings:
                    with self._source.watch_returns(), time_limit(RUN_LIMIT):
                        findings = [self._finding(missing.check, missing.got, missing.expected,
                                                  self._source.location_of_definition(*missing.methods))
                                    for missing in probe.missing_reactions(model, outputs)]
                    findings += self._cost_findings(probe, model)
            yield from findings
        except UserCodeError as error:
            yield self._error_finding(error)
        except UserCodeTimeout as error:
            location = self._source.location_of_error(error)
            yield self._finding("speed", f"does not return within {RUN_LIMIT:g} s", "microseconds per vehicle and step", location)
        except InputError as error:
            if self._subject.kind == "vehicle" and "vehicle.characteristics" in error.problem:
                location = self._source.location_of_text(r"\bUNITS\b") or self._source.last_location
                yield self._finding("units", error.problem, error.legal, location)
            elif self._subject.kind == "vehicle" and error.source == "vehicle":
                yield self._finding("finite", error.problem, error.legal, self._source.last_location)
            elif self._subject.kind in ("metric", "objective") and error.source == "check":
                yield self._finding("contract", error.problem, error.legal, self._source.location_of_definition())
            else:
                raise

    def _compare_runs(self, probe: Probe, model: Any, outputs: Outputs) -> Iterator[Finding]:
        """A finding if a repeated run, or a run of some of the vehicles, gives other results than the first run of all vehicles."""
        vehicles = np.arange(probe.vehicle_count)
        difference = _difference(outputs, probe.run(probe.load(), vehicles), vehicles)
        if difference:
            yield self._difference_finding("determinism", probe, f"{difference} when the run is repeated", "the same, to the bit")
            return
        repetition: dict[str, Outputs] = {}
        self._run_time = measure_time(lambda: repetition.update(outputs=probe.repeat(model, vehicles)))
        difference = _difference(outputs, repetition["outputs"], vehicles)
        if difference:
            yield self._difference_finding("state", probe, f"{difference} in a second run", "the same as in the first run, to the bit")
            return
        if probe.vehicle_count == 1:
            return
        alone = np.linspace(0, len(vehicles) - 1, VEHICLES_ALONE).astype(int)
        groupings: dict[str, list[Indices]] = {"in another order": [vehicles[::-1]], "in two halves": np.array_split(vehicles, 2),
                                               "alone": [vehicles[i:i + 1] for i in alone]}
        for grouping, groups in groupings.items():
            for group in groups:
                difference = _difference({name: values[..., group] for name, values in outputs.items()}, probe.run(model, group), group)
                if difference:
                    suspects_state = self._source.location_of_suspect("state") and not self._source.location_of_suspect("batch")
                    check = "state" if suspects_state else "batch"
                    yield self._difference_finding(check, probe, f"{difference} {grouping}", "the same as all together, to the bit")
                    return

    def _difference_finding(self, check: str, probe: Probe, got: str, expected: str) -> Finding:
        location = self._source.location_of_suspect(check) or self._source.location_of_definition(*probe.methods)
        return self._finding(check, got, expected, location)

    def _cost_findings(self, probe: Probe, model: Any) -> Iterator[Finding]:
        seconds, sentence = probe.cost(model, self._run_time)
        self.speed = self.speed or sentence
        limit = COST_LIMIT * (10 if self._subject.kind == "traci" else 1)  # this includes the time of SUMO
        if seconds > limit:
            yield self._finding("speed", sentence, f"below {limit * 1e6:g} microseconds per vehicle and step",
                                self._source.location_of_definition(*probe.methods))

    def _pickling_findings(self) -> Iterator[Finding]:
        """A finding if the object cannot be pickled for a worker process; a metric or objective is pickled as its function."""
        if self._subject.member.file:
            return  # an FMU is sent as a file
        target = target_of(self._subject)
        payload: Any = target
        if isinstance(target, type) and self._subject.kind != "traci":
            try:
                payload = target(**self._subject.parameters)
            except Exception:
                payload = target  # the probes have instantiated it with parameters
        if getattr(payload, "function", None) is not None and self._subject.kind in ("metric", "objective"):
            payload = payload.function
        try:
            pickle.dumps(payload)
        except Exception as error:
            problem = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            location = self._source.location_of_definition(*["__init__"] if isinstance(target, type) else [])
            yield self._finding("picklable", problem, "an object that pickle can send to a worker process", location)

    def _error_finding(self, error: UserCodeError) -> Finding:
        """The finding for an error that a guard raised."""
        text = error.problem.removeprefix(f"{self._subject.key} ")
        if "returned" in text:  # the finding has the line already
            text = re.sub(r" \([^()]*:\d+\)$", "", text)
        is_not_finite = any(f"= {value} from" in text for value in ("nan", "inf", "-inf")) if "returned" in text else any(
            name in text for name in ("ZeroDivisionError", "OverflowError", "FloatingPointError", "math domain"))
        check = "inputs" if "read-only" in text else "finite" if is_not_finite else "contract"
        expected = error.legal or "no exception"
        if check == "inputs":
            expected = "arguments that stay as they are"
        return self._finding(check, text, expected, self._source.location_of_error(error))

    def _finding(self, check: str, got: str, expected: str, location: tuple[str, int]) -> Finding:
        advice = ADVICE[check].format(base=CONTRACT_FILES[self._subject.kind])
        if self._subject.member.file:
            advice = ADVICE_ON_FMUS.get(check, "see the tutorial on FMUs")
        elif check == "contract" and self._subject.kind == "ads" and isinstance(self._subject.member.target, type) \
                and not issubclass(self._subject.member.target, ScalarAds):
            advice += "; an ADS for one vehicle derives from safevar_sumo.ads.ScalarAds"
        file, line = location
        return Finding(check=check, file=file, line=line, expected=expected, got=got, advice=advice)


def _method_names(problem: str) -> tuple[str, ...]:
    """The names of methods in a violation of the contract."""
    words = problem.replace("(", " ").split()
    return tuple(words[i + 1] for i, word in enumerate(words[:-1]) if word in ("method", "has"))


def _difference(outputs: Outputs, other_outputs: Outputs, vehicles: Indices) -> str:
    """The first result that differs, with its vehicle and both values; "" if all results are equal to the bit."""
    for name, values in outputs.items():
        other_values = other_outputs[name]
        if values.shape != other_values.shape:
            return f"{name} has shape {other_values.shape}, not {values.shape},"
        is_same = values == other_values
        if values.dtype.kind != "U":
            is_same |= np.isnan(values) & np.isnan(other_values)
        if not is_same.all():
            index = tuple(np.argwhere(~is_same)[0])
            return f"{name} of vehicle {vehicles[index[-1]]} is {other_values[index]} instead of {values[index]}"
    return ""

