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

"""The drift-corrected average of a recording, and its stabilised video."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import AnyImage, Mask, check_positive
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.drift.scan_pairs import (
    ScanPairDrift,
    TurnedScan,
    average_scans,
    measure_scan_pairs,
)
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.stack import Stack, StackedImage, StackSums
from semcal_ros.core.wording import counted, omit_numbers
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.files.images.write import IMAGE_SUFFIXES, TIFF_SUFFIXES, pixel_scale, write_image
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.files.video import check_video, open_video, shade
from semcal_ros.workflows.follow_drift import camera_for
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
from semcal_ros.workflows.select_frames import FrameSelection, select_frames
from semcal_ros.workflows.workers import open_workers

__all__ = ["StackResult", "stack"]

# Frames that are added up by themselves before their sums are added to the others'. Of 8-bit
# frames, so many have the size of their sums, which come back from a cluster.
_FRAMES_PER_PART = 20
# Turned scans: each is compared with all of the other kind, and all are held in memory.
_MOST_SCANS = 12


@dataclass(frozen=True, eq=False)
class StackResult:
    """Average of the frames of one magnification.

    Attributes
    ----------
    image
        Mean, standard error, and number of frames in each pixel.
    camera
        Camera of the average: the ``rectified`` one of the first frame; nominal without a calibration. Of scan pairs,
        the average is the square in the middle of its image.
    dtype
        Type of the grey levels of the recording.
    stamps_ns
        n header stamps of the frames of that magnification, size and encoding.
    used
        (n,) bool: whether the frame is in the average.
    path
        Drift of the n frames; None where it was left in, or is that of scan pairs.
    states
        Number of frames by the kind of drift known live, the most frequent first.
    other_kind
        Number of frames of another size or encoding, which are left out.
    config
        The configuration that was used; its ``scan`` may have been estimated from the drift.
    notes
        Notes for the user.
    scan_drift
        Drift during each of the scans, where they were turned against each other.
    """

    image: StackedImage
    camera: ScanCamera
    dtype: np.dtype[Any]
    stamps_ns: tuple[int, ...]
    used: Mask
    path: DriftPath | None
    states: Mapping[str, int]
    other_kind: int
    config: MicroscopeConfig
    notes: tuple[str, ...]
    scan_drift: ScanPairDrift | None = None

    @property
    def lost(self) -> int:
        """Number of frames left out because tracking had been lost before them."""
        return 0 if self.path is None else int((self.path.accepted & ~self.used).sum())

    @property
    def reasons(self) -> Mapping[str, int]:
        """Number of frames left out by the reason, the most frequent first."""
        if self.path is None:
            return {}
        left_out = Counter(
            omit_numbers(update.reason) or "after tracking was lost"
            for update, used in zip(self.path.updates, self.used, strict=True)
            if not used
        )
        return dict(left_out.most_common())

    @property
    def typical_error(self) -> float | None:
        """Median of the standard error over the pixels, grey levels; None where there is none."""
        error = self.image.standard_error
        known = np.isfinite(error)
        return float(np.median(error[known])) if known.any() else None

    def save(self, path: str | os.PathLike[str], *, scale_bar: bool = False) -> None:
        """Write the mean: ``.tif`` (32-bit, with the size of its square pixels) or ``.png`` (as deep as the
        recording).

        Parameters
        ----------
        path
            The file.
        scale_bar
            Whether to append a strip with a scale bar and its 1-sigma.

        Raises
        ------
        InvalidValueError
            If the suffix is not one of these, or a PNG cannot hold the grey levels.
        OSError, BagError
            If the file cannot be written; an existing one is untouched.
        """
        file, levels = Path(path), self.image.mean
        if file.suffix.lower() == ".png" and self.dtype.kind == "u":
            top = np.iinfo(self.dtype).max
            levels = np.clip(np.rint(np.nan_to_num(levels)), 0, top).astype(self.dtype)
        self._write(file, levels, scale_bar)

    def save_sigma(self, path: str | os.PathLike[str]) -> None:
        """Write the standard error of the mean to a ``.tif``; raises as :meth:`save`."""
        self._write(Path(path), self.image.standard_error, scale_bar=False)

    def _write(self, path: Path, image: AnyImage, scale_bar: bool) -> None:
        scale = pixel_scale(self.camera)
        notes = {"magnification": self.camera.magnification, "frames": self.image.frames}
        write_image(path, image, scale, stamp_ns=self.stamps_ns[0], databar=scale_bar, notes=notes)


def stack(
    source: Source,
    *,
    calibration: CalibrationSource | None = None,
    config: ConfigSource | None = None,
    frame_time_s: float | None = None,
    magnification: float | None = None,
    at: float | None = None,
    drift: bool = True,
    scan_pairs_deg: float | None = None,
    interpolation: str = "cubic",
    video: str | os.PathLike[str] | None = None,
    fps: float = 10.0,
    output: str | os.PathLike[str] | None = None,
    sigma: str | os.PathLike[str] | None = None,
    scale_bar: bool = False,
    dask: str | None = None,
    on_progress: OnProgress = ignore_progress,
) -> StackResult:
    """Average frames, each shifted to the specimen's position in the first frame.

    Frames whose drift is not known are left out.

    Parameters
    ----------
    source
        A bag, a folder of images, or (image, magnification[, time_s]) tuples in memory.
    calibration
        A calibration or its file, to undo distortion too.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    frame_time_s
        Seconds of one pass over a frame, in place of what the configuration says.
    magnification
        Magnification of a folder of ordinary images, which do not contain it.
    at
        The magnification whose frames are taken; None where there is only one.
    drift
        False averages the frames without shifting them.
    scan_pairs_deg
        90 or -90: every second frame was scanned with the raster turned by this scan rotation, where a positive one
        turns the specimen in the image from +x towards +y. The drift within the scans is then measured
        (:mod:`~semcal_ros.core.drift.scan_pairs`), and the average shows the square that all of them do, as with no
        scan rotation. Neither stamps nor a frame time are used; at most 12 frames, no
        video, no Dask, no other interpolation.
    interpolation
        ``"linear"``, ``"cubic"`` or ``"lanczos4"``.
    video, fps
        File of a stabilised video (``.mp4`` or ``.avi``), and its frames per second.
    output, sigma
        Files of the average and of its standard error, as :meth:`StackResult.save` and
        :meth:`StackResult.save_sigma` write them.
    scale_bar
        Whether the average gets a strip with a scale bar; the video has one in any case.
    dask
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers resample and add up
        the frames. The drift is measured here.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read; there are several magnifications
        and none is chosen; the drift of no frame is known; or an output cannot hold the result.
    OSError
        If an output cannot be written.

    Examples
    --------
    ::

        from semcal_ros import stack
        average = stack("recordings/gold", calibration="jsm820.yaml")
        average.image.mean, average.image.standard_error      # (h, w) each
        average.save("gold.tif")
    """
    model = resolve_calibration(calibration)
    microscope = resolve_config(config, model, frame_time_s)
    film_path = None if video is None else Path(video)
    if film_path is not None:
        check_video(film_path, fps)
    if at is not None:
        at = check_positive(at, "at =")
    _check_suffix(output, IMAGE_SUFFIXES)
    _check_suffix(sigma, TIFF_SUFFIXES)
    quarter = None
    if scan_pairs_deg is not None:
        others = {
            "--no-drift": not drift,
            "--video": film_path is not None,
            "--dask": dask is not None,
            "--interpolation": interpolation != "cubic",
        }
        quarter = _check_scan_pairs(
            scan_pairs_deg, [name for name, given in others.items() if given]
        )
    with (
        open_workers(dask) as workers,
        open_source(source, microscope, magnification=magnification) as opened,
    ):
        selection = select_frames(
            opened,
            microscope,
            model,
            at=at,
            drift=drift and quarter is None,
            levels=film_path is not None,
            on_first=lambda frame: _check_output(output, frame),
            on_progress=on_progress,
        )
        used = _choose_usable(selection)
        if quarter is not None:
            average, scan_drift = _average_pairs(
                opened, model, selection, used, quarter, on_progress
            )
            result = StackResult(
                average,
                selection.camera.rectified,
                selection.dtype,
                selection.stamps_ns,
                used,
                None,
                {},
                selection.other_kind,
                selection.config,
                opened.notes,
                scan_drift,
            )
            return _save(result, output, sigma, scale_bar)
        summed = Stack(selection.size, interpolation)
        grey = _choose_video_levels(selection)
        count = len(selection.indices)
        with open_video(film_path, selection.size, count, fps) as film:
            advance = count_frames(on_progress, "averaging", int(used.sum()))
            frames = _read_chosen(opened, model, selection, used, film is not None)
            levels = None if film is None else grey
            scale = pixel_scale(selection.camera)
            bar = choose_scale_bar(selection.size[0], scale.size_m, scale.sigma_m)
            # In this process, a part is read frame by frame while it is added up.
            orders = (
                (list(part) if workers.elsewhere else part, selection.config.scan)
                + (selection.size, interpolation, levels)
                for _, part in groupby(frames, lambda frame: frame.number // _FRAMES_PER_PART)
            )
            for sums, images in workers.starmap(add_part, orders):
                summed.merge(sums)
                for number, image in images:
                    assert film is not None
                    caption = _format_caption(selection.times_s, number, bool(used[number]))
                    film.write(image, caption, bar)
                advance(sums.frames)
        notes = opened.notes
    if selection.timing_note:
        notes = (*notes, selection.timing_note)
    on_progress("finishing", 0, None)
    result = StackResult(
        summed.result(),
        selection.camera.rectified,
        selection.dtype,
        selection.stamps_ns,
        used,
        selection.path,
        selection.states,
        selection.other_kind,
        selection.config,
        notes,
    )
    return _save(result, output, sigma, scale_bar)


def _save(
    result: StackResult,
    output: str | os.PathLike[str] | None,
    sigma: str | os.PathLike[str] | None,
    scale_bar: bool,
) -> StackResult:
    if sigma is not None:
        result.save_sigma(sigma)
    if output is not None:
        result.save(output, scale_bar=scale_bar)
    return result


def _check_scan_pairs(scan_pairs_deg: float, others: Sequence[str]) -> int:
    """Return the scan rotation in quarters of a turn; ``others`` are options that do not go with it."""
    if abs(abs(scan_pairs_deg) - 90.0) > 1e-9:
        raise InvalidValueError(
            f"--scan-pairs {scan_pairs_deg:g}",
            expected="90 or -90, the scan rotation of every second frame in degrees",
        )
    if others:
        raise InvalidValueError(
            f"--scan-pairs together with {others[0]}", expected="one of the two"
        )
    return round(scan_pairs_deg / 90.0)


def _average_pairs(
    opened: Recording,
    model: Calibration | None,
    selection: FrameSelection,
    used: Mask,
    quarter_turns: int,
    on_progress: OnProgress,
) -> tuple[StackedImage, ScanPairDrift]:
    """Average scans, all of which are used, and of which every second one was turned."""
    count = len(selection.indices)
    if not 2 <= count <= _MOST_SCANS:
        raise InvalidValueError(
            f"{counted(count, 'frame')} for --scan-pairs",
            expected=f"2 to {_MOST_SCANS} of one magnification, every second one turned",
        )
    if selection.other_kind:
        raise InvalidValueError(
            f"--scan-pairs with {counted(selection.other_kind, 'frame')} of another size or encoding",
            expected="frames of one kind, every second one turned",
        )
    scans = [
        TurnedScan(frame.image, quarter_turns * (frame.number % 2), frame.camera, frame.mask)
        for frame in _read_chosen(opened, model, selection, used, unused_too=False, masks=True)
    ]
    on_progress("matching scans", 0, None)
    found = measure_scan_pairs(scans)
    on_progress("averaging", 0, None)
    return average_scans(scans, found), found


def _check_suffix(output: str | os.PathLike[str] | None, suffixes: Sequence[str]) -> None:
    if output is not None and Path(output).suffix.lower() not in suffixes:
        raise InvalidValueError(
            f"output {os.fspath(output)}", expected="a name that ends in " + ", ".join(suffixes)
        )


def _check_output(output: str | os.PathLike[str] | None, frame: RecordedFrame) -> None:
    """Refuse what :meth:`StackResult.save` could not write, before any work is done for it."""
    if output is None or Path(output).suffix.lower() in TIFF_SUFFIXES:
        return
    if frame.image.dtype.kind != "u":
        raise InvalidValueError(
            f"{os.fspath(output)} for {frame.encoding} frames",
            expected="a .tif, which holds grey levels of 32 bits",
        )


def _choose_usable(selection: FrameSelection) -> Mask:
    """Return which of the chosen frames go into the average, (n,) bool."""
    if selection.path is None:
        return np.ones(len(selection.indices), dtype=bool)
    usable = selection.path.trusted
    if not usable.any():
        raise BagError(
            f"{counted(len(usable), 'frame')}, none of them with a known drift; the first: "
            f"{selection.path[0].status_text}",
            expected="a specimen with structure",
            do="check with `semcal drift`, or average the frames where they are with --no-drift",
        )
    return usable


class _Frame(NamedTuple):
    """A chosen frame: its number among them, and what it needs to be added."""

    number: int
    image: NDArray[Any]
    camera: ScanCamera
    drift: RasterDrift | None
    used: bool
    mask: Mask | None = None


def _read_chosen(
    opened: Recording,
    model: Calibration | None,
    selection: FrameSelection,
    used: Mask,
    unused_too: bool,
    masks: bool = False,
) -> Iterator[_Frame]:
    """Read the chosen frames, of which a video shows those, too, that are not used; with masks where they are wanted,
    which a frame would else carry to the workers for nothing.
    """
    number_of = {index: number for number, index in enumerate(selection.indices)}
    for index, frame in enumerate(opened.frames()):
        number = number_of.get(index)
        if number is None or not (used[number] or unused_too):
            continue
        drift = None if selection.path is None else selection.path[number].raster
        grey = to_gray(frame.image, frame.encoding)
        camera = camera_for(frame, model, selection.config)
        yield _Frame(number, grey, camera, drift, bool(used[number]), frame.mask if masks else None)


def add_part(
    frames: Iterable[_Frame],
    scan: ScanTiming | None,
    size: tuple[int, int],
    interpolation: str,
    levels: tuple[float, float] | None,
) -> tuple[StackSums, list[tuple[int, NDArray[np.uint8]]]]:
    """Add up some frames, away from all others.

    Returns
    -------
    Their sums; number and image of each for a video, where ``levels`` are shown as black and white.
    """
    summed, images = Stack(size, interpolation), []
    for frame in frames:
        image, valid = summed.rectify(frame.image, frame.camera, frame.drift, scan)
        if frame.used:
            summed.add(image, valid)
        if levels is not None:
            images.append((frame.number, shade(image, levels)))
    return summed.sums(), images


def _choose_video_levels(selection: FrameSelection) -> tuple[float, float]:
    """Return the grey levels that are shown as black and white."""
    if selection.dtype == np.uint8 or not selection.levels:
        return 0.0, 255.0
    low, high = np.median(selection.levels, axis=0)
    return float(low), float(high)


def _format_caption(times_s: tuple[float, ...], number: int, used: bool) -> str:
    """Format the number and time of a frame."""
    text = f"{number + 1}/{len(times_s)}  {times_s[number] - times_s[0]:.1f} s"
    return text if used else f"{text}  not tracked"
