"""``semcal rectify``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import click

from semcal_ros.bridge.calibration_text import fill_calibration_text
from semcal_ros.bridge.camera_info import fill_camera_info
from semcal_ros.bridge.drift import fill_drift, fill_drift_velocity
from semcal_ros.bridge.headers import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.bridge.projection import fill_projection
from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import config_option, configured, overwrite_option, progress
from semcal_ros.cli.drift_common import echo_states, frame_time_option
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.recordings import RecordedFrame, open_recording
from semcal_ros.workflows.follow_drift import (
    GIVE_FRAME_TIME,
    Follower,
    camera_of,
    start_time_s,
    timing_seen,
    with_frame_time,
)

__all__ = ["command"]

_TOPICS = {
    "image_rect": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "magnification": "std_msgs/msg/Float64",
    "drift": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "drift_velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "projection": "std_msgs/msg/Float64MultiArray",
    "calibration": "std_msgs/msg/String",
}
_LATCHED = ("projection", "calibration")


class _Output:
    """Writes corrected frames to a bag, one message of each kind per frame."""

    def __init__(self, writer: BagWriter, namespace: str, model: Calibration) -> None:
        self._writer = writer
        self._namespace = namespace
        self._model = model
        self._magnification: float | None = None

    def _write(self, topic: str, log_time_ns: int, message: Any) -> None:
        name = f"{self._namespace}/{topic}"
        latched = topic in _LATCHED
        self._writer.add_topic(name, _TOPICS[topic], latched=latched, depth=1 if latched else 10)
        self._writer.write(name, log_time_ns, message)

    def frame(
        self, frame: RecordedFrame, image: Any, camera: ScanCamera, update: DriftUpdate | None
    ) -> None:
        header = blank_message("std_msgs/msg/Header")
        fill_header(header, frame.stamp_ns, frame.frame_id)
        when = frame.log_time_ns
        if frame.magnification != self._magnification:
            self._on_change(frame, camera)
        rectified = blank_message(_TOPICS["image_rect"])
        fill_image(rectified, image, frame.encoding, header)
        self._write("image_rect", when, rectified)
        info = blank_message(_TOPICS["camera_info"])
        fill_camera_info(info, camera, header, image.shape[1], image.shape[0])
        self._write("camera_info", when, info)
        if update is not None:
            drift = blank_message(_TOPICS["drift"])
            fill_drift(drift, update.drift_m, update.covariance, header)
            self._write("drift", when, drift)
            velocity = blank_message(_TOPICS["drift_velocity"])
            fill_drift_velocity(velocity, update.velocity_m_s, update.covariance, header)
            self._write("drift_velocity", when, velocity)

    def _on_change(self, frame: RecordedFrame, camera: ScanCamera) -> None:
        if self._magnification is None:
            text = blank_message(_TOPICS["calibration"])
            fill_calibration_text(text, self._model.dumps())
            self._write("calibration", frame.log_time_ns, text)
        self._magnification = frame.magnification
        magnification = blank_message(_TOPICS["magnification"])
        magnification.data = frame.magnification
        self._write("magnification", frame.log_time_ns, magnification)
        projection = blank_message(_TOPICS["projection"])
        fill_projection(projection, camera)
        self._write("projection", frame.log_time_ns, projection)


def _timing_notes(
    microscope: MicroscopeConfig, follower: Follower | None, model: Calibration
) -> list[str]:
    """What the drift told of a scan timing that is not configured; it is too late to use it."""
    if follower is None:
        return []
    seen, note = timing_seen(microscope, follower, model)
    if seen is not microscope:
        note += f"; {GIVE_FRAME_TIME}"
    return [note] if note else []


@click.command("rectify")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--calibration", required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Bag to make.")
@click.option("--no-drift", is_flag=True, help="Leave drift in; correct distortion only.")
@click.option(
    "--interpolation",
    type=click.Choice(["linear", "cubic", "lanczos4"]),
    default="linear",
    show_default=True,
)
@click.option("--namespace", default="/sem", show_default=True, help="Of the topics in the output.")
@config_option
@frame_time_option
@overwrite_option
def command(
    recording: Path,
    calibration: Path,
    output: Path,
    no_drift: bool,
    interpolation: str,
    namespace: str,
    config: str,
    frame_time: float | None,
    overwrite: bool,
) -> None:
    """Drift-free, undistorted copy of RECORDING with camera_info and projection per frame.

    \b
    Example:
      semcal rectify recordings/zoom --calibration cal.yaml -o zoom_rect
    """
    model = Calibration.load(calibration)
    microscope = with_frame_time(configured(config, model), frame_time)
    follower = None if no_drift else Follower(hindsight=microscope.scan is None)
    rectifier = Rectifier(interpolation)
    states: Counter[str] = Counter()
    extrapolated, first, count = 0, None, 0
    with (
        open_recording(recording, microscope) as opened,
        BagWriter(output, overwrite=overwrite) as writer,
        progress(opened.frame_count, "rectifying") as bar,
    ):
        out = _Output(writer, namespace.rstrip("/"), model)
        for frame in opened.frames():
            first = frame.stamp_ns if first is None else first
            camera = camera_of(frame, model, microscope)
            extrapolated += not camera.in_range
            update = None
            if follower is not None:
                time_s = start_time_s(frame, first, microscope)
                update = follower.update(frame, time_s, camera, microscope.scan)
                states[update.kind] += 1
            image = rectifier.rectify(
                frame.image, camera, None if update is None else update.raster, microscope.scan
            )
            out.frame(frame, image, camera, update)
            count += 1
            bar.update(1)
        notes = [*opened.notes, *_timing_notes(microscope, follower, model)]
    for note in notes:
        click.echo(f"note: {note}", err=True)
    if extrapolated:
        click.echo(f"warning: {extrapolated} frames are outside of the calibrated range", err=True)
    echo_states(states)
    click.echo(f"{count} frames: {output}")
