"""The command that checks an author's own code."""

from __future__ import annotations

import json

import click
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import json_option
from safevar_sumo.terminal import print_text


@commands.command(name="check")
@click.argument("subject", metavar="SUBJECT")
@click.option("--study", metavar="STUDY", help="Try it in this study.  [default: a study file beside it that names it, else a shipped one]")
@json_option
def check_command(subject: str, study: str | None, as_json: bool) -> int:
    """Check whether your driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller works with this package.

    SUBJECT is package.module:Name, the name of something that is shipped, or a study's name or path, of which everything is checked.
    The exit code is 0 if it passed, 1 with findings, 2 if it cannot be loaded.
    """
    from safevar_sumo.conformance import check

    report = check(subject, study)
    if as_json:
        click.echo(json.dumps(report.to_dict(), indent=2, allow_nan=False))
        return 0 if report.passed else 1
    console = Console()
    for finding in report.findings:
        print_text(console, str(finding))
        print_text(console, f"  expected: {finding.expected}")
        print_text(console, f"  advice: {finding.advice}")
    for remark in (*report.remarks, report.speed):
        if remark:
            print_text(console, f"note: {remark}")
    verdict = "passed" if report.passed else f"{len(report.findings)} finding{'s' * (len(report.findings) > 1)}"
    print_text(console, f"{subject} ({report.kind}): {verdict}, {report.seconds:.1f} s")
    return 0 if report.passed else 1
