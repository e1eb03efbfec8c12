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

"""A video of a recording beside the same frames without drift."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from semcal_ros.bridge.images import to_gray
from semcal_ros.core.errors import BagError
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.files.images.write import pixel_scale
from semcal_ros.files.video import open_video, shade
from semcal_ros.workflows.follow_drift import camera_for
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    resolve_calibration,
)
from semcal_ros.workflows.track_drift import DriftTrack

# Grey levels of more than 8 bits are shown with these quantiles as black and white: one pixel in a thousand
# may be clipped at either end.
_BLACK_WHITE = (0.001, 0.999)
# Black columns between both pictures.
_GAP_PX = 4


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
    with open_source(source, track.config) as opened:
        first = next(iter(opened.frames()))
        grey = to_gray(first.image, first.encoding)
        height, width = grey.shape
        levels = (0.0, 255.0)
        if grey.dtype != np.uint8:
            low, high = np.quantile(grey[np.isfinite(grey)], _BLACK_WHITE)
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
