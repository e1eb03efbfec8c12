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

"""``semcal extend``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import PATH, json_option, output_option
from semcal_ros.cli.output import echo_json, echo_notes, echo_table, echo_verdict, show_progress
from semcal_ros.cli.recording_input import check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.ladder.extend import LadderStep
from semcal_ros.core.ladder.matching import RejectedPair
from semcal_ros.core.ladder.thresholds import SETTLED_DRIFT_PX
from semcal_ros.core.wording import counted, omit_numbers
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.extend import RecordingExtension, extend

# Pairs that were left out, and are named.
_MOST_NAMED = 3


@click.command("extend")
@click.argument("calibration", type=PATH)
@recording_input
@output_option("Extended calibration file.")
@json_option
def command(
    calibration: Path,
    recording: RecordedFiles,
    output: Path,
    config: MicroscopeConfig,
    as_json: bool,
) -> None:
    """Extend CALIBRATION beyond its grid by RECORDING: a ladder of magnifications over one flat, textured specimen.

    The ladder begins inside the calibrated range and goes in steps of at most 1.6. At each magnification it has a few
    pictures that are moved by a fifth to a third of the field, and one whose scan is turned by 90 degrees.

    \b
    Example:
      semcal simulate ladder --plan ladder
      semcal extend cal.yaml ladder -o cal_100kx.yaml
    """
    check_outputs([("-o", output, ())], recording=recording)
    with show_progress() as on_progress:
        done = extend(calibration, recording, config=config, on_progress=on_progress)
    done.calibration.save(output)
    if as_json:
        echo_json(_plain(done))
        return
    echo_verdict(done.calibration)
    ladder, whole = done.calibration.ladder, done.calibration.magnification_range
    assert ladder is not None
    low, high = ladder.anchored
    click.echo(f"range: {whole[0]:g}x to {whole[1]:g}x, of which {low:g}x to {high:g}x by the grid")
    echo_steps(done.calibration, done.result.steps)
    # A larger one is a note, with what it may be.
    if done.result.drift_px <= SETTLED_DRIFT_PX:
        last = done.result.steps[-1].magnification
        click.echo(f"drift within a frame at {last:g}x: {done.result.drift_px:.2f} px (1-sigma)")
    for weakness in done.result.weaknesses:
        click.echo(f"note: {weakness}", err=True)
    echo_notes(done.notes)
    echo_pairs(done.result.rejected, done.result.unused)
    click.echo(f"calibration: {output}")


def echo_steps(calibration: Calibration, steps: Sequence[LadderStep]) -> None:
    """Print what a ladder has at each magnification, and how well nm per pixel is known there."""
    rows = []
    for step in steps:
        camera = calibration.at(step.magnification)
        size, sigma = camera.rectified.pixel_size_m[0], max(camera.rectified.pixel_size_sigma_m)
        rows.append(
            [
                f"{step.magnification:g}",
                str(step.pictures),
                str(step.turned),
                str(step.pairs + step.pairs_below),
                f"{step.rms_px:.3f}",
                f"{1e9 * size:.5g}",
                f"{100.0 * sigma / size:.2f} %",
            ]
        )
    echo_table(
        ["magnification", "pictures", "turned", "pairs", "RMS px", "nm per px", "1-sigma"], rows
    )


def echo_pairs(rejected: Sequence[RejectedPair], unused: Sequence[str]) -> None:
    """Print which pictures and pairs were not used, each reason once."""
    if unused:
        listed = ", ".join(unused[:_MOST_NAMED])
        click.echo(f"not used: {counted(len(unused), 'picture')}: {listed}", err=True)
    kinds: dict[str, list[str]] = {}
    for pair in rejected:
        kinds.setdefault(omit_numbers(pair.reason), []).append(f"{pair.first} with {pair.second}")
    for reason, pairs in kinds.items():
        more = f" and {len(pairs) - _MOST_NAMED} more" if len(pairs) > _MOST_NAMED else ""
        click.echo(f"not matched: {', '.join(pairs[:_MOST_NAMED])}{more}: {reason}", err=True)


def _plain(done: RecordingExtension) -> dict[str, object]:
    result, ladder = done.result, done.calibration.ladder
    assert ladder is not None
    return {
        "magnification_range": list(done.calibration.magnification_range),
        "grid_range": list(ladder.anchored),
        "growth": ladder.growth,
        "relays": [
            {"low": relay.low, "high": relay.high, "jump": relay.jump} for relay in ladder.relays
        ],
        "steps": [
            {
                "magnification": step.magnification,
                "pictures": step.pictures,
                "turned": step.turned,
                "pairs": step.pairs,
                "pairs_below": step.pairs_below,
                "rms_px": step.rms_px,
                "pixel_size_m": list(done.calibration.at(step.magnification).pixel_size_m),
                "pixel_size_sigma_m": list(
                    done.calibration.at(step.magnification).pixel_size_sigma_m
                ),
            }
            for step in result.steps
        ],
        "tilt_rad": result.tilt_rad,
        "tilt_sigma_rad": result.tilt_sigma_rad,
        "drift_px": result.drift_px,
        "variance_factor": result.variance_factor,
        "weaknesses": list(result.weaknesses),
        "rejected": [
            {"first": pair.first, "second": pair.second, "reason": pair.reason}
            for pair in result.rejected
        ],
        "unused": list(result.unused),
        "notes": list(done.notes),
    }
