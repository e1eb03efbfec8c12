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
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from semcal_ros.bridge.fields import absolute_namespace
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.writer import BagWriter, CorrectedBagWriter
from semcal_ros.files.images.image_file import is_image_file
from semcal_ros.files.images.write import (
    TIFF_SUFFIXES,
    TiffStackWriter,
    open_image_folder,
    open_tiff_stack,
    pixel_scale,
    write_image,
)
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.files.tables import TABLE_SUFFIXES
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
from semcal_ros.workflows.options import (
    CONFIG,
    DASK,
    FRAME_TIME,
    INTERPOLATION,
    OVERWRITE,
    PROGRESS,
    KeywordsOf,
    Option,
)
from semcal_ros.workflows.provenance import ConditionsComparison
from semcal_ros.workflows.workers import open_workers


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
        The bag, file or folder that was written, or None.
    frames
        The frames themselves; empty where they were written.
    states
        Number of frames by the kind of drift, the most frequent first; empty where it was left in.
    extrapolated
        Number of frames outside the calibrated range.
    notes
        Notes for the user.
    followed
        Whether any frame was matched with another one; if not, no drift was measured and it was left in.
    """

    frame_count: int
    output: Path | None
    frames: tuple[RectifiedFrame, ...]
    states: Mapping[str, int]
    extrapolated: int
    notes: tuple[str, ...]
    followed: bool = False

    @property
    def images(self) -> tuple[AnyImage, ...]:
        """The images of :attr:`frames`."""
        return tuple(frame.image for frame in self.frames)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the result doubtful, as sentences."""
        out = []
        if self.extrapolated:
            frames = counted(self.extrapolated, "frame is", "frames are")
            out.append(f"{frames} outside the calibrated range")
        if self.states and self.frame_count > 1 and not self.followed:
            out.append(
                f"none of {counted(self.frame_count, 'frame')} was tracked: the drift is not known, and was left in"
            )
        return tuple(out)


@dataclass(frozen=True)
class RectifyOptions:
    """How frames are rectified, and what is written."""

    output: Annotated[
        str | os.PathLike[str] | None,
        Option(
            "A TIFF of all frames, a folder of TIFFs (its name ends with /), a PNG of one frame, or a bag.",
            names=("-o", "--output"),
            metavar="FILE.tif|FOLDER/|FILE.png|BAG",
            required=True,
            python="All frames of a TIFF have one magnification; a bag has camera_info and projection_stamped of each "
            "frame. TIFFs hold pixel size, times and conditions, in the depth of the recording. Without it, the frames "
            "are returned, which takes the memory of all of them.",
        ),
    ] = None
    _: KW_ONLY
    calibration: Annotated[
        CalibrationSource,
        Option("Calibration.", kind="path", required=True, python="Or its file."),
    ]
    config: Annotated[ConfigSource | None, CONFIG] = None
    frame_time_s: Annotated[float | None, FRAME_TIME] = None
    scale_bar: Annotated[
        bool, Option("Append a strip with a scale bar and its uncertainty below each picture.")
    ] = False
    drift: Annotated[
        bool,
        Option(
            "Leave drift in; correct distortion only.",
            names=("--no-drift",),
            python="That is what False does.",
        ),
    ] = True
    interpolation: Annotated[str, INTERPOLATION] = "linear"
    namespace: Annotated[str, Option("Namespace of the topics in the output.")] = "/sem"
    overwrite: Annotated[bool, OVERWRITE] = False
    dask: Annotated[str | None, DASK] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(RectifyOptions)
def rectify(source: Source, options: RectifyOptions) -> RectifiedRecording:
    """Undo distortion and drift of each frame in one interpolation.

    Each frame is corrected with what is known when it arrives, as in the nodes. ``source`` is a bag, a folder of SEM
    TIFF files, or (image, magnification[, time_s]) tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, the output exists, or it cannot hold the
        frames.

    Examples
    --------
    ::

        from semcal_ros import rectify
        rectify("tiffs", "corrected/", calibration="jsm820.yaml")
        rectify("recordings/zoom", "zoom_rect", calibration="jsm820.yaml")
        flat = rectify("recordings/zoom", calibration="jsm820.yaml").images
    """
    return rectify_recording(source, options)


def rectify_recording(source: Source, options: RectifyOptions) -> RectifiedRecording:
    """As :func:`rectify`, for options that are an object already."""
    output, scale_bar, overwrite = options.output, options.scale_bar, options.overwrite
    on_progress = options.on_progress
    model = require_calibration(options.calibration)
    microscope = resolve_config(options.config, model, options.frame_time_s)
    hindsight, follow = microscope.scan is None, microscope.follow
    follower = DriftFollower(hindsight=hindsight, follow=follow) if options.drift else None
    rectifier = Rectifier(options.interpolation)
    topics = absolute_namespace(options.namespace)
    kind = None if output is None else _choose_kind(output, scale_bar)
    target = None if output is None else Path(output)
    frames: list[RectifiedFrame] = []
    conditions = ConditionsComparison(model)
    states: Counter[str] = Counter()
    extrapolated, count, matched = 0, 0, 0
    first_note = ""
    with ExitStack() as open_files:
        workers = open_files.enter_context(open_workers(options.dask))
        opened = open_files.enter_context(open_source(source, microscope, model))
        write: _Write | None = None
        if kind is not None and target is not None:
            if kind == "bag":
                writer = open_files.enter_context(BagWriter(target, overwrite=overwrite))
                write = CorrectedBagWriter(writer, topics, model.dumps()).write
            else:
                write = _open_pictures(open_files, kind, target, opened, overwrite, scale_bar)
        advance = count_frames(on_progress, "rectifying", opened.frame_count)
        under_way: deque[_Followed] = deque()

        def orders() -> Iterator[tuple[object, ...]]:
            for followed in _follow(opened, model, microscope, follower):
                conditions.add(followed.frame.conditions)
                under_way.append(followed)
                raster = None if followed.update is None else followed.update.raster
                image = followed.frame.image
                yield rectifier, image, followed.camera, raster, microscope.scan

        for image in workers.starmap(Rectifier.rectify, orders()):
            frame, camera, update = under_way.popleft()
            extrapolated += not camera.in_range
            if update is not None:
                states[update.kind] += 1
                matched += update.accepted
                if matched == 2 and not first_note:
                    first_note = _note_first(update, microscope)
            if write is None:
                frames.append(RectifiedFrame(image, frame.stamp_ns, camera.rectified, update))
            else:
                write(frame, image, camera, update)
            count += 1
            advance(1)
        on_progress("finishing", 0, None)
        notes = (*opened.notes, *conditions.notes, *_note_timing(microscope, follower, model))
        notes = (*notes, first_note) if first_note else notes
    kinds = dict(states.most_common())
    return RectifiedRecording(
        count, target, tuple(frames), kinds, extrapolated, notes, followed=matched > 1
    )


_Write = Callable[[RecordedFrame, AnyImage, ScanCamera, "DriftUpdate | None"], None]


def _choose_kind(output: str | os.PathLike[str], scale_bar: bool) -> str:
    """What the name of an output asks for: ``tiff``, ``folder``, ``png`` or ``bag``."""
    text = os.fspath(output)
    path = Path(text)
    if text.endswith("/"):
        return "folder"
    if path.suffix.lower() in TIFF_SUFFIXES:
        return "tiff"
    if path.suffix.lower() == ".png":
        return "png"
    if is_image_file(path) or path.suffix.lower() in _OTHER_SUFFIXES:
        raise InvalidValueError(
            f"output {text} for corrected frames",
            expected="x.tif, a folder of TIFFs x/, x.png of one frame, or a bag x without a suffix",
            do="choose one of these names",
        )
    if scale_bar:
        raise InvalidValueError(
            f"a scale bar in the bag {text}",
            expected="pictures, such as x.tif, x/ or x.png",
            do="leave --scale-bar out, or choose one of these names",
        )
    return "bag"


# Stated: shear of the first frame that is worth a note, px.
_SHEAR_NOTED_PX = 0.3

# What a bag is not called by mistake: its files, and what other commands write.
_OTHER_SUFFIXES = (*TABLE_SUFFIXES, ".mcap", ".db3", ".yaml", ".json", ".html", ".svg", ".pdf")


def _open_pictures(
    open_files: ExitStack,
    kind: str,
    target: Path,
    opened: Recording,
    overwrite: bool,
    scale_bar: bool,
) -> _Write:
    """Open a file or a folder of pictures, and return how a frame is written."""
    if kind == "png":
        if opened.frame_count != 1:
            raise InvalidValueError(
                f"{target} for {counted(opened.frame_count, 'frame')}",
                expected="one frame for a PNG",
                do="write x.tif, or a folder of TIFFs: x/",
            )

        def write_one(
            frame: RecordedFrame, image: AnyImage, camera: ScanCamera, _: DriftUpdate | None
        ) -> None:
            write_image(target, _as_rgb(image, frame), pixel_scale(camera), databar=scale_bar)

        return write_one
    if kind == "folder":
        folder = open_files.enter_context(
            open_image_folder(target, overwrite=overwrite, databar=scale_bar)
        )

        def write_file(
            frame: RecordedFrame, image: AnyImage, camera: ScanCamera, _: DriftUpdate | None
        ) -> None:
            folder.write(
                _as_rgb(image, frame),
                frame.stamp_ns,
                pixel_scale(camera),
                source_name=frame.file_name,
                notes=_describe_frame(frame, camera),
            )

        return write_file
    stack: TiffStackWriter | None = None

    def write_page(
        frame: RecordedFrame, image: AnyImage, camera: ScanCamera, _: DriftUpdate | None
    ) -> None:
        nonlocal stack
        if stack is None:
            stack = open_files.enter_context(
                open_tiff_stack(
                    target,
                    expected_bytes=opened.frame_count * image.nbytes,
                    databar=scale_bar,
                    notes=_describe_frame(frame, camera),
                )
            )
        stack.write(_as_rgb(image, frame), frame.stamp_ns, pixel_scale(camera))

    return write_page


def _as_rgb(image: AnyImage, frame: RecordedFrame) -> AnyImage:
    return image[..., ::-1] if frame.encoding.startswith("bgr") else image


def _describe_frame(frame: RecordedFrame, camera: ScanCamera) -> dict[str, object]:
    """What a picture says about itself, in SI units."""
    said: dict[str, object] = {
        "magnification": frame.magnification,
        "in_calibrated_range": camera.in_range,
    }
    if frame.conditions is not None:
        # By themselves: the maker's pixel size is not that of the corrected picture.
        known = frame.conditions.conditions().items()
        said["conditions"] = {name: value for name, value in known if value not in (None, "")}
    return said


class _Followed(NamedTuple):
    """A frame, its camera, and its drift where that is removed."""

    frame: RecordedFrame
    camera: ScanCamera
    update: DriftUpdate | None


def _follow(
    opened: Recording,
    model: Calibration,
    microscope: MicroscopeConfig,
    follower: DriftFollower | None,
) -> Iterator[_Followed]:
    """Read the frames, and measure their drift."""
    first_ns = None
    for frame in opened.frames():
        first_ns = frame.stamp_ns if first_ns is None else first_ns
        camera = camera_for(frame, model, microscope)
        update = None
        if follower is not None:
            time_s = start_time_s(frame, first_ns, microscope)
            update = follower.update(frame, time_s, camera, microscope.scan)
        yield _Followed(frame, camera, update)


def _note_first(second: DriftUpdate, microscope: MicroscopeConfig) -> str:
    """Return a note that the drift within the first frame, of which nothing was known, is left in; the second one tells
    it.
    """
    if microscope.scan is None:
        return ""
    in_px, pass_s = second.px_from_unit, microscope.scan.frame_time_s
    shear_px = np.abs(in_px @ second.velocity_m_s) * pass_s
    sigma_px = np.sqrt(np.diag(in_px @ second.covariance[2:, 2:] @ in_px.T)) * pass_s
    if not np.any(shear_px > _SHEAR_NOTED_PX + 2.0 * sigma_px):
        return ""
    return (
        "the drift within the first frame is left in, since nothing is known of it when the frame arrives: about "
        f"{float(np.max(shear_px)):.1f} px from its first to its last line"
    )


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
