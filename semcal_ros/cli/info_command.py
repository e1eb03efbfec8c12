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

"""``semcal info``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import json_option
from semcal_ros.cli.output import echo_json, echo_notes, echo_table, show_progress
from semcal_ros.cli.recording_input import recording_input, refuse_mask
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.conditions import describe_condition, format_time
from semcal_ros.core.camera.records import NOT_RECORDED
from semcal_ros.core.wording import counted, printable
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.describe_calibration import describe_calibration
from semcal_ros.workflows.describe_recording import (
    GreyLevels,
    Intervals,
    RecordingSummary,
    describe_recording,
)

# A sweep has as many magnifications as frames: of more than this, the middle ones are left out.
_MOST_ROWS = 24


@click.command("info")
@recording_input
@json_option
def command(recording: RecordedFiles, config: MicroscopeConfig, as_json: bool) -> None:
    """What RECORDING contains: frames, scale, times, grey levels, and how it was taken.

    Of a calibration file: where it comes from, its range, conditions and warnings.

    \b
    Example:
      semcal info recordings/grid
      semcal info 'scan_*.tif' --json
      semcal info cal.yaml
    """
    refuse_mask(recording, "--mask for the commands that measure")
    if len(recording.paths) == 1 and _is_calibration(recording.paths[0]):
        described = describe_calibration(Calibration.load(recording.paths[0]))
        if as_json:
            echo_json(described)
        else:
            _echo_calibration(described)
        return
    with show_progress() as on_progress:
        found = describe_recording(recording, config=config, on_progress=on_progress)
    if as_json:
        echo_json(found.summary())
        return
    if found.topics:
        echo_table(
            ["topic", "type", "messages"], [[t.name, t.type, str(t.count)] for t in found.topics]
        )
    _echo_frames(found)
    _echo_settings(found)
    if found.intervals is not None:
        _echo_intervals(found.intervals)
    _echo_pixels(found)
    for name, values in found.conditions.items():
        click.echo(": ".join(describe_condition(name, values)))
    echo_notes(found.notes)


def _is_calibration(path: Path) -> bool:
    # The only other YAML file of ours is that in a bag.
    return (
        path.suffix.lower() in (".yaml", ".yml") and path.name != "metadata.yaml" and path.is_file()
    )


def _anchor_row(ladder: dict[str, Any] | None, method: str) -> list[tuple[str, str]]:
    """What of the range comes from where; no row where all of it comes from a grid."""
    if ladder is None:
        return []
    low, high = ladder["anchored"]
    if method == "specimen":
        return [
            ("  origin", f"a specimen, its scale from a size that was known at {low:g}x"),
        ]
    return [("  origin", f"{low:g}x to {high:g}x a grid, the rest a specimen")]


def _echo_calibration(known: Mapping[str, Any]) -> None:
    def show_known(name: str, show: Callable[[Any], str] = str) -> str:
        value = known[name]
        return NOT_RECORDED if value is None else show(value)

    low, high = known["magnification_range"]
    rows = [
        ("method", known["method"]),
        ("calibrated", show_known("calibrated", "{} UTC".format)),
        ("software", show_known("software_version", "semcal_ros {}".format)),
        ("recording", show_known("recording")),
        ("  SHA-256", show_known("recording_sha256")),
        (
            "  recorded",
            show_known("recorded", lambda dates: " to ".join(dict.fromkeys(dates)) + " UTC"),
        ),
        ("configuration", show_known("configuration")),
        ("  SHA-256", show_known("configuration_sha256")),
        (
            "range",
            f"{low:g}x to {high:g}x, {counted(len(known['magnifications']), 'magnification')}",
        ),
        *_anchor_row(known["ladder"], known["method"]),
        ("image", f"{known['image_width_px']} x {known['image_height_px']} px"),
        ("display width", f"{known['display_width_m']:g} m"),
        ("squares", show_known("squares_m", lambda s: ", ".join(f"{1e6 * v:g} um" for v in s))),
        ("certificate", show_known("grid_certificate")),
        ("views", show_known("views_used")),
        ("corners", show_known("corners")),
        ("RMS", show_known("rms_px", lambda v: f"{v:.4f} px")),
    ]
    if known["conditions"] is None:
        rows.append(("conditions", NOT_RECORDED))
    else:
        rows += [describe_condition(name, values) for name, values in known["conditions"].items()]
    width = max(len(label) for label, _ in rows) + 2
    click.echo(known["verdict"])
    for label, text in rows:
        click.echo(printable(f"{label:{width}}{text}"))
    if known["warnings"] is None:
        click.echo(f"{'warnings':{width}}{NOT_RECORDED}")
    else:
        click.echo(f"{'warnings':{width}}{len(known['warnings']) or 'none'}")
    for warning in known["warnings"] or ():
        click.echo(printable(f"  {warning}"))


def _echo_frames(found: RecordingSummary) -> None:
    size = "" if found.file_bytes is None else f", {_format_bytes(found.file_bytes)}"
    click.echo(f"{counted(found.frame_count, 'frame')} over {found.duration_s:.3f} s{size}")
    for kind, count in found.kinds.items():
        click.echo(f"  {count} x {kind}")
    if found.first_time is None:
        click.echo("dates: none (the stamps are not those of a calendar)")
    else:
        click.echo(f"dates: {found.first_time} to {found.last_time}")


def _echo_settings(found: RecordingSummary) -> None:
    rows = [
        [
            f"{s.magnification:.6g}",
            f"{1e6 * s.field_width_m:.5g}",
            f"{1e9 * s.pixel_size_m:.5g}",
            str(s.frames),
            str(s.visits),
        ]
        for s in found.settings
    ]
    if len(rows) > _MOST_ROWS:
        kept = _MOST_ROWS // 2
        rows = [*rows[:kept], ["..."] * len(rows[0]), *rows[-kept:]]
    if rows:
        echo_table(["magnification", "field um", "nm per px", "frames", "visits"], rows)
    if len(rows) > 1:
        low, high = found.magnifications[0], found.magnifications[-1]
        number = counted(len(found.settings), "magnification")
        click.echo(f"{number}, {low:g} to {high:g}")
    click.echo(f"scale: {found.scale_source}")


def _echo_intervals(times: Intervals) -> None:
    click.echo(
        f"interval: median {format_time(times.median_s)}, {format_time(times.least_s)} to "
        f"{format_time(times.greatest_s)}{'' if times.regular else ' (not regular)'}"
    )
    if times.gaps:
        click.echo(f"gaps: {times.gaps}, as if {counted(times.missing, 'frame')} were missing")
    if times.equal_stamps:
        click.echo(f"equal stamps: {counted(times.equal_stamps, 'frame')}")
    if times.backwards:
        click.echo(f"time runs backwards at {counted(times.backwards, 'frame')}")


def _echo_pixels(found: RecordingSummary) -> None:
    if found.equal_pixels:
        click.echo(
            f"equal pixels: {found.equal_pixels} of {counted(found.compared, 'frame')} compared with "
            "the one before"
        )
    sampled = (
        "" if found.decoded == found.frame_count else f", of {found.decoded} frames that were read"
    )
    for levels in found.grey_levels:
        click.echo(f"grey levels: {_describe_levels(levels)}{sampled}")


def _describe_levels(levels: GreyLevels) -> str:
    span = f"{levels.lowest:g} to {levels.highest:g}"
    if levels.used_bits is None:
        return f"{span}, {levels.stored_bits} bit floating point"
    bits = f"{levels.stored_bits} bit"
    if levels.used_bits < levels.stored_bits:
        bits += f", of which {levels.used_bits} are used"
    ends = [
        f"{part:.2%} {name}"
        for part, name in (
            (levels.black_fraction, "black"),
            (levels.white_fraction, "saturated"),
        )
        if part >= 5e-5  # what rounds to 0.01 %
    ]
    return ", ".join([f"{span} ({bits})", *ends])


def _format_bytes(count: int) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return counted(count, "byte")
