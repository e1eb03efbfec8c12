"""``semcal drift``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import (
    config_option,
    configured,
    progress,
    require_folder,
    require_suffix,
)
from semcal_ros.cli.drift_common import (
    echo_nominal_unit,
    echo_states,
    forecast_text,
    frame_time_option,
    live_option,
    rate_text,
)
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.recordings import Recording, open_recording
from semcal_ros.files.tables import DRIFT_COLUMNS, write_csv
from semcal_ros.workflows.follow_drift import (
    GIVE_FRAME_TIME,
    Follower,
    camera_of,
    start_time_s,
    timing_seen,
    with_frame_time,
)

__all__ = ["command"]

_PLOT_SUFFIXES = (".png", ".svg", ".pdf")


@click.command("drift")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="CSV file.")
@click.option(
    "--calibration", type=click.Path(path_type=Path), help="Work in rectified coordinates."
)
@click.option("--plot", type=click.Path(path_type=Path), help="Figure as png, svg or pdf, too.")
@click.option(
    "--forecast",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="S",
    help="Also tell the drift that long after the last frame.",
)
@live_option
@config_option
@frame_time_option
def command(
    recording: Path,
    output: Path,
    calibration: Path | None,
    plot: Path | None,
    forecast: float | None,
    live: bool,
    config: str,
    frame_time: float | None,
) -> None:
    """Drift of the specimen in RECORDING at the centre of each frame, relative to the first one.

    What lay at X in the sem frame is seen at X + drift. Columns: stamp_ns, dx_m, dy_m, sigma_x_m, sigma_y_m,
    dx_px, dy_px (undistorted pixels), status.

    \b
    Example:
      semcal drift recordings/gold --calibration cal.yaml -o drift.csv --plot drift.png
    """
    require_folder(output)
    _check_plot(plot, output)
    model = None if calibration is None else Calibration.load(calibration)
    microscope = with_frame_time(configured(config, model), frame_time)
    with open_recording(recording, microscope) as opened:
        stamps_ns, follower = _followed(opened, model, microscope)
        seen, note = timing_seen(microscope, follower, model)
        if seen is not microscope and live:
            note += f"; {GIVE_FRAME_TIME}"  # live, nobody could have known
        elif seen is not microscope:
            stamps_ns, follower = _followed(opened, model, seen)
        notes = [*opened.notes, *([note] if note else [])]
    path = follower.path(live=live)
    write_csv(output, DRIFT_COLUMNS, _rows(stamps_ns, path))
    if plot is not None:
        _write_plot(path, plot)
    for note in notes:
        click.echo(f"note: {note}", err=True)
    if model is None:
        echo_nominal_unit(microscope, "drift is in raw pixels, scaled by the nominal pixel size")
    echo_states(Counter(u.kind for u in follower.updates))
    if len(path) > 1:
        click.echo(rate_text(path))
    if forecast is not None:
        then_s = float(path.time_s[-1]) + forecast
        click.echo(forecast_text(follower.tracker.predictor().at(then_s), forecast))
    click.echo(f"drift: {output}")
    if plot is not None:
        click.echo(f"plot: {plot}")


def _check_plot(plot: Path | None, output: Path) -> None:
    if plot is None:
        return
    require_suffix(plot, _PLOT_SUFFIXES, "--plot")
    if plot.absolute() == output.absolute():
        raise InvalidValueError(f"{plot} for both table and plot", expected="two files")
    require_folder(plot)


def _followed(
    opened: Recording, model: Calibration | None, microscope: MicroscopeConfig
) -> tuple[list[int], Follower]:
    """Stamps of all frames, and their drift."""
    follower = Follower()
    stamps_ns: list[int] = []
    with progress(opened.frame_count, "drift") as bar:
        for frame in opened.frames():
            stamps_ns.append(frame.stamp_ns)
            camera = camera_of(frame, model, microscope)
            time_s = start_time_s(frame, stamps_ns[0], microscope)
            follower.update(frame, time_s, camera, microscope.scan)
            bar.update(1)
    return stamps_ns, follower


def _rows(stamps_ns: Sequence[int], path: DriftPath) -> list[tuple[object, ...]]:
    sigma_m = path.sigma_m
    return [
        (stamp_ns, *path.drift_m[k], *sigma_m[k], *path.drift_px[k], path[k].status_text)
        for k, stamp_ns in enumerate(stamps_ns)
    ]


def _write_plot(path: DriftPath, file: Path) -> None:
    # Here, so that those who want no plot do not wait for matplotlib.
    from semcal_ros.report.drift_figures import write_drift_figure

    write_drift_figure(path, file)
