"""Checks of your own code as pytest classes, for a test file of yours.

```python
from safevar_sumo.testing import AdsChecks


class TestCareful(AdsChecks):
    subject = "my_ads:Careful"
```

Each check is a test of its own. `subject` is `package.module:Name` as a study names it, or the class or record itself; `study` is a
study to try it in, by default one beside it that names it.
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
    """Every check of a subject of whatever kind."""

    subject: ClassVar[Any] = None
    study: ClassVar[str | None] = None
    kind: ClassVar[str] = ""
    """Kind that the subject must be of; any by default."""

    def __init_subclass__(cls, kind: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.kind = kind or cls.kind

    @classmethod
    def report(cls) -> Report:
        """What `check` finds, found once."""
        name = cls.subject if isinstance(cls.subject, str) else f"{cls.subject.__module__}:{cls.subject.__qualname__}"
        key = name, cls.study
        if key not in _REPORTS:
            _REPORTS[key] = check(name, cls.study)
        return _REPORTS[key]

    @pytest.mark.parametrize("name", ALL)
    def test_check(self, name: str) -> None:
        """No finding of this check."""
        report = self.report()
        assert self.kind in ("", report.kind), f"{report.subject} is of the kind {report.kind}, not {self.kind}"
        findings = [one for one in report.findings if one.check == name]
        assert not findings, "\n".join(f"{one}\n  expected: {one.expected}\n  advice: {one.advice}" for one in findings)


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
