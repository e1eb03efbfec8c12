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

"""Shape of a ball that turns in a recording: points, mesh, diameter."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from semcal_ros.applications.reconstruction import (
    Ball,
    SequenceTracker,
    Structure,
    TrackerSettings,
    TrackKeyframe,
    measure_ball,
)
from semcal_ros.applications.reconstruction import reconstruct as reconstruct_structure
from semcal_ros.applications.reconstruction.thresholds import COMMON_MIN
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import check_positive
from semcal_ros.core.wording import counted
from semcal_ros.files.meshes import UNITS_PER_M, save_cloud, save_mesh
from semcal_ros.files.recordings import Recording
from semcal_ros.workflows.follow_drift import GIVE_FRAME_TIME, camera_for, start_time_s
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
from semcal_ros.workflows.options import CONFIG, DASK, FRAME_TIME, PROGRESS, KeywordsOf, Option
from semcal_ros.workflows.workers import open_workers

# A surface that is seen from outside bulges towards the gun nearly everywhere; its mirror image
# nearly nowhere. Below this share the choice between the two is worth a warning.
_CLEAR_CONVEXITY = 0.8
# Sigmas by which the perspective may prefer the mirror image by chance.
_MIRROR_DOUBT = 4.0
# Relative 1-sigma of the depth above which more views are worth their time.
_LARGE_RELIEF_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A structure, and the ball in it.

    Attributes
    ----------
    structure
        Points, poses, and their uncertainty.
    ball
        Sphere, mesh and diameter.
    frame_count
        Number of frames that were read.
    notes
        Notes for the user, including doubts about the result.
    """

    structure: Structure
    ball: Ball
    frame_count: int
    notes: tuple[str, ...]

    def save_mesh(self, path: str | os.PathLike[str], *, unit: str = "nm") -> None:
        """Write the mesh of the ball, ``.ply`` or ``.stl``.

        Raises
        ------
        InvalidValueError
            If the suffix or the unit is not one of these.
        OSError
            If the file cannot be written; an existing one is untouched.
        """
        save_mesh(Path(path), self.ball.mesh, unit=unit)

    def save_cloud(self, path: str | os.PathLike[str], *, unit: str = "nm") -> None:
        """Write all points with normals and 1-sigma to a ``.ply``; raises as :meth:`save_mesh`."""
        normals = self.structure.normals
        columns = {
            "nx": normals[:, 0],
            "ny": normals[:, 1],
            "nz": normals[:, 2],
            "sigma": self.structure.normal_sigma_m * UNITS_PER_M.get(unit, 1.0),
            "on_ball": self.ball.sphere.inliers.astype(float),
        }
        save_cloud(Path(path), self.structure.points_m, columns, unit=unit)

    def summary(self) -> dict[str, Any]:
        """Plain numbers, as ``semcal reconstruct --json`` prints them."""
        structure, ball = self.structure, self.ball
        counts = np.bincount(structure.observations.point, minlength=len(structure.points_m))
        return {
            "frames": self.frame_count,
            "views": len(structure.cameras),
            "points": len(structure.points_m),
            "points_on_ball": int(np.count_nonzero(ball.sphere.inliers)),
            "passes": structure.passes,
            "median_views_per_point": float(np.median(counts)),
            "residual_rms_px": structure.adjustment.rms_px,
            "vertices": len(ball.mesh.vertices_m),
            "faces": len(ball.mesh.faces),
            "watertight": ball.mesh.watertight,
            "coverage": ball.coverage,
            "diameter_m": ball.diameter_m,
            "diameter_sigma_m": ball.sigma_m,
            "diameter_interval_m": list(ball.interval_m),
            "sigma_parts_m": {
                "noise": ball.noise_sigma_m,
                "shape": ball.shape_sigma_m,
                "scale": ball.scale_sigma_m,
                "patches": ball.patch_bias_sigma_m,
            },
            "sphere_rms_m": ball.sphere.rms_m,
            "is_ball": ball.roundness.is_ball,
            "departure": {
                "kind": ball.roundness.kind,
                "height_m": ball.roundness.height_m,
                "height_sigma_m": ball.roundness.height_sigma_m,
                "towards": ball.roundness.towards.tolist(),
                "frame": int(structure.frames[structure.adjustment.reference]),
                "probability": ball.roundness.probability,
            },
            "relief_sigma": structure.relief_sigma,
            "relief_condition": structure.relief_condition,
            "convexity": structure.convexity,
            "mirror_sigma": structure.mirror_sigma,
        }


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """How a ball that turns is followed and measured."""

    calibration: Annotated[
        CalibrationSource,
        Option(
            "Needed for a ball; for tilted images it gives the pixel size and its 1-sigma.",
            kind="path",
            python="A calibration or its file.",
        ),
    ]
    config: Annotated[ConfigSource | None, CONFIG] = None
    frame_time_s: Annotated[float | None, FRAME_TIME] = None
    spacing_px: Annotated[
        float, Option("Least distance of features in px.", between=(3.0, 100.0))
    ] = 5.0
    keyframes: Annotated[
        int,
        Option(
            "Largest number of keyframes used.",
            between=(3, 2000),
            python="They are spread evenly.",
        ),
    ] = 150
    height_sigma_m: Annotated[
        float,
        Option(
            "1-sigma of the height above or below the plane of the calibration.",
            kind="length or 0",
            python="In m.",
        ),
    ] = 10e-6
    dask: Annotated[str | None, DASK] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(ReconstructOptions)
def reconstruct(source: Source, options: ReconstructOptions) -> Reconstruction:
    """Reconstruct a ball that turns: follow features, adjust points and poses, fit and mesh.

    ``source`` is a bag, a folder of SEM TIFF files, or (image, magnification[, time_s]) tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, the views cannot be linked, or
        they show no depth.

    Examples
    --------
    ::

        from semcal_ros import reconstruct
        found = reconstruct("recordings/ball", calibration="jsm820.yaml")
        found.ball.diameter_m, found.ball.interval_m
        found.save_mesh("ball.ply")
    """
    return reconstruct_ball(source, options)


def reconstruct_ball(source: Source, options: ReconstructOptions) -> Reconstruction:
    """As :func:`reconstruct`, for options that are an object already."""
    keyframes, height_sigma_m = options.keyframes, options.height_sigma_m
    on_progress = options.on_progress
    model = require_calibration(options.calibration)
    microscope = resolve_config(options.config, model, options.frame_time_s)
    tracker = SequenceTracker(TrackerSettings(spacing_px=options.spacing_px), keep_images=False)
    check_positive(keyframes, "keyframes =")
    if height_sigma_m != 0.0:
        check_positive(height_sigma_m, "height_sigma_m =")
    with open_workers(options.dask) as workers:
        with open_source(source, microscope, model) as opened:
            outside = _track(opened, model, tracker, on_progress)
            notes = list(opened.notes)
            on_progress("reading keyframes", 0, None)
            shown, empty = _leave_out_empty(tracker.finish())
            notes += empty
            chosen = _read_images(opened, _spread_evenly(shown, keyframes))
        structure = reconstruct_structure(
            chosen,
            microscope.scan,
            on_step=lambda step: on_progress(step, 0, None),
            starmap=workers.starmap,
        )
    on_progress("measuring the ball", 0, None)
    ball = measure_ball(structure, height_sigma_m=height_sigma_m)
    if outside:
        notes.append(f"{counted(outside, 'frame is', 'frames are')} outside the calibrated range")
    if not ball.roundness.is_ball:
        notes.append(describe_departure(structure, ball))
    notes += _list_doubts(structure, microscope.scan is not None)
    return Reconstruction(structure, ball, tracker.frames, tuple(notes))


def _track(
    opened: Recording, model: Calibration, tracker: SequenceTracker, on_progress: OnProgress
) -> int:
    """Track all frames; return how many were outside the calibrated range."""
    first_ns, outside = None, 0
    advance = count_frames(on_progress, "tracking", opened.frame_count)
    for frame in opened.frames():
        first_ns = frame.stamp_ns if first_ns is None else first_ns
        camera = camera_for(frame, model, opened.config)
        outside += not camera.in_range
        grey = to_gray(frame.visible, frame.encoding)
        tracker.add(grey, camera, start_time_s(frame, first_ns, opened.config))
        advance(1)
    return outside


def _leave_out_empty(keyframes: list[TrackKeyframe]) -> tuple[list[TrackKeyframe], list[str]]:
    """Leave out keyframes with too few points to be linked to others, and say so.

    They would take the places of others among the keyframes that are used: a specimen that has left the field makes a
    keyframe of every frame.
    """
    shown = [keyframe for keyframe in keyframes if len(keyframe.ids) >= COMMON_MIN]
    empty = [keyframe.index for keyframe in keyframes if len(keyframe.ids) < COMMON_MIN]
    if not shown or not empty:
        return keyframes, []
    note = (
        f"{counted(len(empty), 'keyframe')} with fewer than {COMMON_MIN} points left out, the first of them frame"
        f" {empty[0] + 1}: was the specimen in view?"
    )
    return shown, [note]


def _spread_evenly(keyframes: list[TrackKeyframe], most: int) -> list[TrackKeyframe]:
    """Choose at most ``most`` keyframes, including the first and the last."""
    if len(keyframes) <= most:
        return keyframes
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, most).round().astype(int))
    return [keyframes[int(k)] for k in chosen]


def _read_images(opened: Recording, keyframes: list[TrackKeyframe]) -> list[TrackKeyframe]:
    """Read the images of keyframes, which would not all fit into memory before they are chosen."""
    wanted = {keyframe.index: number for number, keyframe in enumerate(keyframes)}
    last = max(wanted, default=-1)
    filled = list(keyframes)
    for index, frame in zip(range(last + 1), opened.frames(), strict=False):
        number = wanted.get(index)
        if number is not None:
            image = to_gray(frame.visible, frame.encoding).copy()
            filled[number] = replace(keyframes[number], image=image)
    return filled


def describe_departure(structure: Structure, ball: Ball) -> str:
    """Say how a body departs from a ball: what, how high, where."""
    found = ball.roundness
    x, y, z = found.towards
    frame = int(structure.frames[structure.adjustment.reference])
    from_beam = np.degrees(np.arccos(np.clip(-z, -1.0, 1.0)))
    around = np.degrees(np.arctan2(y, x))
    place = (
        f"{from_beam:.0f} deg from the direction to the gun, towards {around:.0f} deg in the image "
        f"(0 right, 90 down) of frame {frame}"
    )
    size = f"{1e9 * abs(found.height_m):.1f} +- {1e9 * found.height_sigma_m:.1f} nm"
    if found.kind == "ellipsoid":
        what = (
            f"it bulges like an ellipsoid by {size} from its lowest to its highest place, {place}"
        )
    else:
        name = "bump" if found.height_m > 0.0 else "dent"
        what = f"a {name} of {size} lies {place}"
    return (
        f"this is not a ball: {what}; noise alone does so with a probability of "
        f"{found.probability:.0e}. The diameter is that of the best sphere"
    )


def _list_doubts(structure: Structure, timed: bool) -> list[str]:
    notes = []
    if structure.unplaced:
        notes.append(f"{structure.unplaced} keyframes could not be linked to the others")
    if structure.convexity < _CLEAR_CONVEXITY:
        notes.append(
            f"only {structure.convexity:.0%} of the surface bulges towards the gun: it could be "
            "its mirror image"
        )
    if structure.mirror_sigma < -_MIRROR_DOUBT:
        notes.append("the perspective of the camera prefers the mirror image")
    if structure.relief_sigma > _LARGE_RELIEF_SIGMA:
        notes.append(
            f"depth is uncertain by {structure.relief_sigma:.1%} (1-sigma): turn the specimen more"
        )
    if not timed:
        notes.append(
            "the scan timing is not configured: movement within frames is left in; "
            f"{GIVE_FRAME_TIME}"
        )
    if not structure.adjustment.converged:
        notes.append("the adjustment did not converge")
    if not structure.converged:
        notes.append(
            f"measuring did not converge in {structure.passes} passes: the surface still moved by more "
            "than half of its 1-sigma"
        )
    return notes
