"""Checks of user code as pytest classes, to use in your test files.

```python
from safevar_sumo.testing import AdsChecks


class TestCareful(AdsChecks):
    subject = "my_ads:Careful"
```

Each check is a separate test. `subject` names your code as `package.module:Name`, as a study file does, or is the class
or record itself. `study` is the study in which the subject is tried, by default a study file beside your code that
names the subject.
"""

from __future__ import annotations

from typing import Any, ClassVar

import pytest

from safevar_sumo.plugins.check import CHECKS, Report, check

_REPORTS: dict[tuple[str, str | None], Report] = {}
CHECK_NAMES = tuple(CHECKS)
"""Names of all checks."""


class Checks:
    """All checks of a subject of any kind."""

    subject: ClassVar[Any] = None
    study: ClassVar[str | None] = None
    kind: ClassVar[str] = ""
    """Required kind of the subject; by default any kind."""

    def __init_subclass__(cls, kind: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.kind = kind or cls.kind

    @classmethod
    def report(cls) -> Report:
        """Check the subject, once for each study; returns the report."""
        subject = (
            cls.subject if isinstance(cls.subject, str) else f"{cls.subject.__module__}:{cls.subject.__qualname__}"
        )
        key = subject, cls.study
        if key not in _REPORTS:
            _REPORTS[key] = check(subject, cls.study)
        return _REPORTS[key]

    @pytest.mark.parametrize("check_name", CHECK_NAMES)
    def test_check(self, check_name: str) -> None:
        """Assert that the check has no finding."""
        report = self.report()
        assert self.kind in ("", report.kind), f"{report.subject} is of the kind {report.kind}, not {self.kind}"
        findings = [finding for finding in report.findings if finding.check == check_name]
        assert not findings, "\n".join(
            f"{finding}\n  expected: {finding.expected}\n  advice: {finding.advice}" for finding in findings
        )


class AdsChecks(Checks, kind="ads"):
    """All checks of a driving system."""


class VehicleChecks(Checks, kind="vehicle"):
    """All checks of a vehicle model."""


class ScenarioChecks(Checks, kind="scenario"):
    """All checks of a scenario."""


class MetricChecks(Checks, kind="metric"):
    """All checks of a metric."""


class ObjectiveChecks(Checks, kind="objective"):
    """All checks of an objective that measures changes, such as f_diff."""


class AlgorithmChecks(Checks, kind="algorithm"):
    """All checks of a search algorithm."""


class TraciControllerChecks(Checks, kind="traci"):
    """All checks of a TraCI controller."""


class StudyChecks(Checks, kind="study"):
    """All checks of everything that a study names; `subject` is the study's name or path."""
