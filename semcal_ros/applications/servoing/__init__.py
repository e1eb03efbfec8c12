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

"""Visual servoing of the stage: a target for any magnification, its pose, the control law."""

from __future__ import annotations

from semcal_ros.applications.servoing.law import Servo, ServoSettings, ServoStatus, ServoStep
from semcal_ros.applications.servoing.motion import CommandHistory, MotionObserver
from semcal_ros.applications.servoing.plane_camera import (
    AxisObserver,
    PlaneCamera,
    choose_projection,
)
from semcal_ros.applications.servoing.pose import (
    PlanePose,
    PoseFit,
    compute_interaction_matrix,
    fit_pose,
)
from semcal_ros.applications.servoing.target import NestedTarget, TargetView, find_target

__all__ = [
    "AxisObserver",
    "CommandHistory",
    "MotionObserver",
    "NestedTarget",
    "PlaneCamera",
    "PlanePose",
    "PoseFit",
    "Servo",
    "ServoSettings",
    "ServoStatus",
    "ServoStep",
    "TargetView",
    "choose_projection",
    "compute_interaction_matrix",
    "find_target",
    "fit_pose",
]
