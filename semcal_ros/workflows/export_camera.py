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

"""From a calibration to the files of other programs: OpenCV, ROS, mrcal, COLMAP, ImageJ and Fiji, and tables.

Formats: OpenCV ``FileStorage`` in YAML; the calibration files of ROS's ``camera_info_manager``; ``.cameramodel``
of mrcal (its documentation, "Camera model file formats"); ``cameras.txt`` of COLMAP (its documentation, "Output
Format"). COLMAP counts pixels from the corner of the first pixel, the others from its centre. ImageJ
and Fiji take the scale from a macro, and the distortion from a map, which other programs read, too.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tifffile
import yaml

from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.camera.pinhole_model import (
    PinholeModel,
    PlumbBobCamera,
    fit_pinhole,
    fit_plumb_bob,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes, atomic_write_text
from semcal_ros.files.tables import TABLE_SUFFIXES, write_table
from semcal_ros.workflows.describe_camera import parameter_sigma
from semcal_ros.workflows.options import KeywordsOf, Option

#: Formats, and the suffixes of their files.
EXPORT_FORMATS = {
    "opencv": (".yaml", ".yml"),
    "ros": (".yaml", ".yml"),
    "mrcal": (".cameramodel",),
    "colmap": (".txt",),
    "fiji": (".ijm",),
    "csv": TABLE_SUFFIXES,
}
#: Distance from the calibration that a file may have by default, px. Raw cameras of ordinary microscopes are 0.2 to
#: 0.9 px off, and 1.2 px in the worst corner of what the nodes publish. Of the 2 to 4 px of distortion that such a
#: camera has, a file that is further off would leave about half.
LOSSY_PX = 1.5
# Suffixes of parameters that have a unit.
_UNITS = {"m": "_px_per_m", "px": "_px", "py": "_px", "rho": "_1_per_m", "ex": "_px", "ey": "_px"}


@dataclass(frozen=True)
class ExportedCamera:
    """What was written.

    Attributes
    ----------
    paths
        The files.
    worst_px, rms_px
        Largest and RMS distance in px of the model in the file from the calibration, over the image and heights
        within a tenth of the field width; 0 for formats that hold it exactly. The RMS is NaN for the camera
        that ROS nodes state of raw images.
    """

    paths: tuple[Path, ...]
    worst_px: float = 0.0
    rms_px: float = 0.0


@dataclass(frozen=True)
class ExportOptions:
    """Which camera is written, and how near it must be."""

    magnifications: Annotated[
        Sequence[float],
        Option(
            "The camera at this magnification; for csv as often as wanted (default: the calibrated ones).",
            names=("--magnification",),
            repeated=True,
            metavar="G",
        ),
    ] = ()
    rectified: Annotated[
        bool, Option("The camera of rectified images, which every format holds exactly.")
    ] = False
    lossy_px: Annotated[
        float,
        Option(
            "Refuse a format that is further from the calibration than this somewhere in the image.",
            between=(0.0, None),
            metavar="PX",
            python="In px.",
        ),
    ] = LOSSY_PX


@KeywordsOf(ExportOptions)
def export_calibration(
    calibration: Calibration, kind: str, path: str | os.PathLike[str], options: ExportOptions
) -> ExportedCamera:
    """Write a calibration as a file of another program.

    Parameters
    ----------
    calibration
        The calibration.
    kind
        ``"opencv"`` and ``"ros"``: YAML; ``"mrcal"``: ``.cameramodel``; ``"colmap"``: ``cameras.txt``; ``"fiji"``: a
        macro ``.ijm`` that sets the pixel size, and beside it, for raw images, a TIFF with the x and y of the raw
        pixel that each rectified pixel shows; ``"csv"``: a table (``.csv``, ``.parquet``, ``.xlsx``) of all
        parameters and their 1-sigma over the magnification.
    path
        The file to write.

    Raises
    ------
    InvalidValueError
        For an unknown format, a name that contradicts it, the wrong number of magnifications, ``rectified`` for
        a table, or a format that cannot hold the camera to ``lossy_px``; nothing is written then.
    OSError
        If a file cannot be written.
    """
    file = Path(path)
    magnifications, rectified, lossy_px = (
        options.magnifications,
        options.rectified,
        options.lossy_px,
    )
    _check(kind, file, magnifications, rectified=rectified)
    if kind == "csv":
        _write_parameters(calibration, magnifications or calibration.magnifications, file)
        return ExportedCamera((file,))
    raw = calibration.at(float(magnifications[0]))
    camera: ScanCamera = raw.rectified if rectified else raw
    notes = _describe(calibration, camera, rectified=rectified)
    if kind == "fiji":
        return _write_imagej(camera, file, notes, rectified=rectified)
    if kind == "ros" and not rectified:
        # As the nodes state it in the camera_info of raw images, with the rectification that image_proc applies.
        fitted = fit_plumb_bob(raw, raw.width, raw.height)
        if fitted is not None:
            _check_loss(kind, camera, fitted.worst_px, lossy_px)
            notes.append(f"Distance from the calibration: up to {fitted.worst_px:.3g} px.")
            name = _name(camera)
            atomic_write_text(file, format_ros(fitted, (raw.width, raw.height), name, notes))
            return ExportedCamera((file,), fitted.worst_px, float("nan"))
    pinhole = fit_pinhole(camera)
    _check_loss(kind, camera, pinhole.worst_px, lossy_px)
    notes.append(
        f"Distance from the calibration: up to {pinhole.worst_px:.3g} px, RMS {pinhole.rms_px:.3g} px."
    )
    atomic_write_text(file, _format(kind, pinhole, camera, notes))
    return ExportedCamera((file,), pinhole.worst_px, pinhole.rms_px)


def _check(
    kind: str,
    file: Path,
    magnifications: Sequence[float],
    *,
    rectified: bool,
) -> None:
    suffixes = EXPORT_FORMATS.get(kind)
    if suffixes is None:
        raise InvalidValueError(f"format {kind!r}", expected=", ".join(EXPORT_FORMATS))
    if file.suffix.lower() not in suffixes:
        raise InvalidValueError(
            f"{file} for the format {kind}", expected="a name that ends in " + ", ".join(suffixes)
        )
    if kind == "csv":
        if rectified:
            raise InvalidValueError("rectified with the format csv", expected="one of them")
    elif len(magnifications) != 1:
        raise InvalidValueError(
            f"{len(magnifications) or 'no'} magnifications for the format {kind}",
            expected="one: the file holds one camera",
            do="give --magnification once",
        )


def _check_loss(kind: str, camera: ScanCamera, worst_px: float, lossy_px: float) -> None:
    # Also refuses what is no number.
    if not worst_px <= lossy_px:
        raise InvalidValueError(
            f"the format {kind} holds the camera at {camera.magnification:g}x to {worst_px:.2g} px only",
            expected=f"{lossy_px:g} px or better",
            do=f"export the camera of rectified images (--rectified), or allow it (--lossy {_round_up(worst_px):g})",
        )


def _round_up(value_px: float) -> float:
    """To two digits, so that the bound that is proposed holds."""
    step = 10.0 ** (math.floor(math.log10(value_px)) - 1) if 0.0 < value_px < math.inf else 1.0
    return step * math.ceil(value_px / step) if math.isfinite(value_px) else value_px


def _describe(calibration: Calibration, camera: ScanCamera, *, rectified: bool) -> list[str]:
    """Return what a reader of the file should know, in ASCII."""
    x_nm, y_nm = (1e9 * size for size in camera.pixel_size_m)
    notes = [
        f"SEM at magnification {camera.magnification:g}, {'rectified' if rectified else 'raw'} images.",
        f"nm per px in the plane of the calibration: {x_nm:.6g} along x, {y_nm:.6g} along y.",
        "The camera looks along +Z of the sem frame, whose plane Z = 0 is at the translation given.",
    ]
    if camera.rho <= 0.0:
        notes.append("The projection is parallel; a very long focal length stands for it.")
    if not camera.in_range:
        low, high = calibration.magnification_range
        notes.append(f"Outside the calibrated range {low:g} to {high:g}: extrapolated.")
    return notes


def _format(kind: str, pinhole: PinholeModel, camera: ScanCamera, notes: Sequence[str]) -> str:
    if kind == "opencv":
        return format_opencv(pinhole, camera.pixel_size_m, notes)
    if kind == "ros":
        return format_ros(pinhole, (camera.width, camera.height), _name(camera), notes)
    return format_mrcal(pinhole, notes) if kind == "mrcal" else format_colmap(pinhole, notes)


def _name(camera: ScanCamera) -> str:
    return f"sem_{camera.magnification:g}x".replace(".", "_")


def _write_imagej(
    camera: ScanCamera, file: Path, notes: list[str], *, rectified: bool
) -> ExportedCamera:
    paths = [file]
    if not rectified:
        paths.append(file.with_name(f"{file.stem}_map.tif"))
        notes.append(
            f"{paths[1].name}: x and y of the raw pixel that each rectified pixel shows, px."
        )
        data = io.BytesIO()
        tifffile.imwrite(data, compute_raw_map(camera), imagej=True, metadata={"axes": "CYX"})
        atomic_write_bytes(paths[1], data.getvalue())
    atomic_write_text(file, format_macro(camera.pixel_size_m, notes))
    return ExportedCamera(tuple(paths))


def _write_parameters(
    calibration: Calibration, magnifications: Sequence[float], file: Path
) -> None:
    columns = ["magnification", "in_range"]
    columns += [
        f"{prefix}nm_per_px_{axis}" for axis in ("x", "y", "rectified") for prefix in ("", "sigma_")
    ]
    for name in calibration.at(calibration.magnification_range[0]).names:
        full = {"m": "scale"}.get(name, name) + _UNITS.get(name, "")
        columns += [full, f"sigma_{full}"]
    rows = []
    for magnification in magnifications:
        camera = calibration.at(float(magnification))
        row: list[object] = [float(magnification), camera.in_range]
        sizes = [*zip(camera.pixel_size_m, camera.pixel_size_sigma_m, strict=True)]
        sizes.append((camera.rectified.pixel_size_m[0], max(camera.rectified.pixel_size_sigma_m)))
        row += [1e9 * float(value) for pair in sizes for value in pair]
        sigma = parameter_sigma(camera)
        for name, value in zip(camera.names, camera.parameters.tolist(), strict=True):
            row += [value, sigma[name]]
        rows.append(row)
    write_table(file, columns, rows)


def format_opencv(
    camera: PinholeModel, pixel_size_m: tuple[float, float], notes: Sequence[str]
) -> str:
    """Format as YAML for ``cv2.FileStorage``."""
    file = cv2.FileStorage("camera.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for note in notes:
        file.writeComment(note)
    file.write("image_width", camera.width)
    file.write("image_height", camera.height)
    file.write("camera_matrix", camera.matrix)
    file.write("distortion_coefficients", np.asarray(camera.distortion).reshape(1, -1))
    file.write("rotation_vector", np.asarray(camera.rotation).reshape(3, 1))
    file.write("translation_vector", np.asarray(camera.translation_m).reshape(3, 1))
    file.write("pixel_size_m", np.array([pixel_size_m]))
    file.write("largest_difference_px", camera.worst_px)
    file.write("rms_difference_px", camera.rms_px)
    return str(file.releaseAndGetString())


def format_ros(
    camera: PinholeModel | PlumbBobCamera, size: tuple[int, int], name: str, notes: Sequence[str]
) -> str:
    """Format as the calibration file of ``camera_info_manager``, for images of (width, height) ``size``.

    A :class:`.PlumbBobCamera` has the rectification that the nodes state in ``camera_info``; a pinhole model none.
    """
    if isinstance(camera, PlumbBobCamera):
        matrix, distortion = camera.K, camera.D
        rectification, projection = camera.R, camera.P
    else:
        matrix, distortion = camera.matrix, camera.distortion
        rectification, projection = np.eye(3), np.hstack([camera.matrix, np.zeros((3, 1))])
    data = {
        "image_width": size[0],
        "image_height": size[1],
        "camera_name": name,
        "camera_matrix": _table(matrix),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _table(np.asarray(distortion)[None]),
        "rectification_matrix": _table(rectification),
        "projection_matrix": _table(projection),
    }
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100_000)
    return "".join(f"# {note}\n" for note in notes) + str(text)


def _table(values: Array) -> dict[str, object]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(v) for v in values.ravel()]}


def format_mrcal(camera: PinholeModel, notes: Sequence[str]) -> str:
    """Format as ``.cameramodel`` with the model LENSMODEL_OPENCV4, 5 or 8; extrinsics from the sem frame, m."""
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    extrinsics = [*camera.rotation, *camera.translation_m]
    lines = [f"# {note}" for note in notes]
    lines += [
        "{",
        f"    'lensmodel':  'LENSMODEL_OPENCV{len(camera.distortion)}',",
        f"    'extrinsics': [ {', '.join(repr(float(v)) for v in extrinsics)}, ],",
        f"    'intrinsics': [ {', '.join(repr(float(v)) for v in intrinsics)}, ],",
        f"    'imagersize': [ {camera.width}, {camera.height}, ],",
        "}",
    ]
    return "\n".join(lines) + "\n"


def format_colmap(camera: PinholeModel, notes: Sequence[str]) -> str:
    """Format as ``cameras.txt`` with the model OPENCV or FULL_OPENCV."""
    model = "OPENCV" if len(camera.distortion) == 4 else "FULL_OPENCV"
    distortion = np.zeros(4 if model == "OPENCV" else 8)
    distortion[: len(camera.distortion)] = camera.distortion
    values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *distortion]
    numbers = " ".join(repr(float(v)) for v in values)
    lines = [f"# {note}" for note in notes]
    lines += [
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        f"1 {model} {camera.width} {camera.height} {numbers}",
    ]
    return "\n".join(lines) + "\n"


def format_macro(pixel_size_m: tuple[float, float], notes: Sequence[str]) -> str:
    """Format a macro that sets the pixel size of the current image."""
    x_nm, y_nm = (1e9 * size for size in pixel_size_m)
    lines = [f"// {note}" for note in notes]
    lines.append(f'setVoxelSize({x_nm!r}, {y_nm!r}, 1, "nm");')
    return "\n".join(lines) + "\n"


def compute_raw_map(camera: ScanCamera) -> Array32:
    """Compute x and y of the raw pixel that each rectified pixel shows, (2, height, width) px.

    They are NaN where there is none.
    """
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    raw = camera.raw_from_rect(np.stack([x.ravel(), y.ravel()], axis=1))
    shape = (camera.height, camera.width)
    return np.stack([raw[:, k].reshape(shape) for k in (0, 1)]).astype(np.float32)
