"""Visual servoing of the stage: a target that can be found at any magnification, its pose, the control law."""

from __future__ import annotations

from semcal_ros.core.servoing.axis import AxisObserver
from semcal_ros.core.servoing.detection import TargetView, find_target
from semcal_ros.core.servoing.law import Servo, ServoStep
from semcal_ros.core.servoing.motion import CommandHistory, DisturbanceObserver
from semcal_ros.core.servoing.plane_camera import PlaneCamera, projection_of_frame
from semcal_ros.core.servoing.pose import PlanePose, PoseFit, fit_pose, interaction_matrix
from semcal_ros.core.servoing.settings import ServoSettings
from semcal_ros.core.servoing.target import NestedTarget

__all__ = [
    "AxisObserver",
    "CommandHistory",
    "DisturbanceObserver",
    "NestedTarget",
    "PlaneCamera",
    "PlanePose",
    "PoseFit",
    "Servo",
    "ServoSettings",
    "ServoStep",
    "TargetView",
    "find_target",
    "fit_pose",
    "interaction_matrix",
    "projection_of_frame",
]
