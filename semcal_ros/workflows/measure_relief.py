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

"""Height map of a specimen from two or three pictures of it at known tilts."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from semcal_ros.applications.reconstruction.tilt_series import HeightMap, measure_heights
from semcal_ros.bridge.images import to_gray
from semcal_ros.core.arrays import AnyImage, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.wording import counted
from semcal_ros.files.images.write import TIFF_SUFFIXES, PixelScale, open_tiff_stack
from semcal_ros.files.meshes import UNITS_PER_M, save_cloud
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.files.tables import TABLE_SUFFIXES, write_table
from semcal_ros.workflows.follow_drift import camera_for
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    ignore_progress,
    open_source,
    resolve_calibration,
    resolve_config,
)
from semcal_ros.workflows.options import CONFIG, PROGRESS, Keyword, KeywordsOf, Option
from semcal_ros.workflows.provenance import ConditionsComparison

#: Suffixes of what a relief is written to: a height map, a cloud of points, tables of points.
RELIEF_SUFFIXES = (*TIFF_SUFFIXES, ".ply", *TABLE_SUFFIXES)
# Sigmas by which the reliefs of two pairs may differ by chance.
_RATIO_DOUBT = 3.0


@dataclass(frozen=True, eq=False)
class Relief:
    """A height map, and where it comes from.

    Attributes
    ----------
    heights
        Heights with their uncertainty.
    scale
        Pixel size of the height map.
    notes
        Notes for the user.
    """

    heights: HeightMap
    scale: PixelScale
    notes: tuple[str, ...]

    def save(self, path: str | os.PathLike[str], *, unit: str = "nm") -> None:
        """Write the height map (``.tif``: float32 in um, the second page its 1-sigma) or the points.

        Parameters
        ----------
        path
            ``.tif``; ``.ply`` or a table for the points.
        unit
            ``m``, ``um`` or ``nm``, of a ``.ply``; tables are in m.

        Raises
        ------
        InvalidValueError
            If the suffix or the unit is not one of these.
        OSError, BagError
            If the file cannot be written; an existing one is untouched.
        """
        file = Path(path)
        suffix = file.suffix.lower()
        if suffix in TIFF_SUFFIXES:
            notes = {"height_unit": "um", "pages": "height, 1-sigma of the height"}
            with open_tiff_stack(file, notes=notes) as pages:
                for index, page in enumerate((self.heights.height_m, self.heights.sigma_m)):
                    pages.write((1e6 * page).astype(np.float32), index, self.scale)
            return
        points, sigma = self.heights.list_points()
        if suffix == ".ply":
            save_cloud(file, points, {"sigma": sigma * UNITS_PER_M.get(unit, 1.0)}, unit=unit)
        elif suffix in TABLE_SUFFIXES:
            rows = np.column_stack([points, sigma]).tolist()
            write_table(file, ("x_m", "y_m", "height_m", "sigma_m"), rows)
        else:
            raise InvalidValueError(
                f"{file} for heights", expected="a name that ends in " + ", ".join(RELIEF_SUFFIXES)
            )

    def summary(self) -> dict[str, Any]:
        """Plain numbers, as ``semcal reconstruct --json`` prints them."""
        found = self.heights
        return {
            "pictures": len(found.tilts_rad),
            "reference": found.reference,
            "tilts_rad": list(found.tilts_rad),
            "pixel_size_m": found.pixel_size_m,
            "pixel_size_sigma_m": self.scale.sigma_m,
            "pairs": [
                {
                    "matches": pair.matches,
                    "inliers": len(pair.first),
                    "residual_rms_px": pair.rms_px,
                    "axis_rad": pair.axis_rad,
                    "axis_sigma_rad": float(np.sqrt(pair.covariance[0, 0])),
                    "magnification_ratio": pair.scale,
                }
                for pair in found.pairs
            ],
            "coverage": found.coverage,
            "relief_m": found.relief_m,
            "rms_m": found.rms_m,
            "median_sigma_m": found.median_sigma_m,
            "relief_ratio": found.relief_ratio,
            "relief_ratio_sigma": found.relief_ratio_sigma,
        }


@dataclass(frozen=True, kw_only=True)
class ReliefOptions:
    """How two or three pictures were tilted."""

    tilts_rad: Annotated[
        Sequence[float] | None,
        Option(
            "Tilts of two or three images, such as 0deg,6deg,12deg (bare numbers are degrees), instead of those of the "
            "stage: measures heights.",
            kind="tilts",
        ),
    ] = None
    axis_rad: Annotated[
        float | None,
        Option(
            "About where the tilt axis points in the image, such as 90deg; its sense tells hills from dents.",
            kind="angle",
            names=("--tilt-axis",),
            python="None for that of the configuration.",
        ),
    ] = None
    tilt_sigma_rad: Annotated[
        float | None,
        Option(
            "1-sigma of each tilt, such as 0.1deg, instead of that of the configuration.",
            kind="angle",
        ),
    ] = None
    calibration: Annotated[
        CalibrationSource | None,
        Keyword("Takes distortion out of the pictures, and gives the pixel size and its 1-sigma."),
    ] = None
    config: Annotated[ConfigSource | None, CONFIG] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(ReliefOptions)
def measure_relief(source: Source, options: ReliefOptions) -> Relief:
    """Measure the relief of a specimen in two or three tilted pictures.

    ``source`` is a recording of two or three images, or (image, magnification) tuples in memory.

    Raises
    ------
    SemcalError
        If the recording cannot be read, tilts are missing, or the pictures allow no height map.
    """
    return measure_recorded_relief(source, options)


def measure_recorded_relief(source: Source, options: ReliefOptions) -> Relief:
    """As :func:`measure_relief`, for options that are an object already."""
    tilts_rad, axis_rad, tilt_sigma_rad = (
        options.tilts_rad,
        options.axis_rad,
        options.tilt_sigma_rad,
    )
    on_progress = options.on_progress
    model = resolve_calibration(options.calibration)
    microscope = resolve_config(options.config, model)
    stage = microscope.stage
    with open_source(source, microscope, model) as opened:
        if opened.frame_count not in (2, 3):
            raise InvalidValueError(
                f"{counted(opened.frame_count, 'image')} for heights",
                expected="two or three images of one specimen at known tilts",
                do="choose them, or give --calibration without --tilts for a ball that turns",
            )
        frames = list(opened.frames())
        conditions = ConditionsComparison(model)
        for frame in frames:
            conditions.add(frame.conditions)
        notes = [*opened.notes, *conditions.notes]
    if len({frame.magnification for frame in frames}) > 1:
        raise InvalidValueError(
            "images of different magnifications", expected="images of one magnification"
        )
    tilts = _read_tilts(frames) if tilts_rad is None else tilts_rad
    raw = camera_for(frames[0], model, microscope)
    camera = raw if model is None else raw.rectified
    size = camera.pixel_size_m[0]
    sigma = None if model is None or camera.covariance is None else max(camera.pixel_size_sigma_m)
    if sigma is None:
        notes.append(
            "the pixel size is nominal: its uncertainty is not in the 1-sigma of the heights"
        )
    else:
        notes.append("the pictures are rectified by the calibration, which gives the pixel size")
    on_progress("measuring heights", 0, None)
    pictures = [to_gray(frame.visible, frame.encoding) for frame in frames]
    masks = [frame.mask for frame in frames]
    if model is not None:
        pictures, masks = _rectify(pictures, masks, raw)
    found = measure_heights(
        pictures,
        tilts,
        size,
        pixel_size_sigma_m=sigma or 0.0,
        tilt_sigma_rad=(
            (stage.sigma.tilt if stage else 0.0035) if tilt_sigma_rad is None else tilt_sigma_rad
        ),
        axis_rad=(
            np.radians(stage.tilt_axis_deg if stage else 0.0) if axis_rad is None else axis_rad
        ),
        masks=masks,
    )
    if len(frames) == 2:
        notes.append(
            "two pictures do not tell a slope of the whole field from a drift within a frame, which is not in the "
            f"1-sigma: a drift of 1 px over a frame may tilt the relief by {_slope_deg(frames[0], tilts):.2g} degrees"
        )
    if axis_rad is None:
        notes.append(
            "hills and dents are told apart by the sense of the tilt axis, which is assumed to be that of the "
            "configuration; --tilt-axis states it"
        )
    ratio, spread = found.relief_ratio, found.relief_ratio_sigma
    if ratio is not None and spread is not None and abs(ratio - 1.0) > _RATIO_DOUBT * spread:
        notes.append(
            f"the second pair shows {ratio:.3f} times the relief of the first, expected 1 +- {spread:.3f}: "
            "the tilts are not as stated, or --tilt-sigma is too small"
        )
    return Relief(found, PixelScale(size, sigma), tuple(notes))


def _rectify(
    pictures: Sequence[AnyImage], masks: Sequence[Mask | None], camera: ScanCamera
) -> tuple[list[AnyImage], list[Mask | None]]:
    """Return rectified pictures of one camera, and their masks, which leave out what was not scanned as well."""
    rectifier = Rectifier("cubic")
    shown: list[Mask | None] = []
    for picture, mask in zip(pictures, masks, strict=True):
        part = np.ones(picture.shape) if mask is None else mask
        rectified = rectifier.rectify(part.astype(np.float32), camera)
        shown.append(np.asarray(rectified, dtype=np.float32) > 0.99)
    return [rectifier.rectify(picture, camera) for picture in pictures], shown


def _slope_deg(frame: RecordedFrame, tilts_rad: Sequence[float]) -> float:
    """Apparent slope of a flat specimen that moves by 1 px, down or up, while the frame is taken."""
    turn = abs(math.tan(tilts_rad[1] - tilts_rad[0]))
    return math.degrees(math.atan(1.0 / (frame.image.shape[0] * turn)))


def _read_tilts(frames: Sequence[RecordedFrame]) -> list[float]:
    tilts = [
        frame.stage.tilt_rad
        for frame in frames
        if frame.stage is not None and frame.stage.tilt_rad is not None
    ]
    if len(tilts) != len(frames):
        raise InvalidValueError(
            f"{counted(len(frames), 'image')} without the tilt of the stage",
            expected="known tilts: without them heights are known only up to a factor",
            do="give --tilts, such as --tilts 0deg,6deg,12deg",
        )
    return tilts
