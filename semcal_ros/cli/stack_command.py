"""``semcal stack``."""

from __future__ import annotations

import io
from collections import Counter
from pathlib import Path

import click
import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import (
    config_option,
    configured,
    magnification_option,
    progress,
    require_folder,
    require_suffix,
)
from semcal_ros.cli.drift_common import echo_nominal_unit, echo_states, frame_time_option
from semcal_ros.core.arrays import Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.core.rectification.stack import Stack, StackedImage
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.recordings import RecordedFrame, Recording, open_recording
from semcal_ros.files.video import VIDEO_CODECS, VideoWriter, open_video
from semcal_ros.workflows.follow_drift import Follower, with_frame_time
from semcal_ros.workflows.select_frames import Job, Survey, surveyed

__all__ = ["command"]

_TIFF = (".tif", ".tiff")


@click.command("stack")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="Average: .tif (32-bit, with the pixel size) or .png (as deep as the recording).",
)
@click.option("--calibration", type=click.Path(path_type=Path), help="Undo distortion, too.")
@click.option("--sigma", type=click.Path(path_type=Path), help=".tif of its standard error.")
@click.option("--video", type=click.Path(path_type=Path), help="Stabilised video: .mp4 or .avi.")
@click.option(
    "--fps",
    type=click.FloatRange(0.1, 240.0),
    default=10.0,
    show_default=True,
    help="Of the video.",
)
@click.option("--at", type=float, metavar="G", help="Take the frames of this magnification.")
@click.option("--no-drift", is_flag=True, help="Average the frames where they are.")
@click.option(
    "--interpolation",
    type=click.Choice(["linear", "cubic", "lanczos4"]),
    default="cubic",
    show_default=True,
)
@config_option
@frame_time_option
@magnification_option
def command(
    recording: Path,
    output: Path,
    calibration: Path | None,
    sigma: Path | None,
    video: Path | None,
    fps: float,
    at: float | None,
    no_drift: bool,
    interpolation: str,
    config: str,
    frame_time: float | None,
    magnification: float | None,
) -> None:
    """Average of the frames of RECORDING, each moved to where the specimen was in the first one.

    Frames whose drift is not known are left out.

    \b
    Example:
      semcal stack recordings/gold --calibration cal.yaml -o gold.tif --video gold.mp4
    """
    _check_outputs(recording, output, sigma, video)
    model = None if calibration is None else Calibration.load(calibration)
    microscope = with_frame_time(configured(config, model), frame_time)
    job = Job(model, microscope, at, None if no_drift else Follower())
    with open_recording(recording, microscope, magnification=magnification) as opened:
        with progress(opened.frame_count, "reading" if no_drift else "drift") as bar:
            survey = surveyed(
                opened,
                job,
                on_first=lambda f: _check_first(f, output),
                levels=video is not None,
                on_frame=bar.update,
            )
        usable = _usable(survey)
        stack = Stack(survey.size, interpolation)
        grey = _video_levels(survey)
        with open_video(video, survey.size, len(survey.chosen), fps, grey) as film:
            _add_frames(opened, survey, usable, stack, film)
        notes = opened.notes
    image = stack.result()
    _write(image, survey, output, sigma)
    for note in notes:
        click.echo(f"note: {note}", err=True)
    _report(survey, usable, image)
    for name, path in (("average", output), ("standard error", sigma), ("video", video)):
        if path is not None:
            click.echo(f"{name}: {path}")


# -- outputs --------------------------------------------------------------------------------------


def _check_outputs(recording: Path, output: Path, sigma: Path | None, video: Path | None) -> None:
    """Refuse names that cannot be written, before any work is done for them."""
    wanted = (
        (output, (*_TIFF, ".png"), "-o"),
        (sigma, _TIFF, "--sigma"),
        (video, tuple(VIDEO_CODECS), "--video"),
    )
    seen: set[Path] = set()
    source = recording.resolve()
    for path, suffixes, option in wanted:
        if path is None:
            continue
        require_suffix(path, suffixes, option)
        require_folder(path)
        target = path.resolve()
        if target in seen or target == source or source in target.parents:
            raise InvalidValueError(
                f"{option} {path} is another output, or belongs to the recording",
                expected="a file of its own outside of the recording",
            )
        seen.add(target)


def _check_first(frame: RecordedFrame, output: Path) -> None:
    if output.suffix.lower() not in _TIFF and frame.image.dtype.kind != "u":
        raise InvalidValueError(
            f"-o {output} for {frame.encoding} frames",
            expected="a .tif, which holds grey levels of 32 bits",
        )


def _write(image: StackedImage, survey: Survey, output: Path, sigma: Path | None) -> None:
    if sigma is not None:
        atomic_write_bytes(sigma, _tiff(image.standard_error, survey.camera))
    if output.suffix.lower() in _TIFF:
        data = _tiff(image.mean, survey.camera)
    else:
        top = np.iinfo(survey.dtype).max
        levels = np.clip(np.rint(np.nan_to_num(image.mean)), 0, top).astype(survey.dtype)
        data = bytes(cv2.imencode(".png", levels)[1])
    atomic_write_bytes(output, data)


def _tiff(values: NDArray[np.float32], camera: ScanCamera) -> bytes:
    """A file of 32-bit grey levels whose pixel size ImageJ understands."""
    per_um = [1e-6 / size for size in camera.pixel_size_m]
    file = io.BytesIO()
    tifffile.imwrite(
        file,
        values,
        imagej=True,
        resolution=(per_um[0], per_um[1]),
        metadata={"axes": "YX", "unit": "um"},
    )
    return file.getvalue()


# -- average and video ----------------------------------------------------------------------------


def _usable(survey: Survey) -> Mask:
    """Which of the chosen frames go into the average, (n,) bool."""
    if survey.path is None:
        return np.ones(len(survey.chosen), dtype=bool)
    usable = survey.path.trusted
    if not usable.any():
        raise BagError(
            f"{len(usable)} frames and none with a known drift, the first: {survey.path[0].status_text}",
            expected="a specimen with structure",
            do="look at `semcal drift`, or average the frames where they are with --no-drift",
        )
    return usable


def _add_frames(
    opened: Recording,
    survey: Survey,
    usable: Mask,
    stack: Stack,
    film: VideoWriter | None,
) -> None:
    number_of = {index: number for number, index in enumerate(survey.chosen)}
    with progress(opened.frame_count, "averaging") as bar:
        for index, frame in enumerate(opened.frames()):
            bar.update(1)
            number = number_of.get(index)
            if number is None or (film is None and not usable[number]):
                continue
            drift = None if survey.path is None else survey.path[number].raster
            grey = to_gray(frame.image, frame.encoding)
            camera, scan = survey.job.camera(frame), survey.job.microscope.scan
            picture, valid = stack.rectified(grey, camera, drift, scan)
            if usable[number]:
                stack.add(picture, valid)
            if film is not None:
                film.write(picture, _caption(survey, number, bool(usable[number])))


def _video_levels(survey: Survey) -> tuple[float, float]:
    """Grey levels that are shown as black and white."""
    if survey.dtype == np.uint8 or not survey.levels:
        return 0.0, 255.0
    low, high = np.median(survey.levels, axis=0)
    return float(low), float(high)


def _caption(survey: Survey, number: int, used: bool) -> str:
    """Number and time of a frame."""
    times_s = survey.times_s
    text = f"{number + 1}/{len(times_s)}  {times_s[number] - times_s[0]:.1f} s"
    return text if used else f"{text}  not tracked"


# -- what a person reads --------------------------------------------------------------------------


def _report(survey: Survey, usable: Mask, image: StackedImage) -> None:
    if survey.timing_note:
        click.echo(f"note: {survey.timing_note}", err=True)
    if survey.job.model is None:
        echo_nominal_unit(survey.job.microscope, "the pixel size is the nominal one")
    elif not survey.camera.in_range:
        click.echo("warning: the frames are outside of the calibrated range", err=True)
    if survey.other_kind:
        click.echo(
            f"note: {survey.other_kind} frames of another size or encoding are left out", err=True
        )
    if survey.follower is not None:
        echo_states(Counter(u.kind for u in survey.follower.updates))
    nm = 1e9 * np.array(survey.camera.pixel_size_m)
    click.echo(
        f"{image.frames} of {len(usable)} frames averaged, {nm[0]:.6g} x {nm[1]:.6g} nm per px"
    )
    lost = 0 if survey.path is None else int((survey.path.accepted & ~usable).sum())
    if lost:
        click.echo(f"note: tracking was lost: {lost} frames after that are left out", err=True)
    known = np.isfinite(image.standard_error)
    if known.any():
        error = float(np.median(image.standard_error[known]))
        click.echo(f"standard error: {error:.4g} grey levels (median of the pixels)")
