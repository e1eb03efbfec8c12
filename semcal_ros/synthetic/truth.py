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

"""The ground truth of a virtual recording, as plain values for a file beside it.

Keys carry their unit; everything is SI or px. The dictionary holds::

    schema              "semcal_ros/truth/1"
    microscope          name of the preset
    specimen            "grid", "gold" or "flat"
    image_width_px, image_height_px, norm_px, display_width_m, databar_rows
    scan                frame_time_s, averages, flyback_fraction
    frames              list, in the order of the recording:
        start_time_s        start of the first pass, after the start of the recording
        magnification
        rotation            (3, 3): X = rotation x + translation_m + drift
        translation_m       (3,)
        square_m            square size, or None without a grid
        drift_m             (2,) at the centre of the acquisition; what lay at X is seen
                            at X + drift
        pixel_size_m        (x, y) true size of an undistorted pixel at the reference plane, in
                            this visit
        visit, visit_scale  number of the visit of the magnification, and the factor with which it
                            came back
        stage, stage_read   tilt, rotation, x, y, z, scan_rotation (rad, m): where the stage was,
                            and what it said; None for a stage that says nothing
    stage               tilt_axis_rad (None for any direction), miss_m (beside the beam, below),
                        height_sigma_m, repeatability, tilt_error_rad, rotation_error_rad,
                        line_jitter_px; None for a perfect one
    grid                stretch, shear, curvature_per_m, wave, wave_squares, and square_errors, a
                        list of square_m and relative error; None for a perfect one
    parameters          list, one entry per magnification, ascending, without the visits' factors:
        magnification, m_px_per_m, aspect, skew, principal_point_px (x, y), rho_per_m, xi_r, xi_t,
        centre_px (x, y), residual_spiral, residual_sine, residual_settling
    residual_sine_cycles, residual_settling_length   shape of the residual, see Residual
"""

from __future__ import annotations

from typing import Any

from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.plans import RecordingPlan

TRUTH_SCHEMA = "semcal_ros/truth/1"


def parameters_of(microscope: VirtualMicroscope, magnification: float) -> dict[str, Any]:
    """Return the true camera parameters at a magnification, as listed above."""
    camera = microscope.camera_at(magnification)
    residual, growth = microscope.residual, microscope.residual_growth(magnification)
    return {
        "magnification": camera.magnification,
        "m_px_per_m": camera.m,
        "aspect": camera.aspect,
        "skew": camera.skew,
        "principal_point_px": [camera.px, camera.py],
        "rho_per_m": camera.rho,
        "xi_r": camera.xi_r,
        "xi_t": camera.xi_t,
        "centre_px": [camera.ex, camera.ey],
        "residual_spiral": growth * residual.spiral,
        "residual_sine": growth * residual.sine,
        "residual_settling": growth * residual.settling,
    }


def truth_of(plan: RecordingPlan) -> dict[str, Any]:
    """Return the truth of a recording as lists, numbers and strings, ready for JSON."""
    microscope = plan.microscope
    magnifications = sorted({frame.magnification for frame in plan.frames})
    return {
        "schema": TRUTH_SCHEMA,
        "microscope": microscope.name,
        "specimen": plan.kind,
        "image_width_px": microscope.width,
        "image_height_px": microscope.height,
        "norm_px": 0.5 * microscope.width,
        "display_width_m": microscope.display_width_m,
        "databar_rows": plan.detector.databar_rows,
        "scan": {
            "frame_time_s": microscope.timing.frame_time_s,
            "averages": microscope.timing.averages,
            "flyback_fraction": microscope.timing.flyback_fraction,
        },
        "frames": [_describe_frame(plan, index) for index in range(len(plan))],
        "parameters": [parameters_of(microscope, g) for g in magnifications],
        "residual_sine_cycles": microscope.residual.sine_cycles,
        "residual_settling_length": microscope.residual.settling_length,
        "stage": _describe_stage(plan),
        "grid": _describe_grid(plan),
    }


def _describe_stage(plan: RecordingPlan) -> dict[str, Any] | None:
    stage = plan.stage
    if stage is None:
        return None
    return {
        "tilt_axis_rad": stage.axis_rad,
        "miss_m": list(stage.miss_m),
        "height_sigma_m": stage.height_sigma_m,
        "repeatability": stage.scale_sigma,
        "tilt_error_rad": stage.tilt_error_rad,
        "rotation_error_rad": stage.rotation_error_rad,
        "line_jitter_px": plan.detector.line_jitter_px,
    }


def _describe_grid(plan: RecordingPlan) -> dict[str, Any] | None:
    grid = plan.grid
    if grid is None:
        return None
    return {
        "stretch": grid.stretch,
        "shear": grid.shear,
        "curvature_per_m": grid.curvature,
        "wave": grid.wave,
        "wave_squares": grid.wave_squares,
        "square_errors": [
            {"square_m": square_m, "error": error}
            for square_m, error in grid.size_errors(plan.seed).items()
        ],
    }


def _describe_frame(plan: RecordingPlan, index: int) -> dict[str, Any]:
    frame = plan.frames[index]
    camera = plan.microscope.during_visit(frame.visit_scale).camera_at(frame.magnification)
    return {
        "start_time_s": frame.start_time_s,
        "magnification": frame.magnification,
        "rotation": frame.pose.R.tolist(),
        "translation_m": frame.pose.t_m.tolist(),
        "square_m": frame.square_m,
        "drift_m": plan.drift_at_centre_m(index).tolist(),
        "pixel_size_m": list(camera.pixel_size_m),
        "visit": frame.visit,
        "visit_scale": frame.visit_scale,
        "stage": None if frame.position is None else frame.position.joints,
        "stage_read": frame.joints,
    }
