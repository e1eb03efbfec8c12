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

"""The virtual SEM: recordings and live frames with known ground truth.

It needs :mod:`semcal_ros.core` only: no ROS, no files, no clock. Time and random seeds are
arguments.
"""

from __future__ import annotations

from semcal_ros.synthetic.detector import NOISE_FREE, Detector
from semcal_ros.synthetic.drift import DRIFTS, NO_DRIFT, Drift, drift_preset
from semcal_ros.synthetic.live import LiveFrame, LiveScene, VirtualStage
from semcal_ros.synthetic.microscope import (
    PRESETS,
    Constant,
    Exponential,
    Logistic,
    Residual,
    Saturation,
    VirtualMicroscope,
    conditions_of,
    preset,
)
from semcal_ros.synthetic.plans import (
    CALIBRATION_MAGNIFICATIONS,
    SPECIMEN_KINDS,
    TRUTH_SCHEMA,
    PlannedFrame,
    RecordingPlan,
    calibration_plan,
    drift_plan,
    ladder_plan,
    parameters_of,
    specimen_for,
    steps_plan,
    truth_of,
    zoom_plan,
)
from semcal_ros.synthetic.pose import Pose, random_poses
from semcal_ros.synthetic.render import render_frame, render_reflectivity
from semcal_ros.synthetic.specimens.gold import GoldOnCarbon
from semcal_ros.synthetic.specimens.grid import (
    TYPICAL_GRID,
    ChessGrid,
    FlatSpecimen,
    GridFaults,
    Specimen,
    square_for,
)
from semcal_ros.synthetic.stage import (
    STAGES,
    SimulatedStage,
    StagePosition,
    make_stage,
    pose_at,
    pose_on_stage,
    read_position,
)
from semcal_ros.synthetic.thresholds import (
    SIMULATED_VOLTAGE_V,
    SIMULATED_WORKING_DISTANCE_M,
    SQUARES_M,
)

__all__ = [
    "CALIBRATION_MAGNIFICATIONS",
    "DRIFTS",
    "NOISE_FREE",
    "NO_DRIFT",
    "PRESETS",
    "SIMULATED_VOLTAGE_V",
    "SIMULATED_WORKING_DISTANCE_M",
    "SPECIMEN_KINDS",
    "SQUARES_M",
    "STAGES",
    "TRUTH_SCHEMA",
    "TYPICAL_GRID",
    "ChessGrid",
    "Constant",
    "Detector",
    "Drift",
    "Exponential",
    "FlatSpecimen",
    "GoldOnCarbon",
    "GridFaults",
    "LiveFrame",
    "LiveScene",
    "Logistic",
    "PlannedFrame",
    "Pose",
    "RecordingPlan",
    "Residual",
    "Saturation",
    "SimulatedStage",
    "Specimen",
    "StagePosition",
    "VirtualMicroscope",
    "VirtualStage",
    "calibration_plan",
    "conditions_of",
    "drift_plan",
    "drift_preset",
    "ladder_plan",
    "make_stage",
    "parameters_of",
    "pose_at",
    "pose_on_stage",
    "preset",
    "random_poses",
    "read_position",
    "render_frame",
    "render_reflectivity",
    "specimen_for",
    "square_for",
    "steps_plan",
    "truth_of",
    "zoom_plan",
]
