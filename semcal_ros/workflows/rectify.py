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

"""The drift-free, rectified copy of a recording."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from semcal_ros.bridge.names import absolute_namespace
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.files.bags.corrected import CorrectedBagWriter
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.workflows.follow_drift import (
    GIVE_FRAME_TIME,
    DriftFollower,
    camera_for,
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
    require_calibration,
    resolve_config,
)

__all__ = ["RectifiedFrame", "RectifiedRecording", "rectify"]


@dataclass(frozen=True, eq=False)
class RectifiedFrame:
    """One frame in square pixels, without distortion and drift.

    Attributes
    ----------
    image
        (h, w) or (h, w, 3) of the type of the recorded image; pixels that were not scanned are 0.
    stamp_ns
        Header stamp, ns since 1970.
    camera
        Camera of the image: the ``rectified`` one of its magnification, of the image's size.
    drift
        The drift that was removed; None where it was left in.
    """

    image: AnyImage
    stamp_ns: int
    camera: ScanCamera
    drift: DriftUpdate | None


@dataclass(frozen=True, eq=False)
class RectifiedRecording:
    """The rectified frames of a recording.

    Attributes
    ----------
    frame_count
        Number of frames.
    output
        The bag that was written, or None.
    frames
        The frames themselves; empty where they were written to a bag.
    states
        Number of frames by the kind of drift, the most frequent first; empty where it was left in.
    extrapolated
        Number of frames outside the calibrated range.
    notes
        Notes for the user.
    """

    frame_count: int
    output: Path | None
    frames: tuple[RectifiedFrame, ...]
    states: Mapping[str, int]
    extrapolated: int
    notes: tuple[str, ...]

    @property
    def images(self) -> tuple[AnyImage, ...]:
        """The images of :attr:`frames`."""
        return tuple(frame.image for frame in self.frames)


def rectify(
    source: Source,
    output: str | os.PathLike[str] | None = None,
    *,
    calibration: CalibrationSource,
    config: ConfigSource | None = None,
    frame_time_s: float | None = None,
    drift: bool = True,
    interpolation: str = "linear",
    namespace: str = "/sem",
    overwrite: bool = False,
    on_progress: OnProgress = ignore_progress,
) -> RectifiedRecording:
    """Undo distortion and drift of each frame in one interpolation.

    Each frame is corrected with what is known when it arrives, as in the nodes.

    Parameters
    ----------
    source
        A bag, a folder of SEM TIFF files, or (image, magnification[, time_s]) tuples in memory.
    output
        Bag to make, with camera_info and projection_stamped of each frame; without it, the frames are
        returned, which takes the memory of all of them.
    calibration
        A calibration or its file.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    frame_time_s
        Seconds of one pass over a frame, in place of what the configuration says.
    drift
        False leaves drift in.
    interpolation
        ``"linear"``, ``"cubic"`` or ``"lanczos4"``.
    namespace
        Of the topics in the bag.
    overwrite
        Whether to replace an existing bag, once the new one is complete.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, or the bag exists.

    Examples
    --------
    ::

        from semcal_ros import rectify
        rectify("recordings/zoom", "zoom_rect", calibration="jsm820.yaml")
        flat = rectify("recordings/zoom", calibration="jsm820.yaml").images
    """
    model = require_calibration(calibration)
    microscope = resolve_config(config, model, frame_time_s)
    follower = DriftFollower(hindsight=microscope.scan is None) if drift else None
    rectifier = Rectifier(interpolation)
    topics = absolute_namespace(namespace)
    target = None if output is None else Path(output)
    frames: list[RectifiedFrame] = []
    states: Counter[str] = Counter()
    extrapolated, first_ns, count = 0, None, 0
    with ExitStack() as open_files:
        opened = open_files.enter_context(open_source(source, microscope))
        bag = None
        if target is not None:
            writer = open_files.enter_context(BagWriter(target, overwrite=overwrite))
            bag = CorrectedBagWriter(writer, topics, model.dumps())
        advance = count_frames(on_progress, "rectifying", opened.frame_count)
        for frame in opened.frames():
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            camera = camera_for(frame, model, microscope)
            extrapolated += not camera.in_range
            update = None
            if follower is not None:
                time_s = start_time_s(frame, first_ns, microscope)
                update = follower.update(frame, time_s, camera, microscope.scan)
                states[update.kind] += 1
            image = rectifier.rectify(
                frame.image, camera, None if update is None else update.raster, microscope.scan
            )
            if bag is None:
                frames.append(RectifiedFrame(image, frame.stamp_ns, camera.rectified, update))
            else:
                bag.write(frame, image, camera, update)
            count += 1
            advance(1)
        notes = (*opened.notes, *_note_timing(microscope, follower, model))
    kinds = dict(states.most_common())
    return RectifiedRecording(count, target, tuple(frames), kinds, extrapolated, notes)


def _note_timing(
    microscope: MicroscopeConfig, follower: DriftFollower | None, model: Calibration
) -> list[str]:
    """Return notes on an unconfigured scan timing that the drift reveals, too late to use it."""
    if follower is None:
        return []
    timed, note = estimate_timing(microscope, follower, model)
    if timed is not microscope:
        note += f"; {GIVE_FRAME_TIME}"
    return [note] if note else []
