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

"""Parameters of ``visual_servo``."""

from __future__ import annotations

import math

from semcal_ros.applications.servoing import PlanePose, ServoSettings
from semcal_ros.nodes.common.parameters import ParameterDeclaration, Parameters

_GOAL = (
    ParameterDeclaration(
        "goal_x_m", 0.0, "Goal of the target in the sem frame, x.", "m", -1e-3, 1e-3
    ),
    ParameterDeclaration(
        "goal_y_m", 0.0, "Goal of the target in the sem frame, y.", "m", -1e-3, 1e-3
    ),
    ParameterDeclaration(
        "goal_rotation_deg", 0.0, "Goal of its rotation.", "degrees", -180.0, 180.0
    ),
)
_LAW = (
    ParameterDeclaration(
        "gain", 1.0, "Fraction of the error that is corrected per second.", "1/s", 0.001, 100.0
    ),
    ParameterDeclaration(
        "speed_limit_um_s", 50.0, "Largest speed of the stage.", "um/s", 1e-3, 1e4
    ),
    ParameterDeclaration(
        "turn_limit_deg_s", 5.0, "Largest speed of the stage's rotation.", "degrees/s", 1e-3, 360.0
    ),
    ParameterDeclaration(
        "travel_limit_px",
        12.0,
        "Largest movement of a marker between two frames, which blurs it.",
        "px",
        0.1,
        1e4,
    ),
    ParameterDeclaration(
        "tolerance_px", 0.5, "Largest error at which the goal counts as reached.", "px", 0.01, 100.0
    ),
    ParameterDeclaration(
        "scale_tolerance",
        0.05,
        "Largest relative error of the target's size against the camera of the frame.",
        low=0.001,
        high=0.5,
    ),
    ParameterDeclaration(
        "axis_sigma_px",
        15.0,
        "1-sigma of the calibrated position of the optical axis, which is corrected by what changes of the"
        " magnification show. 0: it is not corrected.",
        "px",
        0.0,
        1e4,
        fixed=True,
    ),
    ParameterDeclaration(
        "feed_forward", True, "Compensate the drift that remains besides the commands."
    ),
)
_STAGE = (
    ParameterDeclaration("start", False, "Start at once, without ~/start.", fixed=True),
    ParameterDeclaration(
        "stage", "virtual_sem/stage", "Topic of the stage's velocity.", fixed=True
    ),
    ParameterDeclaration(
        "goal_frame",
        "instrument",
        "instrument: the goal is a place under the beam; what was removed from the image as drift is added again."
        " specimen: the goal is a place in the drift-free image, for an actuator that moves the target over it.",
        choices=("instrument", "specimen"),
        fixed=True,
    ),
    ParameterDeclaration(
        "with_drift",
        True,
        "Whether a drift is published with each image, as from stream_corrector; false for images of rectifier.",
        fixed=True,
    ),
    ParameterDeclaration(
        "reset_service",
        "stream_corrector/reset",
        "Service to call when the corrected image has moved too far from what is in view; empty: none.",
        fixed=True,
    ),
    ParameterDeclaration(
        "reset_beyond",
        0.15,
        "It is called when the drift exceeds this fraction of the width.",
        low=0.01,
        high=1.0,
    ),
    ParameterDeclaration(
        "target_cell_m", 180e-6, "Side of a cell of the largest board.", "m", 1e-9, 1.0, fixed=True
    ),
    ParameterDeclaration("height_m", 0.0, "Height of the target along the beam.", "m", -1e-3, 1e-3),
    ParameterDeclaration(
        "rotation_centre_x_m",
        0.0,
        "Where the axis of the stage's rotation meets the target, in the target's frame.",
        "m",
        -1.0,
        1.0,
        fixed=True,
    ),
    ParameterDeclaration(
        "rotation_centre_y_m",
        0.0,
        "Where the axis of the stage's rotation meets the target, in the target's frame.",
        "m",
        -1.0,
        1.0,
        fixed=True,
    ),
)
SERVO_PARAMETERS = (*_GOAL, *_LAW, *_STAGE)


def read_goal(settings: Parameters) -> PlanePose:
    """Read the goal from the parameters."""
    angle_rad = math.radians(settings["goal_rotation_deg"])
    return PlanePose(settings["goal_x_m"], settings["goal_y_m"], angle_rad)


def read_servo_settings(settings: Parameters) -> ServoSettings:
    """Read the settings of the control law from the parameters."""
    return ServoSettings(
        gain_hz=settings["gain"],
        speed_limit_m_s=1e-6 * settings["speed_limit_um_s"],
        turn_limit_rad_s=math.radians(settings["turn_limit_deg_s"]),
        travel_limit_px=settings["travel_limit_px"],
        tolerance_px=settings["tolerance_px"],
        scale_tolerance=settings["scale_tolerance"],
        axis_sigma_px=settings["axis_sigma_px"],
        feed_forward=settings["feed_forward"],
    )
