"""Checks of your own code as pytest classes, to use in your test files.

```python
from safevar_sumo.testing import AdsChecks


class TestCareful(AdsChecks):
    subject = "my_ads:Careful"
```

Each check is a separate test. `subject` is `package.module:Name` as in a study file, or the class or record itself; `study` is the
study to try it in, by default a study file beside the code that names the subject.
"""

from __future__ import annotations

from typing import Any, ClassVar

import pytest

from safevar_sumo.conformance import Report, check
from safevar_sumo.conformance.finding import ADVICE

_REPORTS: dict[tuple[str, str | None], Report] = {}
ALL = tuple(ADVICE)
"""Names of all checks."""


class Checks:
    """Every check, for a subject of any kind."""

    subject: ClassVar[Any] = None
    study: ClassVar[str | None] = None
    kind: ClassVar[str] = ""
    """Required kind of the subject; any kind by default."""

    def __init_subclass__(cls, kind: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.kind = kind or cls.kind

    @classmethod
    def report(cls) -> Report:
        """The report of `check`, made once for each subject and study."""
        name = cls.subject if isinstance(cls.subject, str) else f"{cls.subject.__module__}:{cls.subject.__qualname__}"
        key = name, cls.study
        if key not in _REPORTS:
            _REPORTS[key] = check(name, cls.study)
        return _REPORTS[key]

    @pytest.mark.parametrize("name", ALL)
    def test_check(self, name: str) -> None:
        """Assert that this check has no finding."""
        report = self.report()
        assert self.kind in ("", report.kind), f"{report.subject} is of the kind {report.kind}, not {self.kind}"
        findings = [finding for finding in report.findings if finding.check == name]
        assert not findings, "\n".join(f"{finding}\n  expected: {finding.expected}\n  advice: {finding.advice}" for finding in findings)


class AdsChecks(Checks, kind="ads"):
    """Every check of a driving system."""


class VehicleChecks(Checks, kind="vehicle"):
    """Every check of a vehicle model."""


class ScenarioChecks(Checks, kind="scenario"):
    """Every check of a scenario."""


class MetricChecks(Checks, kind="metric"):
    """Every check of a metric."""


class ObjectiveChecks(Checks, kind="objective"):
    """Every check of a measure of change."""


class AlgorithmChecks(Checks, kind="algorithm"):
    """Every check of a search algorithm."""


class TraciControllerChecks(Checks, kind="traci"):
    """Every check of a TraCI controller."""


class StudyChecks(Checks, kind="study"):
    """Every check of everything that a study names; `subject` is its name or path."""
