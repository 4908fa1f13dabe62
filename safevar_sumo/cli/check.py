"""The command `check`, which tests user code."""

from __future__ import annotations

import json

import click
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import json_option
from safevar_sumo.terminal import print_text


@commands.command(name="check")
@click.argument("subject", metavar="SUBJECT")
@click.option(
    "--study",
    metavar="STUDY",
    help="Study to try SUBJECT in.  [default: a study beside it that names it, else a shipped study]",
)
@json_option
def check_command(subject: str, study: str | None, as_json: bool) -> int:
    """Check whether your driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller works with
    this package.

    SUBJECT is package.module:Name, the name of a shipped model, or the name or path of a study to check everything that
    it names. The exit code is 0 if SUBJECT passes, 1 with findings, 2 if it cannot be loaded.
    """
    from safevar_sumo.plugins.check import check

    report = check(subject, study)
    if as_json:
        click.echo(json.dumps(report.to_dict(), indent=2, allow_nan=False))
        return 0 if report.passed else 1
    console = Console()
    for finding in report.findings:
        print_text(console, str(finding))
        print_text(console, f"  expected: {finding.expected}")
        print_text(console, f"  advice: {finding.advice}")
    if report.remark:
        print_text(console, f"note: {report.remark}")
    verdict = "passed" if report.passed else f"{len(report.findings)} finding{'s' * (len(report.findings) > 1)}"
    print_text(console, f"{subject} ({report.kind}): {verdict}, {report.seconds:.1f} s")
    return 0 if report.passed else 1
