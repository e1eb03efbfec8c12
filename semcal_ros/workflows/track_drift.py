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

"""The drift of a recording as a table, a path, a forecast, and a video beside the same frames without drift."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftEstimate, DriftPath, DriftPredictor
from semcal_ros.core.errors import BagError
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.files.images.write import pixel_scale
from semcal_ros.files.recordings import Recording
from semcal_ros.files.tables import DRIFT_COLUMNS, SIMILARITY_COLUMNS, write_table
from semcal_ros.files.video import BLACK_WHITE, open_video, shade
from semcal_ros.workflows.follow_drift import (
    GIVE_FRAME_TIME,
    DriftFollower,
    camera_for,
    describe_beginnings,
    describe_untracked,
    estimate_timing,
    start_time_s,
)
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    resolve_calibration,
    resolve_config,
)
from semcal_ros.workflows.options import CONFIG, FRAME_TIME, PROGRESS, KeywordsOf, Option

# Black columns between both pictures.
_GAP_PX = 4


@dataclass(frozen=True, eq=False)
class DriftTrack:
    """Drift of the specimen at the n frames of a recording.

    Attributes
    ----------
    stamps_ns
        n header stamps, ns since 1970.
    path
        Drift, rate and covariance at each frame. In raw pixels of a nominal size where no
        calibration was given.
    states
        Number of frames by the kind of drift known live, the most frequent first.
    predictor
        The predictor for forecasts beyond the last frame.
    config
        The configuration that was used; its ``scan`` may have been estimated from the drift.
    notes
        Notes for the user.
    """

    stamps_ns: tuple[int, ...]
    path: DriftPath
    states: Mapping[str, int]
    predictor: DriftPredictor
    config: MicroscopeConfig
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def forecast(self, after_s: float) -> DriftEstimate:
        """Forecast the drift ``after_s`` seconds after the last frame.

        Its covariance is infinite if no drift was measured.

        Raises
        ------
        InvalidValueError
            If that is negative or not finite.
        """
        return self.predictor.at(float(self.path.time_s[-1]) + after_s)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table of ``semcal drift``.

        The suffix is ``.csv``, ``.parquet`` or ``.xlsx``.

        Raises
        ------
        InvalidValueError
            If it is another one, or its library is missing.
        OSError
            If the file cannot be written; an existing one is untouched.
        """
        drift = self.path
        sigma_m = drift.sigma_m
        rows: list[tuple[object, ...]] = [
            (
                stamp_ns,
                *drift.drift_m[k],
                *sigma_m[k],
                *drift.drift_px[k],
                *drift[k].sigma_px,
                drift[k].status_text,
                _correlation(drift[k].covariance[:2, :2]),
                _correlation(drift[k].covariance_px2),
            )
            for k, stamp_ns in enumerate(self.stamps_ns)
        ]
        columns: tuple[str, ...] = DRIFT_COLUMNS
        if drift.turns:
            columns += SIMILARITY_COLUMNS
            pairs = zip(drift.similarity[:, :2], drift.similarity_sigma, strict=True)
            turns = [np.column_stack(pair).ravel() for pair in pairs]
            rows = [(*row, *turn) for row, turn in zip(rows, turns, strict=True)]
        write_table(Path(path), columns, rows)


def _correlation(covariance: Array) -> float:
    """Return the correlation of x and y of a (2, 2) covariance; 0 where one of them is exact or unknown."""
    sigma = np.sqrt(np.diag(covariance))
    if not (np.all(np.isfinite(sigma)) and np.all(sigma > 0.0)):
        return 0.0
    return float(np.clip(covariance[0, 1] / sigma.prod(), -1.0, 1.0))


def _describe_similarity(path: DriftPath) -> str:
    """Describe the rotation and the scale of the last frame."""
    (angle, log_scale), sigma = path.similarity[-1, :2], path.similarity_sigma[-1]
    turn = f"{np.degrees(angle):.4f} +- {np.degrees(sigma[0]):.4f} deg"
    scale = f"{100.0 * log_scale:.3f} +- {100.0 * sigma[1]:.3f} %"
    return f"the image turned by {turn} and grew by {scale} from the first frame to the last"


@dataclass(frozen=True, kw_only=True)
class DriftOptions:
    """How the drift of a recording is measured."""

    calibration: Annotated[
        CalibrationSource | None,
        Option(
            "Work in rectified coordinates.",
            kind="path",
            python="A calibration or its file; without it, drift is in raw pixels of the nominal size.",
        ),
    ] = None
    config: Annotated[ConfigSource | None, CONFIG] = None
    frame_time_s: Annotated[float | None, FRAME_TIME] = None
    live: Annotated[bool, Option("Drift as known live, without hindsight from later frames.")] = (
        False
    )
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(DriftOptions)
def track_drift(source: Source, options: DriftOptions) -> DriftTrack:
    """Measure the drift of the specimen at the centre of each frame, relative to the first one.

    What lay at X in the sem frame is seen at X + drift. Where time runs backwards in the recording, or its first frames
    cannot be used, drift is counted from a later frame, which a note says. Where the configuration has no scan timing
    and the drift shows it, the recording is tracked once more with it. ``source`` is a bag, a folder of
    SEM TIFF files, or (image, magnification[, time_s]) tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read.

    Examples
    --------
    ::

        from semcal_ros import track_drift
        track = track_drift("recordings/gold", calibration="jsm820.yaml")
        track.path.drift_m, track.path.sigma_m      # (n, 2), m
        track.save("drift.csv")
    """
    return track_recording(source, options)


def track_recording(source: Source, options: DriftOptions) -> DriftTrack:
    """As :func:`track_drift`, for options that are an object already."""
    live, on_progress = options.live, options.on_progress
    model = resolve_calibration(options.calibration)
    microscope = resolve_config(options.config, model, options.frame_time_s)
    with open_source(source, microscope, model) as opened:
        stamps_ns, follower = _follow(opened, model, microscope, on_progress)
        on_progress("smoothing", 0, None)
        timed, note = estimate_timing(microscope, follower, model)
        if timed is not microscope and live:
            note += f"; {GIVE_FRAME_TIME}"  # live, this could not have been known
        elif timed is not microscope:
            microscope = timed
            stamps_ns, follower = _follow(opened, model, microscope, on_progress)
            on_progress("smoothing", 0, None)
        notes = [*opened.notes, *([note] if note else [])]
    path = follower.path(live=live)
    notes += [*describe_untracked(path), *describe_beginnings(path)]
    if path.turns:
        notes.append(_describe_similarity(path))
    if len(path) and path[-1].stripes:
        notes.append(
            f"the frames have stripes: what their {path[-1].stripes} have in common was taken out"
        )
    return DriftTrack(
        tuple(stamps_ns),
        path,
        dict(Counter(update.kind for update in follower.updates).most_common()),
        follower.tracker.predictor(),
        microscope,
        tuple(notes),
    )


def describe_rate(path: DriftPath) -> str:
    """Describe the drift rate at the last frame with its 1-sigma in nm/s; empty where none was measured."""
    if not path.followed:
        return ""
    x, y = _format_lengths(path.velocity_m_s[-1], path.velocity_sigma_m_s[-1])
    return f"final drift rate: x {x}, y {y} nm/s"


def describe_forecast(forecast: DriftEstimate, after_s: float) -> str:
    """Describe a forecast for ``after_s`` seconds after the last frame, with its 1-sigma in nm."""
    x, y = _format_lengths(forecast.drift_m, np.sqrt(np.diag(forecast.covariance)[:2]))
    return f"drift {after_s:g} s after the last frame: x {x}, y {y} nm"


def _format_lengths(values: Array, sigmas: Array) -> list[str]:
    """Format lengths in nm with their 1-sigma, to two digits of the smaller uncertainty."""
    smaller = 1e9 * float(np.min(sigmas))
    digits = int(np.clip(1 - np.floor(np.log10(smaller)), 0, 9)) if smaller > 0.0 else 3
    pairs = zip(1e9 * values, 1e9 * sigmas, strict=True)
    return [f"{v:.{digits}f} +- {s:.{digits}f}" for v, s in pairs]


def _follow(
    opened: Recording,
    model: Calibration | None,
    microscope: MicroscopeConfig,
    on_progress: OnProgress,
) -> tuple[list[int], DriftFollower]:
    """Track all frames; return their stamps and drift."""
    follower = DriftFollower(follow=microscope.follow)
    stamps_ns: list[int] = []
    advance = count_frames(on_progress, "drift", opened.frame_count)
    for frame in opened.frames():
        stamps_ns.append(frame.stamp_ns)
        camera = camera_for(frame, model, microscope)
        time_s = start_time_s(frame, stamps_ns[0], microscope)
        follower.update(frame, time_s, camera, microscope.scan)
        advance(1)
    return stamps_ns, follower


def write_drift_video(
    source: Source,
    track: DriftTrack,
    path: str | os.PathLike[str],
    *,
    calibration: CalibrationSource | None = None,
    fps: float = 10.0,
    on_progress: OnProgress = ignore_progress,
) -> None:
    """Write each frame as it was recorded, and beside it where the specimen was in the first one.

    Parameters
    ----------
    source
        The recording that ``track`` was made from.
    track
        What :func:`.track_drift` returned for it.
    path
        ``.mp4`` or ``.avi``.
    calibration
        The calibration that ``track`` was made with; it undoes distortion in the right picture.
    fps
        Frames per second of the video.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    BagError
        The frames have different sizes, or the video cannot be written.
    InvalidValueError
        The suffix is another one, or there is no encoder for it.
    """
    model, rectifier = resolve_calibration(calibration), Rectifier("linear")
    target = Path(path)
    with open_source(source, track.config, model) as opened:
        first = next(iter(opened.frames()))
        grey = to_gray(first.image, first.encoding)
        height, width = grey.shape
        levels = (0.0, 255.0)
        if grey.dtype != np.uint8:
            low, high = np.quantile(grey[np.isfinite(grey)], BLACK_WHITE)
            levels = float(low), float(high)
        size = (2 * width + _GAP_PX, height)
        advance = count_frames(on_progress, "video", len(track))
        with open_video(target, size, len(track), fps) as film:
            assert film is not None
            for number, frame in enumerate(opened.frames()):
                grey = to_gray(frame.image, frame.encoding)
                if grey.shape != (height, width):
                    raise BagError(
                        f"{target} of frames of {width} x {height} px and of {grey.shape[1]} x {grey.shape[0]} px",
                        expected="frames of one size",
                        do="leave --video out",
                    )
                camera = camera_for(frame, model, track.config)
                update = track.path[number]
                both = np.zeros((height, size[0]), dtype=np.uint8)
                both[:, :width] = shade(grey.astype(np.float32), levels)
                # Where the drift is not known, there is nothing to show in place.
                if np.isfinite(update.drift_m).all():
                    right = rectifier.rectify(grey, camera, update.raster, track.config.scan)
                    both[:, -width:] = shade(right.astype(np.float32), levels)
                scale = pixel_scale(camera)
                bar = choose_scale_bar(width, scale.size_m, scale.sigma_m)
                film.write(both, _format_caption(track, number), bar)
                advance(1)


def _format_caption(track: DriftTrack, number: int) -> str:
    """Format number, time and drift of a frame."""
    after_s = 1e-9 * (track.stamps_ns[number] - track.stamps_ns[0])
    text = f"{number + 1}/{len(track)}  {after_s:.1f} s"
    if not track.path.trusted[number]:
        return f"{text}  not tracked"
    x, y = 1e9 * track.path.drift_m[number]
    return f"{text}  {x:.0f}, {y:.0f} +- {1e9 * track.path.sigma_m[number].max():.1f} nm"
