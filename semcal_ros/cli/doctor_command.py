# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""``semcal doctor``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.bridge.fields import absolute_namespace
from semcal_ros.cli.options import PATH, config_option, json_option, options_of
from semcal_ros.cli.output import echo_json
from semcal_ros.core.wording import counted
from semcal_ros.doctor.diagnosis import diagnose
from semcal_ros.doctor.findings import CheckResult, Severity, explain_figures
from semcal_ros.doctor.recording import diagnose_recording
from semcal_ros.files.images.image_series import refuse_images
from semcal_ros.workflows.options import Option

_ORDER = (Severity.PROBLEM, Severity.NOTE, Severity.OK)


@dataclass(frozen=True)
class DoctorOptions:
    """Where to look, and for how long."""

    calibration: Annotated[
        Path | None,
        Option(
            "Calibration to check, instead of the one on the topic `calibration`.",
            kind="path of a file",
        ),
    ] = None
    namespace: Annotated[str, Option("Namespace of the suite's nodes and topics.")] = "/sem"
    seconds: Annotated[
        float,
        Option("How long to listen; choose more than one frame takes.", kind="time to listen"),
    ] = 3.0


@click.command("doctor")
@click.argument("recording", type=PATH, required=False)
@config_option
@options_of(DoctorOptions)
@json_option
def command(recording: Path | None, config: str, options: DoctorOptions, as_json: bool) -> None:
    """Look for what keeps a live stream from working, or is wrong with a RECORDING, and say what to do.

    One line for each check, problems first: problem, note or ok. The exit status is 1 if there is a problem.

    \b
    Example:
      semcal doctor --config jsm820 --calibration cal.yaml --seconds 10
      semcal doctor recording --calibration cal.yaml
    """
    if recording is None:
        namespace = absolute_namespace(options.namespace)
        found = diagnose(config, options.calibration, namespace, options.seconds)
    else:
        refuse_images(recording)
        found = diagnose_recording(recording, config, options.calibration)
    if as_json:
        echo_json({"findings": [_as_dict(finding) for finding in found], **_count_levels(found)})
    else:
        click.echo(_sum_up(_count_levels(found)))
        # Who looks for help reads the first lines.
        for finding in sorted(found, key=lambda finding: _ORDER.index(finding.level)):
            click.echo(f"{finding.level.value:<8} {finding}")
        for text in explain_figures(found):
            click.echo(f"         {text}")
    if any(finding.level is Severity.PROBLEM for finding in found):
        sys.exit(1)


def _count_levels(found: list[CheckResult]) -> dict[str, int]:
    levels = [finding.level for finding in found]
    return {
        "problems": levels.count(Severity.PROBLEM),
        "notes": levels.count(Severity.NOTE),
        "ok": levels.count(Severity.OK),
    }


def _sum_up(levels: dict[str, int]) -> str:
    return f"{counted(levels['problems'], 'problem')}, {counted(levels['notes'], 'note')}, {levels['ok']} ok"


def _as_dict(finding: CheckResult) -> dict[str, str]:
    return {
        "level": finding.level.value,
        "subject": finding.subject,
        "seen": finding.seen,
        "expected": finding.expected,
        "do": finding.do,
    }
