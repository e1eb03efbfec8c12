"""``semcal doctor``."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from semcal_ros.bridge.names import absolute_namespace
from semcal_ros.cli.options import config_option
from semcal_ros.cli.output import echo_json
from semcal_ros.doctor.diagnosis import diagnose
from semcal_ros.doctor.findings import Finding, Severity

__all__ = ["command"]


@click.command("doctor")
@config_option
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Calibration to check, instead of the one on the topic `calibration`.",
)
@click.option(
    "--namespace",
    default="/sem",
    show_default=True,
    help="Namespace of the suite's nodes and topics.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(0.1, 3600.0),
    default=3.0,
    show_default=True,
    help="How long to listen; choose more than one frame takes.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    config: str, calibration: Path | None, namespace: str, seconds: float, as_json: bool
) -> None:
    """Look for what keeps a live stream from working, and say what to do.

    One line for each check: ok, note or problem. The exit status is 1 if there is a problem.

    \b
    Example:
      semcal doctor --config jsm820 --calibration cal.yaml --seconds 10
    """
    found = diagnose(config, calibration, absolute_namespace(namespace), seconds)
    if as_json:
        echo_json({"findings": [_as_dict(finding) for finding in found], **_count_levels(found)})
    else:
        for finding in found:
            click.echo(f"{finding.level.value:<8} {finding}")
        click.echo(", ".join(f"{count} {name}" for name, count in _count_levels(found).items()))
    if any(finding.level is Severity.PROBLEM for finding in found):
        sys.exit(1)


def _count_levels(found: list[Finding]) -> dict[str, int]:
    levels = [finding.level for finding in found]
    return {
        "problems": levels.count(Severity.PROBLEM),
        "notes": levels.count(Severity.NOTE),
        "ok": levels.count(Severity.OK),
    }


def _as_dict(finding: Finding) -> dict[str, str]:
    return {
        "level": finding.level.value,
        "subject": finding.subject,
        "seen": finding.seen,
        "expected": finding.expected,
        "do": finding.do,
    }
