"""``semcal drift``."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import click
import numpy as np

from semcal_ros.bridge.config import MicroscopeConfig
from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import config_option, configured, progress, require_folder
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.drift import DriftTracker, DriftUpdate
from semcal_ros.files.recordings import Frame, open_recording
from semcal_ros.files.tables import DRIFT_COLUMNS, write_csv

__all__ = ["camera_of", "command", "echo_states", "kind_of", "start_time_s"]


_NUMBER = re.compile(r"-?\d[\d.]*")


def camera_of(frame: Frame, model: Calibration | None, config: MicroscopeConfig) -> ScanCamera:
    """The calibrated camera of a frame, or the nominal one of the display width."""
    height, width = frame.image.shape[:2]
    if model is None:
        return ScanCamera.nominal(frame.magnification, width, height, config.display_width_m)
    return model.at(frame.magnification).resized(width, height)


def start_time_s(frame: Frame, first_stamp_ns: int, config: MicroscopeConfig) -> float:
    """Start of the acquisition in seconds after the first frame's stamp."""
    return (frame.stamp_ns - first_stamp_ns) * 1e-9 + config.start_offset_s


def kind_of(update: DriftUpdate) -> str:
    """The status without the numbers of the single frame, so that frames can be counted by kind."""
    return _NUMBER.sub("…", update.status)


def echo_states(states: Counter[str]) -> None:
    """Print how many frames had which kind of drift."""
    for kind, count in states.most_common():
        click.echo(f"{count} frames {kind}")


@click.command("drift")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="CSV file.")
@click.option(
    "--calibration", type=click.Path(path_type=Path), help="Work in rectified coordinates."
)
@config_option
def command(recording: Path, output: Path, calibration: Path | None, config: str) -> None:
    """Drift of the specimen in RECORDING at the centre of each frame, relative to the first one.

    What lay at X in the sem frame is seen at X + drift. Columns: stamp_ns, dx_m, dy_m, sigma_x_m, sigma_y_m,
    dx_px, dy_px (undistorted pixels), status.

    \b
    Example:
      semcal drift recordings/gold --calibration cal.yaml -o drift.csv
    """
    require_folder(output)
    model = None if calibration is None else Calibration.load(calibration)
    microscope = configured(config, model)
    tracker = DriftTracker()
    rows: list[tuple[object, ...]] = []
    states: Counter[str] = Counter()
    first: int | None = None
    with (
        open_recording(recording, microscope) as opened,
        progress(opened.frame_count, "drift") as bar,
    ):
        for frame in opened.frames():
            first = frame.stamp_ns if first is None else first
            camera = camera_of(frame, model, microscope)
            update = tracker.update(
                frame.image,
                start_time_s(frame, first, microscope),
                camera,
                microscope.scan,
            )
            rows.append(_row(frame.stamp_ns, update))
            states[kind_of(update)] += 1
            bar.update(1)
    write_csv(output, DRIFT_COLUMNS, rows)
    if model is None:
        click.echo(
            "note: without --calibration drift is in raw pixels, scaled by the nominal pixel size of "
            f"the display width {microscope.display_width_m:g} m",
            err=True,
        )
    echo_states(states)
    click.echo(f"drift: {output}")


def _row(stamp_ns: int, update: DriftUpdate) -> tuple[object, ...]:
    sigma = np.sqrt(np.diag(update.covariance)[:2])
    return (stamp_ns, *update.drift_m, *sigma, *update.drift_px, update.status)
